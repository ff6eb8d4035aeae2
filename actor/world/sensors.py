"""The robot's sensors: two corner LiDARs by ray casting and a front camera by the TinyRenderer."""

from __future__ import annotations

import math
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actor.world.appearance import Appearance, Light
from actor.world.bullet import BulletClient
from common.geometry import SE2, Array
from common.world_config import CameraConfig, LidarConfig, MountConfig, MountsConfig

RAY_GROUP, ROBOT_GROUP, SOLID_GROUP = 1, 2, 4
"""Collision groups: rays (always in Bullet's first group) and robot meet solid bodies, and only those."""


def pose_of(mount: MountConfig) -> SE2:
    """A mount in the robot's frame."""
    return SE2(mount.x, mount.y, math.radians(mount.yaw))


class Lidar:
    """Both scanners, front then rear, each sweeping counter-clockwise about the yaw of its mount.

    All beams are cast in one call, in the frame of the robot's body, where they never change.
    """

    def __init__(self, config: LidarConfig, mounts: MountsConfig, bullet: BulletClient, robot: int) -> None:
        self.config = config
        half = math.radians(config.fov) / 2
        sweep = np.linspace(-half, half, config.beams)
        starts, ends = [], []
        for mount in (mounts.front_lidar, mounts.rear_lidar):
            angles = pose_of(mount).yaw + sweep
            start = np.tile([mount.x, mount.y, mount.z], (config.beams, 1))
            reach = np.stack([-np.sin(angles), np.cos(angles), np.zeros_like(angles)], axis=1)
            starts.append(start)
            ends.append(start + config.range * reach)
        self.starts: Array = np.concatenate(starts)
        """(2 * beams, 3) in the robot's frame, m."""
        self.ends: Array = np.concatenate(ends)
        """Where a beam ends that hits nothing; likewise."""
        self._rays = self.starts.tolist(), self.ends.tolist()
        self._cast, self._robot = bullet.rayTestBatch, robot

    def sense(self, rng: np.random.Generator) -> NDArray[np.float16]:
        """(2 * beams,) distances as fractions of the range; 1 where nothing is hit. `rng` draws the noise."""
        hits = self._cast(
            *self._rays, parentObjectUniqueId=self._robot, parentLinkIndex=-1, collisionFilterMask=SOLID_GROUP
        )
        reading = np.fromiter(map(itemgetter(2), hits), np.float64, len(hits))
        config = self.config
        if config.noise > 0:
            noisy = reading + rng.normal(0.0, config.noise / config.range, len(reading))
            reading = np.where(reading < 1.0, np.clip(noisy, 0.0, 1.0), 1.0)
        if config.dropout > 0:
            reading[rng.random(len(reading)) < config.dropout] = 1.0
        return reading.astype(np.float16)


class Camera:
    """The front camera, adjusted to the light, exposure and noise of an episode."""

    def __init__(self, config: CameraConfig, mounts: MountsConfig, bullet: BulletClient) -> None:
        self.config = config
        self._mount, self._height = pose_of(mounts.camera), mounts.camera.z
        self._render = Renderer(bullet, config.size, config)
        # normal numbers drawn anew would cost 5% of a step: frames take theirs from a random place in here
        self._normal = np.random.default_rng(0).standard_normal(6 * config.size**2, np.float32)
        self._noise: tuple[NDArray[np.uint8], ...] | None = None

    def adjust(self, look: Appearance) -> None:
        """Prepares for an episode; exposure is a factor on the light, which is the same and costs nothing."""
        light, exposure = look.light, look.camera_exposure
        self._light = replace(light, ambient=exposure * light.ambient, diffuse=exposure * light.diffuse)
        self._noise = None
        if look.camera_noise > 0:
            noise = np.rint(look.camera_noise * self._normal)
            brighter, darker = (np.clip(part, 0, 255).astype(np.uint8) for part in (noise, -noise))
            self._noise = 255 - brighter, brighter, darker

    def view(self, pose: SE2) -> tuple[float, ...]:
        """OpenGL's view matrix for a robot at `pose`, column by column."""
        x, y = pose.apply(self._mount.x, self._mount.y)
        yaw, z = pose.yaw + self._mount.yaw, self._height
        c, s = math.cos(yaw), math.sin(yaw)  # right is (c, s, 0), ahead (-s, c, 0)
        turn = c, 0.0, s, 0.0, s, 0.0, -c, 0.0, 0.0, 1.0, 0.0, 0.0
        return *turn, -c * x - s * y, -z, c * y - s * x, 1.0

    def sense(self, pose: SE2, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(size, size, 3) RGB image; `rng` chooses the noise."""
        return self._add_noise(self._render(self.view(pose), self._light), rng)

    def sense_bodies(
        self, pose: SE2, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        """The image, and (size, size) which body each pixel shows: its id, -1 for none."""
        image, bodies = self._render.bodies(self.view(pose), self._light)
        return self._add_noise(image, rng), bodies

    def _add_noise(self, image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        if self._noise is None:
            return image
        first = int(rng.integers(len(self._normal) - image.size + 1))
        headroom, brighter, darker = (
            part[first : first + image.size].reshape(image.shape) for part in self._noise
        )
        image = np.minimum(image, headroom)  # saturating sums of bytes, three times faster than wider ones
        image += brighter
        image -= np.minimum(image, darker)
        return image


class Renderer:
    """Square pictures of one size and field of view, by the TinyRenderer."""

    def __init__(
        self, bullet: BulletClient, size: int, config: CameraConfig, fov: float | None = None
    ) -> None:
        self._take, self._size = bullet.getCameraImage, size
        self.projection = bullet.computeProjectionMatrixFOV(fov or config.fov, 1.0, config.near, config.far)
        self._constant = {
            "shadow": 0,
            "lightSpecularCoeff": 0.0,
            "renderer": bullet.ER_TINY_RENDERER,
        }
        self._no_bodies = bullet.ER_NO_SEGMENTATION_MASK

    def __call__(self, view: tuple[float, ...], light: Light) -> NDArray[np.uint8]:
        """(size, size, 3) RGB image."""
        return self._shoot(view, light, self._no_bodies)[0]

    def bodies(self, view: tuple[float, ...], light: Light) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        """The image, and (size, size) ids of the bodies that its pixels show; -1 for none."""
        image, ids = self._shoot(view, light, 0)
        return image, np.asarray(ids, np.int32).reshape(self._size, self._size)

    def _shoot(self, view: tuple[float, ...], light: Light, flags: int) -> tuple[NDArray[np.uint8], Any]:
        _, _, image, _, ids = self._take(
            self._size,
            self._size,
            view,
            self.projection,
            lightDirection=light.direction,
            lightColor=light.color,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            flags=flags,
            **self._constant,
        )
        rgba = np.asarray(image, np.uint8).reshape(self._size, self._size, 4)
        rgb = np.empty((self._size, self._size, 3), np.uint8)
        for channel in range(3):  # twice as fast as slicing all three
            rgb[..., channel] = rgba[..., channel]
        return rgb, ids
