"""Tasks and the scenes they stand for: everything about a start that needs no simulator.

A `Task` (cell, seed, start) rebuilds its `Scene` exactly, on any host; the curriculum reads a task's
geometric properties from it without pybullet, the simulator builds the same scene in it.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from common.cells import CELLS, ROOMS, Box, Cell, Kind
from common.config import Config
from common.errors import UsageError
from common.geometry import SE2, Rectangle, bearing, distance_to_rectangle, rectangles_overlap, wrap
from common.settings import Section
from common.world_config import ObstacleConfig, StartRanges, WorldConfig

START_MARGIN = 0.02
"""Free space around a starting robot, m (decided)."""
CORRIDOR_MARGIN = 0.10
"""Free space on either side of the robot on its way under the dolly, m (decided)."""
CATALOGUE_SIZE = 12
"""Boxes that obstacles are taken from."""
DRAWS, DISTANCES = 200, 5
"""Draws of a scene for one distance, and distances that are tried: so they stay uniform whatever fits."""


class PlacedStart(Section):
    """A start at one pose, the dolly at its place in the room: the grid test's (section 4.2)."""

    x: Annotated[float, Field(ge=-20, le=20)]
    """Robot's centre in the dolly's frame, m: x to the dolly's right, y ahead, so y < 0 is in front of it."""
    y: Annotated[float, Field(ge=-20, le=20)]
    yaw: Annotated[float, Field(ge=-180, le=180)]
    """Degrees; 0 faces as the dolly does."""


class DollyShift(Section):
    """The dolly moves in mid-episode, at once (the paper's demonstration of adaptability)."""

    step: Annotated[int, Field(ge=1, le=10_000)]
    """Control steps before it moves; it waits while the robot stands in its new place."""
    x: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Displacement in the dolly's first frame, m."""
    y: Annotated[float, Field(ge=-10, le=10)] = 0.0
    yaw: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Degrees."""


class Task(Section):
    """One episode's start: `seed` fixes geometry, textures, light and noise within the ranges."""

    cell: Annotated[int, Field(ge=0, lt=len(ROOMS))]
    seed: Annotated[int, Field(ge=0, lt=2**53)]
    start: StartRanges | PlacedStart
    shift: DollyShift | None = None


FIRST_SUITE_SEED = 2**40
"""Suites and grids have their seeds from here on, training below."""


def _for_training(task: Task) -> Task:
    if task.cell >= len(CELLS):
        raise ValueError(f"cell {task.cell} is an arena, where nothing is trained")
    if task.seed >= FIRST_SUITE_SEED:
        raise ValueError(f"seed {task.seed} is an examination's, from which nothing is learned")
    return task


TrainingTask = Annotated[Task, AfterValidator(_for_training)]
"""What learner and curriculum accept."""


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
class Obstacle:
    """A box of the catalogue (its index there) at a pose."""

    index: int
    box: Box


@dataclass(frozen=True, slots=True)
class Scene:
    """A task's geometry: poses of robot and dolly in the cell's frame, and the obstacles."""

    robot: SE2
    dolly: SE2
    obstacles: tuple[Obstacle, ...]
    shifted: SE2 | None = None
    """Where the dolly moves in mid-episode."""


def random_stream(task: Task, purpose: int) -> np.random.Generator:
    """The task's own random numbers for one purpose (0 geometry, 1 appearance, 2 sensor noise)."""
    return np.random.default_rng([task.seed, task.cell, purpose])


@lru_cache(maxsize=16)
def obstacle_catalogue(config: ObstacleConfig) -> tuple[tuple[float, float, float, Kind], ...]:
    """The boxes (half width, half depth, height, kind) whose sizes fill the ranges of `config`.

    A scene uses each at most once, so that a simulator can make them all once and move them about.
    """
    kinds: tuple[Kind, ...] = ("crate", "pallet", "machine")

    def spread(low_high: tuple[float, float], index: int) -> float:
        low, high = low_high
        return low + (high - low) * (index % CATALOGUE_SIZE + 0.5) / CATALOGUE_SIZE

    return tuple(
        (  # each size once, hardly correlated
            spread(config.size, i) / 2,
            spread(config.size, i + 2) / 2,
            spread(config.height, 5 * i + 1),
            kinds[i % len(kinds)],
        )
        for i in range(CATALOGUE_SIZE)
    )


def build_scene(task: Task, world: WorldConfig) -> Scene:
    """The scene of a task (appendix B); the same arguments give the same scene to the bit.

    Raises UsageError with the commonest reason when no draw fits.
    """
    rng, reasons = random_stream(task, 0), Counter[str]()
    distance, draws = 0.0, DRAWS
    if isinstance(task.start, StartRanges):
        draws *= DISTANCES
    for draw in range(draws):
        if isinstance(task.start, StartRanges) and draw % DRAWS == 0:
            distance = rng.uniform(task.start.distance_min, task.start.distance_max)
        scene = _draw_scene(task, world, distance, rng)
        if isinstance(scene, Scene):
            return scene
        reasons[scene] += 1
    reason, count = reasons.most_common(1)[0]
    place = f"cell {task.cell} ({ROOMS[task.cell].name})"
    if isinstance(task.start, StartRanges):
        place += f" at a distance of {distance:.2f} m"
    raise UsageError(f"no free start in {place}: {reason} in {count} of {draws} draws")


def _draw_scene(task: Task, world: WorldConfig, distance: float, rng: np.random.Generator) -> Scene | str:
    """One draw: a scene, or the reason why it does not fit."""
    start, cell = task.start, ROOMS[task.cell]
    if isinstance(start, PlacedStart):
        dolly = cell.dolly
        robot = dolly @ SE2(start.x, start.y, math.radians(start.yaw))
    else:
        robot = SE2(
            rng.uniform(-start.jitter, start.jitter),
            rng.uniform(-start.jitter, start.jitter),
            math.radians(rng.uniform(-start.yaw, start.yaw)),
        )
        angle = math.radians(rng.uniform(-start.bearing, start.bearing))
        dolly = SE2(
            robot.x - distance * math.sin(angle),
            robot.y + distance * math.cos(angle),
            math.radians(rng.uniform(-start.dolly_yaw, start.dolly_yaw)),
        )
    body = Rectangle(robot, world.robot.width / 2, world.robot.length / 2)
    if any(rectangles_overlap(body, side, START_MARGIN) for side in dolly_sides(dolly, world)):
        return "the robot touches the dolly"
    if not cell.contains(robot.x, robot.y) or _hits(body, cell.solids, START_MARGIN):
        return "the robot stands in a wall or fixture"
    keep_free = [body]
    shifted = None
    if task.shift is not None:
        shifted = dolly @ SE2(task.shift.x, task.shift.y, math.radians(task.shift.yaw))
    for place, who in ((dolly, "dolly"), (shifted, "shifted dolly")):
        if place is None:
            continue
        target = Rectangle(place, world.dolly.width / 2, world.dolly.length / 2)
        corridor = docking_corridor(place, robot, world)
        if not cell.contains(place.x, place.y) or _hits(target, cell.solids, START_MARGIN):
            return f"the {who} stands in a wall or fixture"
        if _hits(corridor, cell.solids):
            return f"the {who} has no free docking corridor"
        keep_free += [target, corridor]
    obstacles = _place_obstacles(rng, world.obstacles, keep_free, cell, dolly)
    if obstacles is None:
        return "the room has no space for the obstacles"
    return Scene(robot, dolly, obstacles, shifted)


def _hits(shape: Rectangle, others: tuple[Rectangle, ...], margin: float = 0.0) -> bool:
    return any(rectangles_overlap(shape, other, margin) for other in others)


def dolly_sides(dolly: SE2, world: WorldConfig) -> tuple[Rectangle, Rectangle]:
    """What a robot under the deck can touch of the dolly: its long sides, each two legs and the rail."""
    config = world.dolly
    x = (config.width - config.leg) / 2
    left, right = (dolly @ SE2(sign * x) for sign in (-1, 1))
    return (
        Rectangle(left, config.leg / 2, config.length / 2),
        Rectangle(right, config.leg / 2, config.length / 2),
    )


def docking_corridor(dolly: SE2, robot: SE2, world: WorldConfig) -> Rectangle:
    """The strip before the dolly's short side on the robot's side that a docking robot passes through."""
    length = world.robot.length + 2 * CORRIDOR_MARGIN
    side = 1.0 if (dolly.inverse() @ robot).y > 0 else -1.0
    middle = dolly @ SE2(0.0, side * (world.dolly.length + length) / 2)
    return Rectangle(middle, world.robot.width / 2 + CORRIDOR_MARGIN, length / 2)


def _place_obstacles(
    rng: np.random.Generator, config: ObstacleConfig, keep_free: list[Rectangle], cell: Cell, dolly: SE2
) -> tuple[Obstacle, ...] | None:
    """Boxes left and right of the dolly, clear of everything; None when the room has no space for them."""
    catalogue, placed = obstacle_catalogue(config), list[Obstacle]()
    count = int(rng.integers(config.count_min, config.count_max + 1))
    spread = math.radians(config.spread)
    for index in rng.permutation(len(catalogue))[:count]:
        half_x, half_y, height, kind = catalogue[index]
        for _ in range(50):
            away = rng.uniform(config.distance_min, config.distance_max)
            side = rng.uniform(-spread, spread) + (math.pi if rng.random() < 0.5 else 0.0)
            x, y = dolly.x + away * math.cos(side), dolly.y + away * math.sin(side)
            shape = Rectangle(SE2(x, y, rng.uniform(-math.pi, math.pi)), half_x, half_y)
            taken = (*cell.solids, *(other.box.footprint for other in placed))
            blocks_way = any(rectangles_overlap(shape, r, config.clearance) for r in keep_free)
            if cell.contains(x, y) and not blocks_way and not _hits(shape, taken):
                placed.append(Obstacle(int(index), Box(shape, height, kind)))
                break
        else:
            return None
    return tuple(placed)


def surfaces(cell: int, scene: Scene) -> list[Rectangle]:
    """Footprints of everything solid but the dolly."""
    return [*ROOMS[cell].solids, *(obstacle.box.footprint for obstacle in scene.obstacles)]


def geometric_properties(task: Task, scene: Scene) -> GeometricProperties:
    """Table 2 of the paper and the two properties of NavACL-Q+."""
    robot, dolly = scene.robot, scene.dolly
    solid = surfaces(task.cell, scene)
    seen = dolly.inverse() @ robot
    line = SE2(robot.x, robot.y, dolly.yaw)
    return GeometricProperties(
        distance=math.hypot(dolly.x - robot.x, dolly.y - robot.y),
        agent_clearance=min(distance_to_rectangle(robot.x, robot.y, r) for r in solid),
        goal_clearance=min(distance_to_rectangle(dolly.x, dolly.y, r) for r in solid),
        relative_angle=abs(wrap(bearing(robot, dolly.x, dolly.y))),
        lateral_offset=abs(seen.x),
        approach_angle=abs(bearing(line, dolly.x, dolly.y)),
    )


def random_task(cell: int, config: Config, rng: np.random.Generator) -> Task:
    """A task of the full training distribution (the paper's RND)."""
    return Task(cell=cell, seed=int(rng.integers(2**32)), start=config.world.start)


def narrowed_task(cell: int, config: Config, rng: np.random.Generator, share: float) -> Task:
    """A task of the training distribution, or with probability `share` from ranges narrowed at random."""
    task = random_task(cell, config, rng)
    if rng.random() < share:
        start = config.curriculum.gate.ranges.towards(config.world.start, float(rng.random()))
        return task.model_copy(update={"start": start})
    return task


def candidate_task(cell: int, config: Config, rng: np.random.Generator, solved: float = 0.0) -> Task:
    """A task for the curriculum's database; the more random tasks are `solved`, the fewer are narrowed."""
    return narrowed_task(cell, config, rng, config.curriculum.narrowed_candidates * (1 - solved))
