"""Plans under the dolly for a robot that turns on the spot and drives straight: an A* search over such moves.

A path is a list of poses; from one to the next the robot either turns or drives, never both. What a straight
drive sweeps is a rectangle, so drives are checked exactly and turns by close samples.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.geometry import SE2, Array, Rectangle, as_rows, separations, wrap
from common.tasks import dolly_sides
from common.world_config import RobotConfig, WorldConfig

MARGIN = 0.06
"""Free space that a path leaves around the robot where its start does not stand nearer to something, m."""
STOP = 0.4
"""What starting and stopping adds to the time of a turn or a drive at full rate, s."""
STAGING = (1.3, 1.4, 1.55, 1.75, 2.0, 2.3, 2.7, 3.2)
"""Distances from the dolly's centre at which a robot may turn into its axis, m."""
SHORT_OF_CENTRE = 0.1
"""Distance from the dolly's centre at which paths end, m; less than what counts as docked."""
TOUCHING = 0.01
"""Poses nearer than this are one place, m; the tracking makes up for it."""
HEADINGS = np.arange(16) * (math.tau / 16)
NUDGES = np.array([-0.12, 0.0, 0.12])
LENGTHS = np.array([-2.4, -1.2, -0.6, -0.3, -0.15, 0.15, 0.3, 0.6, 1.2, 2.4])
"""Turns (rad, about the dolly's yaw) and drives (m) of which the search makes its detours."""
COARSE = 0.25
"""Where the robot can turn, the search takes poses nearer than this in x and y for one, m."""
FINE = 0.2, 0.3
"""The same elsewhere, m, and for headings, rad."""
SPACING = 0.2
"""Spacing of the points between which the time to go is mapped, m."""
SMALL = 0.1
"""Solids with a smaller half diagonal are points to the map of the time to go, m."""
GREED = 1.5
"""Weight of the estimated time to go; above 1 the search is faster and its path up to this factor slower."""
EXPANSIONS = 1500
"""After so many poses the search gives up."""


class FreeSpace:
    """What the robot must not touch, and how near it may come: `margin` (m) or half of what `start` has.

    A start that overlaps something, which only solids measured too large can, may stay as deep in it.
    """

    def __init__(
        self,
        solids: Sequence[Rectangle],
        dolly: SE2 | None,
        start: SE2,
        world: WorldConfig,
        margin: float = MARGIN,
    ) -> None:
        self._half = world.robot.width / 2, world.robot.length / 2
        self._surfaces = len(solids)
        self.solids = as_rows([*solids, *(dolly_sides(dolly, world) if dolly else ())])
        self._radii = np.hypot(self.solids[:, 3], self.solids[:, 4]) + 2 * margin
        gaps = separations(_row(start), self._half, self.solids)[0]
        self._margins = np.where(gaps < 0, gaps - TOUCHING, np.clip(gaps / 2, 0.0, margin))

    def can_turn(self, pose: SE2, yaw: float) -> bool:
        """Whether a turn on the spot to `yaw` (rad), the shorter way round, touches nothing."""
        turn = wrap(yaw - pose.yaw)
        if turn == 0.0:
            return True
        poses = np.repeat(_row(pose), 2 + int(abs(turn) / 0.05), axis=0)
        poses[:, 2] += np.linspace(0.0, turn, len(poses))
        near = self._near(pose, self._half)
        return bool((separations(poses, self._half, self.solids[near]) >= self._margins[near]).all())

    def can_drive(self, pose: SE2, length: float, docking: bool = False) -> bool:
        """Whether driving straight for `length` (m) touches nothing; `docking` leaves the dolly out."""
        swept = self._half[0], self._half[1] + abs(length) / 2
        middle = pose @ SE2(0.0, length / 2)
        near = self._near(middle, swept)
        if docking:
            near = near[near < self._surfaces]
        return bool((separations(_row(middle), swept, self.solids[near]) >= self._margins[near]).all())

    def is_free(self, path: Sequence[SE2], docking: bool) -> bool:
        """Whether a path's turns and drives touch nothing; with `docking` the last drive may the dolly."""
        for count, (a, b) in enumerate(itertools.pairwise(path), 2):
            last = docking and count == len(path)
            if not (self.can_turn(a, b.yaw) if a.yaw != b.yaw else self._can_reach(a, b, last)):
                return False
        return True

    def _can_reach(self, a: SE2, b: SE2, docking: bool) -> bool:
        return self.can_drive(a, (a.inverse() @ b).y, docking)

    def _near(self, pose: SE2, half: tuple[float, float]) -> NDArray[np.int64]:
        """The solids that a rectangle of half extents `half` at `pose` may come too near to."""
        apart = np.hypot(self.solids[:, 0] - pose.x, self.solids[:, 1] - pose.y)
        return np.flatnonzero(apart < self._radii + math.hypot(*half))


class Raster:
    """A coarse map for a quick search: how far solids are from its points (m), and the time to go from them.

    It only guides: what is free is decided by `FreeSpace`.
    """

    def __init__(self, solids: Array, places: Array) -> None:
        """A map that covers the middles of the solids (M, 5), so the room, and the places (N, 2)."""
        covered = np.vstack([solids[:, :2], places])
        self._low = covered.min(axis=0)
        self._shape = (2 + (covered.max(axis=0) - self._low) / SPACING).astype(int)
        points = np.zeros((*self._shape, 3))
        points[..., :2] = self._low + SPACING * np.moveaxis(np.indices(self._shape), 0, -1)
        self._gaps = _gaps(points.reshape(-1, 3), solids).reshape(self._shape)
        self._times = np.zeros(self._shape)

    def set_times(self, places: Array, times: Array, radius: float) -> None:
        """Estimates times (s) to N places (N, 2), each with its own left, for a disc that avoids solids."""
        field = np.full(self._shape + 2, np.inf)  # the border spares the shifts their special cases
        np.minimum.at(field, tuple(self._index(places).T + 1), times)
        inner, before = field[1:-1, 1:-1], np.empty(0)
        shifts = [shift for shift in itertools.product((-1, 0, 1), repeat=2) if any(shift)]
        while not np.array_equal(before, inner):
            before = inner.copy()
            for i, j in shifts:
                near = field[1 + i : field.shape[0] - 1 + i, 1 + j : field.shape[1] - 1 + j]
                np.minimum(inner, near + SPACING * math.hypot(i, j), out=inner, where=self._gaps > radius)
        self._times = np.where(np.isfinite(inner), inner, 2 * inner[np.isfinite(inner)].max())

    def covers(self, positions: Array) -> NDArray[np.bool_]:
        """Which positions (N, 2) lie on the map."""
        index = (positions - self._low) / SPACING
        return np.asarray(((index >= 0) & (index <= np.array(self._shape) - 1)).all(axis=-1))

    def gaps(self, positions: Array) -> Array:
        """Distances to the nearest solid (m) of positions (..., 2)."""
        return np.asarray(self._gaps[tuple(np.moveaxis(self._index(positions), -1, 0))])

    def times(self, positions: Array) -> Array:
        """Times to go (s) of positions (..., 2)."""
        return np.asarray(self._times[tuple(np.moveaxis(self._index(positions), -1, 0))])

    def are_open(self, origin: Array, ends: Array, radius: float) -> NDArray[np.bool_]:
        """Whether a disc finds the lines from one position (1, 2) to N others (N, 2) open."""
        lines = origin + np.linspace(0.0, 1.0, 9)[:, None, None] * (ends - origin)
        return np.asarray((self.gaps(lines) > radius).all(axis=0))

    def _index(self, positions: Array) -> NDArray[np.int64]:
        index: NDArray[np.int64] = np.rint((positions - self._low) / SPACING).astype(np.int64)
        return np.asarray(np.clip(index, 0, self._shape - 1))


class Entry(NamedTuple):
    """A pose on the dolly's axis, the length of the straight drive from there (m) and its time (s)."""

    pose: SE2
    length: float
    time: float


class _Node(NamedTuple):
    """A pose that the search may reach: by a turn to `heading` and a drive, maybe on through an entry."""

    parent: int
    heading: float
    length: float
    entry: Entry | None
    spent: float


def entries(start: SE2, dolly: SE2, space: FreeSpace) -> list[Entry]:
    """Free ways in: by either short side, forwards or in reverse, from `STAGING` or abreast of `start`."""
    found = []
    abreast = abs((dolly.inverse() @ start).y)
    for distance, front, turned in itertools.product((*STAGING, abreast), (False, True), (False, True)):
        length = (distance - SHORT_OF_CENTRE) * (-1.0 if turned else 1.0)
        yaw = math.pi if front != turned else 0.0
        pose = dolly @ SE2(0.0, distance if front else -distance, yaw)
        if distance > SHORT_OF_CENTRE and space.can_drive(pose, length, docking=True):
            found.append(Entry(pose, length, float(_move_time(length))))
    return found


def plan(start: SE2, dolly: SE2, solids: Sequence[Rectangle], world: WorldConfig) -> list[SE2]:
    """A quick free path from `start` to the place under the dolly; empty when none was found."""
    space = FreeSpace(solids, dolly, start, world)
    ways_in = entries(start, dolly, space)
    return _Search(dolly.yaw, space, ways_in, world.robot).run(start) if ways_in else []


def plan_to(start: SE2, goals: Sequence[SE2], solids: Sequence[Rectangle], world: WorldConfig) -> list[SE2]:
    """A quick free path from `start` to that goal which is the soonest reached; empty when none was found.

    It gives up soon, as the goals may be beyond walls.
    """
    space = FreeSpace(solids, None, start, world)
    ends = [Entry(goal, 0.0, 0.0) for goal in goals]
    return _Search(start.yaw, space, ends, world.robot, EXPANSIONS // 10).run(start)[:-1] if ends else []


class _Search:
    """A* over turns and drives; whether a move is free is asked only when its turn comes."""

    def __init__(
        self,
        yaw: float,
        space: FreeSpace,
        ways_in: list[Entry],
        robot: RobotConfig,
        expansions: int = EXPANSIONS,
    ) -> None:
        self._expansions = expansions
        self._yaw, self._space, self._ways_in = yaw, space, ways_in
        self._goals = np.array([(e.pose.x, e.pose.y, e.pose.yaw) for e in ways_in])
        self._times = np.array([e.time for e in ways_in])
        self._raster = Raster(space.solids, self._goals[:, :2])
        self._raster.set_times(self._goals[:, :2], self._times, robot.width / 2)
        self._narrow = robot.width / 2 - SPACING / 2
        self._turning = math.hypot(robot.width, robot.length) / 2 + MARGIN
        self._paths: list[list[SE2]] = []
        self._seen: set[tuple[int, int, int]] = set()
        self._waiting: list[tuple[float, int, _Node]] = []
        self._order = itertools.count()

    def run(self, start: SE2) -> list[SE2]:
        """The first path that is found; empty when there is none, or when the search gives up."""
        self._expand([start], 0.0)
        while self._waiting and len(self._paths) < self._expansions:
            _, _, node = heapq.heappop(self._waiting)
            before = self._paths[node.parent]
            moves = _moves(before[-1], node)
            known = node.entry is None and self._keys(_row(moves[-1]))[0] in self._seen
            if known or not self._is_free(before[-1], moves, node):
                continue
            if node.entry is not None:
                return before + moves
            self._expand(before + moves, node.spent)
        return []

    def _expand(self, path: list[SE2], spent: float) -> None:
        """Queues the ways in and the detours from the end of a free path that takes `spent` s."""
        pose = _row(path[-1])
        self._seen.update(self._keys(pose))
        self._paths.append(path)
        headings, lengths, times = (a[0].tolist() for a in _reaches(pose, self._goals))
        for i in np.flatnonzero(self._raster.are_open(pose[:, :2], self._goals[:, :2], self._narrow)):
            entry = self._ways_in[i]
            for way in range(2):
                total = spent + times[i][way] + entry.time
                self._queue(total, headings[i][way], lengths[i][way], entry, total)
        ends, drives, more = _detours(pose, self._yaw)
        kept = self._raster.are_open(pose[:, :2], ends[:, :2], self._narrow)
        kept &= [key not in self._seen for key in self._keys(ends)]
        ends, drives, totals = ends[kept], drives[kept], spent + more[kept]
        to_go = (_reaches(ends, self._goals)[2] + self._times[:, None]).min(axis=(1, 2))
        promises = totals + GREED * np.maximum(to_go, self._raster.times(ends[:, :2]))
        rows = np.column_stack([promises, ends[:, 2], drives, totals]).tolist()
        for promise, heading, length, total in rows:
            self._queue(promise, heading, length, None, total)

    def _queue(
        self, promise: float, heading: float, length: float, entry: Entry | None, spent: float
    ) -> None:
        node = _Node(len(self._paths) - 1, heading, length, entry, spent)
        heapq.heappush(self._waiting, (promise, next(self._order), node))

    def _is_free(self, before: SE2, moves: list[SE2], node: _Node) -> bool:
        turned, driven = moves[:2]
        return (
            self._space.can_drive(turned, node.length)
            and self._space.can_turn(before, turned.yaw)
            and (node.entry is None or self._space.can_turn(driven, node.entry.pose.yaw))
        )

    def _keys(self, poses: Array) -> list[tuple[int, int, int]]:
        """What the search takes for one pose: headings count where the robot cannot turn."""
        tight = self._raster.gaps(poses[:, :2]) < self._turning
        x, y = np.rint(poses[:, :2].T / np.where(tight, FINE[0], COARSE)).astype(int)
        heading = np.where(tight, np.rint(_wrap(poses[:, 2] - self._yaw) / FINE[1]), 99).astype(int)
        return list(zip(x.tolist(), y.tolist(), heading.tolist(), strict=True))


def _gaps(points: Array, solids: Array) -> Array:
    """(N,) distances (m) from points (N, 3), whose yaw is 0, to the nearest of the solids (M, 5)."""
    small = np.hypot(solids[:, 3], solids[:, 4]) < SMALL
    gaps = separations(points, (0.0, 0.0), solids[~small]).min(axis=1, initial=np.inf)
    if small.any():  # measured ones, which are many
        x, y = (points[:, None, k] - solids[small, k] for k in range(2))
        gaps = np.minimum(gaps, np.sqrt((x * x + y * y).min(axis=1)) - SMALL / 2)
    return np.asarray(gaps)


def _row(pose: SE2) -> Array:
    return np.array([[pose.x, pose.y, pose.yaw]], np.float64)


def _wrap(angles: Array) -> Array:
    return np.asarray((angles + math.pi) % math.tau - math.pi)


def _move_time(amount: Array | float) -> Array:
    """Time (s) of turns (rad) or drives (m): both go at 1 a second."""
    size = np.abs(amount)
    return np.asarray(np.where(size > TOUCHING, size + STOP, size))


def _reaches(poses: Array, goals: Array) -> tuple[Array, Array, Array]:
    """Turn, drive, turn from N poses to M goals: heading of the drive (rad), length (m), time (s).

    Each (N, M, 2); the last index is 0 forwards and 1 in reverse.
    """
    dx, dy = (goals[None, :, None, k] - poses[:, None, None, k] for k in range(2))
    lengths = np.hypot(dx, dy) * np.array([1.0, -1.0])
    headings = np.arctan2(-dx, dy) + np.array([0.0, math.pi])
    here = np.abs(lengths) < TOUCHING
    lengths = np.where(here, 0.0, lengths)
    headings = np.where(here, goals[None, :, None, 2], headings)
    turns = _wrap(headings - poses[:, None, None, 2]), _wrap(goals[None, :, None, 2] - headings)
    return headings, lengths, _move_time(turns[0]) + _move_time(lengths) + _move_time(turns[1])


def _detours(pose: Array, yaw: float) -> tuple[Array, Array, Array]:
    """Turns and drives from a pose (1, 3): the poses (N, 3), lengths (m) and times (s)."""
    yaws, lengths = (
        grid.ravel() for grid in np.meshgrid(np.append(HEADINGS + yaw, pose[0, 2] + NUDGES), LENGTHS)
    )
    x, y = pose[0, 0] - lengths * np.sin(yaws), pose[0, 1] + lengths * np.cos(yaws)
    times = _move_time(_wrap(yaws - pose[0, 2])) + _move_time(lengths)
    return np.stack([x, y, yaws], axis=1), lengths, times


def _moves(before: SE2, node: _Node) -> list[SE2]:
    """The poses after each turn and drive that lead from `before` to the node."""
    turned = SE2(before.x, before.y, wrap(node.heading))
    driven = turned @ SE2(0.0, node.length)
    if node.entry is None:
        return [turned, driven]
    return [turned, driven, node.entry.pose, node.entry.pose @ SE2(0.0, node.entry.length)]
