"""Dead reckoning: where the robot has driven to by its own actions and the known model of its drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from actor.world.drive import advance, wheel_targets
from common.geometry import SE2, wrap
from common.world_config import WorldConfig


class Odometry:
    """Pose in the frame of the start, where it was the identity, and wheel speeds.

    The drive knows no slip, so that this is exact until an episode ends.
    """

    def __init__(self, world: WorldConfig) -> None:
        self._world = world
        self.pose = SE2()
        self.speeds = 0.0, 0.0
        """Of the left and the right wheel, m/s."""

    def move(self, action: NDArray[np.float32]) -> SE2:
        """Goes on by one control period with [v, w] in [-1, 1]; returns the motion in the old frame."""
        world, before = self._world, self.pose
        v, w = np.clip(action, -1.0, 1.0).tolist()
        dt = world.control_period / world.substeps
        targets = wheel_targets(world.robot, v, w)
        motion = advance(world.robot, before, self.speeds, targets, dt, world.substeps)
        self.pose = SE2(float(motion.x[-1]), float(motion.y[-1]), wrap(float(motion.yaw[-1])))
        self.speeds = float(motion.left[-1]), float(motion.right[-1])
        return before.inverse() @ self.pose
