"""Every message on the wire and in the log: typed, versioned, bounded, without pickle.

A message is msgpack of [schema version, type name, fields]. An array is [dtype, shape, raw bytes in C order].
Nothing is trusted on arrival: size, version, type, every field, dtype, shape and finiteness are checked, and
`MessageError` says which of them failed.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainSerializer,
    Tag,
    ValidationError,
)

from common.cells import CELLS
from common.observation import ACTION_SIZE, Columns, ObservationLayout
from common.tasks import TrainingTask

SCHEMA_VERSION = 1
"""Of the encoded messages, those in logs too."""
PROTOCOL = 3
"""Of the bus: its keys, and how messages are delivered."""
MEGABYTE = 2**20
BUNDLE = 64
"""Messages in one delivery at most."""

Ending = Literal["success", "dolly_contact", "other_contact", "timeout"]
ENDINGS: tuple[Ending, ...] = ("success", "dolly_contact", "other_contact", "timeout")
Requested = Literal["easy", "frontier", "random"]
Category = Literal["easy", "frontier", "random", "gate", "rnd", "schedule", "sfl", "unserved"]
"""Why a task was proposed: what was requested, `random` too when n_T draws met nothing, `gate` while the gate
is closed, `rnd` without curriculum; `unserved` when the curriculum did not answer."""
Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+$")]
CellIndex = Annotated[int, Field(ge=0, lt=len(CELLS))]
Address = Annotated[str, Field(max_length=129, pattern=r"^[A-Za-z0-9_.-]{1,64}(/[A-Za-z0-9_.-]{1,64})?$")]
"""GROUP/NAME of a process; the group is the common name of its certificate, or `local`."""
NonNegative = Annotated[int, Field(ge=0)]
Pose = tuple[float, float, float]
"""x and y, m; yaw, rad."""


class MessageError(ValueError):
    """A message that was refused; the text is the reason, safe to send back."""


def _to_array(value: Any) -> NDArray[Any]:
    if isinstance(value, np.ndarray):
        return value
    if not (isinstance(value, list) and len(value) == 3 and isinstance(value[2], bytes)):
        raise ValueError("an array is [dtype, shape, bytes]")
    dtype, shape, raw = value
    if dtype not in ("float16", "float32", "float64", "uint8"):
        raise ValueError(f"dtype {dtype!r} is not allowed")
    if not (
        isinstance(shape, list)
        and 1 <= len(shape) <= 5
        and all(type(n) is int and 0 <= n < 2**31 for n in shape)
    ):
        raise ValueError("a shape is a list of one to five non-negative integers")
    count = 1
    for n in shape:
        count *= n
    if count * np.dtype(dtype).itemsize != len(raw):
        raise ValueError(f"{len(raw)} bytes do not hold {dtype} of shape {shape}")
    array = np.frombuffer(raw, dtype).reshape(shape)
    if array.dtype.kind == "f" and not _is_finite(array):
        raise ValueError("an array holds NaN or infinity")
    return array


def _is_finite(array: NDArray[Any]) -> bool:
    if array.dtype != np.float16 or not array.size:
        return bool(np.isfinite(array).all())
    # Bits of NaN and infinity are above all others of their sign; ten times as fast as numpy's own test.
    return bool(array.view(np.int16).max() < 0x7C00 and array.view(np.uint16).max() < 0xFC00)


def _from_array(array: NDArray[Any]) -> list[Any]:
    return [array.dtype.name, list(array.shape), array.tobytes()]


WireArray = Annotated[np.ndarray, BeforeValidator(_to_array), PlainSerializer(_from_array)]


class Message(BaseModel):
    """Base of all messages; `max_bytes` bounds the encoded size."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    max_bytes: ClassVar[int] = MEGABYTE


def _check_array(name: str, array: NDArray[Any], shape: tuple[int, ...], dtype: str) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise MessageError(f"{name} is {array.dtype} {array.shape}, expected {dtype} {shape}")


class Origin(Message):
    """Who made a message, once and for all: retries carry the same one, so that duplicates are recognised."""

    actor: Address
    boot: Name
    """Fresh for every incarnation of the process."""
    seq: NonNegative


class Version(Message):
    """Version of the weights: the learner's incarnation and its update count; compared in that order."""

    epoch: NonNegative = 0
    counter: NonNegative = 0

    def __lt__(self, other: Version) -> bool:
        return (self.epoch, self.counter) < (other.epoch, other.counter)


Digest = Annotated[dict[str, str], Field(max_length=16)]
"""Short hashes of everything that must agree, by field; see common/contract.py."""


class Episode(Message):
    """A finished episode: T transitions in T + 1 rows (see common/observation.py)."""

    max_bytes: ClassVar[int] = 64 * MEGABYTE

    digest: Digest
    task: TrainingTask
    visual: WireArray
    lidar: WireArray
    action: WireArray
    reward: WireArray
    ending: Ending
    first_version: Version
    last_version: Version
    category: Category

    @property
    def length(self) -> int:
        """T, the number of transitions."""
        return len(self.reward) - 1

    @property
    def truncated(self) -> bool:
        """True when the episode ran out of time: its last step bootstraps."""
        return self.ending == "timeout"

    def columns(self) -> Columns:
        """The rows."""
        return Columns(self.visual, self.lidar, self.action, self.reward)

    def check_layout(self, layout: ObservationLayout, max_steps: int, largest_reward: float) -> None:
        """Raises MessageError unless the rows are those of the layout, and their numbers possible ones."""
        rows = len(self.reward)
        if not 2 <= rows <= max_steps + 1:
            raise MessageError(f"episode of {rows - 1} steps; 1 to {max_steps} are possible")
        expected = {
            "visual": ((rows, *layout.row_shape), layout.row_dtype),
            "lidar": ((rows, layout.lidar), "float16"),
            "action": ((rows, ACTION_SIZE), "float32"),
            "reward": ((rows,), "float32"),
        }
        for name, (shape, dtype) in expected.items():
            _check_array(name, getattr(self, name), shape, dtype)
        if np.abs(self.action).max() > 1.0:
            raise MessageError("action outside [-1, 1]")
        # the bits of what lies in [0, 1] are in order, up to those of 1; float16 compares slowly
        if self.lidar.view(np.uint16).max() > 0x3C00 and (self.lidar.min() < 0.0 or self.lidar.max() > 1.0):
            raise MessageError("lidar outside [0, 1]")
        if np.abs(self.reward).max() > largest_reward * 1.001:  # the sum of its terms, in float32
            raise MessageError(f"reward larger than {largest_reward:g}, the most of the world's terms")


class Frames(Message):
    """A random drive as the camera saw it, for pre-training; see common/frames.py."""

    max_bytes: ClassVar[int] = 64 * MEGABYTE

    digest: Digest
    task: TrainingTask
    frame: WireArray
    mask: WireArray
    goal: WireArray

    def check_layout(self, size: int, most: int) -> None:
        """Raises MessageError unless these are 1 to `most` frames of `size` pixels a side."""
        rows = len(self.frame)
        expected = {
            "frame": ((rows, size, size, 3), "uint8"),
            "mask": ((rows, size * size // 8), "uint8"),
            "goal": ((rows, 3), "float32"),
        }
        if not 1 <= rows <= most:
            raise MessageError(f"drive of {rows} frames; 1 to {most} are possible")
        for name, (shape, dtype) in expected.items():
            _check_array(name, getattr(self, name), shape, dtype)


class TaskQuery(Message):
    """An actor (or anybody) asks for tasks."""

    cell: CellIndex
    t: NonNegative = 0
    """The asking world's own environment steps so far."""
    count: Annotated[int, Field(ge=1, le=1000)] = 1


Parameters = Annotated[dict[Name, float], Field(min_length=1, max_length=32)]
"""A task of somebody else's environment."""


def _kind_of_task(task: Any) -> str:
    return "other task" if isinstance(task, dict) and "cell" not in task else "docking task"


AnyTask = Annotated[
    Annotated[TrainingTask, Tag("docking task")] | Annotated[Parameters, Tag("other task")],
    Discriminator(_kind_of_task),
]
Properties = Annotated[dict[Name, float], Field(max_length=32)]
"""What f_pi may see of a task, by name; m and rad in the docking world."""


class Proposal(Message):
    """One proposed task with everything that led to it."""

    id: Name
    task: AnyTask
    requested: Requested
    category: Category
    why: str
    """The choice in words."""
    properties: Properties
    q: float | None
    """Q(s0, a0) under the weights `q_version`, EPOCH.COUNTER; `q_reason` says where it is from, or not."""
    q_version: str | None
    q_reason: str
    f: float | None
    """Predicted success; mu and sigma are the normal fit to those of the tasks drawn beside it."""
    mu: float | None
    sigma: float | None
    robot: Pose | None
    dolly: Pose | None


class Proposals(Message):
    """The answer to a TaskQuery."""

    max_bytes: ClassVar[int] = 16 * MEGABYTE

    tasks: list[Proposal]


class Outcome(Message):
    """How a task ended, for f_pi; `proposal` makes it idempotent, None: it came from no curriculum."""

    digest: Digest = {}
    proposal: Name | None
    task: AnyTask
    success: bool


class Scored(Message):
    """A task to be scored: itself, or its properties, all that f_pi sees."""

    task: AnyTask | None = None
    properties: Properties | None = None
    q: float | None = None
    """Q(s0, a0), when whoever asks knows it."""


class ScoreQuery(Message):
    """What is the predicted success of these tasks?"""

    tasks: Annotated[list[Scored], Field(min_length=1, max_length=1000)]


class Scores(Message):
    """The answer to a ScoreQuery, task by task."""

    max_bytes: ClassVar[int] = 16 * MEGABYTE

    f: list[float]
    properties: list[Properties]
    outcomes: NonNegative
    """From how many outcomes f_pi has learned."""


class Snapshot(Message):
    """The state of a curriculum."""

    algorithm: str
    outcomes: NonNegative
    candidates: list[NonNegative]
    """In the database, by cell."""
    leases: NonNegative
    gate_open: bool
    proposed: dict[str, NonNegative]
    """Tasks by category."""
    inputs: list[str]
    """Of f_pi; empty when there is none."""
    brier: float | None
    """Mean squared error of the predictions made before each of the last outcomes."""
    reliability: list[tuple[float, float, NonNegative]]
    """The same by tenths of the prediction: mean prediction, share of successes, outcomes."""
    network: bytes
    """f_pi and its scaling, safetensors; empty when there is none."""


class Candidate(Message):
    """A start that an actor has rendered and encoded: one observation row, stacked by replication."""

    task: TrainingTask
    visual: WireArray
    lidar: WireArray


class Candidates(Message):
    """New candidate starts for the task database."""

    max_bytes: ClassVar[int] = 16 * MEGABYTE

    digest: Digest
    candidates: Annotated[list[Candidate], Field(max_length=1000)]


class WeightsBlob(Message):
    """Tensors in safetensors format with their checksum; see common/weights.py."""

    max_bytes: ClassVar[int] = 256 * MEGABYTE

    version: Version
    sha256: str
    blob: bytes


class ContractReply(Message):
    """What a newcomer must know of a run; see common/contract.py."""

    max_bytes: ClassVar[int] = 64 * MEGABYTE

    run: Name
    config: str
    """The resolved configuration, TOML."""
    encoder: bytes
    """Weights of the frozen encoder, safetensors."""
    digest: Digest
    job: Literal["training", "pretraining"] = "training"
    """What actors are wanted for: episodes, or frames."""


class Stat(Message):
    """A process's figures for the live screen, about once a second."""

    max_bytes: ClassVar[int] = 16 * 1024

    role: Name
    group: Name
    name: Name
    host: Annotated[str, Field(max_length=128)]
    pid: NonNegative
    since: float
    """Start of the process, seconds since 1970."""
    code: Annotated[str, Field(max_length=64)]
    """Version of the program; see common/version.py."""
    protocol: NonNegative
    values: Annotated[dict[str, float | int | str], Field(max_length=96)]


class Receipt(Message):
    """What became of each message of a delivery, in order: empty if the receiver has it, else why."""

    answers: Annotated[list[Annotated[str, Field(max_length=400)]], Field(max_length=BUNDLE)]


class Nothing(Message):
    """An empty question."""


M = TypeVar("M", bound=Message)


def encode(message: Message) -> bytes:
    """The message as bytes; raises MessageError when it is larger than its type allows."""
    fields = message.model_dump(mode="python")
    data: bytes = msgpack.packb([SCHEMA_VERSION, type(message).__name__, fields], use_bin_type=True)
    _check_size(type(message), len(data))
    return data


def decode(kind: type[M], data: bytes) -> M:
    """The message of that type in `data`; raises MessageError with the reason."""
    _check_size(kind, len(data))
    try:
        outer = msgpack.unpackb(data, raw=False, strict_map_key=True)
    except Exception as error:  # msgpack raises half a dozen kinds, each of which means the same here
        raise MessageError(f"not msgpack: {type(error).__name__}") from None
    if not (isinstance(outer, list) and len(outer) == 3):
        raise MessageError("a message is [version, type, fields]")
    version, name, fields = outer
    if version != SCHEMA_VERSION:
        raise MessageError(f"schema version: {str(version)[:40]!r}, this side speaks {SCHEMA_VERSION}")
    if name != kind.__name__:
        raise MessageError(f"message of another type: {str(name)[:40]!r} where {kind.__name__} is expected")
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        # pydantic names also what the field was tried as: "docking task", "function-after[...]"
        path = ".".join(str(part) for part in first["loc"] if not {" ", "["} & set(str(part)))[:80]
        raise MessageError(f"{name}.{path}: {first['msg'][:160]}") from None


def _check_size(kind: type[Message], size: int) -> None:
    if size > kind.max_bytes:
        raise MessageError(f"{kind.__name__} of {size} bytes; at most {kind.max_bytes} are allowed")
