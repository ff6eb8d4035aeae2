"""Where LiDAR returns lie: a box around those of each square of a lattice."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from actor.baseline.scans import Scan
from common.geometry import SE2, Array, Rectangle

CELL = 0.08
"""Side of a square, m."""
REACH = 20.0
"""Half the side of the lattice about the start, m; what lies beyond is not kept."""
THINNEST = 0.01
"""Smallest half extent of a box, m."""
GROWTH = 0.02
"""A box that grows by more is news, m."""


class Occupancy:
    """All returns so far, in the frame of odometry."""

    def __init__(self) -> None:
        self._side = int(2 * REACH / CELL)
        count = self._side**2
        self._low = np.full((count, 2), np.inf)
        self._high = np.full((count, 2), -np.inf)
        self._plain = np.zeros((self._side, self._side), np.bool_)
        """Squares with returns of what is not narrow."""
        self._used = np.zeros(count, np.bool_)
        self._news: list[NDArray[np.int64]] = []

    def add(self, scan: Scan) -> None:
        """Takes in the returns of a scan."""
        self._add(scan.points[scan.hits], scan.narrow[scan.hits])

    def suppose(self, points: Array) -> None:
        """Takes in points (N, 2) of walls that no beam has met."""
        self._add(points, np.zeros(len(points), np.bool_))

    def _add(self, points: Array, narrow: NDArray[np.bool_]) -> None:
        cells, kept = self._cells(points)
        points, narrow = points[kept], narrow[kept]
        touched = np.unique(cells)
        low, high = self._low[touched], self._high[touched]
        np.minimum.at(self._low, cells, points)
        np.maximum.at(self._high, cells, points)
        grown = ((low - self._low[touched] > GROWTH) | (self._high[touched] - high > GROWTH)).any(axis=1)
        self._used[touched] = True
        self._plain.ravel()[cells[~narrow]] = True
        self._news.append(touched[grown])

    def clear(self, x: float, y: float, radius: float) -> None:
        """Forgets the returns of a disc."""
        used = np.flatnonzero(self._used)
        middle = (self._low[used] + self._high[used]) / 2
        gone = used[np.hypot(*(middle - [x, y]).T) < radius]
        self._low[gone], self._high[gone], self._used[gone] = np.inf, -np.inf, False
        self._plain.ravel()[gone] = False

    def are_alone(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (N, 2) have no returns of wider things 0.1 to 0.3 m beside them."""
        reach = round(0.3 / CELL)
        offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
        offsets = offsets[(np.abs(offsets).max(axis=1) >= 2) & (np.hypot(*offsets.T) <= reach)]
        index = np.floor((points + REACH) / CELL).astype(np.int64)
        around = np.clip(index[:, None] + offsets, 0, self._side - 1)
        return np.asarray(~self._plain[around[..., 0], around[..., 1]].any(axis=1))

    def boxes(self) -> list[Rectangle]:
        """One box around the returns of each square."""
        return self._as_boxes(np.flatnonzero(self._used))

    def news(self) -> list[Rectangle]:
        """The boxes that are new or have grown since the last call."""
        changed, self._news = self._news, []
        return self._as_boxes(np.unique(np.concatenate(changed))) if changed else []

    def _as_boxes(self, cells: NDArray[np.int64]) -> list[Rectangle]:
        cells = cells[self._used[cells]]
        middle = (self._low[cells] + self._high[cells]) / 2
        half = np.maximum((self._high[cells] - self._low[cells]) / 2, THINNEST)
        rows = np.hstack([middle, half]).tolist()
        return [Rectangle(SE2(x, y), half_x, half_y) for x, y, half_x, half_y in rows]

    def _cells(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Indices of the squares of those points (N, 2) that lie on the lattice, and which do."""
        index = np.floor((points + REACH) / CELL).astype(np.int64)
        kept = np.asarray(((index >= 0) & (index < self._side)).all(axis=1))
        return np.asarray(index[kept] @ np.array([self._side, 1])), kept


def outside(boxes: list[Rectangle], dolly: SE2, half_x: float, half_y: float) -> list[Rectangle]:
    """The boxes whose middles do not lie in a rectangle about the dolly, of half extents in m."""
    if not boxes:
        return []
    c, s = math.cos(dolly.yaw), math.sin(dolly.yaw)
    middle = np.array([(box.pose.x - dolly.x, box.pose.y - dolly.y) for box in boxes])
    own = np.abs(middle @ np.array([[c, -s], [s, c]]))
    return [box for box, (x, y) in zip(boxes, own.tolist(), strict=True) if x > half_x or y > half_y]
