"""The docking world as the Gymnasium environment `navaclq/Docking-v0`, with Dict observations (table 1)."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from actor.world.views import VIEWS
from actor.world.world import DockingWorld, Sensed
from common.cells import CELLS
from common.config import Config, resolve
from common.observation import ACTION_SIZE, HISTORY, Columns, ObservationLayout, observe
from common.tasks import Task, random_task

Observed = dict[str, NDArray[Any]]


class DockingEnv(gymnasium.Env[Observed, NDArray[np.float32]]):
    """Drive the robot under the dolly.

    Action: (2,) float32 [v, w] in [-1, 1], m/s and rad/s.

    Observation: `camera` (4, S, S, 3) uint8 and `actions` (4, 2), `rewards` (4,) float32 are the four most
    recent, oldest first; `lidar` (2 * beams,) float32 in [0, 1].

    `reset(options={"task": Task})` sets the start, `{"cell": 3}` the cell; otherwise the seed decides both.
    `render()` gives the scene from above or, with `view="chase"`, from behind the robot.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012

    def __init__(
        self,
        config: Config | None = None,
        render_mode: str | None = None,
        view: Literal["birds_eye", "chase"] = "birds_eye",
    ) -> None:
        if view not in VIEWS:
            raise ValueError(f"view {view!r} does not exist; choose one of {', '.join(VIEWS)}")
        config = config or resolve()
        raw = config.model_copy(update={"encoder": config.encoder.model_copy(update={"end_to_end": True})})
        self.config, self.render_mode, self._view = config, render_mode, VIEWS[view]
        self._layout = ObservationLayout.of(raw)
        steps = config.world.max_episode_steps
        self._world = DockingWorld(config.world, steps)
        self._rows = Columns.empty(steps + 1, self._layout)
        size = config.world.camera.size
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            camera=spaces.Box(0, 255, (HISTORY, size, size, 3), np.uint8),
            lidar=spaces.Box(0.0, 1.0, (self._layout.lidar,), np.float32),
            actions=spaces.Box(-1.0, 1.0, (HISTORY, ACTION_SIZE), np.float32),
            rewards=spaces.Box(-100.0, 100.0, (HISTORY,), np.float32),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Starts the episode of `options["task"]`, or one drawn from the environment's generator."""
        super().reset(seed=seed)
        options = options or {}
        cell = options.get("cell", int(self.np_random.integers(len(CELLS))))
        task: Task = options.get("task") or random_task(cell, self.config, self.np_random)
        self._put(0, self._world.reset(task))
        return self._observe(0), {"task": task.model_dump()}

    def step(self, action: NDArray[np.float32]) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Holds the action for one control period; `info["ending"]` says how the episode ended."""
        t = self._world.steps
        sensed, reward, ending = self._world.step(action)
        self._rows.action[t], self._rows.reward[t] = np.clip(action, -1.0, 1.0), reward
        self._put(t + 1, sensed)
        truncated = ending == "timeout"
        info = {"ending": ending, "is_success": ending == "success"}
        return self._observe(t + 1), float(reward), ending is not None and not truncated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene, (480, 480, 3) uint8, in render mode `rgb_array`."""
        return self._view(self._world, 480) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Frees the physics client."""
        self._world.close()

    def _put(self, row: int, sensed: Sensed) -> None:
        self._rows.visual[row], self._rows.lidar[row] = sensed

    def _observe(self, row: int) -> Observed:
        seen = observe(self._rows, np.array([row]), np.array([0]), self._layout)
        split = HISTORY * ACTION_SIZE
        return {
            "camera": seen.visual[0],
            "lidar": seen.lidar[0].astype(np.float32),
            "actions": seen.history[0, :split].reshape(HISTORY, ACTION_SIZE),
            "rewards": seen.history[0, split:],
        }
