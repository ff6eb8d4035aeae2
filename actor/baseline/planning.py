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

from actor.baseline.space import MARGIN, SPACING, TOUCHING, FreeSpace, Raster, as_row
from common.geometry import SE2, Array, Rectangle, wrap
from common.world_config import RobotConfig, WorldConfig

STOP = 0.4
"""What starting and stopping adds to the time of a turn or a drive at full rate, s."""
STAGING = (1.3, 1.4, 1.55, 1.75, 2.0, 2.3, 2.7, 3.2)
"""Distances from the dolly's centre at which a robot may turn into its axis, m."""
SHORT_OF_CENTRE = 0.1
"""Distance from the dolly's centre at which paths end, m; less than what counts as docked."""
HEADINGS = np.arange(16) * (math.tau / 16)
NUDGES = np.array([-0.12, 0.0, 0.12])
LENGTHS = np.array([-2.4, -1.2, -0.6, -0.3, -0.15, 0.15, 0.3, 0.6, 1.2, 2.4])
"""Turns (rad, about the dolly's yaw) and drives (m) of which the search makes its detours."""
COARSE = 0.25
"""Where the robot can turn, the search takes poses nearer than this in x and y for one, m."""
FINE = 0.2, 0.3
"""The same elsewhere, m, and for headings, rad."""
GREED = 1.5
"""Weight of the estimated time to go; above 1 the search is faster and its path up to this factor slower."""
EXPANSIONS = 1500
"""After so many poses the search gives up."""


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
            known = node.entry is None and self._keys(as_row(moves[-1]))[0] in self._seen
            if known or not self._is_free(before[-1], moves, node):
                continue
            if node.entry is not None:
                return before + moves
            self._expand(before + moves, node.spent)
        return []

    def _expand(self, path: list[SE2], spent: float) -> None:
        """Queues the ways in and the detours from the end of a free path that takes `spent` s."""
        pose = as_row(path[-1])
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
