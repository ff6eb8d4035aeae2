"""A scripted controller that docks with true poses: it tracks the planner's turns and drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

from actor.baseline.planning import plan
from actor.baseline.tracking import Speeds, Tracker, is_still
from common.geometry import SE2, Rectangle, wrap
from common.world_config import WorldConfig

MOVED = 0.01
"""The dolly has moved when it is this far, or turned this much, from where it was, m and rad."""


class ScriptedController:
    """Docks under the dolly from true poses: the ceiling of what control can reach (baseline B0).

    `solids` are the footprints of everything but the dolly, in the frame of the poses.
    """

    def __init__(self, world: WorldConfig, solids: Sequence[Rectangle]) -> None:
        self._world, self._solids = world, solids
        self._tracker = Tracker(world)
        self._dolly: SE2 | None = None
        """Where the dolly stood when the path was planned."""

    def act(self, pose: SE2, dolly: SE2, speeds: Speeds) -> tuple[float, float]:
        """The action [v, w] in [-1, 1] (m/s, rad/s) for the next control period.

        `pose` of the robot and `dolly` are true and in one frame, `speeds` are those of the left and right
        wheel, m/s. It stands still while it knows no way.
        """
        tracker = self._tracker
        tracker.finish_moves(pose, speeds)
        if self._dolly is None or apart(self._dolly, dolly, MOVED, MOVED) or tracker.is_off(pose):
            if not is_still(speeds):
                return tracker.steered(0.0, 0.0, speeds)
            tracker.path, self._dolly = plan(pose, dolly, self._solids, self._world), dolly
            tracker.finish_moves(pose, speeds)
        return tracker.command(pose, speeds)


def apart(a: SE2, b: SE2, distance: float, angle: float) -> bool:
    """Whether two poses differ by more than a distance (m) or an angle (rad)."""
    return math.hypot(a.x - b.x, a.y - b.y) > distance or abs(wrap(a.yaw - b.yaw)) > angle
