"""Tracks a path of turns on the spot and straight drives, braking in time for the end of each."""

from __future__ import annotations

import math

from common.geometry import SE2, wrap
from common.world_config import WorldConfig

TURNED = 0.005
"""A turn ends within this of its heading, rad."""
ARRIVED = 0.01
"""A drive ends within this of its end, m."""
STILL = 0.02
"""Wheels slower than this stand, m/s."""
CROSS_GAIN = 1.5
"""Heading towards the line for each metre off it, rad/m."""
STEEPEST = 0.3
"""Largest heading towards the line, rad."""
HEADING_GAIN = 3.0
"""Rate of turn for each radian of heading error, 1/s."""
OFF_PATH = 0.10, 0.20
"""Distance from the path (m) and heading error of a drive (rad) that make a path useless."""
OFF_AXIS = 0.02, math.radians(2.0)
"""The same for the drive under the dolly."""
UNDER = 1.2
"""Nearer than this to the end of the path's last drive the robot counts as under the dolly, m."""

Speeds = tuple[float, float]
"""Of the left and the right wheel, m/s."""


def approach(remaining: float, rate: float, acceleration: float, period: float) -> float:
    """Fastest rate in [-1, 1] to hold for `period` (s) so that the robot can still stop after `remaining`.

    `rate` is measured now; units are m, m/s, m/s^2 for drives and rad, rad/s, rad/s^2 for turns.
    """
    sign = math.copysign(1.0, remaining)
    distance, now = abs(remaining), sign * rate
    command = (distance + now * now / (2 * acceleration)) / (period + max(now, 0.0) / acceleration)
    if command < now:  # it has to brake: held + slowing down to it + stopping from it = distance
        half = (now - acceleration * period) / 2
        command = half + math.sqrt(max(half * half - now * now / 2 + acceleration * distance, 0.0))
    return sign * min(max(command, 0.0), 1.0)


def is_still(speeds: Speeds) -> bool:
    """Whether the robot stands."""
    return max(map(abs, speeds)) <= STILL


class Tracker:
    """Follows `path`: where the present move began, where it ends, and the ends of those after it."""

    def __init__(self, world: WorldConfig) -> None:
        self._world = world
        self.path: list[SE2] = []

    @property
    def is_turning(self) -> bool:
        """Whether the present move is a turn."""
        return self.path[0].yaw != self.path[1].yaw

    def finish_moves(self, pose: SE2, speeds: Speeds) -> None:
        """Drops the moves that are done, but never the last."""
        while len(self.path) > 2 and self.is_done(pose, speeds):
            del self.path[0]

    def is_done(self, pose: SE2, speeds: Speeds) -> bool:
        """Whether the robot stands at the end of the present move."""
        target = self.path[1]
        here = target.inverse() @ pose
        error, tolerance = (here.yaw, TURNED) if self.is_turning else (here.y, ARRIVED)
        return abs(error) < tolerance and max(map(abs, speeds)) < STILL

    def is_off(self, pose: SE2, docking: bool = True) -> bool:
        """Whether the robot has left its path: too far for the margins, or under the dolly for its legs.

        `docking` tells whether the path's last drive leads under the dolly.
        """
        if len(self.path) < 2:
            return False
        here = self.path[1].inverse() @ pose
        if self.is_turning:
            return math.hypot(here.x, here.y) > OFF_PATH[0]
        last = docking and len(self.path) == 2 and abs(here.y) < UNDER
        limits = OFF_AXIS if last else OFF_PATH
        return abs(here.x) > limits[0] or abs(here.yaw) > limits[1]

    def command(self, pose: SE2, speeds: Speeds) -> tuple[float, float]:
        """The action [v, w] in [-1, 1] (m/s, rad/s) for the next control period; rests without a path."""
        if len(self.path) < 2:
            return 0.0, 0.0
        return self._turn(pose, speeds) if self.is_turning else self._drive(pose, speeds)

    def steered(self, v: float, w: float, speeds: Speeds) -> tuple[float, float]:
        """The action nearest to v (m/s) whose w (rad/s) both wheels can reach within the period."""
        config = self._world.robot
        rate, turning = (speeds[0] + speeds[1]) / 2, (speeds[1] - speeds[0]) / config.track
        change = config.wheel_acceleration * self._world.control_period - abs(w - turning) * config.track / 2
        return min(max(v, rate - change), rate + change), w

    def _turn(self, pose: SE2, speeds: Speeds) -> tuple[float, float]:
        config = self._world.robot
        rate = (speeds[1] - speeds[0]) / config.track
        acceleration = 2 * config.wheel_acceleration / config.track
        remaining = wrap(self.path[1].yaw - pose.yaw)
        return 0.0, approach(remaining, rate, acceleration, self._world.control_period)

    def _drive(self, pose: SE2, speeds: Speeds) -> tuple[float, float]:
        config, period = self._world.robot, self._world.control_period
        here = self.path[1].inverse() @ pose
        ahead = -here.y
        wanted = math.copysign(min(CROSS_GAIN * abs(here.x), STEEPEST), here.x * ahead)
        w = min(max(HEADING_GAIN * (wanted - here.yaw), -1.0), 1.0)
        rate = (speeds[0] + speeds[1]) / 2
        return self.steered(approach(ahead, rate, config.wheel_acceleration, period), w, speeds)
