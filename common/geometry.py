"""Plane geometry: rigid motions SE(2) and oriented rectangles, as pure functions.

Frame of a cell: x to the right, y ahead (the dolly's axis), yaw counter-clockwise from +y, so that yaw 0
looks along +y and yaw -90 deg looks at the right-hand wall (paper, appendix B). A body's own frame is the
same: x to its right, y forward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SE2:
    """A pose in the plane: position x, y in m and yaw in rad. `a @ b` composes, `a.inverse()` inverts."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def __matmul__(self, other: SE2) -> SE2:
        x, y = self.apply(other.x, other.y)
        return SE2(x, y, wrap(self.yaw + other.yaw))

    def apply(self, x: float, y: float) -> tuple[float, float]:
        """A point of the body's frame (m), in the frame that the pose is given in (m)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + c * x - s * y, self.y + s * x + c * y

    def inverse(self) -> SE2:
        """The pose p with p @ self == identity."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return SE2(-c * self.x - s * self.y, s * self.x - c * self.y, wrap(-self.yaw))

    @property
    def forward(self) -> tuple[float, float]:
        """Unit vector of the heading."""
        return -math.sin(self.yaw), math.cos(self.yaw)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """An oriented rectangle: pose of its centre, half extents along its own x and y (m)."""

    pose: SE2
    half_x: float
    half_y: float

    def corners(self) -> Array:
        """(4, 2) corner positions, counter-clockwise."""
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        return np.array([self.pose.apply(sx * self.half_x, sy * self.half_y) for sx, sy in signs])


def wrap(angle: float) -> float:
    """The angle in (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def bearing(origin: SE2, x: float, y: float) -> float:
    """Signed angle (rad) from the heading of `origin` to the point, positive to the left."""
    fx, fy = origin.forward
    dx, dy = x - origin.x, y - origin.y
    return math.atan2(fx * dy - fy * dx, fx * dx + fy * dy)


def distance_to_rectangle(x: float, y: float, rectangle: Rectangle) -> float:
    """Distance (m) from a point to the nearest point of a rectangle; 0 inside it."""
    local = rectangle.pose.inverse().apply(x, y)
    dx = max(abs(local[0]) - rectangle.half_x, 0.0)
    dy = max(abs(local[1]) - rectangle.half_y, 0.0)
    return math.hypot(dx, dy)


def rectangles_overlap(a: Rectangle, b: Rectangle, margin: float = 0.0) -> bool:
    """Whether two oriented rectangles, `a` grown by `margin` (m) on every side, share a point.

    Separating axes: convex shapes are apart exactly when their projections on the normal of some edge are.
    """
    apart = math.hypot(a.pose.x - b.pose.x, a.pose.y - b.pose.y)
    if apart > math.hypot(a.half_x + margin, a.half_y + margin) + math.hypot(b.half_x, b.half_y):
        return False  # nine of ten calls end here, ten times sooner than below
    grown = Rectangle(a.pose, a.half_x + margin, a.half_y + margin)
    pa, pb = grown.corners(), b.corners()
    for yaw in (a.pose.yaw, a.pose.yaw + math.pi / 2, b.pose.yaw, b.pose.yaw + math.pi / 2):
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        qa, qb = pa @ axis, pb @ axis
        if qa.max() < qb.min() or qb.max() < qa.min():
            return False
    return True


def separations(poses: Array, half: tuple[float, float], rectangles: Array) -> Array:
    """Largest gap along a separating axis (m) between N rectangles of one size and M others, (N, M).

    `poses` (N, 3) are x, y, yaw of the first, `half` their half extents; `rectangles` (M, 5) rows of x, y,
    yaw, half_x, half_y. Negative exactly when two overlap, then minus the depth; positive, it never exceeds
    their distance.
    """
    x, y, yaw = (poses[:, None, k] for k in range(3))
    rx, ry, ryaw, rhx, rhy = (rectangles[None, :, k] for k in range(5))
    c, s = np.abs(np.cos(yaw - ryaw)), np.abs(np.sin(yaw - ryaw))
    dx, dy = rx - x, ry - y

    def along(angle: Array) -> tuple[Array, Array]:
        return np.abs(np.cos(angle) * dx + np.sin(angle) * dy), np.abs(
            np.cos(angle) * dy - np.sin(angle) * dx
        )

    own, theirs = along(yaw), along(ryaw)
    gaps = (
        own[0] - half[0] - (c * rhx + s * rhy),
        own[1] - half[1] - (s * rhx + c * rhy),
        theirs[0] - rhx - (c * half[0] + s * half[1]),
        theirs[1] - rhy - (s * half[0] + c * half[1]),
    )
    return np.asarray(np.maximum.reduce(gaps))


def as_rows(rectangles: Iterable[Rectangle]) -> Array:
    """(M, 5) rows of x, y, yaw, half_x, half_y."""
    rows = [(r.pose.x, r.pose.y, r.pose.yaw, r.half_x, r.half_y) for r in rectangles]
    return np.array(rows, np.float64).reshape(-1, 5)


def inside_polygon(x: float, y: float, corners: Sequence[tuple[float, float]]) -> bool:
    """Whether a point lies inside a simple polygon: a ray to +x crosses its edges an odd number of times."""
    inside = False
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside
