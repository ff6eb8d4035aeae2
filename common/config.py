"""Every number of the project in one typed, frozen configuration.

Resolution order: defaults (= preset `fast`) < preset < TOML file < overrides `section.key=value`. Numbers of
the paper carry their table or section; `decided` marks what the paper leaves open.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import UsageError

Preset = Literal["paper", "fast", "smoke"]
Variant = Literal["navacl-q", "rnd", "e2e"]
Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]


class Section(BaseModel):
    """A group of settings: immutable, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


class StartRanges(Section):
    """Where an episode may start (appendix B, table of randomisation)."""

    distance_min: Positive = 1.5
    """Smallest centre-to-centre distance of robot and dolly, m; below 1.25 the robot starts half under it."""
    distance_max: Positive = 5.0
    """Largest one, m; uniform in between (the paper's RND histogram is flat)."""
    yaw: Annotated[float, Field(ge=0, le=180)] = 90.0
    """Robot yaw is uniform in +- this, degrees."""
    bearing: Annotated[float, Field(ge=0, le=15)] = 15.0
    """Half the central angle of the dolly's circle segment about the cell's +y, degrees."""
    dolly_yaw: Annotated[float, Field(ge=0, le=15)] = 15.0
    """Dolly yaw is uniform in +- this, degrees."""

    @model_validator(mode="after")
    def _ordered(self) -> StartRanges:
        if not self.distance_min <= self.distance_max <= 5.0:
            raise ValueError("distance_min <= distance_max <= 5 m must hold")
        return self

    def towards(self, other: StartRanges, share: float) -> StartRanges:
        """Ranges between these and others: share 0 is these, 1 the others."""
        values = {}
        for key, ours in self.model_dump().items():
            theirs = getattr(other, key)
            between = (1 - share) * ours + share * theirs
            values[key] = min(max(between, min(ours, theirs)), max(ours, theirs))  # rounding may leave them
        return StartRanges(**values)


class RobotConfig(Section):
    """The vehicle (appendix C); drive limits decided."""

    length: Positive = 1.273
    width: Positive = 0.630
    height: Positive = 0.300
    """Top of the chassis above the floor, m."""
    floor_gap: Positive = 0.030
    max_speed: Positive = 1.2
    """Largest speed of either wheel, m/s."""
    track: Positive = 0.500
    """Distance of the two driven wheels, m."""
    wheel_acceleration: Positive = 3.0
    """Largest change of a wheel's speed, m/s^2."""


class DollyConfig(Section):
    """The dolly (appendix C); heights, legs and rails decided."""

    length: Positive = 1.230
    width: Positive = 0.820
    underside: Positive = 0.340
    deck: Positive = 0.060
    """Thickness of the deck, m."""
    leg: Positive = 0.040
    """Side of the square section of a leg and of a rail, m."""
    rail_height: Positive = 0.100
    """Centre line of the side rails above the floor, m."""


class CameraConfig(Section):
    """The front camera (table 1, appendix C)."""

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 80
    """Width and height, pixels."""
    fov: Annotated[float, Field(gt=1, lt=170)] = 47.0
    """Field of view, degrees."""
    near: Positive = 0.02
    far: Positive = 40.0


class LidarConfig(Section):
    """Two LiDARs on diagonal corners, front-left and rear-right (table 1, appendix C)."""

    beams: Annotated[int, Field(ge=2, le=4096)] = 128
    """Beams of each sensor."""
    fov: Annotated[float, Field(gt=0, le=270)] = 225.0
    """Degrees."""
    range: Positive = 6.0
    """Largest distance, m; readings are scaled by it to [0, 1]."""
    height: Positive = 0.200


class RewardConfig(Section):
    """The reward's terms (section 3.3)."""

    step: float = -0.1
    slow: float = -0.05
    slow_speed: float = 0.3
    """Forward speed at the end of the step below which `slow` applies, m/s."""
    dolly_contact: float = -0.1
    other_contact: float = -10.0
    success: float = 10.0
    success_distance: Positive = 0.3
    """Distance of the centres that counts as docked, m."""


class ObstacleConfig(Section):
    """Obstacles left and right of the dolly (appendix B); sizes decided."""

    count_min: Annotated[int, Field(ge=0)] = 1
    count_max: Annotated[int, Field(ge=0, le=8)] = 4
    distance_min: Positive = 2.0
    distance_max: Positive = 5.0

    @model_validator(mode="after")
    def _ordered(self) -> ObstacleConfig:
        if self.count_min > self.count_max or self.distance_min > self.distance_max:
            raise ValueError("count_min <= count_max and distance_min <= distance_max must hold")
        return self


class WorldConfig(Section):
    """The docking task, the same in every preset."""

    control_period: Positive = 0.180
    """Seconds for which an action is held (section 3.3)."""
    substeps: Count = 36
    """Physics steps per control period; contact and success are checked at each."""
    max_episode_steps: Count = 100
    """Training; a truncation, never a terminal (decided)."""
    max_evaluation_steps: Count = 200
    randomize_appearance: bool = True
    """New textures, colours and light in every episode (section 3.3)."""
    robot: RobotConfig = RobotConfig()
    dolly: DollyConfig = DollyConfig()
    camera: CameraConfig = CameraConfig()
    lidar: LidarConfig = LidarConfig()
    reward: RewardConfig = RewardConfig()
    start: StartRanges = StartRanges()
    obstacles: ObstacleConfig = ObstacleConfig()


class EncoderConfig(Section):
    """The image encoder and its contract with everything that stores or reads codes."""

    kind: Literal["residual", "light"] = "light"
    """`residual` is the paper's (figure of the ResNet blocks); `light` is four times cheaper per frame."""
    frames_per_code: Literal[1, 4] = 1
    """4: one code of the 12-channel stack per step (paper); 1: one code per frame, four stacked by index."""
    channels: tuple[Count, Count, Count, Count] = (16, 16, 32, 4)
    end_to_end: bool = False
    """True trains the encoder with the critic from uint8 frames; False freezes it at its seeded start."""


class NetworkConfig(Section):
    """Sensor fusion (figure of the network); an empty branch passes its input through."""

    lidar_branch: tuple[Count, ...] = ()
    history_branch: tuple[Count, ...] = ()
    hidden: tuple[Count, ...] = (256, 256)
    layer_norm: bool = True
    """LayerNorm in the critics (decided for `fast` by measurement)."""
    normalize: bool = False
    """Running normalisation of what the networks see. Off: it brings out the noise in the codes of an
    untrained encoder."""


class SacConfig(Section):
    """Soft actor-critic (section 3.1, table of hyper-parameters)."""

    gamma: Annotated[float, Field(gt=0, lt=1)] = 0.98
    learning_rate: Positive = 3e-4
    batch_size: Count = 128
    n_step: Count = 3
    target: Literal["soft", "hard"] = "soft"
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Smoothing of soft targets."""
    target_interval: Count = 1000
    """Updates between hard copies."""
    policy_delay: Count = 2
    """Critic updates per policy and temperature update."""
    initial_alpha: Positive = 0.1
    """The paper's 0.2 takes minutes to decay; until then the noise alone makes most dockings fail."""
    alpha_floor: Annotated[float, Field(ge=0)] = 0.02
    target_entropy: float = -2.0


class ReplayConfig(Section):
    """Proportional prioritised replay (table of hyper-parameters)."""

    capacity: Count = 2**18
    """Transitions."""
    priority_exponent: Fraction = 0.6
    """c; 0 samples uniformly."""
    importance_start: Fraction = 0.4
    """b_0."""
    importance_end: Fraction = 0.6
    """b_1."""
    importance_steps: Count = 250_000
    """Environment steps over which b goes from b_0 to b_1."""
    warmup_steps: Count = 2_000
    """Transitions stored before the first update."""

    @model_validator(mode="after")
    def _can_begin(self) -> ReplayConfig:
        if 2 * self.warmup_steps > self.capacity:
            raise ValueError(f"warmup_steps must be at most half the capacity of {self.capacity}")
        return self


class LearnerConfig(Section):
    """The learner process."""

    updates_per_step: Positive = 0.5
    """Most SAC updates per environment step beyond the warm-up."""
    publish_seconds: Positive = 2.0
    checkpoint_seconds: Positive = 60.0
    snapshot_steps: Count = 25_000
    """Environment steps between kept snapshots of the policy."""
    keep_checkpoints: Count = 3
    threads: Count = 1
    """Threads of torch."""


class ActorConfig(Section):
    """An actor process."""

    worlds: Annotated[int, Field(ge=1, le=64)] = 9
    """Worlds of a process, one per cell in turn (the paper's nine agents)."""
    uniform_start: bool = True
    """Uniform actions until the first update; they cover more than an untrained policy."""
    refresh: Literal["episode", "step"] = "step"
    """When a world takes newer weights; `episode`: one policy per episode (algorithm 2)."""
    spool_megabytes: Positive = 256.0
    """Episodes waiting on disk for the learner's acknowledgement; a full spool pauses the simulation."""
    task_timeout: Positive = 2.0
    """Seconds to wait for the curriculum before a random task."""
    candidates_at_start: Annotated[int, Field(ge=0, le=1000)] = 100
    """Candidate starts that each world encodes before its first episode; one per episode after that."""


class FavourableRanges(StartRanges):
    """Near and straight, the nearest half under the dolly.

    From 1.5 m, random drives hardly ever end in success, and the agent learns that an early contact is the
    cheapest ending.
    """

    distance_min: Positive = 0.4
    distance_max: Positive = 2.0
    yaw: Annotated[float, Field(ge=0, le=180)] = 10.0
    bearing: Annotated[float, Field(ge=0, le=15)] = 4.0
    dolly_yaw: Annotated[float, Field(ge=0, le=15)] = 4.0


class GateConfig(Section):
    """Favourable starts until they succeed (the cure proposed in section 5.3; ours to define)."""

    enabled: bool = True
    window: Count = 60
    """Outcomes of favourable starts that are judged."""
    threshold: Fraction = 0.65
    """Success among them that opens the gate."""
    ranges: FavourableRanges = FavourableRanges()


class CurriculumConfig(Section):
    """NavACL-Q (algorithm 1, table of hyper-parameters) and its extension NavACL-Q+."""

    algorithm: Literal["navacl-q", "navacl-q+", "rnd"] = "navacl-q+"
    beta: Annotated[float, Field(ge=0)] = 1.0
    gamma: Annotated[float, Field(ge=0)] = 0.1
    chi: Fraction = 0.95
    max_draws: Count = 100
    """n_T."""
    filter_samples: Count = 100
    """Tasks drawn for the normal fit of adaptive filtering (algorithm 2)."""
    batch_size: Count = 16
    """m, fresh outcomes per training of f_pi."""
    learning_rate: Positive = 4e-3
    hidden: tuple[Count, ...] = (32, 32)
    fit_steps: Count = 8
    """Gradient steps per batch of fresh outcomes."""
    fit_batch: Count = 64
    """Outcomes per gradient step, from the reservoir; unused by `navacl-q`, which takes the fresh ones."""
    reservoir: Count = 1500
    random_limit: Fraction = 0.15
    """P(random) = min(random_limit, t / random_steps), t the asking actor's own steps (authors' code)."""
    random_steps: Positive = 20_000.0
    easy_share: Fraction = 0.25
    """Share of easy tasks among those that are not random; the authors' code has a half."""
    narrowed_candidates: Fraction = 0.75
    """Share of candidates drawn from ranges between the gate's and the full ones."""
    store_per_cell: Count = 1000
    gate: GateConfig = GateConfig()


class Config(Section):
    """A run's complete configuration."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    preset: Preset = "fast"
    variant: Variant = "navacl-q"
    world: WorldConfig = WorldConfig()
    encoder: EncoderConfig = EncoderConfig()
    network: NetworkConfig = NetworkConfig()
    sac: SacConfig = SacConfig()
    replay: ReplayConfig = ReplayConfig()
    learner: LearnerConfig = LearnerConfig()
    actor: ActorConfig = ActorConfig()
    curriculum: CurriculumConfig = CurriculumConfig()

    def to_toml(self) -> str:
        """The whole configuration as TOML, readable back by `parse`."""
        return tomli_w.dumps(self.model_dump(mode="json"))


VARIANTS: dict[str, dict[str, Any]] = {
    "navacl-q": {},
    "rnd": {"curriculum": {"algorithm": "rnd", "gate": {"enabled": False}}},
    "e2e": {"encoder": {"end_to_end": True}},
}


def resolve(
    preset: str | None = None,
    file: Path | None = None,
    overrides: tuple[str, ...] = (),
    variant: str | None = None,
    seed: int | None = None,
) -> Config:
    """The configuration of a run; raises UsageError naming the first thing that is wrong."""
    values: dict[str, Any] = _read_toml(file) if file else {}
    for name, asked in (("preset", preset), ("variant", variant)):
        if asked and asked != values.get(name, asked):
            raise UsageError(
                f"{file} says {name} = {values[name]!r}, --{name} says {asked!r}; drop one of them"
            )
    preset = preset or values.get("preset", "fast")
    if preset not in get_args(Preset):
        raise UsageError(f"preset {preset!r} does not exist; choose one of {', '.join(get_args(Preset))}")
    variant = variant or values.get("variant", "navacl-q")
    if variant not in get_args(Variant):
        raise UsageError(f"variant {variant!r} does not exist; choose one of {', '.join(VARIANTS)}")
    text = resources.files("common").joinpath("presets", f"{preset}.toml").read_text("utf-8")
    merged = _merge(_merge(tomllib.loads(text), VARIANTS[variant]), values)
    merged |= {"preset": preset, "variant": variant}
    if seed is not None:
        merged["seed"] = seed
    return override(merged, overrides)


def override(values: dict[str, Any], overrides: tuple[str, ...]) -> Config:
    """`values` with `section.key=value` settings on top, validated."""
    for setting in overrides:
        values = _merge(values, _parse_override(setting))
    return validate(values)


def parse(text: str) -> Config:
    """A configuration written by `Config.to_toml`."""
    try:
        return validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"the configuration is not TOML: {error}") from None


def validate(values: dict[str, Any]) -> Config:
    """Checks keys and values; an unknown key is named together with the nearest known one."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            nearest = difflib.get_close_matches(key, known_keys(), n=1, cutoff=0.0)[0]
            raise UsageError(f"config key {key!r} does not exist; the nearest key is {nearest!r}") from None
        raise UsageError(f"config key {key!r} = {first.get('input')!r}: {first['msg']}") from None


def known_keys() -> list[str]:
    """All keys, dotted, sections included."""

    def walk(model: type[BaseModel], prefix: str) -> list[str]:
        keys = []
        for name, field in model.model_fields.items():
            keys.append(prefix + name)
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
                keys += walk(field.annotation, f"{prefix}{name}.")
        return keys

    return walk(Config, "")


def differing_key(
    ours: BaseModel, theirs: BaseModel, within: tuple[str, ...] = ("",)
) -> tuple[str, Any, Any] | None:
    """The first dotted key, of those that begin with one of `within`, whose values differ, with both values.

    None when all agree.
    """

    def walk(x: Any, y: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
        if isinstance(x, dict) and isinstance(y, dict):
            for key in x:
                yield from walk(x[key], y.get(key), f"{path}.{key}" if path else key)
        elif x != y:
            yield path, x, y

    found = walk(ours.model_dump(), theirs.model_dump(), "")
    return next((item for item in found if item[0].startswith(within)), None)


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text("utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read the configuration {file}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{file} is not TOML: {error}") from None


def _parse_override(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise UsageError(f"--set {text!r} must have the form section.key=value")
    if key in ("preset", "variant"):  # each stands for many values, which a setting would not bring along
        raise UsageError(f"--set cannot change the {key}; use --{key} {value}")
    try:
        parsed = tomllib.loads(f"v = {value}")["v"]
    except tomllib.TOMLDecodeError:
        parsed = value
    for part in reversed(key.split(".")):
        parsed = {part: parsed}
    return dict(parsed)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
