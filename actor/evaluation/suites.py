"""What a policy is examined on: fixed lists of seeded tasks, and the grid test (section 4.2)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.cells import CELLS, arena_index
from common.errors import UsageError
from common.tasks import FIRST_SUITE_SEED, DollyShift, PlacedStart, Task
from common.world_config import StartRanges

GRID_HEADINGS = (0, -45, 45, -90, 90, -135, 135, 180)
"""Degrees (section 4.2)."""
GRID_SIDE, GRID_SPACING = 11, 0.5
"""Starts in a row, and their distance, m (section 4.2)."""
NEAREST = 1.5
"""Distance of the nearest row of starts from the dolly's centre, m (decided)."""
REPEATS = {"quick": 1, "paper": 9}
"""Of each start of a grid."""


@dataclass(frozen=True, slots=True)
class Examination:
    """Tasks, and settings of the world on top of those that a policy was trained with."""

    name: str
    tasks: tuple[Task, ...]
    overrides: tuple[str, ...] = ()
    is_grid: bool = False


def _cells(first: int, count: int, start: StartRanges) -> tuple[Task, ...]:
    return tuple(Task(cell=i % len(CELLS), seed=first + i, start=start) for i in range(count))


def _moving(first: int) -> tuple[Task, ...]:
    """The dolly moves by up to 0.6 m along and across and turns by up to 10 degrees, after 0.9 to 2.7 s."""
    tasks = []
    for task in _cells(first, 200, StartRanges()):
        rng = np.random.default_rng(task.seed)
        x, y = rng.uniform(-0.6, 0.6, 2)
        shift = DollyShift(step=int(rng.integers(5, 16)), x=x, y=y, yaw=rng.uniform(-10, 10))
        tasks.append(task.model_copy(update={"shift": shift}))
    return tuple(tasks)


def _far(first: int) -> tuple[Task, ...]:
    """From 10 to 11 m away, up to 4 m beside the dolly's axis; there is space for that in the test arena."""
    tasks = []
    for seed in range(first, first + 200):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-4.0, 4.0)
        start = PlacedStart(x=x, y=-math.sqrt(10.1**2 - min(x * x, 6.0)), yaw=rng.uniform(-90, 90))
        tasks.append(Task(cell=arena_index("test"), seed=seed, start=start))
    return tuple(tasks)


def _training_look(**ranges: str) -> tuple[str, ...]:
    return tuple(f"world.randomization.training.{name}={value}" for name, value in ranges.items())


SHORT = StartRanges(distance_max=2.0, yaw=20.0, bearing=4.0, dolly_yaw=4.0)
_SUITES: dict[str, tuple[int, Callable[[int], tuple[Task, ...]], tuple[str, ...]]] = {
    "short": (1, lambda first: _cells(first, 100, SHORT), ()),
    "train": (2, lambda first: _cells(first, 400, StartRanges()), ()),
    "moving-dolly": (8, _moving, ()),
    "far": (9, _far, ()),
    "cluttered": (
        10,
        lambda first: _cells(first, 200, StartRanges()),
        ("world.obstacles.count_min=5", "world.obstacles.count_max=8"),
    ),
    "noisy": (
        11,
        lambda first: _cells(first, 200, StartRanges()),
        (
            "world.lidar.noise=0.03",
            "world.lidar.dropout=0.05",
            *_training_look(camera_noise="[10.0, 15.0]"),
        ),
    ),
    "other-dolly": (
        12,
        lambda first: _cells(first, 200, StartRanges()),
        _training_look(dolly_hue="[90.0, 150.0]"),
    ),
    "other-rooms": (
        13,
        lambda first: _cells(first, 200, StartRanges()),
        _training_look(
            floor_pattern='["diagonal", "herringbone"]',
            wall_pattern='["louvres", "cladding"]',
            floor_tone="[0.2, 0.5]",
            wall_tone="[0.2, 0.5]",
        ),
    ),
}
SUITES = {
    "short": "100 near, straight starts",
    "train": "400 of the full training distribution",
    "moving-dolly": "200 of these in which the dolly is moved in mid-episode",
    "far": "200 starts more than 10 m away, in the test arena",
    "cluttered": "200 with 5 to 8 obstacles instead of 1 to 4",
    "noisy": "200 with LiDAR noise of 3 cm, 5% lost beams, and camera noise",
    "other-dolly": "200 with a green dolly",
    "other-rooms": "200 with patterns and tones of floor and walls that training never shows",
}
"""In words; all but `far` are in the training cells, under seeds that training never draws."""


def suite(name: str) -> Examination:
    """A suite by its name; raises UsageError when there is none."""
    if name not in _SUITES:
        raise UsageError(f"suite {name!r} does not exist; choose one of {', '.join(SUITES)}")
    block, make, overrides = _SUITES[name]
    return Examination(name, make(block * FIRST_SUITE_SEED), overrides)


def grid(size: str, arena: str, seed: int = 0, nearest: float = NEAREST) -> Examination:
    """The grid test (section 4.2): 11 x 11 starts, 8 headings, repeats that differ in all but the start.

    `size` is `quick` (968 tasks) or `paper` (8,712), `nearest` the distance of the nearest row from the
    dolly's centre, m. Raises UsageError for an unknown arena.
    """
    half = GRID_SPACING * (GRID_SIDE - 1) / 2
    starts = [
        PlacedStart(x=GRID_SPACING * column - half, y=-nearest - GRID_SPACING * row, yaw=heading)
        for heading in GRID_HEADINGS
        for row in range(GRID_SIDE)
        for column in range(GRID_SIDE)
    ]
    cell, first = arena_index(arena), 4 * FIRST_SUITE_SEED + seed * 2**20
    tasks = [Task(cell=cell, seed=first + i, start=s) for i, s in enumerate(starts * REPEATS[size])]
    return Examination(f"grid-{size}", tuple(tasks), is_grid=True)


def is_inside_training_support(start: PlacedStart, ranges: StartRanges) -> bool:
    """Whether training can draw this start, position and heading: seen from the dolly, whose yaw is free.

    With the dolly turned by d in its cell, the line from robot to dolly lies at a + d of the cell's axis and
    the robot looks at h + d, a and h as seen here: some d within the ranges must bring all within theirs.
    """
    distance = math.hypot(start.x, start.y)
    if not ranges.distance_min <= distance <= ranges.distance_max:
        return False
    line = math.degrees(math.atan2(start.x, -start.y))

    def is_possible(line: float, yaw: float) -> bool:
        low = max(-ranges.dolly_yaw, -ranges.bearing - line, -ranges.yaw - yaw)
        high = min(ranges.dolly_yaw, ranges.bearing - line, ranges.yaw - yaw)
        return low <= high

    turns = itertools.product((-360.0, 0.0, 360.0), repeat=2)  # an angle is the same a turn further
    return any(is_possible(line + a, start.yaw + b) for a, b in turns)
