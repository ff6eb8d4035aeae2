import pytest
import torch

from common.cells import CELLS
from common.config import override, parse, resolve
from common.contract import (
    accept_contract,
    check_digest,
    digest,
    make_contract,
)
from common.encoders import pack_encoder, unpack_encoder
from common.errors import UsageError
from common.messages import PROTOCOL, ContractReply, MessageError, decode, encode
from common.networks import make_encoder

CONFIG = resolve("smoke", seed=3)
ENCODER = pack_encoder(make_encoder(CONFIG))
ALL_FIELDS = {"protocol", "encoder", "observation", "dynamics", "reward"}


def changed(*overrides: str, blob: bytes = b"weights", base=CONFIG) -> set[str]:
    """Fields of the digest that overrides change, the encoder's weights left as they are."""
    other = override(base.model_dump(mode="json"), overrides)
    before, after = digest(base, b"weights"), digest(other, blob)
    return {field for field in before if before[field] != after[field]}


def test_digest_has_its_five_fields_and_repeats():
    assert set(digest(CONFIG, b"weights")) == ALL_FIELDS
    assert digest(CONFIG, b"weights") == digest(parse(CONFIG.to_toml()), b"weights")


@pytest.mark.parametrize(
    ("setting", "fields"),
    [
        ("world.camera.size=64", {"observation"}),
        ("world.camera.fov=60.0", {"observation"}),
        ("world.lidar.beams=64", {"observation"}),
        ("world.lidar.range=1.5", {"observation"}),
        ("world.lidar.noise=0.01", {"observation"}),
        ("world.lidar.dropout=0.1", {"observation"}),
        ("world.randomization.fixed=['all']", {"observation"}),
        ("world.randomization.training.camera_noise=[0, 1]", {"observation"}),
        ("world.randomization.training.wall_pattern=['plain']", {"observation"}),
        ("encoder.kind=residual", {"observation"}),
        ("encoder.frames_per_code=4", {"observation"}),
        ("encoder.channels=[8,8,8,8]", {"observation"}),
        ("encoder.end_to_end=true", {"observation", "encoder"}),
        ("world.robot.max_speed=1.0", {"dynamics"}),
        ("world.robot.width=0.7", {"dynamics"}),
        ("world.dolly.rail_height=0.2", {"dynamics"}),
        ("world.obstacles.count_max=2", {"dynamics"}),
        ("world.obstacles.size=[0.3, 1.1]", {"dynamics"}),
        ("world.obstacles.clearance=0.5", {"dynamics"}),
        ("world.robot.mounts.camera.z=0.2", {"dynamics"}),
        ("world.control_period=0.1", {"dynamics"}),
        ("world.substeps=18", {"dynamics"}),
        ("world.reward.dolly_contact=-10", {"reward"}),
        ("world.reward.success_distance=0.2", {"reward"}),
        ("world.max_episode_steps=50", {"reward"}),
    ],
)
def test_digest_reacts_to_what_must_agree_in_the_right_field(setting, fields):
    assert changed(setting) == fields


@pytest.mark.parametrize(
    "setting",
    [
        "seed=9",
        "world.max_evaluation_steps=50",
        "world.start.yaw=20",
        "world.start.jitter=1",
        "network.hidden=[16]",
        "sac.gamma=0.5",
        "replay.capacity=5000",
        "learner.threads=2",
        "actor.worlds=1",
        "curriculum.beta=2.0",
    ],
)
def test_digest_ignores_what_each_process_may_choose(setting):
    assert changed(setting) == set()


def test_digest_reacts_to_the_training_cells_and_to_the_worlds_version(monkeypatch):
    before = digest(CONFIG, b"weights")
    with monkeypatch.context() as patch:
        patch.setattr("common.contract.CELLS", CELLS[:-1])
        other_cells = digest(CONFIG, b"weights")
    world = CONFIG.world.model_copy(update={"version": CONFIG.world.version + 1})
    other_version = digest(CONFIG.model_copy(update={"world": world}), b"weights")
    for after in (other_cells, other_version):
        assert {field for field in before if before[field] != after[field]} == {"dynamics"}
    assert digest(CONFIG, b"weights") == before


def test_digest_does_not_change_when_a_cells_walls_have_been_looked_at():
    before = digest(CONFIG, b"weights")
    assert all(cell.solids and cell.walls and cell.edges for cell in CELLS)
    assert digest(CONFIG, b"weights") == before


def test_digest_names_the_protocol_of_the_bus():
    assert digest(CONFIG, b"weights")["protocol"] == str(PROTOCOL)


def test_digest_of_a_frozen_encoder_is_that_of_its_weights():
    assert changed(blob=b"others") == {"encoder"}


def test_digest_of_an_encoder_in_training_does_not_depend_on_its_weights():
    assert changed(blob=b"others", base=resolve("smoke", variant="e2e")) == set()


def test_equal_digests_pass_and_the_first_difference_is_named():
    ours = digest(CONFIG, b"weights")
    check_digest(ours, dict(ours))
    for field in ALL_FIELDS:
        with pytest.raises(
            MessageError, match=f"contract differs in '{field}': this run has {ours[field]}, got x"
        ):
            check_digest(ours, {**ours, field: "x"})
        with pytest.raises(MessageError, match=f"contract differs in '{field}': .* got None"):
            check_digest(ours, {key: value for key, value in ours.items() if key != field})


def test_encoder_arrives_to_the_bit_through_the_contract():
    contract = decode(ContractReply, encode(make_contract("run-1", CONFIG, ENCODER)))
    assert contract.run == "run-1"
    config = accept_contract(contract)
    assert config == CONFIG
    expected, found = make_encoder(CONFIG).state_dict(), unpack_encoder(contract.encoder, config).state_dict()
    assert set(found) == set(expected)
    assert all(torch.equal(found[key], expected[key]) for key in expected)


def test_encoder_comes_from_the_contract_and_not_from_the_seed():
    contract = make_contract("r", CONFIG, ENCODER)
    other = resolve("smoke", seed=CONFIG.seed + 1)
    expected = make_encoder(CONFIG).state_dict()
    found = unpack_encoder(contract.encoder, other).state_dict()
    assert all(torch.equal(found[key], expected[key]) for key in expected)


def test_local_overrides_that_keep_the_contract_are_taken():
    config = accept_contract(
        make_contract("r", CONFIG, ENCODER), ("actor.worlds=7", "world.max_evaluation_steps=9")
    )
    assert config.actor.worlds == 7
    assert config.world.max_evaluation_steps == 9
    assert config.sac == CONFIG.sac


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ("world.robot.max_speed=0.9",),
            "refused by run 'r': dynamics differs: world.robot.max_speed is 0.9 here and 1.2 there",
        ),
        (
            ("seed=8", "world.max_evaluation_steps=7", "world.reward.step=-0.2"),
            "refused by run 'r': reward differs: world.reward.step is -0.2 here and -0.1 there",
        ),
        (
            ("actor.worlds=1", "encoder.channels=[8,8,8,8]"),
            "refused by run 'r': observation differs: "
            "encoder.channels is (8, 8, 8, 8) here and (8, 8, 8, 4) there",
        ),
        (
            ("world.randomization.fixed=['light_azimuth']",),
            "refused by run 'r': observation differs: "
            "world.randomization.fixed is ('light_azimuth',) here and () there",
        ),
        (
            ("actor.worlds=1", "world.randomization.training.light_color=[0.5, 1.0]"),
            "refused by run 'r': observation differs: "
            "world.randomization.training.light_color is (0.5, 1.0) here and (0.85, 1.0) there",
        ),
        (
            ("encoder.end_to_end=true",),
            "refused by run 'r': encoder differs: encoder.end_to_end is True here and False there",
        ),
    ],
)
def test_override_that_breaks_the_contract_is_refused_with_its_key(settings, said):
    with pytest.raises(UsageError) as caught:
        accept_contract(make_contract("r", CONFIG, ENCODER), settings)
    assert str(caught.value) == said


def test_contract_of_another_protocol_is_refused():
    contract = make_contract("r", CONFIG, ENCODER)
    newer = contract.model_copy(update={"digest": {**contract.digest, "protocol": "999"}})
    with pytest.raises(UsageError, match="refused by run 'r': protocol differs"):
        accept_contract(newer)


def test_contract_with_unknown_settings_of_another_version_is_refused():
    contract = make_contract("r", CONFIG, ENCODER)
    newer = contract.model_copy(update={"config": contract.config + "\n[novelty]\nx = 1\n"})
    with pytest.raises(UsageError, match="config key 'novelty' does not exist"):
        accept_contract(newer)


def test_tampered_encoder_weights_are_refused():
    contract = make_contract("r", CONFIG, ENCODER)
    blob = bytearray(contract.encoder)
    blob[-1] ^= 1
    with pytest.raises(UsageError, match="refused by run 'r': encoder differs"):
        accept_contract(contract.model_copy(update={"encoder": bytes(blob)}))


@pytest.mark.parametrize("preset", ["paper", "fast"])
def test_encoder_of_another_shape_is_a_usage_error(preset):
    with pytest.raises(UsageError, match=r"the run's encoder does not fit: tensor encoder\.blocks"):
        unpack_encoder(ENCODER, resolve(preset))


def test_encoder_that_is_no_safetensors_is_a_usage_error():
    contract = make_contract("r", CONFIG, ENCODER).model_copy(update={"encoder": b"junk"})
    with pytest.raises(UsageError, match="the run's encoder does not fit"):
        unpack_encoder(contract.encoder, CONFIG)
