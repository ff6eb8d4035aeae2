"""Cells, tasks and the scenes they stand for: everything about a start that needs no simulator.

A `Task` (cell, seed, start ranges) rebuilds its `Scene` exactly, on any host; the curriculum reads a task's
geometric properties from it without pybullet, the simulator builds the same scene in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from common.config import Config, Section, StartRanges, WorldConfig
from common.errors import UsageError
from common.geometry import SE2, Rectangle, bearing, distance_to_rectangle, rectangles_overlap, wrap

START_JITTER = 0.5
"""Robot start, +- m around the cell's start point in x and y (appendix B)."""
START_MARGIN = 0.02
"""Free space around a starting robot, m (decided)."""


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box standing on the floor."""

    footprint: Rectangle
    height: float


@dataclass(frozen=True, slots=True)
class Cell:
    """A room in the frame of its start point (0, 0): inner faces of its walls and what stands in it (m)."""

    left: float
    right: float
    back: float
    front: float
    fixtures: tuple[Box, ...] = ()
    wall_height: float = 3.0

    def walls(self) -> tuple[Box, ...]:
        """The four walls as boxes, 0.2 m thick, outside the inner faces."""
        t = 0.1
        mid_x, mid_y = (self.left + self.right) / 2, (self.back + self.front) / 2
        half_x, half_y = (self.right - self.left) / 2, (self.front - self.back) / 2
        placed = (
            (self.left - t, mid_y, t, half_y + 2 * t),
            (self.right + t, mid_y, t, half_y + 2 * t),
            (mid_x, self.back - t, half_x, t),
            (mid_x, self.front + t, half_x, t),
        )
        return tuple(_box(x, y, hx, hy, self.wall_height) for x, y, hx, hy in placed)


def _box(x: float, y: float, half_x: float, half_y: float, height: float, yaw: float = 0.0) -> Box:
    return Box(Rectangle(SE2(x, y, yaw), half_x, half_y), height)


CELLS: tuple[Cell, ...] = (
    Cell(-5.5, 5.5, -2.5, 9.0),
    Cell(-4.5, 7.0, -2.0, 8.0, (_box(6.4, 3.0, 0.5, 2.5, 2.2),)),
    Cell(-7.0, 4.8, -3.0, 10.0, (_box(-4.2, 2.0, 0.2, 0.2, 3.0), _box(-4.2, 6.5, 0.2, 0.2, 3.0))),
    Cell(-6.0, 6.0, -2.2, 7.5, (_box(-5.4, 5.6, 0.6, 1.6, 1.6),)),
    Cell(-5.0, 5.0, -4.0, 11.0, (_box(3.6, -2.6, 0.6, 0.4, 1.1), _box(-3.8, -2.8, 0.4, 0.6, 0.8))),
    Cell(-8.0, 8.0, -2.5, 8.5, (_box(7.3, 0.0, 0.5, 1.8, 2.0), _box(-7.3, 4.0, 0.5, 2.4, 2.0))),
    Cell(-4.6, 4.6, -2.0, 12.0, (_box(0.0, 11.2, 2.0, 0.5, 2.4),)),
    Cell(-6.5, 5.2, -3.5, 9.5, (_box(-5.0, -2.8, 1.2, 0.5, 1.2), _box(4.6, 7.5, 0.4, 1.5, 1.8))),
    Cell(-7.5, 6.0, -2.8, 7.2, (_box(5.2, 6.4, 0.6, 0.6, 1.0), _box(-6.9, -2.2, 0.4, 0.4, 1.4))),
)
"""The nine training cells (section 3.3); sizes and fixtures decided."""


class Task(Section):
    """One episode's start: `seed` fixes geometry, textures and light within the ranges."""

    cell: Annotated[int, Field(ge=0, lt=len(CELLS))]
    seed: Annotated[int, Field(ge=0, lt=2**53)]
    start: StartRanges


class GeometricProperties(Section):
    """What f_pi sees of a task: the paper's four (table 2) and two more of NavACL-Q+; m and rad."""

    distance: float
    """Centre of the robot to centre of the dolly."""
    agent_clearance: float
    """Centre of the robot to the nearest surface that is not the dolly, walls included."""
    goal_clearance: float
    """The same from the centre of the dolly."""
    relative_angle: float
    """Unsigned, between the start heading and the vector to the goal."""
    lateral_offset: float
    """Unsigned distance of the robot from the dolly's long axis."""
    approach_angle: float
    """Unsigned, between the dolly's long axis and the line from robot to dolly."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A task's geometry: poses of robot and dolly in the cell's frame, and the obstacles."""

    robot: SE2
    dolly: SE2
    obstacles: tuple[Box, ...]


def check_cell(cell: int) -> int:
    """The cell itself; raises UsageError when there is none of that number."""
    if not 0 <= cell < len(CELLS):
        raise UsageError(f"cell {cell} does not exist; cells are 0 to {len(CELLS) - 1}")
    return cell


def random_stream(task: Task, purpose: int) -> np.random.Generator:
    """The task's own random numbers for one purpose (0 geometry, 1 appearance)."""
    return np.random.default_rng([task.seed, task.cell, purpose])


def build_scene(task: Task, world: WorldConfig) -> Scene:
    """The scene of a task (appendix B); the same arguments give the same scene to the bit."""
    rng = random_stream(task, 0)
    start, cell = task.start, CELLS[task.cell]
    for _ in range(1000):
        robot = SE2(
            rng.uniform(-START_JITTER, START_JITTER),
            rng.uniform(-START_JITTER, START_JITTER),
            math.radians(rng.uniform(-start.yaw, start.yaw)),
        )
        distance = rng.uniform(start.distance_min, start.distance_max)
        angle = math.radians(rng.uniform(-start.bearing, start.bearing))
        dolly = SE2(
            robot.x - distance * math.sin(angle),
            robot.y + distance * math.cos(angle),
            math.radians(rng.uniform(-start.dolly_yaw, start.dolly_yaw)),
        )
        body = Rectangle(robot, world.robot.width / 2, world.robot.length / 2)
        target = Rectangle(dolly, world.dolly.width / 2, world.dolly.length / 2)
        solid = [box.footprint for box in cell.walls() + cell.fixtures]
        if any(rectangles_overlap(body, side, START_MARGIN) for side in dolly_sides(dolly, world)):
            continue
        if any(rectangles_overlap(shape, r, START_MARGIN) for shape in (body, target) for r in solid):
            continue
        obstacles = _place_obstacles(rng, world, [body, target], solid, dolly)
        if obstacles is not None:
            return Scene(robot, dolly, obstacles)
    raise UsageError(
        f"no free start in cell {task.cell} for distances {start.distance_min} to {start.distance_max} m"
    )


def dolly_sides(dolly: SE2, world: WorldConfig) -> tuple[Rectangle, Rectangle]:
    """What a robot under the deck can touch of the dolly: its long sides, each two legs and the rail."""
    config = world.dolly
    x = (config.width - config.leg) / 2
    left, right = (dolly @ SE2(sign * x) for sign in (-1, 1))
    return (
        Rectangle(left, config.leg / 2, config.length / 2),
        Rectangle(right, config.leg / 2, config.length / 2),
    )


def _place_obstacles(
    rng: np.random.Generator, world: WorldConfig, movable: list[Rectangle], solid: list[Rectangle], dolly: SE2
) -> tuple[Box, ...] | None:
    """Boxes left and right of the dolly, clear of everything; None when the room has no space for them."""
    config, boxes = world.obstacles, list[Box]()
    for _ in range(int(rng.integers(config.count_min, config.count_max + 1))):
        for _ in range(50):
            away = rng.uniform(config.distance_min, config.distance_max)
            side = rng.uniform(-0.5, 0.5) + (math.pi if rng.random() < 0.5 else 0.0)
            shape = Rectangle(
                SE2(
                    dolly.x + away * math.cos(side), dolly.y + away * math.sin(side), rng.uniform(-3.14, 3.14)
                ),
                rng.uniform(0.15, 0.6),
                rng.uniform(0.15, 0.6),
            )
            height = rng.uniform(0.4, 1.8)
            taken = solid + [box.footprint for box in boxes]
            clear = not any(rectangles_overlap(shape, r) for r in taken)
            if clear and not any(rectangles_overlap(shape, r, 0.4) for r in movable):
                boxes.append(Box(shape, height))
                break
        else:
            return None
    return tuple(boxes)


def geometric_properties(task: Task, scene: Scene) -> GeometricProperties:
    """Table 2 of the paper and the two properties of NavACL-Q+."""
    cell, robot, dolly = CELLS[task.cell], scene.robot, scene.dolly
    surfaces = [box.footprint for box in cell.walls() + cell.fixtures + scene.obstacles]
    seen = dolly.inverse() @ robot
    line = SE2(robot.x, robot.y, dolly.yaw)
    return GeometricProperties(
        distance=math.hypot(dolly.x - robot.x, dolly.y - robot.y),
        agent_clearance=min(distance_to_rectangle(robot.x, robot.y, r) for r in surfaces),
        goal_clearance=min(distance_to_rectangle(dolly.x, dolly.y, r) for r in surfaces),
        relative_angle=abs(wrap(bearing(robot, dolly.x, dolly.y))),
        lateral_offset=abs(seen.x),
        approach_angle=abs(bearing(line, dolly.x, dolly.y)),
    )


def random_task(cell: int, config: Config, rng: np.random.Generator) -> Task:
    """A task of the full training distribution (the paper's RND)."""
    return Task(cell=cell, seed=int(rng.integers(2**32)), start=config.world.start)


def candidate_task(cell: int, config: Config, rng: np.random.Generator) -> Task:
    """A task for the database: `curriculum.narrowed_candidates` of them from ranges narrowed at random."""
    task = random_task(cell, config, rng)
    if rng.random() < config.curriculum.narrowed_candidates:
        start = config.curriculum.gate.ranges.towards(config.world.start, float(rng.random()))
        return task.model_copy(update={"start": start})
    return task


SUITES = ("short", "train")
"""Fixed lists of evaluation tasks in the training cells; training never draws their seeds."""


def suite(name: str, config: Config) -> list[Task]:
    """The tasks of a suite: `short`, 100 near and straight ones; `train`, 400 of the full distribution."""
    if name == "short":
        start = StartRanges(distance_max=2.0, yaw=20.0, bearing=4.0, dolly_yaw=4.0)
        return [Task(cell=i % len(CELLS), seed=2**40 + i, start=start) for i in range(100)]
    if name == "train":
        return [Task(cell=i % len(CELLS), seed=2**41 + i, start=config.world.start) for i in range(400)]
    raise UsageError(f"suite {name!r} does not exist; choose one of {', '.join(SUITES)}")
