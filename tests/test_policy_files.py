import pytest
import torch

from common.config import resolve
from common.errors import UsageError
from common.policy_files import CONFIG, NETWORKS, load_policy, load_tensors, save_folder

SETTINGS = resolve("paper", seed=7)
TENSORS = {"policy.a": torch.arange(6.0).reshape(2, 3), "critic.b": torch.tensor([1], dtype=torch.int64)}


def save(folder, tensors=TENSORS):
    save_folder(folder, {CONFIG: SETTINGS.to_toml()}, {NETWORKS: tensors})


def test_policy_is_read_back_with_its_configuration(tmp_path):
    save(tmp_path / "runs" / "checkpoint")
    config, tensors = load_policy(tmp_path / "runs" / "checkpoint")
    assert config == SETTINGS
    assert set(tensors) == set(TENSORS)
    assert all(torch.equal(tensors[key], TENSORS[key]) for key in TENSORS)


def test_saving_again_replaces_all_and_leaves_no_temporary_folder(tmp_path):
    save(tmp_path / "best")
    (tmp_path / "best.part").mkdir()
    (tmp_path / "best.part" / "torn").write_text("left by a crash")
    save(tmp_path / "best", {"only": torch.zeros(1)})
    assert set(load_policy(tmp_path / "best")[1]) == {"only"}
    assert [path.name for path in tmp_path.iterdir()] == ["best"]
    assert {path.name for path in (tmp_path / "best").iterdir()} == {CONFIG, NETWORKS}


def test_tensors_that_share_memory_are_saved_both(tmp_path):
    shared = torch.arange(3.0)
    save(tmp_path / "x", {"online": shared, "target": shared})
    assert {key: value.tolist() for key, value in load_policy(tmp_path / "x")[1].items()} == {
        "online": [0, 1, 2],
        "target": [0, 1, 2],
    }


def test_missing_foreign_and_damaged_policies_are_usage_errors(tmp_path):
    with pytest.raises(UsageError, match=r"nothing is no policy: a checkpoint folder with config\.toml"):
        load_policy(tmp_path / "nothing")
    save(tmp_path / "x")
    networks = tmp_path / "x" / NETWORKS
    networks.write_bytes(networks.read_bytes()[:-4])
    with pytest.raises(UsageError, match=r"networks\.safetensors is damaged"):
        load_policy(tmp_path / "x")
    networks.unlink()
    with pytest.raises(UsageError, match=r"networks\.safetensors does not exist"):
        load_tensors(networks)


def test_a_policy_of_another_version_is_named(tmp_path):
    text = SETTINGS.to_toml()
    assert "version = 2\n" in text
    save_folder(tmp_path / "x", {CONFIG: text.replace("version = 2\n", "version = 1\n")}, {NETWORKS: TENSORS})
    with pytest.raises(UsageError, match=r"x was made by another version of navaclq: .*world\.version"):
        load_policy(tmp_path / "x")
