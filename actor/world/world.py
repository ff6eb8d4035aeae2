"""The docking world: one room with robot, dolly and obstacles, stepped at the control rate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from actor.world.appearance import Appearance, draw_appearance
from actor.world.bodies import Bodies
from actor.world.bullet import connect
from actor.world.drive import advance, wheel_targets
from actor.world.reward import ending_of, reward
from actor.world.sensors import Camera, Lidar
from common.geometry import SE2, Rectangle, as_rows, rectangles_overlap, separations, wrap
from common.messages import Ending
from common.tasks import START_MARGIN, Scene, Task, build_scene, dolly_sides, random_stream, surfaces
from common.world_config import WorldConfig

NEAR = 0.1
"""Free space beyond its reach in which a robot is not watched at every substep, m."""


class Sensed(NamedTuple):
    """One row of an episode as sensed: frame (S, S, 3) uint8, lidar (2 * beams,) float16 in [0, 1]."""

    frame: NDArray[np.uint8]
    lidar: NDArray[np.float16]


class Step(NamedTuple):
    """What a control step brought: the new row, the reward, and the ending if the episode has ended."""

    sensed: Sensed
    reward: float
    ending: Ending | None


class DockingWorld:
    """A pybullet world to the letter of section 3.3 and appendices B and C.

    The robot is moved kinematically: wheel speeds with limited acceleration, integrated at every physics
    substep; pybullet finds contacts, casts the LiDAR's rays and renders the camera.

    >>> world.reset(task)
    >>> while not world.step(action).ending:
    ...     pass
    """

    task: Task
    scene: Scene
    appearance: Appearance

    def __init__(self, config: WorldConfig, max_steps: int) -> None:
        self.config, self.max_steps = config, max_steps
        self.bullet = connect()
        self.bodies = Bodies(self.bullet, config)
        mounts = config.robot.mounts
        self.lidar = Lidar(config.lidar, mounts, self.bullet, self.bodies.robot)
        self.camera = Camera(config.camera, mounts, self.bullet)
        self.pose = self.dolly = SE2()
        self.speeds = 0.0, 0.0
        """Of the left and the right wheel, m/s."""
        self.steps = 0
        self._shift_at: int | None = None
        self._detect = self.bullet.performCollisionDetection
        self._points = self.bullet.getContactPoints

    def reset(self, task: Task) -> Sensed:
        """Builds the task's scene and returns the first row; raises UsageError for an impossible task."""
        self.place(task)
        return self.sense()

    def place(self, task: Task) -> None:
        """`reset` without sensing."""
        self.scene = build_scene(task, self.config)
        self.task = task
        self.appearance = draw_appearance(random_stream(task, 1), self.config.randomization, task.cell)
        self._noise = random_stream(task, 2)
        self.bodies.enter(task.cell)
        self.bodies.arrange(self.scene.obstacles)
        self.bodies.dress(self.appearance)
        self.camera.adjust(self.appearance)
        self.speeds, self.steps = (0.0, 0.0), 0
        self._shift_at = task.shift.step if task.shift else None
        self.stand(self.scene.robot, self.scene.dolly)

    def stand(self, robot: SE2, dolly: SE2) -> None:
        """Puts robot and dolly where they have not driven to."""
        self.pose, self.dolly = robot, dolly
        self._touchable = as_rows([*surfaces(self.task.cell, self.scene), *dolly_sides(dolly, self.config)])
        self._gap = 0.0  # how far the robot may surely go before it touches anything or docks, m
        self.bodies.hide(self.bodies.robot)
        self._detect()  # or Bullet would keep contacts of the old place
        self.bodies.place(self.bodies.dolly, dolly)
        self.bodies.place(self.bodies.robot, robot)
        self._detect()

    def step(self, action: ArrayLike) -> Step:
        """Holds the action [v, w] in [-1, 1]^2 (m/s, rad/s) for one control period, or until the end."""
        reward, ending = self.advance(action)
        return Step(self.sense(), reward, ending)

    def advance(self, action: ArrayLike) -> tuple[float, Ending | None]:
        """`step` without sensing: reward and ending. Raises ValueError for an action that is not a number."""
        v, w = np.clip(action, -1.0, 1.0).tolist()
        if math.isnan(v + w):
            raise ValueError(f"action [{v}, {w}] is not a number")
        if self._shift_at is not None and self.steps >= self._shift_at:
            self._shift_dolly()
        config, substeps = self.config, self.config.substeps
        targets = wheel_targets(config.robot, v, w)
        # where nothing is near, the last substep is enough; that saves 5% of a step
        first = 0 if self._is_anything_near(targets) else substeps - 1
        period = config.control_period / substeps
        motion = advance(config.robot, self.pose, self.speeds, targets, period, substeps).since(first)
        distances = np.hypot(motion.x - self.dolly.x, motion.y - self.dolly.y).tolist()
        half = motion.yaw / 2
        nothing = [0.0] * (substeps - first)
        places = zip(motion.x.tolist(), motion.y.tolist(), nothing, strict=True)
        turns = zip(nothing, nothing, np.sin(half).tolist(), np.cos(half).tolist(), strict=True)
        ending: Ending | None = None
        docked = config.reward.success_distance
        move, detect, points, robot = self.bodies.move, self._detect, self._points, self.bodies.robot
        # the loop makes Bullet's calls and next to nothing else: it runs 36 times a control step
        for k, (place, turn) in enumerate(zip(places, turns, strict=True)):
            move(robot, place, turn)
            detect()
            near = points(robot)
            if near or distances[k] < docked:
                # Bullet also reports near misses
                touched = {point[2] for point in near if point[8] <= 0.0}
                on_dolly = self.bodies.dolly in touched
                ending = ending_of(config.reward, distances[k], on_dolly, len(touched) > on_dolly)
                if ending:
                    break
        self.pose = SE2(float(motion.x[k]), float(motion.y[k]), wrap(float(motion.yaw[k])))
        self.speeds = float(motion.left[k]), float(motion.right[k])
        self.steps += 1
        if ending is None and self.steps >= self.max_steps:
            ending = "timeout"
        return reward(config.reward, sum(self.speeds) / 2, ending), ending

    def sense(self) -> Sensed:
        """What the robot senses where it stands."""
        return Sensed(self.camera.sense(self.pose, self._noise), self.lidar.sense(self._noise))

    def close(self) -> None:
        """Frees the physics client."""
        if self.bullet.isConnected():
            self.bullet.disconnect()

    def _is_anything_near(self, targets: tuple[float, float]) -> bool:
        """Whether the robot could touch anything, or dock, in the next control step.

        No point of it goes farther than its centre does and its farthest corner turns, and speed and rate of
        turn change steadily towards their targets. The gap is measured anew when that has used it up.
        """
        robot, pose, period = self.config.robot, self.pose, self.config.control_period
        half = robot.width / 2, robot.length / 2
        (left, right), (new_left, new_right) = self.speeds, targets
        speed = max(abs(left + right), abs(new_left + new_right)) / 2
        rate = max(abs(right - left), abs(new_right - new_left)) / robot.track
        reach = period * (speed + rate * math.hypot(*half))
        self._gap -= reach
        if self._gap < NEAR:
            here = np.array([[pose.x, pose.y, pose.yaw]])
            to_touch = float(separations(here, half, self._touchable).min())
            to_dock = math.hypot(pose.x - self.dolly.x, pose.y - self.dolly.y)
            self._gap = min(to_touch, to_dock - self.config.reward.success_distance) - reach
        return self._gap < NEAR

    def _shift_dolly(self) -> None:
        """Moves the dolly as the task asks, unless the robot stands where it is to be."""
        assert self.scene.shifted is not None
        robot, dolly = self.config.robot, self.config.dolly
        body = Rectangle(self.pose, robot.width / 2, robot.length / 2)
        target = Rectangle(self.scene.shifted, dolly.width / 2, dolly.length / 2)
        if not rectangles_overlap(body, target, START_MARGIN):
            self._shift_at = None
            self.stand(self.pose, self.scene.shifted)
