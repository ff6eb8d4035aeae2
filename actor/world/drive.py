"""The differential drive: wheel speeds follow their targets with limited acceleration, without slip."""

from __future__ import annotations

import math
from dataclasses import dataclass

from common.config import RobotConfig
from common.geometry import SE2, wrap


@dataclass(slots=True)
class DifferentialDrive:
    """Wheel speeds (m/s) of a robot that turns about the middle of its axle, its centre."""

    config: RobotConfig
    left: float = 0.0
    right: float = 0.0

    @property
    def speed(self) -> float:
        """Measured forward speed, m/s."""
        return (self.left + self.right) / 2

    def targets(self, v: float, w: float) -> tuple[float, float]:
        """Wheel speeds for v (m/s) and w (rad/s), slowed down together when one would exceed the limit."""
        half = w * self.config.track / 2
        fastest = max(abs(v - half), abs(v + half))
        scale = min(1.0, self.config.max_speed / fastest) if fastest > 0 else 1.0
        return (v - half) * scale, (v + half) * scale

    def advance(self, pose: SE2, targets: tuple[float, float], dt: float) -> SE2:
        """The pose after `dt` s; wheel speeds move towards `targets`."""
        limit = self.config.wheel_acceleration * dt
        self.left += min(max(targets[0] - self.left, -limit), limit)
        self.right += min(max(targets[1] - self.right, -limit), limit)
        turn = (self.right - self.left) / self.config.track * dt
        middle = pose.yaw + turn / 2
        step = self.speed * dt
        return SE2(pose.x - step * math.sin(middle), pose.y + step * math.cos(middle), wrap(pose.yaw + turn))
