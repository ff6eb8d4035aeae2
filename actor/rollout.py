"""Several worlds that act in one batch: the loop shared by training actors and evaluation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actor.inference import Actor, Eyes
from actor.world.world import DockingWorld, Sensed
from common.config import Config
from common.messages import Candidate, Category, Ending, Episode, Version
from common.observation import ACTION_SIZE, HISTORY, Columns, ObservationLayout, observe
from common.tasks import Task


@dataclass(frozen=True, slots=True)
class Finished:
    """An episode that has just ended in world `slot`: its T + 1 rows (copies) and how it ended."""

    slot: int
    task: Task
    columns: Columns
    ending: Ending

    def message(self, digest: dict[str, str], first: Version, last: Version, category: Category) -> Episode:
        """What is sent to the learner; `first` and `last` version of the weights that drove."""
        return Episode(
            digest=digest,
            task=self.task,
            visual=self.columns.visual,
            lidar=self.columns.lidar,
            action=self.columns.action,
            reward=self.columns.reward,
            ending=self.ending,
            first_version=first,
            last_version=last,
            category=category,
        )


class Rollout:
    """W worlds side by side. `reset` starts an episode in a slot, `step` advances every running one.

    >>> rollout.reset(0, task)
    >>> while not (finished := rollout.step(actor)):
    ...     pass
    """

    def __init__(self, config: Config, eyes: Eyes, slots: int, max_steps: int) -> None:
        self.layout = ObservationLayout.of(config)
        self.steps = 0
        """Environment steps of all worlds so far."""
        self._eyes = eyes
        self.worlds = [DockingWorld(config.world, max_steps) for _ in range(slots)]
        self._rows = max_steps + 1
        self._columns = Columns.empty(slots * self._rows, self.layout)
        self._recent: list[list[NDArray[np.uint8]]] = [[] for _ in range(slots)]
        self._running: list[Task | None] = [None] * slots

    def __len__(self) -> int:
        return len(self.worlds)

    @property
    def idle(self) -> list[int]:
        """Slots without an episode."""
        return [slot for slot, task in enumerate(self._running) if task is None]

    def reset(self, slot: int, task: Task) -> None:
        """Starts an episode; raises UsageError for an impossible task."""
        self._recent[slot].clear()
        self._put([slot], [self.worlds[slot].reset(task)])
        self._running[slot] = task

    def look(self, slot: int, task: Task) -> Candidate:
        """Renders and encodes a start in an idle slot without driving it."""
        sensed = self.worlds[slot].reset(task)
        return Candidate(task=task, visual=self._eyes.see([[sensed.frame]])[0], lidar=sensed.lidar)

    def newest(self, slot: int) -> tuple[Sensed, NDArray[np.float32], float]:
        """What a world sensed last, and the action and reward that led there (zeros at a start)."""
        steps = self.worlds[slot].steps
        row = slot * self._rows + steps
        sensed = Sensed(self._recent[slot][-1], self._columns.lidar[row])
        if steps == 0:
            return sensed, np.zeros(ACTION_SIZE, np.float32), 0.0
        return sensed, self._columns.action[row - 1], float(self._columns.reward[row - 1])

    def step(self, actor: Actor) -> list[Finished]:
        """One control step of every running world; returns the episodes that it ended."""
        slots = [slot for slot, task in enumerate(self._running) if task is not None]
        if not slots:
            return []
        starts = np.array(slots) * self._rows
        rows = starts + [self.worlds[slot].steps for slot in slots]
        actions = actor.act(observe(self._columns, rows, starts, self.layout), slots)
        steps = [self.worlds[slot].step(action) for slot, action in zip(slots, actions, strict=True)]
        self._columns.action[rows] = actions
        self._columns.reward[rows] = [step.reward for step in steps]
        self._put(slots, [step.sensed for step in steps])
        self.steps += len(slots)
        return [
            self._finish(slot, step.ending) for slot, step in zip(slots, steps, strict=True) if step.ending
        ]

    def close(self) -> None:
        """Frees the physics clients."""
        for world in self.worlds:
            world.close()

    def _put(self, slots: list[int], sensed: list[Sensed]) -> None:
        """Stores the newest row of each slot; every frame (or stack) is encoded once."""
        for slot, new in zip(slots, sensed, strict=True):
            self._recent[slot] = [*self._recent[slot], new.frame][-HISTORY:]
        visual = self._eyes.see([self._recent[slot] for slot in slots])
        for slot, new, seen in zip(slots, sensed, visual, strict=True):
            row = slot * self._rows + self.worlds[slot].steps
            self._columns.visual[row], self._columns.lidar[row] = seen, new.lidar

    def _finish(self, slot: int, ending: Ending) -> Finished:
        task, self._running[slot] = self._running[slot], None
        assert task is not None
        first = slot * self._rows
        last = first + self.worlds[slot].steps
        self._columns.action[last], self._columns.reward[last] = 0.0, 0.0
        columns = Columns(*(part[first : last + 1].copy() for part in self._columns.parts()))
        return Finished(slot, task, columns, ending)
