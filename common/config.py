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
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from common.errors import UsageError
from common.settings import Count, Fraction, NotNegative, Positive, Section
from common.world_config import StartRanges, WorldConfig

Preset = Literal["paper", "fast", "smoke"]
Variant = Literal["navacl-q", "navacl-q-letter", "navacl", "q-only", "schedule", "sfl", "rnd", "e2e"]
Objective = Literal["reconstruction", "semantic"]


class EncoderConfig(Section):
    """The image encoder and its contract with everything that stores or reads codes."""

    kind: Literal["residual", "light"] = "light"
    """`residual` is the paper's (figure of the ResNet blocks); `light` is four times cheaper per frame."""
    frames_per_code: Literal[1, 4] = 1
    """4: one code of the 12-channel stack per step (paper); 1: one code per frame, four stacked by index."""
    channels: tuple[Count, Count, Count, Count] = (16, 32, 64, 4)
    end_to_end: bool = False
    """True trains the encoder with the critic from uint8 frames, from random weights; False freezes it."""
    weights: Annotated[str, Field(min_length=1)] = "fast"
    """Of a frozen encoder: one that is shipped (`fast`, `paper`), `random` at its seeded initialisation, or
    the folder of one that `navaclq pretrain` made."""


class PretrainingConfig(Section):
    """Pre-training of the encoder on frames of random drives (section 3.5)."""

    objective: Objective = "semantic"
    """`reconstruction` is the paper's autoencoder; `semantic` adds what the simulator knows of the dolly."""
    sequences: Count = 50_000
    """Stacks of four frames to learn from; one ends at every frame (section 3.5)."""
    drive_steps: Count = 24
    """Control steps of a drive, unless a contact ends it before (decided)."""
    near_share: Fraction = 0.5
    """Share of drives that start in ranges narrowed towards `curriculum.gate.ranges` (decided)."""
    epochs: Count = 15
    batch_size: Count = 128
    learning_rate: Positive = 1e-3
    """Of Adam, at the start."""
    final_learning_rate: Positive = 1e-5
    """At the end of a cosine (decided)."""
    mask_weight: NotNegative = 0.1
    """Weight of the dolly mask's cross-entropy against the pixels' squared error; `semantic` only."""
    pose_weight: NotNegative = 0.1
    """Weight of visibility, bearing, distance and relative yaw; `semantic` only."""
    mirror: bool = True
    """Whether half of the samples are seen in a mirror (decided)."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    """Of the products; on a CPU with AMX bfloat16 is four times as fast, on an old one slower."""
    probe_drives: Annotated[int, Field(ge=9)] = 900
    """Drives of each of the three sets of frames on which the finished encoder is examined."""


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
    critic_loss: Literal["squared", "huber"] = "squared"
    """`huber` is linear beyond an error of 1."""
    actor_batch: Literal["critic", "uniform"] = "critic"
    """What policy and temperature learn from: the critics' prioritised batch, or a uniform one."""
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
    draw_ahead: Annotated[int, Field(ge=1, le=64)] = 4
    """Batches drawn at one go, which is cheaper; new priorities and episodes count from the next draw on."""
    samples_per_insert: Positive = 64.0
    """Transitions sampled per transition stored after the warm-up: with batches of 128, an update per two."""
    error_buffer: Positive = 10_000.0
    """Samples by which learning may run ahead of that, or lag behind."""
    hold_actors: bool = False
    """Whether actors wait for a learner that lags behind; if not, the lag beyond the band is forgotten."""

    @model_validator(mode="after")
    def _can_begin(self) -> ReplayConfig:
        if 2 * self.warmup_steps > self.capacity:
            raise ValueError(f"warmup_steps must be at most half the capacity of {self.capacity}")
        return self


class LearnerConfig(Section):
    """The learner process."""

    durability: Literal["process", "host"] = "process"
    """What an acknowledged episode survives: the death of the learner, or (fdatasync) that of its host."""
    publish_seconds: Positive = 2.0
    checkpoint_seconds: Positive = 60.0
    snapshot_steps: Count = 25_000
    """Environment steps between kept snapshots of the policy."""
    keep_checkpoints: Count = 3
    threads: Count | Literal["auto"] = "auto"
    """Threads of torch; `auto`: half of the cores, at most four, so that actors beside it are not starved."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where SAC computes; `auto`: on a GPU if there is one. On a GPU it was never run."""


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


class ScheduleConfig(Section):
    """The plain schedule: ranges widen from the gate's to the full ones with the success of their tasks."""

    first_level: Fraction = 0.15
    step: Fraction = 0.06
    """By which the level grows when enough of the last tasks succeeded."""
    window: Count = 50
    threshold: Fraction = 0.65


class SflConfig(Section):
    """Sampling for learnability (Rutherford et al., NeurIPS 2024), for each cell."""

    levels: Count = 24
    """Random tasks that are surveyed."""
    trials: Count = 3
    """Episodes of each in a survey."""
    kept: Count = 8
    """Tasks of highest p (1 - p) that are kept."""
    share: Fraction = 0.5
    """Share of the tasks between two surveys that are taken from the kept ones; the others are random."""
    pause: Count = 100
    """Tasks between two surveys."""


class ParameterConfig(Section):
    """A number that makes up a task of somebody else's environment."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]
    low: float
    high: float
    easy: float
    """Its easiest value, from which gate and narrowed ranges start."""

    @model_validator(mode="after")
    def _ordered(self) -> ParameterConfig:
        if not self.low <= self.easy <= self.high or self.low == self.high:
            raise ValueError(f"{self.name}: low <= easy <= high and low < high must hold")
        return self


GEOMETRIC = (
    "distance",
    "agent_clearance",
    "goal_clearance",
    "relative_angle",
    "lateral_offset",
    "approach_angle",
)
"""Properties of a docking task, the paper's four (table 2) first; see common/tasks.py."""
INPUTS = (*GEOMETRIC, "q")
"""What f_pi may see of a docking task."""


class CurriculumConfig(Section):
    """NavACL-Q (algorithm 1, table of hyper-parameters), its extension NavACL-Q+, and their rivals."""

    algorithm: Literal["navacl-q", "navacl-q+", "rnd", "schedule", "sfl"] = "navacl-q+"
    """`navacl-q+`: frontier at predicted success 0.5, f_pi fitted from a reservoir."""
    inputs: Annotated[tuple[str, ...], Field(min_length=1)] = INPUTS
    """Of f_pi. Without q it is NavACL, with q alone the domain-independent variant (section 5.3)."""
    balanced: bool = False
    """`navacl-q+`: successes and failures are drawn equally often from the reservoir."""
    calibrate: bool = False
    """Predictions are corrected by what became of the last ones (Platt scaling)."""
    calibration_window: Count = 300
    """Outcomes whose predictions are corrected by."""
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
    average: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """f_pi predicts by a running mean of its weights that keeps this share of itself at each gradient step;
    0: by its last weights."""
    random_limit: Fraction = 0.15
    """P(random) = min(random_limit, t / random_steps), t the asking actor's own steps (authors' code)."""
    random_steps: Positive = 20_000.0
    easy_share: Fraction = 0.25
    """Share of easy tasks among those that are not random; the authors' code has a half."""
    narrowed_candidates: Fraction = 0.75
    """Share of candidates drawn from ranges between the gate's and the full ones."""
    narrowed_fades: bool = True
    """That share goes down as random tasks succeed: times the share of an actor's last 100 that failed."""
    store_per_cell: Count = 1000
    lease: Positive = 600.0
    """Seconds after which a task that was handed out and not reported may be proposed again."""
    gate: GateConfig = GateConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    sfl: SflConfig = SflConfig()
    parameters: Annotated[tuple[ParameterConfig, ...], Field(max_length=32)] = ()
    """Of somebody else's environment, whose tasks are boxes of numbers; empty: the docking world's tasks."""

    @field_validator("inputs")
    @classmethod
    def _known(cls, inputs: tuple[str, ...]) -> tuple[str, ...]:
        for name in inputs:
            if name not in INPUTS:
                raise ValueError(f"{name!r} is none of {', '.join(INPUTS)}")
        if len(set(inputs)) < len(inputs):
            raise ValueError("each only once")
        return inputs

    @field_validator("parameters")
    @classmethod
    def _named(cls, parameters: tuple[ParameterConfig, ...]) -> tuple[ParameterConfig, ...]:
        names = [p.name for p in parameters]
        for name in names:
            if name in ("q", "cell") or names.count(name) > 1:
                raise ValueError(f"{name!r} is the name of something else")
        return parameters

    @property
    def uses_q(self) -> bool:
        """Whether tasks are judged by Q(s0, a0), for which actors encode candidate starts."""
        return self.algorithm.startswith("navacl") and "q" in self.inputs and not self.parameters


class Config(Section):
    """A run's complete configuration."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    preset: Preset = "fast"
    variant: Variant = "navacl-q"
    world: WorldConfig = WorldConfig()
    encoder: EncoderConfig = EncoderConfig()
    pretraining: PretrainingConfig = PretrainingConfig()
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
    "e2e": {"encoder": {"end_to_end": True, "weights": "random"}},
    "navacl-q-letter": {
        "curriculum": {
            "algorithm": "navacl-q",
            "inputs": [*GEOMETRIC[:4], "q"],
            "learning_rate": 4e-4,
            "fit_steps": 1,
            "easy_share": 0.5,
            "narrowed_candidates": 0.0,
            "gate": {"enabled": False},
        }
    },
    "navacl": {"curriculum": {"inputs": list(GEOMETRIC[:4])}},
    "q-only": {"curriculum": {"inputs": ["q"]}},
    "schedule": {"curriculum": {"algorithm": "schedule", "gate": {"enabled": False}}},
    "sfl": {"curriculum": {"algorithm": "sfl", "gate": {"enabled": False}}},
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
    merged = Config().model_dump(mode="json")  # or a part of a section would bring back its class's defaults
    for layer in (tomllib.loads(text), VARIANTS[variant], values):
        merged = _merge(merged, layer)
    merged |= {"preset": preset, "variant": variant}
    if seed is not None:
        merged["seed"] = seed
    return override(merged, overrides)


def override(values: dict[str, Any], overrides: tuple[str, ...]) -> Config:
    """`values` with `section.key=value` settings on top, validated."""
    for setting in overrides:
        values = _merge(values, _parse_override(setting))
    return validate(values)


def parse(text: str, sections: tuple[str, ...] = ()) -> Config:
    """A configuration written by `Config.to_toml`, or only these sections of it."""
    try:
        values = tomllib.loads(text)
        return validate({key: values[key] for key in sections if key in values} if sections else values)
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


def differing_keys(
    ours: BaseModel, theirs: BaseModel, within: tuple[str, ...] = ("",)
) -> list[tuple[str, Any, Any]]:
    """The dotted keys, of those that begin with one of `within`, whose values differ, with both values."""

    def walk(x: Any, y: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
        if isinstance(x, dict) and isinstance(y, dict):
            for key in x:
                yield from walk(x[key], y.get(key), f"{path}.{key}" if path else key)
        elif x != y:
            yield path, x, y

    found = walk(ours.model_dump(), theirs.model_dump(), "")
    return [item for item in found if item[0].startswith(within)]


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
