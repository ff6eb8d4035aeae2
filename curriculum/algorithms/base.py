"""The interface of a curriculum's algorithm: pure, free of files and the bus."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from common.messages import Category, Requested
from curriculum.task_space import Entry, Properties, Scaling


@dataclass(frozen=True, slots=True)
class Drawn:
    """N tasks that were drawn, as f_pi sees them; `entry` makes that of an index, when it is chosen."""

    scaled: NDArray[np.float64]
    """(N, P), see Scaling."""
    q: NDArray[np.float64]
    """(N,), NaN where it is not known."""
    entry: Callable[[int], Entry]

    @classmethod
    def of(cls, entries: Sequence[Entry], scaling: Scaling) -> Drawn:
        """Some that are there as a whole."""
        scaled = scaling([entry.properties for entry in entries])
        return cls(scaled, np.array([entry.q for entry in entries], float), entries.__getitem__)


class Pool(Protocol):
    """Where an algorithm takes the tasks of the asking cell from."""

    cell: int

    def draw(self, count: int) -> Drawn:
        """RandomTask, `count` times: from the cell's database, or by geometry alone while that is empty."""

    def new(self, level: float = 1.0) -> Entry:
        """A random task, of the full distribution at level 1, a favourable one at level 0."""


class Pick(NamedTuple):
    """A task that was chosen, and why."""

    entry: Entry
    category: Category
    why: str
    requested: Requested = "random"
    f: float | None = None
    mu: float | None = None
    sigma: float | None = None


class Result(NamedTuple):
    """How a task ended, with what was known of it when it was proposed."""

    entry: Entry
    category: Category
    f: float | None
    success: bool


class State(NamedTuple):
    """What an algorithm has learned: arrays, and what JSON can hold."""

    arrays: dict[str, NDArray[Any]]
    values: Mapping[str, Any]


class Algorithm(ABC):
    """Chooses tasks, and learns from how they end."""

    @abstractmethod
    def propose(self, t: int, pool: Pool, rng: np.random.Generator) -> Pick:
        """A task for whoever has made t environment steps so far."""

    @abstractmethod
    def report(self, result: Result) -> None:
        """Takes how a task ended, be it proposed or not."""

    def score(
        self, properties: Sequence[Properties], q: Sequence[float | None]
    ) -> NDArray[np.float64] | None:
        """Predicted success of N tasks, (N,) in [0, 1]; None from an algorithm that predicts nothing."""
        return None

    def snapshot(self) -> State:
        """Everything that `restore` needs to go on."""
        return State({}, {})

    def restore(self, state: State) -> None:  # noqa: B027, for one that learns nothing
        """Goes on from a snapshot; raises ValueError or KeyError when it does not fit."""
