"""What the camera says of the dolly: pixels of its blue, their bearings, and roughly where it stands."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actor.world.sensors import pose_of
from common.geometry import SE2, Array
from common.world_config import WorldConfig

RED_SHARE, GREEN_SHARE = 1.0 / 1.55, 1.03
"""Most red and green for each blue: only the dolly stays below, in all lights of the training cells."""
DARKEST = 24
"""Below this level of blue (of 255) the camera's noise decides the hue."""
FEWEST = 0.0005
"""Share of the image's pixels that must be blue before they count: 3 of 80 x 80."""
FARTHEST = 5.0
"""A dolly that seems farther, as one half in view may, is looked for at this distance first, m."""
BEHIND_EDGE = 0.55
"""From the dolly's nearest edge to its centre, m, whatever its yaw: 0.41 to 0.74."""


class Sighting(NamedTuple):
    """One frame: the camera's pose, which columns (S,) hold blue, and the dolly's rough place (m) if any."""

    camera: SE2
    columns: NDArray[np.bool_]
    place: tuple[float, float] | None


class Sight:
    """Finds the dolly's blue in frames of any square size."""

    def __init__(self, world: WorldConfig) -> None:
        config, mount = world.camera, world.robot.mounts.camera
        self._mount, self._size = pose_of(mount), config.size
        self.focal = config.size / 2 / math.tan(math.radians(config.fov) / 2)
        """Focal length, pixels."""
        self._rise = world.dolly.underside + world.dolly.deck - mount.z
        self._offsets: Array = config.size / 2 - 0.5 - np.arange(config.size, dtype=np.float64)

    def look(self, pose: SE2, frame: NDArray[np.uint8]) -> Sighting:
        """What a frame (S, S, 3) shows to a robot at `pose`, in the frame of that pose."""
        camera = pose @ self._mount
        blue = is_blue(frame)
        rows, columns = np.asarray(blue.any(axis=1)), np.asarray(blue.any(axis=0))
        if np.count_nonzero(blue) < max(3, FEWEST * blue.size):
            return Sighting(camera, np.zeros_like(columns), None)
        left, right = self._offsets[np.flatnonzero(columns)[[0, -1]]]
        top = float(self._offsets[np.flatnonzero(rows)[0]])
        # the deck's nearest upper edge is its highest in the image, as the camera looks up at it
        depth = self.focal * self._rise / max(top, 0.5)
        depth = min(depth, FARTHEST)
        side = -float(left + right) / 2 / self.focal
        away = (depth + BEHIND_EDGE / math.hypot(1.0, side)) if depth > 0 else 0.0
        return Sighting(camera, columns, camera.apply(side * away, away))

    def agrees(self, sightings: list[Sighting], x: float, y: float) -> tuple[int, int]:
        """How many frames that had a place (m) in view, 1 to 5 m away, show blue there, and how many none."""
        yes = no = 0
        for camera, columns, _ in sightings:
            side, ahead = camera.inverse().apply(x, y)
            if not 1.0 < ahead < 5.0:
                continue
            column = self._size / 2 + self.focal * side / ahead
            margin = self.focal * 0.25 / ahead
            if not margin < column < self._size - margin:
                continue
            if columns[int(column - margin) : int(column + margin) + 1].any():
                yes += 1
            else:
                no += 1
        return yes, no


def is_blue(frame: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(S, S) which pixels of a frame (S, S, 3) are as blue as a dolly."""
    red, green, blue = (frame[..., k].astype(np.float32) for k in range(3))
    return np.asarray((blue > DARKEST) & (red < RED_SHARE * blue) & (green < GREEN_SHARE * blue))
