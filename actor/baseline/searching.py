"""Where to look for a dolly that has not been seen: what was seen so far, and places that would show more."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from actor.baseline.scans import Scan
from actor.baseline.space import Raster
from common.geometry import SE2, Rectangle, as_rows
from common.world_config import WorldConfig

CELL, REACH = 0.5, 10.0
"""Side of the squares that are ticked off, and how far they go about the start, m."""
CAMERA_SIGHT, LIDAR_SIGHT = 6.0, 2.5
"""So far the camera shows the dolly's colour, and scans from different places its legs, m."""
BEHIND = 0.25
"""Beams that end this far before a place have not shown it, m."""
LATTICE, STRIDE = 0.75, 4.5
"""Spacing of places to look from, and the farthest of them, m."""
VIEW = 4.0
"""Farthest place that a look is taken for, m."""
OPEN = 0.15
"""A line of sight keeps this far from solids, m."""
ROOM = 0.8
"""A place to look from is this far from solids, so that the robot can turn there, m."""
BEST = 8
"""Places that are offered to the planner."""


class Coverage:
    """Which squares of the floor have been seen, in the frame of odometry."""

    def __init__(self, world: WorldConfig) -> None:
        axis = np.arange(-REACH, REACH + CELL / 2, CELL)
        self._places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        self.seen: NDArray[np.bool_] = np.zeros(len(self._places), np.bool_)
        self._sweep, self._beams = math.radians(world.lidar.fov), world.lidar.beams
        self._view = math.radians(world.camera.fov) / 2

    def add(self, pose: SE2, scan: Scan) -> None:
        """Ticks off what a robot at `pose` sees."""
        hidden = np.flatnonzero(~self.seen)
        x, y = scan.origins[0].tolist()
        camera = SE2(x, y, pose.yaw)
        for sensor, reach, view in (
            (0, CAMERA_SIGHT, self._view),
            (0, LIDAR_SIGHT, math.pi),
            (1, LIDAR_SIGHT, math.pi),
        ):
            shown = self._shown(scan, sensor, hidden, reach)
            if view < math.pi:
                to = self._places[hidden] - [camera.x, camera.y]
                ahead = to @ np.array(camera.forward)
                aside = np.abs(to @ np.array([camera.forward[1], -camera.forward[0]]))
                shown &= np.arctan2(aside, ahead) < view
            self.seen[hidden[shown]] = True

    def viewpoints(self, pose: SE2, solids: list[Rectangle]) -> list[SE2]:
        """Poses from which most of the unseen floor would be seen for the way to them, the best first."""
        steps = np.arange(-STRIDE, STRIDE + LATTICE / 2, LATTICE)
        here = np.array([[pose.x, pose.y]])
        spots = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + here
        raster = Raster(as_rows(solids), spots)
        in_sight = raster.are_open(here, spots, OPEN)  # so on this side of the walls
        spots = spots[(raster.gaps(spots) > ROOM) & in_sight]
        hidden = self._places[~self.seen & raster.covers(self._places)]
        share = np.linspace(0.0, 1.0, 25)[:, None, None]
        offers = []
        for spot in spots:
            near = hidden[np.hypot(*(hidden - spot).T) < VIEW]
            lines = spot + share * (near - spot)
            visible = near[(raster.gaps(lines) > OPEN).all(axis=0)]
            if len(visible) < 2:
                continue
            x, y = (visible.mean(axis=0) - spot).tolist()
            worth = len(visible) / (2.0 + math.hypot(spot[0] - pose.x, spot[1] - pose.y))
            offers.append((worth, SE2(float(spot[0]), float(spot[1]), math.atan2(-x, y))))
        offers.sort(key=lambda offer: -offer[0])
        return [view for _, view in offers[:BEST]]

    def _shown(self, scan: Scan, sensor: int, places: NDArray[np.int64], reach: float) -> NDArray[np.bool_]:
        """Which places (by index) one LiDAR's beams have reached."""
        part = slice(sensor * self._beams, (sensor + 1) * self._beams)
        to = self._places[places] - scan.origins[part][0]
        first = scan.directions[part][0]
        turn = np.arctan2(first[0] * to[:, 1] - first[1] * to[:, 0], to @ first) % math.tau
        beam = np.rint(turn / self._sweep * (self._beams - 1)).astype(np.int64)
        away = np.hypot(*to.T)
        reached = scan.ranges[part][np.minimum(beam, self._beams - 1)] > away - BEHIND
        return np.asarray(reached & (beam < self._beams) & (away < reach))


def ring(x: float, y: float, radii: tuple[float, ...], count: int) -> list[SE2]:
    """Poses around a place (m) that look at it."""
    angles = np.arange(count) * (math.tau / count)
    return [
        SE2(x + radius * math.sin(angle), y - radius * math.cos(angle), float(angle))
        for radius in radii
        for angle in angles.tolist()
    ]
