"""A scripted controller that docks with true poses: it tracks the planner's turns and drives."""

from __future__ import annotations

import math

from actor.baseline.planning import plan
from common.geometry import SE2, wrap
from common.tasks import Scene, surfaces
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
"""Distance from the path (m) and heading error of a drive (rad) that make it plan anew."""
OFF_AXIS = 0.02, math.radians(2.0)
"""The same for the drive under the dolly."""
MOVED = 0.01
"""The dolly has moved when it is this far, or turned this much, from where it was, m and rad."""


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


class ScriptedController:
    """Docks under the dolly from true poses: the ceiling of what control can reach (baseline B0)."""

    def __init__(self, world: WorldConfig, cell: int, scene: Scene) -> None:
        self._world = world
        self._surfaces = surfaces(cell, scene)
        self._path: list[SE2] = []
        """Where the present move began, where it ends, and the ends of those after it."""
        self._dolly: SE2 | None = None
        """Where the dolly stood when the path was planned."""

    def act(self, pose: SE2, dolly: SE2, speeds: tuple[float, float]) -> tuple[float, float]:
        """The action [v, w] in [-1, 1] (m/s, rad/s) for the next control period.

        `pose` of the robot and `dolly` are true and in the cell's frame, `speeds` are those of the left and
        right wheel, m/s. It stands still while it knows no way.
        """
        self._finish_moves(pose, speeds)
        if self._dolly is None or _apart(self._dolly, dolly, MOVED) or self._is_off(pose):
            if max(map(abs, speeds)) > STILL:
                return self._steered(0.0, 0.0, speeds)
            self._path, self._dolly = plan(pose, dolly, self._surfaces, self._world), dolly
            self._finish_moves(pose, speeds)
        if len(self._path) < 2:
            return 0.0, 0.0
        return self._turn(pose, speeds) if self._is_turn() else self._drive(pose, speeds)

    def _is_turn(self) -> bool:
        return self._path[0].yaw != self._path[1].yaw

    def _finish_moves(self, pose: SE2, speeds: tuple[float, float]) -> None:
        """Drops the moves that are done."""
        while len(self._path) > 2 and self._is_done(pose, speeds):
            del self._path[0]

    def _is_done(self, pose: SE2, speeds: tuple[float, float]) -> bool:
        target = self._path[1]
        here = target.inverse() @ pose
        error, tolerance = (here.yaw, TURNED) if self._is_turn() else (here.y, ARRIVED)
        return abs(error) < tolerance and max(map(abs, speeds)) < STILL

    def _is_off(self, pose: SE2) -> bool:
        """Whether the robot has left its path: too far for the margins, or under the dolly for its legs."""
        if len(self._path) < 2:
            return False
        here = self._path[1].inverse() @ pose
        if self._is_turn():
            return math.hypot(here.x, here.y) > OFF_PATH[0]
        last = len(self._path) == 2 and abs(here.y) < 1.2
        limits = OFF_AXIS if last else OFF_PATH
        return abs(here.x) > limits[0] or abs(here.yaw) > limits[1]

    def _turn(self, pose: SE2, speeds: tuple[float, float]) -> tuple[float, float]:
        config = self._world.robot
        rate = (speeds[1] - speeds[0]) / config.track
        acceleration = 2 * config.wheel_acceleration / config.track
        remaining = wrap(self._path[1].yaw - pose.yaw)
        return 0.0, approach(remaining, rate, acceleration, self._world.control_period)

    def _drive(self, pose: SE2, speeds: tuple[float, float]) -> tuple[float, float]:
        config, period = self._world.robot, self._world.control_period
        here = self._path[1].inverse() @ pose
        ahead = -here.y
        wanted = math.copysign(min(CROSS_GAIN * abs(here.x), STEEPEST), here.x * ahead)
        w = min(max(HEADING_GAIN * (wanted - here.yaw), -1.0), 1.0)
        rate = (speeds[0] + speeds[1]) / 2
        return self._steered(approach(ahead, rate, config.wheel_acceleration, period), w, speeds)

    def _steered(self, v: float, w: float, speeds: tuple[float, float]) -> tuple[float, float]:
        """The action nearest to v (m/s) whose w (rad/s) both wheels can reach within the period."""
        config = self._world.robot
        rate, turning = (speeds[0] + speeds[1]) / 2, (speeds[1] - speeds[0]) / config.track
        change = config.wheel_acceleration * self._world.control_period - abs(w - turning) * config.track / 2
        return min(max(v, rate - change), rate + change), w


def _apart(a: SE2, b: SE2, limit: float) -> bool:
    return math.hypot(a.x - b.x, a.y - b.y) > limit or abs(wrap(a.yaw - b.yaw)) > limit
