"""The task database: encoded candidate starts per cell, with Q(s0, a0) under the newest weights."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.cells import CELLS
from common.config import Config
from common.errors import UsageError
from common.messages import Candidate, MessageError, Version
from common.networks import Perception, Policy, TwinCritic, initial_q, load_state
from common.observation import Observation, ObservationLayout
from common.tasks import GeometricProperties, Scene, Task, build_scene, geometric_properties


@dataclass(slots=True, eq=False)
class Entry:
    """A task in the database; without an observation its Q is never known."""

    task: Task
    scene: Scene
    properties: GeometricProperties
    observed: Candidate | None = None
    q: float | None = None
    q_version: Version | None = None


class CriticView:
    """The learner's policy and critic as the curriculum sees them: Q(s0, a0) in batches."""

    def __init__(self, config: Config) -> None:
        self.version: Version | None = None
        self._layout = ObservationLayout.of(config)
        self._perception = Perception(config).eval()
        self._policy = Policy(self._layout, config.network).eval()
        self._critic = TwinCritic(self._layout, config.network).eval()

    def load(self, version: Version, tensors: dict[str, Tensor]) -> None:
        """Takes newer weights; ValueError when they do not fit."""
        load_state(tensors, perception=self._perception, policy=self._policy, critic=self._critic)
        self.version = version

    def refresh(self, entries: list[Entry]) -> None:
        """Renews Q of the entries that were valued under other weights; one batch."""
        if self.version is None:
            return
        stale = [e for e in entries if e.observed is not None and e.q_version != self.version]
        if not stale:
            return
        observation = self._starts([e.observed for e in stale if e.observed is not None])
        with torch.inference_mode():
            values = initial_q(self._policy, self._critic, self._perception(observation))
        for entry, value in zip(stale, values, strict=True):
            entry.q, entry.q_version = float(value), self.version

    def _starts(self, candidates: list[Candidate]) -> Observation:
        """Start observations: the one visual row repeated, no history."""
        visual = np.stack([c.visual for c in candidates])
        stacked: NDArray[np.generic] = np.repeat(visual[:, None], self._layout.stack, axis=1)
        lidar = np.stack([c.lidar for c in candidates])
        return Observation(stacked, lidar, np.zeros((len(visual), self._layout.history), np.float32))


class TaskStore:
    """At most `store_per_cell` candidates per cell; the oldest make room, used ones leave."""

    def __init__(self, config: Config) -> None:
        self._config, self._layout = config, ObservationLayout.of(config)
        self._cells: list[deque[Entry]] = [deque(maxlen=config.curriculum.store_per_cell) for _ in CELLS]

    def __len__(self) -> int:
        return sum(len(entries) for entries in self._cells)

    def count(self, cell: int) -> int:
        """Candidates of a cell."""
        return len(self._cells[cell])

    def make_entry(self, task: Task, observed: Candidate | None = None) -> Entry:
        """A task with its geometry; raises UsageError for an impossible one."""
        scene = build_scene(task, self._config.world)
        return Entry(task, scene, geometric_properties(task, scene), observed)

    def add(self, candidates: list[Candidate]) -> None:
        """Stores candidates, all or none; raises MessageError for one that is not of this run's layout."""
        entries = [self._checked(candidate) for candidate in candidates]
        for entry in entries:
            self._cells[entry.task.cell].append(entry)

    def _checked(self, candidate: Candidate) -> Entry:
        expected = {
            "visual": (self._layout.row_shape, self._layout.row_dtype),
            "lidar": ((self._layout.lidar,), "float16"),
        }
        for name, (shape, dtype) in expected.items():
            array: NDArray[np.generic] = getattr(candidate, name)
            if array.shape != shape or array.dtype != dtype:
                raise MessageError(
                    f"candidate {name} is {array.dtype} {array.shape}, expected {dtype} {shape}"
                )
        try:
            return self.make_entry(candidate.task, candidate)
        except UsageError as error:
            raise MessageError(f"candidate task: {error}") from None

    def sample(self, cell: int, count: int, rng: np.random.Generator) -> list[Entry]:
        """Up to `count` different candidates of a cell, in random order."""
        entries = self._cells[cell]
        return [entries[int(i)] for i in rng.permutation(len(entries))[:count]]

    def remove(self, entry: Entry) -> None:
        """Takes a candidate out, for it has been proposed."""
        with suppress(ValueError):
            self._cells[entry.task.cell].remove(entry)
