"""The differential drive: wheel speeds follow their targets with limited acceleration, without slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import SE2, Array
from common.world_config import RobotConfig


@dataclass(frozen=True, slots=True)
class Motion:
    """N substeps, (N,) each: x, y in m, yaw in rad (not wrapped), wheel speeds in m/s."""

    x: Array
    y: Array
    yaw: Array
    left: Array
    right: Array

    def since(self, first: int) -> Motion:
        """Without the substeps before `first`."""
        return Motion(*(part[first:] for part in (self.x, self.y, self.yaw, self.left, self.right)))


def wheel_targets(config: RobotConfig, v: float, w: float) -> tuple[float, float]:
    """Wheel speeds for v (m/s) and w (rad/s), slowed down together when one would exceed the limit."""
    half = w * config.track / 2
    fastest = max(abs(v - half), abs(v + half))
    scale = min(1.0, config.max_speed / fastest) if fastest > 0 else 1.0
    return (v - half) * scale, (v + half) * scale


def advance(
    config: RobotConfig,
    pose: SE2,
    speeds: tuple[float, float],
    targets: tuple[float, float],
    dt: float,
    substeps: int,
) -> Motion:
    """The next `substeps` of `dt` s from a pose and wheel speeds (left, right), which approach `targets`.

    The robot turns about the middle of its axle, its centre.
    """
    change = config.wheel_acceleration * dt * np.arange(1, substeps + 1)
    left, right = (
        np.minimum(speed + change, target) if target > speed else np.maximum(speed - change, target)
        for speed, target in zip(speeds, targets, strict=True)
    )
    turns = (right - left) * (dt / config.track)
    yaw = pose.yaw + turns.cumsum()
    middle = yaw - turns / 2
    steps = (left + right) * (dt / 2)
    x = pose.x - (steps * np.sin(middle)).cumsum()
    y = pose.y + (steps * np.cos(middle)).cumsum()
    return Motion(x, y, yaw, left, right)
