"""What learns, apart from bus and files: replay, rate limiter and SAC, and the one step that joins them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from common.config import Config
from common.errors import RunError
from common.messages import Episode
from common.observation import ObservationLayout
from learner.replay.buffer import Batch, Replay
from learner.replay.limiter import RateLimiter
from learner.sac import SAC, Losses


class Learner:
    """Takes episodes in and makes updates; `save` and `load` hold all of it but the episodes themselves."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.layout = ObservationLayout.of(config)
        steps = config.world.max_episode_steps
        self._rng = np.random.default_rng([config.seed, 1])
        self.limiter = RateLimiter(config.replay, config.sac.batch_size, steps)
        self.replay = Replay(config.replay, self.layout, steps, self._rng)
        self.sac = SAC(config)
        self._drawn: list[Batch] = []

    def insert(self, episode: Episode, first_step: int, restored: bool = False) -> None:
        """Stores an episode, whose first transition is the run's `first_step`.

        A restored one is worth no updates: those were made, or were lost, before the restart.
        """
        self.replay.add(episode, first_step)
        if restored:
            self.limiter.inserted += episode.length
        else:
            self.limiter.insert(episode.length)

    def update(self, env_steps: int) -> Losses | None:
        """One update, if the limiter allows it; `env_steps` is where the run stands in its schedules.

        Raises RunError when the losses are no longer numbers.
        """
        if not self.limiter.may_sample():
            return None
        batch = self._next_batch(env_steps)
        self.limiter.sample()
        sac = self.config.sac
        uniform = sac.actor_batch == "uniform" and self.sac.policy_due
        others = self.replay.sample_uniformly(sac.batch_size) if uniform else None
        due = self.sac.policy_due
        losses, errors = self.sac.update(batch, others)
        if not np.isfinite([losses.critic, losses.alpha, losses.policy if due else 0.0]).all():
            raise RunError(
                f"the losses of update {self.sac.updates} are not finite ({losses}); "
                "the last checkpoint is from before"
            )
        self.replay.update_priorities(batch, errors)
        return losses

    def _next_batch(self, env_steps: int) -> Batch:
        if not self._drawn:
            replay, sac = self.config.replay, self.config.sac
            done = min(1.0, env_steps / replay.importance_steps)
            b = replay.importance_start + done * (replay.importance_end - replay.importance_start)
            self._drawn = self.replay.sample_many(replay.draw_ahead, sac.batch_size, sac.n_step, sac.gamma, b)
        return self._drawn.pop(0)

    def save(self) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
        """Groups of tensors, and what goes into JSON; batches drawn ahead are not kept, here or there.

        Raises RunError when a network holds numbers that are none.
        """
        self._drawn.clear()
        networks, moments = self.sac.state()
        for name, tensor in networks.items():
            if not tensor.isfinite().all():
                raise RunError(f"{name} is not finite after update {self.sac.updates}; nothing was saved")
        steps, weights = self.replay.priorities()
        priorities = {"steps": torch.from_numpy(steps), "weights": torch.from_numpy(weights)}
        state = {
            "updates": self.sac.updates,
            "balance": self.limiter.balance,
            "generator": self._rng.bit_generator.state,
        }
        return {"networks": networks, "optimizers": moments, "priorities": priorities}, state

    def load(self, tensors: dict[str, dict[str, Tensor]], state: dict[str, Any]) -> None:
        """Takes what `save` gave, once the replay holds its episodes again.

        Raises ValueError, KeyError or TypeError naming the first thing that does not fit.
        """
        self.sac.load(tensors["networks"], tensors["optimizers"], int(state["updates"]))
        priorities = tensors["priorities"]
        self.replay.load_priorities(priorities["steps"].numpy(), priorities["weights"].numpy())
        self.limiter.balance = float(state["balance"])
        self._rng.bit_generator.state = state["generator"]
