import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from common import policy_files
from common.config import Config
from common.encoders import frozen_encoder, pack_encoder
from common.errors import UsageError
from common.networks import Perception, Policy, load_state, make_encoder, state_of
from common.observation import ObservationLayout
from common.policy_files import finish_saving, load_policy, load_tensors, save_folder
from learner import checkpoint
from learner.checkpoint import RunDirectory
from learner.learner import Learner
from learner.sac import SAC
from tests.helpers import largest_file, small_config, tiny_episode

SETTINGS = ("learner.keep_checkpoints=2", "network.normalize=true")
CONFIG = small_config(*SETTINGS)
FILES = {
    "config.toml",
    "networks.safetensors",
    "optimizers.safetensors",
    "priorities.safetensors",
    "state.json",
}
FIRST = "00000-000000000"

pytestmark = pytest.mark.usefixtures("one_thread")


def frozen(config: Config = CONFIG) -> dict[str, Tensor]:
    return state_of(encoder=frozen_encoder(config))


def filled(config: Config = CONFIG, episodes: int = 2) -> Learner:
    """A learner with a few episodes in its replay, as the log gives them back."""
    learner = Learner(config)
    for i in range(episodes):
        learner.insert(tiny_episode(config, 10, seed=i), 10 * i, restored=True)
    return learner


def saved(run: RunDirectory, updates: int, epoch: int = 1) -> Learner:
    """A learner of `updates` updates, with weights that show it, in a checkpoint."""
    learner = filled(run.config)
    learner.sac.updates = updates
    with torch.no_grad():
        learner.sac.log_alpha.fill_(updates)
    run.save(learner, frozen(run.config), epoch, 10 * updates)
    return learner


def trained(run: RunDirectory, updates: int = 3) -> Learner:
    """A learner that has learned a little, in a checkpoint."""
    learner = filled(run.config)
    for _ in range(updates):
        assert learner.update(20) is not None
    run.save(learner, frozen(run.config), 1, 20)
    return learner


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def state_in(folder: Path) -> dict[str, Any]:
    state: dict[str, Any] = json.loads((folder / "state.json").read_text())
    return state


def same_tensors(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert torch.equal(value, theirs[key]), key


class KilledError(BaseException):
    """Stands for a SIGKILL: nothing catches it."""


@contextmanager
def killed_at(monkeypatch: pytest.MonkeyPatch, place: Any, name: str, call: int = 0) -> Iterator[None]:
    """The process dies in place of the call of that number, counted from 0, of a function."""
    original: Callable[..., Any] = getattr(place, name)
    calls = 0

    def die(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call + 1:
            raise KilledError
        return original(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(place, name, die)
        with pytest.raises(KilledError):
            yield


def test_new_run_has_a_complete_configuration_and_an_identity(tmp_path):
    run = RunDirectory(tmp_path / "runs" / "x", CONFIG)
    assert (run.name, run.config) == ("x", CONFIG)
    assert names(run.folder) == ["config.toml", "encoder.safetensors", "run.json"]
    assert run.folder.joinpath("config.toml").read_text() == CONFIG.to_toml()
    assert run.folder.joinpath("encoder.safetensors").read_bytes() == pack_encoder(make_encoder(CONFIG))
    assert run.encoder == pack_encoder(make_encoder(CONFIG))
    assert json.loads(run.folder.joinpath("run.json").read_text()) == {
        "schema": 4,
        "job": "training",
        "epoch": 0,
    }


def test_run_without_a_checkpoint_restores_nothing(tmp_path):
    learner = filled()
    before = [{k: v.clone() for k, v in part.items()} for part in learner.sac.state()]
    RunDirectory(tmp_path / "x", CONFIG).restore(learner)
    assert learner.sac.updates == 0
    for ours, theirs in zip(learner.sac.state(), before, strict=True):
        same_tensors(ours, theirs)


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


@pytest.mark.parametrize("schema", [2, 99])
def test_run_of_another_schema_is_refused_and_damage_reported(tmp_path, schema):
    identity = RunDirectory(tmp_path / "x", CONFIG).folder / "run.json"
    identity.write_text(json.dumps({"schema": schema, "job": "training", "epoch": 0}))
    said = f"incompatible version: its run schema is {schema}, this version has 4"
    with pytest.raises(UsageError, match=said):
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


@pytest.mark.parametrize("name", ["config.toml", "encoder.safetensors", "checkpoints/1/weights"])
def test_files_of_others_with_our_names_are_left_alone(tmp_path, name):
    (tmp_path / "x" / name).parent.mkdir(parents=True)
    (tmp_path / "x" / name).write_text("mine")
    with pytest.raises(UsageError, match="is not empty and no run directory"):
        RunDirectory(tmp_path / "x", CONFIG)
    assert (tmp_path / "x" / name).read_text() == "mine"


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
    run.release()
    for epoch, config in ((3, None), (4, CONFIG)):
        again = RunDirectory(tmp_path / "x", config)
        assert again.next_epoch() == epoch
        again.release()
    assert names(run.folder) == ["config.toml", "encoder.safetensors", "lock", "run.json"]


def test_folder_belongs_to_one_learner_at_a_time(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    assert run.next_epoch() == 1
    other = RunDirectory(tmp_path / "x")
    with pytest.raises(UsageError, match=r"another learner trains in .*x; stop it first, or choose another"):
        other.next_epoch()
    assert json.loads((run.folder / "run.json").read_text())["epoch"] == 1
    run.release()
    assert other.next_epoch() == 2


def test_folder_that_cannot_be_written_is_a_usage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match=r"cannot write to the run directory .*x: Not a directory"):
        RunDirectory(tmp_path / "file" / "x", CONFIG)
    with largest_file(0), pytest.raises(UsageError, match=r"run directory .*x: File too large"):
        RunDirectory(tmp_path / "x", CONFIG)
    run = RunDirectory(tmp_path / "x", CONFIG)
    with largest_file(0), pytest.raises(UsageError, match=r"run directory .*x: File too large"):
        run.next_epoch()
    assert run.next_epoch() == 1


def test_newest_checkpoints_are_kept_and_the_newest_is_restored(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    for updates in (5, 90, 1000, 20_000):
        saved(run, updates)
    assert names(run.folder / "checkpoints") == ["00001-000001000", "00001-000020000"]
    restored = filled()
    RunDirectory(tmp_path / "x").restore(restored)
    assert restored.sac.updates == 20_000
    assert restored.sac.log_alpha.item() == 20_000
    assert state_in(run.checkpoints()[-1])["env_steps"] == 200_000


def test_checkpoint_of_a_later_start_is_newer_than_one_of_more_updates(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 900, epoch=1)
    saved(run, 70, epoch=2)
    assert [path.name for path in run.checkpoints()] == ["00001-000000900", "00002-000000070"]
    restored = filled()
    run.restore(restored)
    assert restored.sac.updates == 70
    saved(run, 80, epoch=10)
    assert [path.name for path in run.checkpoints()] == ["00002-000000070", "00010-000000080"]


def test_checkpoint_holds_all_that_learns(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    learner = trained(run)
    (folder,) = run.checkpoints()
    assert set(names(folder)) == FILES
    same_tensors(
        {k: v for k, v in load_tensors(folder / "networks.safetensors").items() if k in frozen()}, frozen()
    )
    state = state_in(folder)
    assert (state["updates"], state["env_steps"]) == (3, 20)
    assert state["balance"] == learner.limiter.balance == -3 * CONFIG.sac.batch_size
    restored = filled(CONFIG.model_copy(update={"seed": 5}))
    assert len(set(restored.replay.priorities()[1])) == 1
    run.restore(restored)
    for ours, theirs in zip(learner.sac.state(), restored.sac.state(), strict=True):
        same_tensors(ours, theirs)
    assert len(set(learner.replay.priorities()[1])) > 10
    for ours, theirs in zip(learner.replay.priorities(), restored.replay.priorities(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert restored.limiter.balance == learner.limiter.balance
    assert restored._rng.bit_generator.state == learner._rng.bit_generator.state
    assert restored.update(20) == learner.update(20)


def test_half_written_checkpoint_does_not_count(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    torn = run.folder / "checkpoints" / "00001-000000009.part"
    torn.mkdir()
    (torn / "networks.safetensors").write_bytes(b"torn")
    assert [path.name for path in run.checkpoints()] == ["00001-000000007"]
    restored = filled()
    run.restore(restored)
    assert restored.sac.updates == 7


@pytest.mark.parametrize(
    "file", ["networks.safetensors", "optimizers.safetensors", "priorities.safetensors", "state.json"]
)
@pytest.mark.parametrize("damage", [None, b"", b"[]", b"\x10\x00\x00\x00\x00\x00\x00\x00{}", "cut"])
def test_damaged_checkpoint_is_a_usage_error_that_names_it(tmp_path, file, damage):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    path = run.folder / "checkpoints" / "00001-000000007" / file
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-3] if damage == "cut" else damage)
    said = r"checkpoint .*00001-000000007 does not fit: .*; remove it to use an older one$"
    with pytest.raises(UsageError, match=said):
        run.restore(filled())


@pytest.mark.parametrize(
    ("tensors", "said"),
    [
        ({"steps": torch.arange(20)}, "'weights'"),
        ({"weights": torch.ones(20)}, "'steps'"),
        ({"steps": torch.arange(20), "weights": torch.ones(19)}, r"shape \(19,\) for steps of shape \(20,\)"),
        ({"steps": torch.arange(20), "weights": torch.full((20,), math.nan)}, "finite and not negative"),
        ({"steps": torch.arange(20), "weights": -torch.ones(20)}, "finite and not negative"),
    ],
)
def test_priorities_that_do_not_fit_are_a_usage_error_that_names_the_checkpoint(tmp_path, tensors, said):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    (folder,) = run.checkpoints()
    kept = {name: load_tensors(folder / name) for name in ("networks.safetensors", "optimizers.safetensors")}
    texts = {name: (folder / name).read_text() for name in ("config.toml", "state.json")}
    save_folder(folder, texts, kept | {"priorities.safetensors": tensors})
    with pytest.raises(UsageError, match=f"00001-000000007 does not fit: .*{said}.*; remove it"):
        run.restore(filled())


@pytest.mark.parametrize("key", ["updates", "balance", "generator"])
def test_checkpoint_whose_state_lacks_something_names_it(tmp_path, key):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    file = run.checkpoints()[-1] / "state.json"
    state = json.loads(file.read_text())
    del state[key]
    file.write_text(json.dumps(state))
    with pytest.raises(UsageError, match=f"00001-000000007 does not fit: '{key}'"):
        run.restore(filled())
    file.write_text(json.dumps(state | {key: "x"}))
    with pytest.raises(UsageError, match="00001-000000007 does not fit"):
        run.restore(filled())


def test_checkpoint_of_another_architecture_names_the_tensor(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    with pytest.raises(UsageError, match=r"does not fit: tensor policy\.net\.fusion\.bias .* remove it"):
        run.restore(filled(small_config("network.hidden=[24, 16]", *SETTINGS)))


def policy_of(config: Config, tensors: dict[str, Tensor]) -> Tensor:
    """The greedy action of a stored policy for an observation of ones."""
    policy, perception = Policy(ObservationLayout.of(config), config.network), Perception(config)
    load_state(tensors, policy=policy, perception=perception)
    with torch.no_grad():
        return policy.mode(torch.ones(1, ObservationLayout.of(config).size))


def test_snapshots_and_checkpoints_are_policies_that_evaluation_reads(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    sac = saved(run, 7).sac
    folder = run.snapshot("000000250", sac.policy_state(), {"updates": 7, "env_steps": 250})
    assert folder == run.folder / "snapshots" / "000000250"
    assert state_in(folder) == {"updates": 7, "env_steps": 250}
    expected = sac.policy.mode(torch.ones(1, ObservationLayout.of(CONFIG).size))
    for place in (folder, run.checkpoints()[-1]):
        config, tensors = load_policy(place)
        assert config == CONFIG
        assert torch.equal(policy_of(config, tensors), expected)


def test_snapshots_are_not_cleared_away_with_old_checkpoints(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    for updates in range(5):
        run.snapshot(str(updates), saved(run, updates).sac.policy_state(), {})
    assert names(run.folder / "snapshots") == list("01234")


def test_best_score_is_that_of_the_best_snapshot_and_follows_it(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    assert run.best_score == -math.inf
    run.snapshot("final", {}, {"success_random": 0.9})
    assert run.best_score == -math.inf
    for score in (0.25, 0.5, 0.0):
        run.snapshot("best", {}, {"updates": 3, "success_random": score})
        assert run.best_score == score
    assert RunDirectory(tmp_path / "x").best_score == 0.0


@pytest.mark.parametrize(
    "state",
    [
        None,
        b"",
        b"{",
        b"[]",
        b"3",
        b"{}",
        b"\xff\xfe",
        b'{"success_random": null}',
        b'{"success_random": "high"}',
        b'{"success_random": [0.5]}',
        b'{"success_random": NaN}',
    ],
)
def test_damaged_best_snapshot_is_worth_nothing_so_that_the_next_policy_is_better(tmp_path, state):
    run = RunDirectory(tmp_path / "x", CONFIG)
    file = run.snapshot("best", {}, {"success_random": 0.5}) / "state.json"
    if state is None:
        file.unlink()
    else:
        file.write_bytes(state)
    assert run.best_score == -math.inf


def started_from(tmp_path: Path, source: Path, *overrides: str, name: str = "y") -> RunDirectory:
    """A run of the settings of these tests and `overrides`, which takes its weights from `source`."""
    return RunDirectory(tmp_path / name, small_config(*SETTINGS, *overrides), source=source)


def test_run_from_another_has_its_weights_and_the_rest_of_its_own(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin, 2)
    older = trained(origin, 4)
    run = started_from(tmp_path, origin.folder, "sac.initial_alpha=0.3", "sac.gamma=0.9")
    assert names(run.folder) == ["checkpoints", "config.toml", "encoder.safetensors", "run.json"]
    assert [path.name for path in run.checkpoints()] == [FIRST]
    learner, fresh = Learner(run.config), Learner(run.config)
    run.restore(learner)
    for module in ("perception", "policy", "critic", "target"):
        same_tensors(getattr(learner.sac, module).state_dict(), getattr(older.sac, module).state_dict())
    assert older.sac.perception.normalizer.count > 0
    assert not torch.equal(older.sac.alpha, torch.tensor(CONFIG.sac.initial_alpha))
    assert learner.sac.alpha.item() == pytest.approx(0.3)
    assert set(older.sac.state()[1]) > set(learner.sac.state()[1]) == {"generator"}
    assert torch.equal(learner.sac.state()[1]["generator"], fresh.sac.state()[1]["generator"])
    assert (learner.sac.updates, learner.limiter.balance, learner.replay.transitions) == (0, 0.0, 0)
    assert learner._rng.bit_generator.state == fresh._rng.bit_generator.state


def test_run_from_another_tells_where_its_weights_are_from(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    for name, source in (("y", origin.folder), ("z", origin.checkpoints()[-1])):
        run = started_from(tmp_path, source, name=name)
        assert state_in(run.checkpoints()[0]) == {"from": str(source)}
        assert load_policy(run.checkpoints()[0])[0] == run.config


def test_run_may_begin_from_any_checkpoint_of_another(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    older = trained(origin, 2)
    trained(origin, 5)
    run = started_from(tmp_path, origin.folder / "checkpoints" / "00001-000000002")
    learner = Learner(run.config)
    run.restore(learner)
    same_tensors(learner.sac.critic.state_dict(), older.sac.critic.state_dict())


def test_run_from_another_begins_again_with_these_weights_until_its_first_own_checkpoint(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    older = trained(origin)
    started_from(tmp_path, origin.folder)
    run, learner = RunDirectory(tmp_path / "y"), filled()
    run.restore(learner)
    same_tensors(learner.sac.policy.state_dict(), older.sac.policy.state_dict())
    assert learner.update(20) is not None
    run.save(learner, frozen(), 1, 20)
    assert [path.name for path in run.checkpoints()] == [FIRST, "00001-000000001"]
    again = filled()
    RunDirectory(tmp_path / "y").restore(again)
    for ours, theirs in zip(learner.sac.state(), again.sac.state(), strict=True):
        same_tensors(ours, theirs)
    saved(run, 9)
    assert [path.name for path in run.checkpoints()] == ["00001-000000001", "00001-000000009"]


def test_run_from_another_outlives_it(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    older = trained(origin)
    run = started_from(tmp_path, origin.folder)
    shutil.rmtree(origin.folder)
    learner = filled()
    run.restore(learner)
    same_tensors(learner.sac.policy.state_dict(), older.sac.policy.state_dict())


def test_run_from_an_end_to_end_one_has_its_encoders(tmp_path):
    settings = ("encoder.end_to_end=true", "sac.batch_size=4", "network.normalize=false")
    origin = RunDirectory(tmp_path / "x", small_config(*settings))
    learner = filled(origin.config)
    for _ in range(2):
        learner.update(20)
    origin.save(learner, {}, 1, 20)
    run = started_from(tmp_path, origin.folder, *settings)
    restored = Learner(run.config)
    run.restore(restored)
    for module in ("perception", "target_perception"):
        theirs = getattr(learner.sac, module).state_dict()
        same_tensors(getattr(restored.sac, module).state_dict(), theirs)
        assert any(key.startswith("encoder.") for key in theirs)
    with pytest.raises(UsageError, match=r"another encoder than 'random'|does not fit the configuration"):
        started_from(tmp_path, origin.folder, "network.normalize=false", name="z")


def refused_start(tmp_path: Path, source: Path, said: str, *overrides: str) -> None:
    """The start from `source` ends with `said` and leaves nothing behind."""
    with pytest.raises(UsageError, match=said):
        started_from(tmp_path, source, *overrides)
    assert not (tmp_path / "y").exists()


def test_existing_run_cannot_begin_from_another(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    RunDirectory(tmp_path / "y", CONFIG)
    said = r"y exists; to begin from .*x choose another --run"
    for config in (None, CONFIG):
        with pytest.raises(UsageError, match=said):
            RunDirectory(tmp_path / "y", config, source=origin.folder)
    assert RunDirectory(tmp_path / "y").checkpoints() == []


@pytest.mark.parametrize(
    ("setting", "tensor"),
    [
        ("network.hidden=[24, 16]", r"policy\.net\.fusion\.bias is of shape \(1, 1, 16\)"),
        ("world.lidar.beams=4", r"perception\.normalizer\.mean is of shape"),
        ("network.layer_norm=false", None),
        ("network.history_branch=[4]", r"history_branch\.0\.bias is missing"),
    ],
)
def test_weights_of_another_shape_are_refused_naming_the_tensor(tmp_path, setting, tensor):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    if tensor is None:  # what is asked for has less than the source: there too, none of it may be dropped
        tensor = r"critic\.net\.head\.1\."
    refused_start(tmp_path, origin.folder, f"does not fit the configuration: tensor .*{tensor}", setting)


def test_weights_that_saw_a_normalised_observation_are_refused_where_it_is_not(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    refused_start(tmp_path, origin.folder, r"perception\.normalizer", "network.normalize=false")


def test_weights_that_read_codes_of_another_encoder_are_refused(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    said = "was trained with another encoder than 'random'; set encoder.weights to its folder"
    with pytest.raises(UsageError, match=said):
        RunDirectory(tmp_path / "y", CONFIG.model_copy(update={"seed": 9}), source=origin.folder)
    assert not (tmp_path / "y").exists()


def test_source_without_a_checkpoint_is_refused(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    refused_start(tmp_path, origin.folder, "x has no checkpoint yet")
    refused_start(tmp_path, tmp_path / "absent", r"absent.networks\.safetensors does not exist")
    (tmp_path / "empty").mkdir()
    refused_start(tmp_path, tmp_path / "empty", r"empty.networks\.safetensors does not exist")
    policy = origin.snapshot("final", SAC(CONFIG).policy_state() | frozen(), {})
    refused_start(tmp_path, policy, r"final does not fit the configuration: tensor critic\..* is missing")
    trained(origin)
    (origin.checkpoints()[-1] / "networks.safetensors").write_bytes(b"torn")
    refused_start(tmp_path, origin.folder, r"networks\.safetensors is damaged")


def test_source_of_another_schema_or_job_is_refused(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    identity = origin.folder / "run.json"
    identity.write_text(json.dumps({"schema": 2, "job": "training", "epoch": 1}))
    refused_start(tmp_path, origin.folder, "its run schema is 2, this version has 4")
    identity.write_text(json.dumps({"schema": 4, "job": "pretraining", "epoch": 1}))
    refused_start(tmp_path, origin.folder, "is the folder of a pretraining")


def test_source_is_left_as_it_is_even_while_it_writes_a_checkpoint(tmp_path):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    writing = origin.folder / "checkpoints" / "00001-000000009.part"
    writing.mkdir()
    (writing / "config.toml").write_text("half")
    before = sorted(origin.folder.rglob("*"))
    started_from(tmp_path, origin.folder)
    assert sorted(origin.folder.rglob("*")) == before


STEPS = {
    "before the folder": (Path, "mkdir"),
    "before the configuration": (Path, "write_text"),
    "before the encoder": (Path, "write_bytes"),
    "before the checkpoint": (checkpoint, "save_folder"),
    "in the checkpoint": (policy_files, "save_file"),
    "before the checkpoint has its name": (Path, "rename"),
    "before the identity": (checkpoint, "write_atomically"),
    "before the identity has its name": (Path, "replace"),
}
"""The functions in place of which a start from another run may die."""


@pytest.mark.parametrize("moment", STEPS)
def test_start_that_was_interrupted_can_be_made_again(tmp_path, monkeypatch, moment):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    older = trained(origin)
    with killed_at(monkeypatch, *STEPS[moment]):
        started_from(tmp_path, origin.folder)
    assert not (tmp_path / "y" / "run.json").exists()
    run = started_from(tmp_path, origin.folder)
    assert (run.folder / "config.toml").read_text() == run.config.to_toml()
    assert run.encoder == origin.encoder
    assert [path.name for path in run.checkpoints()] == [FIRST]
    learner = filled()
    RunDirectory(tmp_path / "y").restore(learner)
    same_tensors(learner.sac.policy.state_dict(), older.sac.policy.state_dict())
    assert run.next_epoch() == 1


@pytest.mark.parametrize(("name", "call"), [("write_text", 0), ("write_bytes", 0), ("replace", 0)])
def test_plain_start_that_was_interrupted_can_be_made_again_with_other_settings(
    tmp_path, monkeypatch, name, call
):
    with killed_at(monkeypatch, Path, name, call):
        RunDirectory(tmp_path / "y", CONFIG)
    other = small_config("sac.gamma=0.5", "seed=4")
    run = RunDirectory(tmp_path / "y", other)
    assert RunDirectory(tmp_path / "y").config == other
    assert run.encoder == pack_encoder(make_encoder(other)) != pack_encoder(make_encoder(CONFIG))


def test_start_from_nothing_takes_no_weights_from_an_interrupted_one(tmp_path, monkeypatch):
    origin = RunDirectory(tmp_path / "x", CONFIG)
    trained(origin)
    with killed_at(monkeypatch, Path, "replace"):
        started_from(tmp_path, origin.folder)
    assert (tmp_path / "y" / "checkpoints" / FIRST).is_dir()
    run, learner = RunDirectory(tmp_path / "y", CONFIG), Learner(CONFIG)
    run.restore(learner)
    same_tensors(learner.sac.state()[0], Learner(CONFIG).sac.state()[0])


def version_in(folder: Path) -> int:
    number: int = state_in(folder)["version"]
    return number


def write(folder: Path, version: int) -> None:
    """A folder with files of both kinds that show `version`."""
    tensors = {"networks.safetensors": {"x": torch.full((2,), float(version))}}
    save_folder(folder, {"state.json": json.dumps({"version": version})}, tensors)


KILLS = {
    "before the first rename": (Path, "rename", 0, ["best", "best.part"], 1),
    "between the two renames": (Path, "rename", 1, ["best.old.part", "best.part"], 1),
    "after the second rename": (shutil, "rmtree", 0, ["best", "best.old.part"], 2),
}
"""Where `save_folder` died, the folders that it left, and the version that is to count."""


@pytest.mark.parametrize("moment", KILLS)
def test_folder_that_was_being_replaced_is_whole_again_after_a_kill(tmp_path, monkeypatch, moment):
    place, name, call, left, counts = KILLS[moment]
    parent = tmp_path / "snapshots"
    write(parent / "best", 1)
    write(parent / "other", 7)
    with killed_at(monkeypatch, place, name, call):
        write(parent / "best", 2)
    assert names(parent) == [*left, "other"]
    for _ in range(2):
        finish_saving(parent)
        assert names(parent) == ["best", "other"]
    assert version_in(parent / "best") == counts
    assert load_tensors(parent / "best" / "networks.safetensors")["x"].tolist() == [counts, counts]
    assert version_in(parent / "other") == 7
    write(parent / "best", 3)
    assert version_in(parent / "best") == 3
    assert names(parent) == ["best", "other"]


@pytest.mark.parametrize("moment", KILLS)
def test_folder_can_be_replaced_again_after_a_kill(tmp_path, monkeypatch, moment):
    place, name, call, _, _ = KILLS[moment]
    write(tmp_path / "best", 1)
    with killed_at(monkeypatch, place, name, call):
        write(tmp_path / "best", 2)
    write(tmp_path / "best", 3)
    assert version_in(tmp_path / "best") == 3
    assert names(tmp_path) == ["best"]


def test_nothing_is_finished_where_nothing_is(tmp_path):
    finish_saving(tmp_path / "absent")
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize("moment", KILLS)
@pytest.mark.parametrize("kind", ["checkpoints", "snapshots"])
def test_run_that_is_opened_again_after_a_kill_has_whole_folders_only(tmp_path, monkeypatch, kind, moment):
    place, name, call, _, counts = KILLS[moment]
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    run.snapshot("best", SAC(CONFIG).policy_state(), {"success_random": 1.0})

    def save(version: int) -> None:
        if kind == "snapshots":
            run.snapshot("best", SAC(CONFIG).policy_state(), {"success_random": float(version)})
        else:
            run.save(filled(), {}, 1, version)

    run.save(filled(), {}, 1, 1)  # 0 updates
    with killed_at(monkeypatch, place, name, call):
        save(2)
    again = RunDirectory(tmp_path / "x")
    again.next_epoch()
    assert names(run.folder / "checkpoints") == ["00001-000000000", "00001-000000007"]
    assert names(run.folder / "snapshots") == ["best"]
    if kind == "snapshots":
        assert again.best_score == counts
    else:
        assert state_in(again.checkpoints()[0])["env_steps"] == counts


def test_checkpoint_that_the_disk_does_not_take_is_an_os_error_and_leaves_the_others_whole(tmp_path):
    run = RunDirectory(tmp_path / "x", CONFIG)
    saved(run, 7)
    later = filled()
    later.sac.updates = 8
    size = len(CONFIG.to_toml().encode())
    assert (run.checkpoints()[-1] / "networks.safetensors").stat().st_size > size + 5000
    with largest_file(size + 5000), pytest.raises(OSError, match="too large"):
        run.save(later, {}, 1, 80)
    assert [path.name for path in run.checkpoints()] == ["00001-000000007"]
    restored = filled()
    run.restore(restored)
    assert restored.sac.updates == 7
    run.save(later, {}, 1, 80)
    assert names(run.folder / "checkpoints") == ["00001-000000007", "00001-000000008"]
