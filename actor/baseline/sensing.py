"""The rivals that sense: B1 with a map and Monte-Carlo localisation, B2 with camera and LiDAR alone.

Both read of a world its configuration, its step count and, through the rollout, what the robot sensed and
did; B1 reads the room's index as well, for the map. Neither looks at the true poses.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from actor.baseline.localization import KnownRoom, LikelihoodField, ParticleFilter
from actor.baseline.pilot import Map, NoMap, Pilot
from actor.rollout import Rollout
from common.cells import ROOMS
from common.geometry import SE2
from common.observation import Observation
from common.tasks import Task, build_scene, random_stream
from common.world_config import WorldConfig

START_ERROR = 0.25, math.radians(10.0)
"""Standard deviations of the pose that B1's filter is begun with, m (x and y) and rad."""
START_PURPOSE = 3
"""Purpose of the random numbers that the start's error and the filter use."""

RoughStart = Callable[[Task, WorldConfig, np.random.Generator], SE2]


class SensingActor(ABC):
    """Drives the worlds of a rollout by what is sensed in them, one pilot for each episode."""

    def __init__(self, rollout: Rollout) -> None:
        self._rollout = rollout
        self._pilots: dict[int, Pilot] = {}

    def act(self, observation: Observation, slots: list[int]) -> NDArray[np.float32]:
        """(B, 2) actions in [-1, 1]; a world at its first step gets a new pilot."""
        actions = np.zeros((len(slots), 2), np.float32)
        for row, slot in enumerate(slots):
            sensed, last, _ = self._rollout.newest(slot)
            world = self._rollout.worlds[slot]
            is_start = world.steps == 0
            if is_start:
                self._pilots[slot] = Pilot(world.config, self._map(slot))
            pilot = self._pilots[slot]
            actions[row] = pilot.act(sensed.frame, sensed.lidar, None if is_start else last)
        return actions

    @abstractmethod
    def _map(self, slot: int) -> Map:
        """What is known of the room of a slot."""


class MaplessActor(SensingActor):
    """B2: camera, LiDAR and odometry, and nothing known before."""

    def _map(self, slot: int) -> Map:
        return NoMap()


class MappedActor(SensingActor):
    """B1: as B2, and with a map of the room, without obstacles and dolly, in which it localises itself.

    As with AMCL on a real fleet its filter has to be told roughly where it starts: `rough_start` gives that
    pose. By default it is the true one with a random error (`START_ERROR`), the only truth it is told.
    """

    def __init__(self, rollout: Rollout, rough_start: RoughStart | None = None) -> None:
        super().__init__(rollout)
        self._rough_start = rough_start or wrong_start

    def _map(self, slot: int) -> Map:
        world = self._rollout.worlds[slot]
        rng = random_stream(world.task, START_PURPOSE)
        start = self._rough_start(world.task, world.config, rng)
        cell = world.task.cell
        return KnownRoom(ROOMS[cell], ParticleFilter(_field(cell), start, START_ERROR, rng))


def wrong_start(task: Task, world: WorldConfig, rng: np.random.Generator) -> SE2:
    """The pose at which the robot starts, with a random error."""
    true = build_scene(task, world).robot
    x, y = rng.normal(0.0, START_ERROR[0], 2).tolist()
    return SE2(true.x + x, true.y + y, true.yaw + float(rng.normal(0.0, START_ERROR[1])))


@lru_cache(maxsize=len(ROOMS))
def _field(cell: int) -> LikelihoodField:
    return LikelihoodField(ROOMS[cell])
