"""LiDAR readings as beams in the plane, and which of them met something as narrow as a dolly's leg."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actor.world.sensors import pose_of
from common.geometry import SE2, Array
from common.world_config import WorldConfig

JUMP = 0.10
"""Neighbouring beams whose ranges differ by more hit different things, m."""
NARROW = 0.075
"""Largest chord of what may be a leg, m; its diagonal is 57 mm."""
END_SECTOR = math.radians(9.0)
"""Beams of this sector at the end of a sweep tell whether a wall goes on beyond it, rad."""
STRAIGHT, LONGEST_BRIDGE = 0.04, 4.0
"""Largest distance of their ends from one line, and length of the line, m."""
WINDOW = 60
"""Scans that are kept."""
SAME_PLACE = 0.002
"""A scan from nearer than this (m and rad) to the last one says nothing new and replaces it."""

Mask = NDArray[np.bool_]


class Scan(NamedTuple):
    """N beams in one frame: origins (N, 2) in m, unit directions (N, 2), ranges (N,) in m.

    `hits` (N,) tells which returned; `narrow` (N,) which of those met something narrow that stands free.
    """

    origins: Array
    directions: Array
    ranges: Array
    hits: Mask
    narrow: Mask

    @property
    def points(self) -> Array:
        """(N, 2) ends of the beams, m."""
        return self.origins + self.ranges[:, None] * self.directions

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Scan:
        """Some of the beams, by mask or index."""
        return Scan(
            self.origins[chosen],
            self.directions[chosen],
            self.ranges[chosen],
            self.hits[chosen],
            self.narrow[chosen],
        )


class Scanner:
    """Both LiDARs' beams, for any number, range and mounting of them."""

    def __init__(self, world: WorldConfig) -> None:
        config, mounts = world.lidar, world.robot.mounts
        self._limit, self._beams = config.range, config.beams
        half = math.radians(config.fov) / 2
        self._step = 2 * half / (config.beams - 1)
        sweep = np.linspace(-half, half, config.beams)
        angles, starts = [], []
        for mount in (mounts.front_lidar, mounts.rear_lidar):
            angles.append(pose_of(mount).yaw + sweep)
            starts.append(np.tile([mount.x, mount.y], (config.beams, 1)))
        self._starts = np.concatenate(starts)
        self._angles = np.concatenate(angles)

    def read(self, pose: SE2, lidar: NDArray[np.float16]) -> Scan:
        """The beams of a robot at `pose`, in the frame of that pose; `lidar` (2 * beams,) in [0, 1]."""
        hits = lidar < 1.0
        ranges = lidar.astype(np.float64) * self._limit
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        origins = self._starts @ np.array([[c, s], [-s, c]]) + [pose.x, pose.y]
        angles = self._angles + pose.yaw
        directions = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
        points = origins + ranges[:, None] * directions
        n = self._beams
        narrow = [are_narrow(ranges[part], points[part], hits[part]) for part in (slice(n), slice(n, None))]
        return Scan(origins, directions, ranges, hits, np.concatenate(narrow))

    def bridges(self, scan: Scan) -> Array:
        """(K, 2) points of walls that run through the sectors beside the robot which neither LiDAR sees, m.

        A wall is taken to go on between the last beams of one scanner and the first of the other when all
        of these lie on one line.
        """
        n, few = self._beams, max(3, round(END_SECTOR / self._step))
        found = [np.empty((0, 2))]
        for last, first in ((slice(n - few, n), slice(n, n + few)), (slice(2 * n - few, None), slice(few))):
            ends = np.concatenate([scan.points[last], scan.points[first]])
            a, b = ends[0], ends[-1]
            length = float(np.hypot(*(b - a)))
            if not (scan.hits[last].all() and scan.hits[first].all() and 0.0 < length < LONGEST_BRIDGE):
                continue
            x, y = ((b - a) / length).tolist()
            if np.abs((ends - a) @ np.array([-y, x])).max() < STRAIGHT:
                found.append(a + np.linspace(0.0, 1.0, 2 + int(length / 0.08))[:, None] * (b - a))
        return np.concatenate(found)


def are_narrow(ranges: Array, points: Array, hits: Mask) -> Mask:
    """Which beams (B,) of one sweep hit something no wider than `NARROW` before a background."""
    breaks = np.abs(np.diff(ranges)) > JUMP
    firsts = np.flatnonzero(np.append(True, breaks))
    lasts = np.append(firsts[1:] - 1, len(ranges) - 1)
    chords = np.hypot(*(points[lasts] - points[firsts]).T)
    before, after = ranges[np.maximum(firsts - 1, 0)], ranges[np.minimum(lasts + 1, len(ranges) - 1)]
    free = (before > ranges[firsts]) & (after > ranges[lasts])  # false at the ends of a sweep
    return np.repeat(free & hits[firsts] & (chords <= NARROW), lasts - firsts + 1)


class ScanMemory:
    """The scans of the last `WINDOW` places, in one frame."""

    def __init__(self) -> None:
        self._scans: deque[Scan] = deque(maxlen=WINDOW)
        self._last: SE2 | None = None

    def __len__(self) -> int:
        return len(self._scans)

    def add(self, pose: SE2, scan: Scan) -> None:
        """Keeps a scan that was taken at `pose`."""
        last = self._last
        if last is not None and math.hypot(pose.x - last.x, pose.y - last.y) + abs(pose.yaw - last.yaw) < (
            SAME_PLACE
        ):
            self._scans.pop()
        self._scans.append(scan)
        self._last = pose

    def forget(self, keep: int) -> None:
        """Drops all but the newest `keep` scans."""
        while len(self._scans) > keep:
            self._scans.popleft()
        if not self._scans:
            self._last = None

    def latest(self, count: int) -> Scan:
        """The beams of the newest `count` scans."""
        scans = list(self._scans)[-count:]
        return Scan(*(np.concatenate(parts) for parts in zip(*scans, strict=True)))
