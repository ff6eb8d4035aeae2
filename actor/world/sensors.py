"""The robot's sensors: two corner LiDARs by ray casting and a front camera by the TinyRenderer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.config import CameraConfig, LidarConfig, RobotConfig
from common.geometry import SE2

RAY_GROUP, ROBOT_GROUP, SOLID_GROUP = 1, 2, 4
"""Collision groups: rays (always in Bullet's first group) and robot meet solid bodies, and only those."""


@dataclass(frozen=True, slots=True)
class Light:
    """Illumination of a scene: direction towards the light, colour, ambient and diffuse shares."""

    direction: tuple[float, float, float] = (2.0, -3.0, 6.0)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ambient: float = 0.6
    diffuse: float = 0.5


class Lidar:
    """Both scanners, front-left then rear-right, sweeping counter-clockwise about the outward diagonal."""

    def __init__(self, config: LidarConfig, robot: RobotConfig) -> None:
        self.config = config
        half = math.radians(config.fov) / 2
        sweep = np.linspace(-half, half, config.beams)
        front_left = SE2(-robot.width / 2, robot.length / 2, math.pi / 4)
        rear_right = SE2(robot.width / 2, -robot.length / 2, -3 * math.pi / 4)
        mounts = (front_left, rear_right)
        self._origins = np.concatenate([np.tile([m.x, m.y], (config.beams, 1)) for m in mounts])
        angles = np.concatenate([m.yaw + sweep for m in mounts])
        self._directions = np.stack([-np.sin(angles), np.cos(angles)], axis=1)

    def rays(self, pose: SE2) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Start and end points of all beams for a robot at `pose`, (2 * beams, 3) each, m."""
        c, s = math.cos(pose.yaw), math.sin(pose.yaw)
        rotation = np.array([[c, s], [-s, c]])
        starts = self._origins @ rotation + (pose.x, pose.y)
        ends = starts + self.config.range * (self._directions @ rotation)
        z = np.full((len(starts), 1), self.config.height)
        return np.hstack([starts, z]), np.hstack([ends, z])

    def sense(self, bullet: Any, pose: SE2) -> NDArray[np.float16]:
        """(2 * beams,) distances as fractions of the range; 1 where nothing is hit."""
        starts, ends = self.rays(pose)
        hits = bullet.rayTestBatch(starts.tolist(), ends.tolist(), collisionFilterMask=SOLID_GROUP)
        return np.array([hit[2] for hit in hits], np.float16)


class Camera:
    """The front camera, in the middle of the front face, looking ahead."""

    def __init__(self, config: CameraConfig, robot: RobotConfig) -> None:
        self.config = config
        self._mount = SE2(0.0, robot.length / 2)
        self._height = (robot.floor_gap + robot.height) / 2

    def sense(self, bullet: Any, pose: SE2, light: Light) -> NDArray[np.uint8]:
        """(size, size, 3) RGB image."""
        eye = pose @ self._mount
        ahead = eye.apply(0.0, 1.0)
        view = bullet.computeViewMatrix((eye.x, eye.y, self._height), (*ahead, self._height), (0, 0, 1))
        return render(bullet, view, self.config.size, self.config.fov, self.config, light)


def render(
    bullet: Any, view: Any, size: int, fov: float, clip: CameraConfig, light: Light
) -> NDArray[np.uint8]:
    """(size, size, 3) RGB image of a square view with field of view `fov` (degrees)."""
    image = bullet.getCameraImage(
        size,
        size,
        view,
        bullet.computeProjectionMatrixFOV(fov, 1.0, clip.near, clip.far),
        lightDirection=light.direction,
        lightColor=light.color,
        lightAmbientCoeff=light.ambient,
        lightDiffuseCoeff=light.diffuse,
        lightSpecularCoeff=0.0,
        shadow=0,
        renderer=bullet.ER_TINY_RENDERER,
        flags=bullet.ER_NO_SEGMENTATION_MASK,
    )[2]
    return np.asarray(image, np.uint8).reshape(size, size, 4)[..., :3].copy()
