"""The learner's policy and critic as the curriculum sees them: Q(s0, a0) of candidate starts."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.config import Config
from common.messages import Candidate, MessageError, Version
from common.networks import Perception, Policy, TwinCritic, initial_q, load_state
from common.observation import Observation, ObservationLayout
from curriculum.task_space import Entry


class CriticView:
    """Computes Q(s0, a0) in batches, once for each candidate and version of the weights."""

    def __init__(self, config: Config) -> None:
        self.version: Version | None = None
        self._layout = ObservationLayout.of(config)
        self._perception = Perception(config).eval()
        self._policy = Policy(self._layout, config.network).eval()
        self._critic = TwinCritic(self._layout, config.network).eval()

    def load(self, version: Version, tensors: dict[str, Tensor]) -> None:
        """Takes newer weights; ValueError when they do not fit."""
        load_state(tensors, perception=self._perception, policy=self._policy, critic=self._critic)
        if version != self.version:  # what is known under a version is recognised by the object
            self.version = version

    def stale(self, entries: Iterable[Entry]) -> list[Entry]:
        """Those whose Q could be newer."""
        if self.version is None:
            return []
        return [e for e in entries if e.q_version is not self.version and e.observed is not None]

    def refresh(self, entries: Iterable[Entry]) -> list[Entry]:
        """Renews Q of those that were valued under other weights, in one batch; returns them."""
        stale = self.stale(entries)
        if stale:
            observation = self._starts([e.observed for e in stale if e.observed is not None])
            with torch.inference_mode():
                values = initial_q(self._policy, self._critic, self._perception(observation))
            for entry, value in zip(stale, values.tolist(), strict=True):
                entry.q, entry.q_version = value, self.version
        return stale

    def _starts(self, candidates: list[Candidate]) -> Observation:
        """Start observations: the one visual row repeated, no history."""
        visual = np.stack([c.visual for c in candidates])
        stacked: NDArray[np.generic] = np.repeat(visual[:, None], self._layout.stack, axis=1)
        lidar = np.stack([c.lidar for c in candidates])
        return Observation(stacked, lidar, np.zeros((len(visual), self._layout.history), np.float32))

    def check(self, candidate: Candidate) -> None:
        """Raises MessageError for a candidate that is not of this run's layout."""
        expected = {
            "visual": (self._layout.row_shape, self._layout.row_dtype),
            "lidar": ((self._layout.lidar,), "float16"),
        }
        for name, (shape, dtype) in expected.items():
            array: NDArray[np.generic] = getattr(candidate, name)
            if array.shape != shape or array.dtype != dtype:
                raise MessageError(
                    f"candidate {name} is {array.dtype} {array.shape}, expected {dtype} {shape}"
                )
