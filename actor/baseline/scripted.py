"""The scripted controller in the place of a policy: it drives the worlds of a rollout by their true poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from actor.baseline.docking import ScriptedController
from actor.world.world import DockingWorld
from common.observation import Observation
from common.tasks import surfaces


class ScriptedActor:
    """Chooses actions like any `Actor`, but from the worlds themselves instead of the observation."""

    def __init__(self, worlds: Sequence[DockingWorld]) -> None:
        self._worlds = worlds
        self._controllers: dict[int, ScriptedController] = {}

    def act(self, observation: Observation, slots: list[int]) -> NDArray[np.float32]:
        """(B, 2) actions in [-1, 1]; a world at its first step gets a new controller."""
        actions = []
        for slot in slots:
            world = self._worlds[slot]
            if world.steps == 0:
                solids = surfaces(world.task.cell, world.scene)
                self._controllers[slot] = ScriptedController(world.config, solids)
            actions.append(self._controllers[slot].act(world.pose, world.dolly, world.speeds))
        return np.array(actions, np.float32)
