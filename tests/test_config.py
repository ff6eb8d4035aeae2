import math
import re
import tomllib
from functools import reduce
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import (
    GEOMETRIC,
    INPUTS,
    VARIANTS,
    Config,
    Variant,
    differing_keys,
    known_keys,
    override,
    parse,
    resolve,
    validate,
)
from common.errors import UsageError
from common.world_config import (
    TRAINING_FLOORS,
    TRAINING_WALLS,
    LookRanges,
    MountConfig,
    ObstacleConfig,
    Pattern,
    Quantity,
    StartRanges,
    WorldConfig,
)

PRESETS = ("paper", "fast", "smoke")

TASK = {  # facts.md, section 1: the same in every preset
    "world.control_period": 0.180,
    "world.robot.length": 1.273,
    "world.robot.width": 0.630,
    "world.robot.height": 0.300,
    "world.robot.max_speed": 1.2,
    "world.dolly.length": 1.230,
    "world.dolly.width": 0.820,
    "world.dolly.underside": 0.34,
    "world.dolly.leg": 0.040,
    "world.dolly.rail_height": 0.10,
    "world.camera.size": 80,
    "world.camera.fov": 47.0,
    "world.lidar.beams": 128,
    "world.lidar.fov": 225.0,
    "world.lidar.range": 6.0,
    "world.lidar.noise": 0.0,
    "world.lidar.dropout": 0.0,
    "world.robot.mounts.camera": MountConfig(x=0, y=1.273 / 2, z=0.165, yaw=0),
    "world.robot.mounts.front_lidar": MountConfig(x=-0.630 / 2, y=1.273 / 2, z=0.2, yaw=45),
    "world.robot.mounts.rear_lidar": MountConfig(x=0.630 / 2, y=-1.273 / 2, z=0.2, yaw=-135),
    "world.reward.step": -0.1,
    "world.reward.slow": -0.05,
    "world.reward.slow_speed": 0.3,
    "world.reward.dolly_contact": -0.1,
    "world.reward.other_contact": -10.0,
    "world.reward.success": 10.0,
    "world.reward.success_distance": 0.3,
    "world.start.jitter": 0.5,
    "world.start.distance_min": 1.5,
    "world.start.distance_max": 5.0,
    "world.start.yaw": 90.0,
    "world.start.bearing": 15.0,
    "world.start.dolly_yaw": 15.0,
    "world.obstacles.count_min": 1,
    "world.obstacles.count_max": 4,
    "world.obstacles.distance_min": 2.0,
    "world.obstacles.distance_max": 5.0,
    "world.obstacles.spread": 30.0,
    "world.obstacles.size": (0.3, 1.2),
    "world.obstacles.height": (0.4, 1.8),
    "world.obstacles.clearance": 0.4,
    "world.randomization.fixed": (),
    "world.randomization.training.floor_pattern": TRAINING_FLOORS,
    "world.randomization.training.wall_pattern": TRAINING_WALLS,
    "world.randomization.training.light_color": (0.85, 1.0),
    "world.randomization.training.camera_noise": (0.0, 3.0),
    "world.randomization.validation.floor_pattern": ("diagonal",),
    "world.randomization.validation.wall_pattern": ("louvres",),
    "world.randomization.test.floor_pattern": ("herringbone",),
    "world.randomization.test.wall_pattern": ("cladding",),
}
PAPER = {  # facts.md, sections 2 and 3
    "world.max_episode_steps": 100,
    "world.max_evaluation_steps": 200,
    "encoder.kind": "residual",
    "encoder.frames_per_code": 4,
    "encoder.channels": (16, 16, 32, 32),
    "encoder.end_to_end": False,
    "network.lidar_branch": (64, 32),
    "network.history_branch": (8,),
    "network.hidden": (256, 256),
    "network.layer_norm": False,
    "network.normalize": False,
    "sac.gamma": 0.999,
    "sac.learning_rate": 2e-4,
    "sac.batch_size": 64,
    "sac.n_step": 1,
    "sac.critic_loss": "squared",
    "sac.actor_batch": "critic",
    "sac.target": "hard",
    "sac.target_interval": 1000,
    "sac.policy_delay": 1,
    "sac.initial_alpha": 0.2,
    "sac.alpha_floor": 0.0,
    "sac.target_entropy": -2.0,
    "replay.capacity": 2**20,
    "replay.priority_exponent": 0.6,
    "replay.importance_start": 0.4,
    "replay.importance_end": 0.6,
    "replay.importance_steps": 5_000_000,
    "replay.warmup_steps": 15_000,
    "replay.samples_per_insert": 16.0,
    "replay.hold_actors": True,
    "learner.snapshot_steps": 25_000,
    "actor.worlds": 9,
    "actor.refresh": "episode",
    "curriculum.algorithm": "navacl-q",
    "curriculum.inputs": ("distance", "agent_clearance", "goal_clearance", "relative_angle", "q"),
    "curriculum.beta": 1.0,
    "curriculum.gamma": 0.1,
    "curriculum.chi": 0.95,
    "curriculum.max_draws": 100,
    "curriculum.filter_samples": 100,
    "curriculum.batch_size": 16,
    "curriculum.learning_rate": 4e-4,
    "curriculum.hidden": (32, 32),
    "curriculum.fit_steps": 1,
    "curriculum.random_limit": 0.15,
    "curriculum.random_steps": 1e6,
    "curriculum.narrowed_candidates": 0.0,
    "curriculum.gate.enabled": False,
}


def value(config: Config, key: str) -> object:
    return reduce(getattr, key.split("."), config)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_resolves_with_every_variant(preset, variant):
    config = resolve(preset, variant=variant, seed=4)
    assert (config.preset, config.variant, config.seed) == (preset, variant, 4)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("key", TASK)
def test_the_task_is_the_papers_in_every_preset(preset, key):
    assert value(resolve(preset), key) == TASK[key]


@pytest.mark.parametrize("key", PAPER)
def test_paper_preset_has_the_papers_number(key):
    assert value(resolve("paper"), key) == PAPER[key]


def test_fast_is_the_default_and_equals_the_defaults():
    assert resolve() == resolve("fast") == Config()
    assert resolve().curriculum.algorithm == "navacl-q+"
    assert resolve().encoder.frames_per_code == 1


def test_smoke_preset_is_small():
    config = resolve("smoke")
    assert config.world.max_episode_steps <= 20
    assert config.actor.worlds <= 2
    assert config.replay.warmup_steps <= 200


@pytest.mark.parametrize(("preset", "updates"), [("paper", 0.25), ("fast", 0.5), ("smoke", 0.5)])
def test_presets_sample_so_much_per_transition_that_they_make_that_many_updates_of_it(preset, updates):
    config = resolve(preset)
    assert config.replay.samples_per_insert / config.sac.batch_size == updates


def test_only_the_paper_lets_its_actors_wait_for_the_learner():
    assert [resolve(preset).replay.hold_actors for preset in PRESETS] == [True, False, False]


@pytest.mark.parametrize("preset", PRESETS)
def test_an_acknowledged_episode_survives_the_process_unless_more_is_asked_for(preset):
    assert resolve(preset).learner.durability == "process"
    assert resolve(preset, overrides=("learner.durability=host",)).learner.durability == "host"


def test_variants_change_the_curriculum_or_the_encoder():
    rnd, e2e = resolve("paper", variant="rnd"), resolve("paper", variant="e2e")
    assert (rnd.curriculum.algorithm, rnd.curriculum.gate.enabled) == ("rnd", False)
    assert not resolve(variant="rnd").curriculum.gate.enabled
    assert e2e.encoder.end_to_end
    assert e2e.curriculum.algorithm == "navacl-q"
    assert set(VARIANTS) == set(get_args(Variant))


@pytest.mark.parametrize(
    ("variant", "algorithm", "inputs", "gate", "uses_q"),
    [
        ("navacl-q", "navacl-q+", INPUTS, True, True),
        ("navacl-q-letter", "navacl-q", (*GEOMETRIC[:4], "q"), False, True),
        ("navacl", "navacl-q+", GEOMETRIC[:4], True, False),
        ("q-only", "navacl-q+", ("q",), True, True),
        ("schedule", "schedule", INPUTS, False, False),
        ("sfl", "sfl", INPUTS, False, False),
        ("rnd", "rnd", INPUTS, False, False),
        ("e2e", "navacl-q+", INPUTS, True, True),
    ],
)
def test_variant_names_a_curriculum(variant, algorithm, inputs, gate, uses_q):
    found = resolve("fast", variant=variant).curriculum
    assert (found.algorithm, found.inputs, found.gate.enabled) == (algorithm, inputs, gate)
    assert found.uses_q is uses_q, "whether actors encode candidates"


def test_variant_to_the_letter_has_the_curriculum_of_the_paper_preset_but_for_its_pace():
    differing = differing_keys(resolve(variant="navacl-q-letter").curriculum, resolve("paper").curriculum)
    assert [key for key, _, _ in differing] == ["random_steps"]


PARAMETERS = [
    {"name": "wind", "low": -1.0, "high": 8.0, "easy": 0.0},
    {"name": "mass", "low": 1.0, "high": 3.0, "easy": 1.0},
]


def test_parameters_of_another_environment_are_kept_in_order_and_need_no_q():
    config = validate({"curriculum": {"parameters": PARAMETERS}})
    assert [p.model_dump() for p in config.curriculum.parameters] == PARAMETERS
    assert not config.curriculum.uses_q
    assert parse(config.to_toml()) == config


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": "1st"},
        {"name": ""},
        {"name": "a" * 41},
        {"name": "a.b"},
        {"low": 9.0},
        {"easy": 8.5},
        {"easy": -1.5},
        {"low": 8.0, "easy": 8.0},
        {"high": math.inf},
        {"high": math.nan},
        {"step": 1.0},
    ],
)
def test_impossible_parameters_are_usage_errors(wrong):
    with pytest.raises(UsageError, match=r"'curriculum\.parameters\.0"):
        validate({"curriculum": {"parameters": [PARAMETERS[0] | wrong]}})


@pytest.mark.parametrize(
    ("inputs", "said"), [([], "at least 1"), (["q", "q"], "only once"), (["mass"], "'mass' is none of")]
)
def test_impossible_inputs_are_usage_errors(inputs, said):
    with pytest.raises(UsageError, match=rf"'curriculum\.inputs' = .*{said}"):
        validate({"curriculum": {"inputs": inputs}})


def test_later_sources_win(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text("[sac]\nbatch_size = 32\nlearning_rate = 1e-3\n")
    assert resolve("fast").sac.gamma != 0.999
    assert resolve("paper").sac.batch_size == 64
    config = resolve("paper", file, ("sac.learning_rate=0.5",))
    assert config.sac.batch_size == 32
    assert config.sac.learning_rate == 0.5
    assert config.sac.gamma == 0.999


def test_later_overrides_win_and_the_seed_argument_beats_the_file(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text("seed = 5\n")
    assert resolve(file=file).seed == 5
    assert resolve(file=file, seed=6).seed == 6
    assert resolve(file=file, seed=6, overrides=("seed=7", "seed=8")).seed == 8


def test_preset_and_variant_named_in_the_file_apply_and_must_not_contradict_the_command(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text('preset = "paper"\nvariant = "rnd"\n')
    config = resolve(file=file)
    assert (config.preset, config.variant) == ("paper", "rnd")
    assert config.sac.gamma == 0.999
    assert config.curriculum.algorithm == "rnd"
    with pytest.raises(UsageError, match=r"preset = 'paper'.*drop one of them"):
        resolve("smoke", file)


def test_file_of_a_run_resolves_to_the_same_configuration(tmp_path):
    config = resolve("paper", variant="e2e", overrides=("actor.worlds=3",), seed=11)
    file = tmp_path / "config.toml"
    file.write_text(config.to_toml())
    assert resolve(file=file) == config


@pytest.mark.parametrize(
    ("setting", "nearest"),
    [
        ("sac.gama=0.9", "sac.gamma"),
        ("world.robot.lenght=1.0", "world.robot.length"),
        ("replays=3", "replay"),
        ("curriculum.gate.window_=3", "curriculum.gate.window"),
        ("encoder.chanels=[1,2,3,4]", "encoder.channels"),
        ("replay.sample_per_insert=3", "replay.samples_per_insert"),
        ("replay.hold_actor=true", "replay.hold_actors"),
    ],
)
def test_unknown_key_is_named_with_the_nearest_known_one(setting, nearest):
    key = setting.split("=")[0]
    with pytest.raises(UsageError) as caught:
        resolve(overrides=(setting,))
    assert str(caught.value) == f"config key {key!r} does not exist; the nearest key is {nearest!r}"


def test_the_updates_per_step_of_earlier_versions_are_no_key_any_more():
    with pytest.raises(UsageError, match=r"config key 'learner\.updates_per_step' does not exist"):
        resolve(overrides=("learner.updates_per_step=0.5",))


def test_unknown_key_of_a_file_is_refused_too(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text("[actor]\nworld = 3\n")
    with pytest.raises(
        UsageError, match=r"'actor\.world' does not exist; the nearest key is 'actor\.worlds'"
    ):
        resolve(file=file)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("sac.gamma=1.5", r"'sac\.gamma' = 1\.5.*less than 1"),
        ("sac.gamma=nan", r"'sac\.gamma'.*finite number"),
        ("sac.learning_rate=0", r"'sac\.learning_rate' = 0.*greater than 0"),
        ("sac.batch_size=lots", r"'sac\.batch_size' = 'lots'.*integer"),
        ("sac.batch_size=1.5", r"'sac\.batch_size' = 1\.5.*integer"),
        ("sac.target=medium", r"'sac\.target' = 'medium'.*'soft' or 'hard'"),
        ("sac.critic_loss=l1", r"'sac\.critic_loss' = 'l1'.*'squared' or 'huber'"),
        ("sac.actor_batch=both", r"'sac\.actor_batch' = 'both'.*'critic' or 'uniform'"),
        ("replay.samples_per_insert=0", r"'replay\.samples_per_insert' = 0.*greater than 0"),
        ("replay.error_buffer=0", r"'replay\.error_buffer' = 0.*greater than 0"),
        ("replay.error_buffer=inf", r"'replay\.error_buffer' = inf.*finite number"),
        ("replay.hold_actors=maybe", r"'replay\.hold_actors' = 'maybe'.*valid boolean"),
        ("replay.warmup_steps=0", r"'replay\.warmup_steps' = 0.*greater than or equal to 1"),
        ("learner.durability=disk", r"'learner\.durability' = 'disk'.*'process' or 'host'"),
        ("encoder.frames_per_code=2", r"'encoder\.frames_per_code' = 2.*1 or 4"),
        ("encoder.channels=[1,2,3]", r"'encoder\.channels\.3'.*required"),
        ("world.camera.size=81", r"'world\.camera\.size' = 81.*multiple of 16"),
        ("world.start.distance_max=1.0", r"'world\.start'.*distance_min <= distance_max"),
        ("world.start.distance_min=6.0", r"'world\.start'.*distance_min <= distance_max"),
        ("world.start.distance_min=0", r"'world\.start\.distance_min' = 0.*greater than 0"),
        ("world.start.distance_max=21", r"'world\.start\.distance_max' = 21.*less than or equal to 20"),
        ("world.start.jitter=-0.1", r"'world\.start\.jitter' = -0\.1.*greater than or equal to 0"),
        ("world.start.jitter=6", r"'world\.start\.jitter' = 6.*less than or equal to 5"),
        ("world.start.bearing=181", r"'world\.start\.bearing' = 181.*less than or equal to 180"),
        ("world.start.dolly_yaw=-1", r"'world\.start\.dolly_yaw' = -1.*greater than or equal to 0"),
        ("curriculum.gate.ranges.bearing=20", r"'curriculum\.gate\.ranges\.bearing' = 20.*equal to 15"),
        ("world.lidar.noise=-0.1", r"'world\.lidar\.noise' = -0\.1.*greater than or equal to 0"),
        ("world.lidar.dropout=1.1", r"'world\.lidar\.dropout' = 1\.1.*less than or equal to 1"),
        ("world.obstacles.count_min=5", r"'world\.obstacles'.*count_min <= count_max"),
        ("world.obstacles.distance_min=6", r"'world\.obstacles'.*distance_min <= distance_max"),
        ("world.obstacles.count_max=13", r"'world\.obstacles\.count_max' = 13.*less than or equal to 12"),
        ("world.obstacles.spread=91", r"'world\.obstacles\.spread' = 91.*less than or equal to 90"),
        ("world.obstacles.clearance=-1", r"'world\.obstacles\.clearance' = -1.*greater than or equal"),
        ("world.obstacles.size=[1.2, 0.3]", r"'world\.obstacles\.size' = \[1\.2, 0\.3\].*must not be above"),
        ("world.obstacles.height=[2, 1]", r"'world\.obstacles\.height' = \[2, 1\].*must not be above"),
        ("world.obstacles.size=[0, 1]", r"'world\.obstacles' = .*size and height must be positive"),
        ("world.obstacles.size=0.5", r"'world\.obstacles\.size' = 0\.5.*valid tuple"),
        ("world.obstacles.size=[1, 2, 3]", r"'world\.obstacles\.size'.*at most 2 items"),
        (
            "world.randomization.training.light_elevation=[80, 30]",
            r"'world\.randomization\.training\.light_elevation' = \[80, 30\].*must not be above",
        ),
        (
            "world.randomization.test.camera_noise=[1, nan]",
            r"'world\.randomization\.test\.camera_noise\.1' = nan.*finite number",
        ),
        (
            "world.randomization.training.floor_pattern=['slabs', 'marble']",
            r"'world\.randomization\.training\.floor_pattern\.1' = 'marble'.*'concrete', 'slabs'",
        ),
        (
            "world.randomization.validation.wall_pattern=[]",
            r"'world\.randomization\.validation\.wall_pattern' = \[\].*at least 1 item",
        ),
        ("world.randomization.fixed=['sun']", r"world\.randomization\.fixed\.0.* = 'sun'.*'light_azimuth'"),
        ("world.randomization.fixed=all", r"'world\.randomization\.fixed' = 'all'.*valid tuple"),
        ("actor.worlds=0", r"'actor\.worlds' = 0.*greater than or equal to 1"),
        ("sac=3", r"'sac' = 3"),
        ("sac.gamma.x=1", r"'sac\.gamma'.*valid number"),
        ("seed=-1", r"'seed' = -1"),
    ],
)
def test_bad_value_is_named_with_its_key_and_reason(setting, said):
    with pytest.raises(UsageError, match=said):
        resolve(overrides=(setting,))


@pytest.mark.parametrize("setting", ["sac.gamma", "=3", ""])
def test_override_without_key_and_value_is_refused(setting):
    with pytest.raises(UsageError, match=r"must have the form section\.key=value"):
        resolve(overrides=(setting,))


@pytest.mark.parametrize("setting", ["preset=paper", "variant=rnd"])
def test_override_cannot_relabel_the_preset_or_the_variant(setting):
    key, _, name = setting.partition("=")
    with pytest.raises(UsageError, match=f"cannot change the {key}; use --{key} {name}"):
        resolve(overrides=(setting,))


@pytest.mark.parametrize(
    ("setting", "key", "expected"),
    [
        ("sac.target=hard", "sac.target", "hard"),
        ('sac.target="hard"', "sac.target", "hard"),
        ("encoder.end_to_end=true", "encoder.end_to_end", True),
        ("network.lidar_branch=[7, 5]", "network.lidar_branch", (7, 5)),
        ("curriculum.gate={enabled=false, window=5}", "curriculum.gate.window", 5),
        ("world.reward.dolly_contact=-10", "world.reward.dolly_contact", -10.0),
        ("replay.capacity=10_000", "replay.capacity", 10_000),
        ("replay.hold_actors=true", "replay.hold_actors", True),
        ("replay.error_buffer=250", "replay.error_buffer", 250.0),
        ("sac.actor_batch=uniform", "sac.actor_batch", "uniform"),
        ("world.obstacles.size=[0.5, 0.5]", "world.obstacles.size", (0.5, 0.5)),
        ("world.randomization.fixed=['all']", "world.randomization.fixed", ("all",)),
        (
            "world.randomization.fixed=['light_azimuth', 'camera_noise']",
            "world.randomization.fixed",
            ("light_azimuth", "camera_noise"),
        ),
        (
            "world.randomization.training.wall_pattern=['bricks']",
            "world.randomization.training.wall_pattern",
            ("bricks",),
        ),
    ],
)
def test_override_takes_toml_values_and_bare_words(setting, key, expected):
    assert value(resolve(overrides=(setting,)), key) == expected


def test_override_of_one_key_leaves_its_neighbours():
    config = resolve("paper", overrides=("curriculum.gate.window=5",))
    assert config.curriculum.gate.window == 5
    assert not config.curriculum.gate.enabled


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"preset": "papers"}, "preset 'papers' does not exist; choose one of paper, fast, smoke"),
        (
            {"variant": "x"},
            "variant 'x' does not exist; choose one of navacl-q, rnd, e2e, navacl-q-letter, navacl, q-only, "
            "schedule, sfl",
        ),
    ],
)
def test_unknown_preset_and_variant_are_usage_errors(arguments, said):
    with pytest.raises(UsageError) as caught:
        resolve(**arguments)
    assert str(caught.value) == said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = [", "is not TOML"),
        ("variant = [1]", "variant [1] does not exist"),
        ("preset = {a = 1}", "preset {'a': 1} does not exist"),
    ],
)
def test_unusable_file_is_a_usage_error(tmp_path, text, said):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(UsageError) as caught:
        resolve(file=file)
    assert said in str(caught.value)


def test_missing_and_binary_files_are_usage_errors(tmp_path):
    with pytest.raises(UsageError, match=r"cannot read the configuration .*none\.toml: No such file"):
        resolve(file=tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="is not TOML"):
        resolve(file=tmp_path / "binary.toml")


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_toml_round_trip_is_exact_and_complete(preset, variant):
    config = resolve(preset, variant=variant, seed=3)
    assert parse(config.to_toml()) == config
    assert tomllib.loads(config.to_toml()) == config.model_dump(mode="json")


@given(
    st.floats(1e-9, 1 - 1e-9), st.floats(1e-12, 1e6), st.lists(st.integers(1, 999), max_size=4), st.booleans()
)
def test_toml_round_trip_keeps_floats_to_the_bit(gamma, rate, branch, gate):
    config = validate(
        {
            "sac": {"gamma": gamma, "learning_rate": rate},
            "network": {"lidar_branch": branch},
            "curriculum": {"gate": {"enabled": gate}},
        }
    )
    assert parse(config.to_toml()) == config
    assert parse(config.to_toml()).sac.learning_rate == rate


def test_parse_refuses_what_is_not_toml():
    with pytest.raises(UsageError, match="the configuration is not TOML"):
        parse("][")


def test_parse_of_some_sections_leaves_the_others_at_their_defaults():
    config = resolve("paper", overrides=("sac.gamma=0.5", "replay.capacity=50_000"), seed=7)
    found = parse(config.to_toml(), ("seed", "sac"))
    assert (found.seed, found.sac) == (7, config.sac)
    assert found == Config(seed=7, sac=config.sac)
    assert found.replay.capacity != 50_000
    assert parse(config.to_toml(), tuple(Config.model_fields)) == config


def test_parse_of_some_sections_outlives_changes_in_the_others_only():
    text = "[learner]\nupdates_per_step = 0.5\n[encoder]\nkind = 'residual'\n"
    assert parse(text, ("encoder", "world")).encoder.kind == "residual"
    assert parse(text, ("encoder", "world")).world == WorldConfig()
    for sections in ((), ("learner",), ("encoder", "learner")):
        with pytest.raises(UsageError, match=r"'learner\.updates_per_step' does not exist"):
            parse(text, sections)
    with pytest.raises(UsageError, match="the configuration is not TOML"):
        parse("][", ("encoder",))


def test_warm_up_that_fills_more_than_half_the_replay_is_refused():
    assert resolve(overrides=("replay.capacity=4000",)).replay.warmup_steps == 2000
    with pytest.raises(UsageError, match="warmup_steps must be at most half the capacity of 3999"):
        resolve(overrides=("replay.capacity=3999",))


def test_configuration_is_frozen_in_depth():
    config = Config()
    before = config.sac.gamma
    with pytest.raises(ValueError, match="frozen"):
        config.sac.gamma = 0.5
    assert config.sac.gamma == before


def test_override_leaves_the_given_values_alone():
    values = {"sac": {"gamma": 0.5}}
    assert override(values, ("sac.gamma=0.6",)).sac.gamma == 0.6
    assert values == {"sac": {"gamma": 0.5}}


def test_known_keys_are_dotted_and_hold_sections_and_leaves():
    keys = known_keys()
    assert len(keys) == len(set(keys))
    assert {"seed", "world", "world.start.yaw", "curriculum.gate.ranges.dolly_yaw"} <= set(keys)
    assert set(TASK) | set(PAPER) <= set(keys)


def test_differing_keys_come_with_both_values():
    ours, gamma = resolve(overrides=("world.robot.track=0.4", "sac.gamma=0.5")), Config().sac.gamma
    track = ("world.robot.track", 0.4, Config().world.robot.track)
    assert differing_keys(ours, Config()) == [track, ("sac.gamma", 0.5, gamma)]
    assert differing_keys(ours, Config(), ("sac", "replay")) == [("sac.gamma", 0.5, gamma)]
    assert differing_keys(ours, Config(), ("replay",)) == []
    assert differing_keys(Config(), Config()) == []


def test_ranges_refuse_what_means_nothing():
    for bad in ({"distance_min": 0.0}, {"yaw": 181.0}, {"bearing": -1.0}, {"yaw": math.inf}, {"jitter": 5.1}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            StartRanges(**bad)
    assert StartRanges(jitter=5, distance_min=20, distance_max=20, yaw=180, bearing=180, dolly_yaw=180)


def test_ranges_from_their_ends_to_a_single_value_are_taken():
    config = ObstacleConfig(size=(0.1, 0.1), height=(0.2, 3.0), clearance=0.0, count_min=12, count_max=12)
    assert (config.size, config.height) == ((0.1, 0.1), (0.2, 3.0))


def test_arenas_look_as_no_training_cell_does():
    looks = WorldConfig().randomization
    floors = (looks.training.floor_pattern, looks.validation.floor_pattern, looks.test.floor_pattern)
    walls = (looks.training.wall_pattern, looks.validation.wall_pattern, looks.test.wall_pattern)
    for patterns in (floors, walls):
        assert len({name for names in patterns for name in names}) == sum(len(names) for names in patterns)
    unseen = {*looks.validation.floor_pattern, *looks.test.floor_pattern, *walls[1], *walls[2]}
    assert unseen == set(get_args(Pattern)[-4:])
    assert {*floors[0], *walls[0]} == set(get_args(Pattern)[:-4])


def test_every_quantity_that_is_random_can_be_held():
    assert set(get_args(Quantity)) == set(LookRanges.model_fields)
    for name in (*get_args(Quantity), "all"):
        assert resolve(overrides=(f"world.randomization.fixed=['{name}']",)).world.randomization.fixed == (
            name,
        )


@pytest.mark.parametrize("arena", ["validation", "test"])
def test_override_of_an_arenas_look_leaves_its_other_values(arena):
    config = resolve(overrides=(f"world.randomization.{arena}.light_color=[0.5, 0.6]",))
    looks, before = getattr(config.world.randomization, arena), getattr(Config().world.randomization, arena)
    assert looks == before.model_copy(update={"light_color": (0.5, 0.6)})


@pytest.mark.parametrize("mount", ["camera", "front_lidar", "rear_lidar"])
def test_override_of_one_coordinate_of_a_mount_leaves_the_others(mount):
    config = resolve(overrides=(f"world.robot.mounts.{mount}.z=0.25",))
    before = getattr(Config().world.robot.mounts, mount)
    assert getattr(config.world.robot.mounts, mount) == before.model_copy(update={"z": 0.25})


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("world.dolly.width=0.5", "fit between the dolly's legs"),
        ("world.dolly.leg=0.5", "fit between the dolly's legs"),
        ("world.dolly.length=0.05", "fit between the dolly's legs"),
        ("world.robot.floor_gap=0.4", "floor_gap < robot.height < dolly.underside"),
        ("world.robot.height=0.35", "floor_gap < robot.height < dolly.underside"),
        ("world.camera.near=50", "camera.near < camera.far"),
        ("world.robot.length=1.0", "robot.mounts.camera lies outside the chassis"),
        ("world.robot.mounts.rear_lidar.x=0.5", "robot.mounts.rear_lidar lies outside the chassis"),
        ("world.version=3", "world.version"),
    ],
)
def test_a_world_in_which_nobody_can_dock_is_refused_by_its_reason(setting, said):
    with pytest.raises(UsageError, match=re.escape(said)):
        resolve(overrides=(setting,))
