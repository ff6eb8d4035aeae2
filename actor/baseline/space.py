"""What space a robot has: exact checks of its turns and drives, and a coarse map that guides a search."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.geometry import SE2, Array, Rectangle, as_rows, separations, wrap
from common.tasks import dolly_sides
from common.world_config import WorldConfig

MARGIN = 0.06
"""Free space that a path leaves around the robot where its start does not stand nearer to something, m."""
TOUCHING = 0.01
"""Poses nearer than this are one place, m; the tracking makes up for it."""
SPACING = 0.2
"""Spacing of the points between which the time to go is mapped, m."""
SMALL = 0.1
"""Solids with a smaller half diagonal are points to the map of the time to go, m."""


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
        gaps = separations(as_row(start), self._half, self.solids)[0]
        self._margins = np.where(gaps < 0, gaps - TOUCHING, np.clip(gaps / 2, 0.0, margin))

    def can_turn(self, pose: SE2, yaw: float) -> bool:
        """Whether a turn on the spot to `yaw` (rad), the shorter way round, touches nothing."""
        turn = wrap(yaw - pose.yaw)
        if turn == 0.0:
            return True
        poses = np.repeat(as_row(pose), 2 + int(abs(turn) / 0.05), axis=0)
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
        return bool((separations(as_row(middle), swept, self.solids[near]) >= self._margins[near]).all())

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


def as_row(pose: SE2) -> Array:
    """(1, 3) x, y, yaw."""
    return np.array([[pose.x, pose.y, pose.yaw]], np.float64)


def _gaps(points: Array, solids: Array) -> Array:
    """(N,) distances (m) from points (N, 3), whose yaw is 0, to the nearest of the solids (M, 5)."""
    small = np.hypot(solids[:, 3], solids[:, 4]) < SMALL
    gaps = separations(points, (0.0, 0.0), solids[~small]).min(axis=1, initial=np.inf)
    if small.any():  # measured ones, which are many
        x, y = (points[:, None, k] - solids[small, k] for k in range(2))
        gaps = np.minimum(gaps, np.sqrt((x * x + y * y).min(axis=1)) - SMALL / 2)
    return np.asarray(gaps)
