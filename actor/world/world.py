"""The docking world: one cell with robot, dolly and obstacles, stepped at the control rate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from actor.world.appearance import Appearance, draw_appearance
from actor.world.bodies import Bodies
from actor.world.bullet import connect
from actor.world.drive import DifferentialDrive
from actor.world.reward import ending_of, reward
from actor.world.sensors import Camera, Lidar
from common.config import WorldConfig
from common.geometry import SE2
from common.messages import Ending
from common.tasks import CELLS, Scene, Task, build_scene, random_stream


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
    """

    def __init__(self, config: WorldConfig, max_steps: int) -> None:
        self.config, self.max_steps = config, max_steps
        self.bullet = connect()
        self.bodies = Bodies(self.bullet, config)
        self._detect = self.bullet.performCollisionDetection
        self._points = self.bullet.getContactPoints
        self.lidar = Lidar(config.lidar, config.robot)
        self.camera = Camera(config.camera, config.robot)
        self.drive = DifferentialDrive(config.robot)
        self.task: Task | None = None
        self.scene: Scene | None = None
        self.pose = self.dolly = SE2()
        self.appearance = Appearance()
        self.steps = 0
        self._cell = -1

    def reset(self, task: Task) -> Sensed:
        """Builds the task's scene and returns the first row; raises UsageError for an impossible task."""
        self.task, self.scene = task, build_scene(task, self.config)
        boxes = CELLS[task.cell].fixtures + self.scene.obstacles
        self.appearance = Appearance()
        if self.config.randomize_appearance:
            self.appearance = draw_appearance(random_stream(task, 1), len(boxes))
        if task.cell != self._cell:
            self.bodies.build_room(task.cell)
            self._cell = task.cell
        self.bodies.build_boxes(boxes, self.appearance)
        self.pose, self.dolly, self.steps = self.scene.robot, self.scene.dolly, 0
        self.drive = DifferentialDrive(self.config.robot)
        self.bodies.place(self.bodies.robot, self.pose)
        self.bodies.place(self.bodies.dolly, self.dolly)
        self.bullet.performCollisionDetection()
        return self._sense()

    def step(self, action: ArrayLike) -> Step:
        """Holds the action [v, w] in [-1, 1]^2 (m/s, rad/s) for one control period, or until the end."""
        v, w = (float(a) for a in np.clip(action, -1.0, 1.0))
        targets = self.drive.targets(v, w)
        dt = self.config.control_period / self.config.substeps
        ending: Ending | None = None
        for _ in range(self.config.substeps):
            self.pose = self.drive.advance(self.pose, targets, dt)
            self.bodies.place(self.bodies.robot, self.pose)
            self._detect()
            distance = math.hypot(self.pose.x - self.dolly.x, self.pose.y - self.dolly.y)
            ending = ending_of(self.config.reward, distance, *self._contacts())
            if ending:
                break
        self.steps += 1
        if ending is None and self.steps >= self.max_steps:
            ending = "timeout"
        return Step(self._sense(), reward(self.config.reward, self.drive.speed, ending), ending)

    def close(self) -> None:
        """Frees the physics client."""
        if self.bullet.isConnected():
            self.bullet.disconnect()

    def _contacts(self) -> tuple[bool, bool]:
        """Whether the robot touches the dolly, and anything else (Bullet also reports near misses)."""
        touched = {point[2] for point in self._points(self.bodies.robot) if point[8] <= 0.0}
        return self.bodies.dolly in touched, bool(touched - {self.bodies.dolly})

    def _sense(self) -> Sensed:
        return Sensed(
            self.camera.sense(self.bullet, self.pose, self.appearance.light),
            self.lidar.sense(self.bullet, self.pose),
        )
