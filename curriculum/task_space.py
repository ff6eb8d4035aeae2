"""What tasks there are: those of the docking world, or boxes of numbers for somebody else's environment."""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.cells import CELLS
from common.config import Config
from common.errors import UsageError
from common.messages import Candidate, Pose, Version
from common.tasks import Task, build_scene, geometric_properties, random_task
from common.world_config import StartRanges

Properties = Mapping[str, float]
Scales = Mapping[str, tuple[float, float]]
"""Centre and half width that bring a property to about [-1, 1]."""
AnyTask = Task | dict[str, float]
DOCKING_SCALES: Scales = {
    "distance": (3.25, 1.75),
    "agent_clearance": (3.0, 2.0),
    "goal_clearance": (3.0, 2.0),
    "relative_angle": (math.pi / 4, math.pi / 4),
    "lateral_offset": (0.75, 0.75),
    "approach_angle": (math.pi / 12, math.pi / 12),
}
"""m and rad."""
NARROWEST = 0.25
"""Share of a parameter's range that level 0 leaves around its easiest value."""
HUGE = 1e6
"""Properties beyond it, from whoever asks for a score, count as it."""


class Scaling:
    """Brings the properties that f_pi sees to about [-1, 1]."""

    def __init__(self, inputs: Sequence[str], scales: Scales) -> None:
        self.names = tuple(name for name in inputs if name != "q")
        self._centres, self._halves = np.array([scales[name] for name in self.names]).reshape(-1, 2).T

    def __call__(self, properties: Sequence[Properties]) -> NDArray[np.float64]:
        """Those of N tasks, (N, len(names)); KeyError for one without a property that is an input."""
        values = np.array([p[name] for p in properties for name in self.names], float)
        values = np.clip(values, -HUGE, HUGE).reshape(len(properties), len(self.names))
        return np.asarray((values - self._centres) / self._halves)


@dataclass(slots=True, eq=False)
class Entry:
    """A task and what is known of it; without an observation its Q is never known."""

    cell: int
    task: AnyTask
    properties: Properties
    poses: tuple[Pose, Pose] | None = None
    """Of robot and dolly."""
    observed: Candidate | None = None
    q: float | None = None
    q_version: Version | None = None
    row: int | None = None
    """In the database."""
    lease: float = 0.0
    """Until when it is in somebody's hands, seconds since 1970."""
    _text: str = ""

    @property
    def text(self) -> str:
        """Cell, task, properties and poses in JSON, made once; without what changes."""
        if not self._text:
            task = self.task.model_dump(mode="json") if isinstance(self.task, Task) else self.task
            self._text = json.dumps([self.cell, task, dict(self.properties), self.poses])
        return self._text

    @classmethod
    def read(cls, text: str) -> Entry:
        """That of a `text`."""
        cell, fields, properties, poses = json.loads(text)
        task: AnyTask = Task.model_validate(fields) if "cell" in fields else fields
        poses = poses and (tuple(poses[0]), tuple(poses[1]))
        return cls(cell, task, properties, poses, _text=text)


class TaskSpace(ABC):
    """Draws tasks; `level` 0 is the favourable ones, 1 the full distribution."""

    cells: int
    inputs: tuple[str, ...]
    """What f_pi sees of a task, Q included."""
    scales: Scales
    at_once = 200
    """Tasks drawn for a request, at most, while there are no candidates."""

    @abstractmethod
    def draw(self, cell: int, level: float, rng: np.random.Generator) -> Entry:
        """A random task."""

    @abstractmethod
    def entry(self, task: AnyTask) -> Entry:
        """A given task; raises UsageError for an impossible one."""

    def candidate(self, cell: int, share: float, rng: np.random.Generator) -> Entry:
        """A random task, with probability `share` of a random level."""
        return self.draw(cell, float(rng.random()) if rng.random() < share else 1.0, rng)


class DockingSpace(TaskSpace):
    """The docking world's tasks, cell by cell."""

    at_once = 25  # a millisecond for each

    def __init__(self, config: Config) -> None:
        self._config = config
        self._gate = StartRanges(**config.curriculum.gate.ranges.model_dump())
        self.cells, self.inputs, self.scales = len(CELLS), config.curriculum.inputs, DOCKING_SCALES

    def draw(self, cell: int, level: float, rng: np.random.Generator) -> Entry:
        """A random task with its geometry, about a millisecond."""
        task, full = random_task(cell, self._config, rng), self._config.world.start
        if level < 1:
            ranges = self._gate.towards(full, level) if level > 0 else self._gate
            task = task.model_copy(update={"start": ranges})
        return self.entry(task)

    def entry(self, task: AnyTask) -> Entry:
        """A given task with its geometry."""
        if not isinstance(task, Task):
            raise UsageError("a task of the docking world is {cell, seed, start}")
        scene = build_scene(task, self._config.world)
        robot, dolly = scene.robot, scene.dolly
        poses = (robot.x, robot.y, robot.yaw), (dolly.x, dolly.y, dolly.yaw)
        return Entry(task.cell, task, geometric_properties(task, scene).model_dump(), poses)


class BoxSpace(TaskSpace):
    """Boxes of numbers, drawn uniformly: `curriculum.parameters`. All in cell 0, without Q."""

    def __init__(self, config: Config) -> None:
        self._parameters = config.curriculum.parameters
        self.cells, self.inputs = 1, tuple(p.name for p in self._parameters)
        self.scales = {p.name: ((p.low + p.high) / 2, (p.high - p.low) / 2) for p in self._parameters}

    def draw(self, cell: int, level: float, rng: np.random.Generator) -> Entry:
        """A random task."""
        share = NARROWEST + (1 - NARROWEST) * level
        task = {
            p.name: float(rng.uniform(p.easy + share * (p.low - p.easy), p.easy + share * (p.high - p.easy)))
            for p in self._parameters
        }
        return Entry(0, task, task)

    def entry(self, task: AnyTask) -> Entry:
        """A given task."""
        if isinstance(task, Task) or task.keys() != self.scales.keys():
            raise UsageError(f"a task here is a number for each of {', '.join(self.scales)}")
        for p in self._parameters:
            if not p.low <= task[p.name] <= p.high:
                raise UsageError(f"{p.name} is {task[p.name]:g}; it lies between {p.low:g} and {p.high:g}")
        return Entry(0, task, task)


def make_space(config: Config) -> TaskSpace:
    """The space that a configuration means."""
    return BoxSpace(config) if config.curriculum.parameters else DockingSpace(config)
