"""The learner's policy and critic as the curriculum sees them: Q(s0, a0) of candidate starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.config import Config
from common.messages import Candidate
from common.networks import Perception, Policy, TwinCritic, initial_q, load_state
from common.observation import Observation, ObservationLayout


class CriticView:
    """Computes Q(s0, a0) in batches."""

    def __init__(self, config: Config) -> None:
        self._layout = ObservationLayout.of(config)
        self._perception = Perception(config).eval()
        self._policy = Policy(self._layout, config.network).eval()
        self._critic = TwinCritic(self._layout, config.network).eval()

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Takes weights; ValueError when they do not fit."""
        load_state(tensors, perception=self._perception, policy=self._policy, critic=self._critic)

    def value(self, candidates: Sequence[Candidate]) -> NDArray[np.float64]:
        """Q(s0, a0) of N candidates, (N,)."""
        with torch.inference_mode():
            return initial_q(self._policy, self._critic, self._perception(self._starts(candidates)))

    def _starts(self, candidates: Sequence[Candidate]) -> Observation:
        """Start observations: the one visual row repeated, no history."""
        visual = np.stack([c.visual for c in candidates])
        stacked: NDArray[np.generic] = np.repeat(visual[:, None], self._layout.stack, axis=1)
        lidar = np.stack([c.lidar for c in candidates])
        return Observation(stacked, lidar, np.zeros((len(visual), self._layout.history), np.float32))
