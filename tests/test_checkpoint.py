import json
from pathlib import Path

import pytest
import torch

from common.config import Config
from common.errors import UsageError
from common.networks import Perception, Policy, load_state
from common.observation import ObservationLayout
from common.policy_files import load_policy
from learner.checkpoint import RunDirectory
from learner.sac import SAC
from tests.helpers import small_config

CONFIG = small_config("learner.keep_checkpoints=2", "network.normalize=true")


def saved(run: RunDirectory, updates: int) -> SAC:
    """A learner of `updates` updates, with weights that show it, in a checkpoint."""
    sac = SAC(CONFIG)
    sac.updates = updates
    with torch.no_grad():
        sac.log_alpha.fill_(updates)
    run.save(sac, {"encoder.frozen": torch.ones(3)}, 10 * updates)
    return sac


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_new_run_has_a_complete_configuration_and_an_identity(tmp_path):
    run = RunDirectory(tmp_path / "runs" / "x", CONFIG)
    assert (run.name, run.config) == ("x", CONFIG)
    assert names(run.folder) == ["config.toml", "encoder.safetensors", "run.json"]
    assert run.folder.joinpath("config.toml").read_text() == CONFIG.to_toml()
    assert run.restore(SAC(CONFIG)) == 0


def test_run_is_resumed_with_its_own_configuration_asked_for_or_not(tmp_path):
    RunDirectory(tmp_path / "x", CONFIG)
    assert RunDirectory(tmp_path / "x").config == CONFIG
    assert RunDirectory(tmp_path / "x", CONFIG).config == CONFIG


def test_setting_that_conflicts_with_the_run_is_named(tmp_path):
    RunDirectory(tmp_path / "x", CONFIG)
    other = CONFIG.model_copy(update={"sac": CONFIG.sac.model_copy(update={"gamma": 0.5})})
    with pytest.raises(UsageError, match=r"x exists with sac\.gamma = 0\.98, asked was 0\.5"):
        RunDirectory(tmp_path / "x", other)
    assert RunDirectory(tmp_path / "x").config == CONFIG


def test_run_of_another_schema_is_refused_and_damage_reported(tmp_path):
    identity = RunDirectory(tmp_path / "x", CONFIG).folder / "run.json"
    identity.write_text(json.dumps({"schema": 99, "epoch": 0}))
    with pytest.raises(UsageError, match="incompatible version: its run schema is 99, this version has 2"):
        RunDirectory(tmp_path / "x", CONFIG)
    for damage in ("", "{", "[]", "{}", "3"):
        identity.write_text(damage)
        with pytest.raises(UsageError, match="is damaged"):
            RunDirectory(tmp_path / "x", CONFIG)


def test_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "thesis.tex").write_text("dear")
    with pytest.raises(UsageError, match="is not empty and no run directory"):
        RunDirectory(tmp_path / "x", CONFIG)
    assert names(tmp_path / "x") == ["thesis.tex"]
    with pytest.raises(UsageError, match=r"is no run directory: it has no run\.json"):
        RunDirectory(tmp_path / "x")
    with pytest.raises(UsageError, match=r"is no run directory: it has no run\.json"):
        RunDirectory(tmp_path / "absent")
    assert not (tmp_path / "absent").exists()


def test_folder_that_holds_only_what_the_launcher_puts_there_becomes_a_run(tmp_path):
    for name in ("logs", "spool"):
        (tmp_path / "x" / name).mkdir(parents=True)
    assert RunDirectory(tmp_path / "x", CONFIG).config == CONFIG


@pytest.mark.parametrize("name", ["a b", "a*", "x" * 65, "é"])
def test_name_that_cannot_be_a_key_on_the_bus_is_refused(tmp_path, name):
    with pytest.raises(UsageError, match=r"run name .* may hold letters, digits"):
        RunDirectory(tmp_path / name, CONFIG)


def test_epoch_counts_every_start_and_outlives_the_process(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    assert [run.next_epoch(), run.next_epoch()] == [1, 2]
    assert RunDirectory(tmp_path / "x").next_epoch() == 3
    assert RunDirectory(tmp_path / "x", CONFIG).next_epoch() == 4
    assert names(run.folder) == ["config.toml", "encoder.safetensors", "run.json"]


def test_newest_checkpoints_are_kept_and_the_newest_is_restored(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    for updates in (5, 90, 1000, 20_000):
        saved(run, updates)
    assert names(run.folder / "checkpoints") == ["000001000", "000020000"]
    restored = SAC(CONFIG)
    assert RunDirectory(tmp_path / "x").restore(restored) == 20_000
    assert restored.updates == 20_000
    assert restored.log_alpha.item() == 20_000
    assert json.loads((run.checkpoints()[-1] / "state.json").read_text())["env_steps"] == 200_000


def test_checkpoint_holds_all_that_learns(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    sac = saved(run, 3)
    restored = SAC(CONFIG.model_copy(update={"seed": 5}))
    run.restore(restored)
    for ours, theirs in zip(sac.state(), restored.state(), strict=True):
        assert ours.keys() == theirs.keys()
        for key, value in ours.items():
            assert torch.equal(value, theirs[key]), key


def test_half_written_checkpoint_does_not_count(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    torn = run.folder / "checkpoints" / "000000009.part"
    torn.mkdir()
    (torn / "networks.safetensors").write_bytes(b"torn")
    assert [path.name for path in run.checkpoints()] == ["000000007"]
    assert run.restore(SAC(CONFIG)) == 7


@pytest.mark.parametrize("file", ["networks.safetensors", "optimizers.safetensors", "state.json"])
@pytest.mark.parametrize("damage", [None, b"", b"[]", b"\x10\x00\x00\x00\x00\x00\x00\x00{}", "cut"])
def test_damaged_checkpoint_is_a_usage_error_that_names_it(tmp_path, file, damage):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    path = run.folder / "checkpoints" / "000000007" / file
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-3] if damage == "cut" else damage)
    with pytest.raises(UsageError, match="000000007"):
        run.restore(SAC(CONFIG))


def test_checkpoint_of_another_architecture_names_the_tensor(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    with pytest.raises(UsageError, match=r"does not fit: tensor policy\.net\.head\.0\.weight .* remove it"):
        run.restore(SAC(small_config("network.hidden=[24, 16]", "network.normalize=true")))


def policy_of(config: Config, tensors: dict[str, torch.Tensor]) -> torch.Tensor:
    """The greedy action of a stored policy for an observation of ones."""
    policy, perception = Policy(ObservationLayout.of(config), config.network), Perception(config)
    load_state(tensors, policy=policy, perception=perception)
    with torch.no_grad():
        return policy.mode(torch.ones(1, ObservationLayout.of(config).size))


def test_snapshots_and_checkpoints_are_policies_that_evaluation_reads(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    sac = saved(run, 7)
    folder = run.snapshot("000000250", sac.policy_state(), {"updates": 7, "env_steps": 250})
    assert folder == run.folder / "snapshots" / "000000250"
    assert json.loads((folder / "state.json").read_text()) == {"updates": 7, "env_steps": 250}
    expected = sac.policy.mode(torch.ones(1, ObservationLayout.of(CONFIG).size))
    for place in (folder, run.checkpoints()[-1]):
        config, tensors = load_policy(place)
        assert config == CONFIG
        assert torch.equal(policy_of(config, tensors), expected)


def test_snapshots_are_not_cleared_away_with_old_checkpoints(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    for updates in range(5):
        run.snapshot(str(updates), saved(run, updates).policy_state(), {})
    assert names(run.folder / "snapshots") == list("01234")
