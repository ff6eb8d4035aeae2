"""Monte-Carlo localisation: a particle filter whose measurement model is a likelihood field of the map.

Thrun, Burgard and Fox, Probabilistic Robotics (2005), tables 6.3 (likelihood field) and 8.2 (MCL).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from actor.baseline.scans import Scan
from common.cells import Cell
from common.geometry import SE2, Array, Rectangle, as_rows, separations

PIXEL = 0.05
"""Side of the field's squares, m."""
PARTICLES = 300
BEAMS = 60
"""Beams that weigh a particle, of all that returned."""
SIGMAS = 0.5, 0.25, 0.12
"""Standard deviations of a return about the map (m) with which the first scan is weighed in turn."""
SIGMA = 0.06
"""The same for all others."""
STRAY = 0.05
"""Likelihood of a return that the map does not explain, relative to one on it."""
DRIFT = 0.02, 0.01
"""Standard deviations added for each metre of motion (m) and each radian (rad): the drive is exact here."""
JITTER = 0.005, 0.002
"""Standard deviations added when particles are drawn anew, m and rad."""
MOVED = 0.2
"""Between two weighings the robot moves by this, m and rad."""
SHRUNK = 0.05
"""By this the map's rectangles are smaller on every side for the planner, m."""
KNOWN = 0.15, math.radians(3.0)
"""Spread of the particles below which the pose counts as known, m and rad."""


class LikelihoodField:
    """Distance to the nearest surface of a room's map, from any place in it."""

    def __init__(self, room: Cell) -> None:
        left, right, back, front = room.extent
        self._low = np.array([left - 0.5, back - 0.5])
        shape = np.ceil((np.array([right + 0.5, front + 0.5]) - self._low) / PIXEL).astype(int)
        points = np.zeros((*shape, 3))
        points[..., :2] = self._low + PIXEL * (np.moveaxis(np.indices(shape), 0, -1) + 0.5)
        flat = points.reshape(-1, 3)
        rows = as_rows(room.solids)
        solid = np.zeros(len(flat), np.bool_)
        for row in rows:  # one at a time: all together would take much memory
            solid |= separations(flat, (0.0, 0.0), row[None])[:, 0] <= 0
        inside = solid.reshape(tuple(shape))
        distance = distance_transform_edt(~inside) + distance_transform_edt(inside)
        self._distance: Array = PIXEL * (distance - 0.5)

    def distances(self, points: Array) -> Array:
        """(...,) distances (m) from points (..., 2) to the nearest surface."""
        index = ((points - self._low) / PIXEL).astype(np.int64)
        index = np.clip(index, 0, np.array(self._distance.shape) - 1)
        return np.asarray(self._distance[index[..., 0], index[..., 1]])


class ParticleFilter:
    """The robot's pose in the room, begun about a rough one with the given standard deviations (m, rad)."""

    def __init__(
        self, field: LikelihoodField, start: SE2, spread: tuple[float, float], rng: np.random.Generator
    ) -> None:
        self._field, self._rng = field, rng
        self._particles = self._scattered(np.tile([start.x, start.y, start.yaw], (PARTICLES, 1)), *spread)
        self._weights = np.full(PARTICLES, 1.0 / PARTICLES)
        self._since = math.inf
        """Motion since the last weighing, m and rad."""

    @property
    def pose(self) -> SE2:
        """The weighted mean."""
        x, y, yaw = self._particles.T
        c, s = self._weights @ np.cos(yaw), self._weights @ np.sin(yaw)
        return SE2(float(self._weights @ x), float(self._weights @ y), math.atan2(s, c))

    @property
    def is_known(self) -> bool:
        """Whether the particles agree."""
        mean = self.pose
        off = self._particles - [mean.x, mean.y, mean.yaw]
        turned = (off[:, 2] + math.pi) % math.tau - math.pi
        place = math.sqrt(float(self._weights @ (off[:, :2] ** 2).sum(axis=1)))
        return place < KNOWN[0] and math.sqrt(float(self._weights @ turned**2)) < KNOWN[1]

    def update(self, motion: SE2, points: Array) -> None:
        """Moves with the robot (its frame) and weighs the returns (N, 2), in the robot's frame, m."""
        length = math.hypot(motion.x, motion.y)
        if length + abs(motion.yaw) > 0:
            self._move(motion, length)
        self._since += length + abs(motion.yaw)
        if self._since < MOVED or not len(points):
            return
        sigmas = SIGMAS if math.isinf(self._since) else (SIGMA,)
        self._since = 0.0
        chosen = points[:: 1 + len(points) // BEAMS]
        for sigma in sigmas:
            self._weigh(chosen, sigma)
            if 1.0 / float((self._weights**2).sum()) < PARTICLES / 2:
                self._draw(sigma)

    def _move(self, motion: SE2, length: float) -> None:
        yaw = self._particles[:, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        self._particles += np.stack(
            [c * motion.x - s * motion.y, s * motion.x + c * motion.y, np.full_like(yaw, motion.yaw)], axis=1
        )
        self._particles = self._scattered(self._particles, DRIFT[0] * length, DRIFT[1] * abs(motion.yaw))

    def _weigh(self, points: Array, sigma: float) -> None:
        x, y, yaw = (self._particles[:, k : k + 1] for k in range(3))
        c, s = np.cos(yaw), np.sin(yaw)
        placed = np.stack(
            [x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]], axis=2
        )
        off = self._field.distances(placed) / sigma
        log = np.log(np.exp(-off * off / 2) + STRAY).sum(axis=1) / 2  # beams are not independent
        weights = self._weights * np.exp(log - log.max())
        self._weights = weights / weights.sum()

    def _draw(self, sigma: float) -> None:
        """Low-variance resampling (table 4.4), with the more jitter the wider the field was."""
        places = (self._rng.random() + np.arange(PARTICLES)) / PARTICLES
        index = np.minimum(np.searchsorted(np.cumsum(self._weights), places), PARTICLES - 1)
        wide = sigma / SIGMA if sigma > SIGMA else 1.0
        self._particles = self._scattered(self._particles[index], wide**2 * JITTER[0], wide**2 * JITTER[1])
        self._weights = np.full(PARTICLES, 1.0 / PARTICLES)

    def _scattered(self, particles: Array, place: float, turn: float) -> Array:
        return particles + self._rng.standard_normal(particles.shape) * [place, place, turn]


class KnownRoom:
    """The map of a room in the frame of odometry, once the robot knows where it is."""

    def __init__(self, room: Cell, filter_: ParticleFilter) -> None:
        self._solids, self.filter = room.solids, filter_
        self._origin: SE2 | None = None

    def update(self, motion: SE2, scan: Scan, odometry: SE2) -> None:
        """Takes in one step."""
        back = odometry.inverse()
        c, s = math.cos(back.yaw), math.sin(back.yaw)
        points = scan.points[scan.hits] @ np.array([[c, s], [-s, c]]) + [back.x, back.y]
        self.filter.update(motion, points)
        if self.filter.is_known:
            self._origin = odometry @ self.filter.pose.inverse()

    def solids(self) -> list[Rectangle]:
        """Walls and fixtures, a little smaller as the pose is not exact; the returns make up for it."""
        if self._origin is None:
            return []
        return [
            Rectangle(self._origin @ solid.pose, solid.half_x - SHRUNK, solid.half_y - SHRUNK)
            for solid in self._solids
        ]
