"""Prioritised replay of whole episodes: each row stored once, observations and n-step targets by index."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.config import ReplayConfig
from common.errors import UsageError
from common.messages import Episode
from common.observation import Columns, Observation, ObservationLayout, observe
from learner.replay.sum_tree import SumTree

PRIORITY_FLOOR = 1e-6
ROWS_PER_TRANSITION = 1.25
"""Rows kept per transition of capacity: an episode of T transitions has T + 1 rows."""


class Batch(NamedTuple):
    """B sampled transitions, n-step where the episode is long enough."""

    observation: Observation
    action: NDArray[np.float32]
    """(B, 2)."""
    reward: NDArray[np.float32]
    """(B,) discounted sum of up to n rewards."""
    discount: NDArray[np.float32]
    """(B,) gamma^k for the bootstrap k <= n steps ahead; 0 when the episode terminated before it."""
    next_observation: Observation
    weight: NDArray[np.float32]
    """(B,) importance weights, largest 1."""
    rows: NDArray[np.int64]
    written: NDArray[np.int64]
    """Absolute step of each row when it was sampled: a late priority for an overwritten row is ignored."""


class Replay:
    """A ring of rows and a sum tree over them; the oldest episode is dropped as a whole.

    Probability of a transition: P(i) = p_i^c / sum_k p_k^c with p = |TD error| + 1e-6. Importance weight:
    (N P(i))^-b, divided by the batch's largest (Schaul et al. 2015, equations 1 and section 3.4).
    """

    def __init__(
        self,
        config: ReplayConfig,
        layout: ObservationLayout,
        max_steps: int,
        rng: np.random.Generator,
    ) -> None:
        self.config, self._layout, self._rng = config, layout, rng
        if config.capacity < 2 * max_steps:
            raise UsageError(
                f"replay.capacity = {config.capacity} holds no two episodes of {max_steps} steps"
            )
        self._size = int(ROWS_PER_TRANSITION * config.capacity) + max_steps + 1
        self.columns = Columns.empty(self._size, layout)
        self._first = np.zeros(self._size, np.int64)
        self._last = np.zeros(self._size, np.int64)
        self._terminated = np.zeros(self._size, bool)
        self._written = np.full(self._size, -1, np.int64)
        self._tree = SumTree(self._size)
        self._episodes: deque[tuple[int, int]] = deque()
        """(first row, transitions) of each stored episode, oldest first."""
        self._head = 0
        self._clock = 0
        self.transitions = 0

    @staticmethod
    def bytes_needed(config: ReplayConfig, layout: ObservationLayout, max_steps: int) -> int:
        """Memory of a full buffer, for a word before it is filled."""
        rows = int(ROWS_PER_TRANSITION * config.capacity) + max_steps + 1
        leaves = 2 << max(rows - 1, 1).bit_length()
        return rows * (Columns.empty(1, layout).nbytes + 25) + 8 * leaves

    @property
    def highest_priority(self) -> float:
        """The highest current p^c, which new transitions get; 1 while the buffer is empty."""
        return float(self._tree.weights.max()) or 1.0

    def add(self, episode: Episode) -> None:
        """Stores an episode at the highest current priority."""
        rows = episode.length + 1
        priority = self.highest_priority
        if self._head + rows > self._size:  # an episode never wraps around the end
            while self._episodes and self._episodes[0][0] >= self._head:
                self._drop_oldest()
            self._head = 0
        first, last = self._head, self._head + rows - 1
        while self._episodes and (
            self._overlaps(first, last) or self.transitions + episode.length > self.config.capacity
        ):
            self._drop_oldest()
        for column, part in zip(self.columns.parts(), episode.columns().parts(), strict=True):
            column[first : last + 1] = part
        span = slice(first, last + 1)
        self._first[span], self._last[span] = first, last
        self._terminated[span] = not episode.truncated
        self._written[span] = np.arange(self._clock, self._clock + rows)
        self._tree.set(np.arange(first, last), priority)  # the last row is never sampled
        self._episodes.append((first, episode.length))
        self._clock += rows
        self._head = last + 1
        self.transitions += episode.length

    def _overlaps(self, first: int, last: int) -> bool:
        start, length = self._episodes[0]
        return start <= last and first <= start + length

    def _drop_oldest(self) -> None:
        first, length = self._episodes.popleft()
        self._tree.set(np.arange(first, first + length + 1), 0.0)
        self._written[first : first + length + 1] = -1
        self.transitions -= length

    def sample(self, size: int, n_step: int, gamma: float, importance: float) -> Batch:
        """A stratified batch; `importance` is the exponent b."""
        strata = (np.arange(size) + self._rng.random(size)) / size
        rows = self._tree.find(strata * self._tree.total)
        probability = self._tree.get(rows) / self._tree.total
        weight = (self.transitions * probability) ** -importance
        ahead = rows[:, None] + np.arange(n_step)
        last = self._last[rows]
        valid = ahead < last[:, None]
        rewards = self.columns.reward[np.minimum(ahead, last[:, None])] * valid
        powers = gamma ** np.arange(n_step)
        following = np.minimum(rows + n_step, last)
        ended = (following == last) & self._terminated[rows]
        first = self._first[rows]
        return Batch(
            observation=observe(self.columns, rows, first, self._layout),
            action=self.columns.action[rows],
            reward=(rewards @ powers).astype(np.float32),
            discount=np.where(ended, 0.0, gamma ** (following - rows)).astype(np.float32),
            next_observation=observe(self.columns, following, first, self._layout),
            weight=(weight / weight.max()).astype(np.float32),
            rows=rows,
            written=self._written[rows],
        )

    def update_priorities(self, batch: Batch, errors: NDArray[np.float64]) -> None:
        """Sets p = |error| + 1e-6 of the sampled rows that still hold what was sampled."""
        current = self._written[batch.rows] == batch.written
        priority = (np.abs(errors[current]) + PRIORITY_FLOOR) ** self.config.priority_exponent
        self._tree.set(batch.rows[current], priority)
