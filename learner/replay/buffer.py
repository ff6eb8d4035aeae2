"""Prioritised replay of whole episodes: each row stored once, observations and n-step targets by index."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.config import ReplayConfig
from common.errors import UsageError
from common.messages import Episode
from common.observation import Columns, Observation, ObservationLayout, observe
from learner.replay.sum_tree import SumTree

PRIORITY_FLOOR = 1e-6
NO_STEP = np.int64(-1)
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
    steps: NDArray[np.int64]
    """The run's step that each row held when it was sampled: a late priority for another one is ignored."""

    def part(self, rows: slice) -> Batch:
        """Some of them."""
        parts: list[Any] = [part.part(rows) if isinstance(part, Observation) else part[rows] for part in self]
        return Batch(*parts)


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
        self._step = np.full(self._size, NO_STEP)
        """The run's step that a row holds."""
        self._tree = SumTree(self._size)
        self._episodes: deque[tuple[int, int]] = deque()
        """(first row, transitions) of each stored episode, oldest first."""
        self._head = self._used = 0
        self._highest: float | None = None
        self.transitions = 0

    @staticmethod
    def bytes_needed(config: ReplayConfig, layout: ObservationLayout, max_steps: int) -> int:
        """Memory of a full buffer, for a word before it is filled."""
        rows = int(ROWS_PER_TRANSITION * config.capacity) + max_steps + 1
        return rows * (Columns.empty(1, layout).nbytes + 25) + SumTree.bytes_needed(rows)

    @property
    def highest_priority(self) -> float:
        """The highest current p^c, which new transitions get; 1 while the buffer is empty."""
        if self._highest is None:
            self._highest = float(self._tree.weights.max())
        return self._highest or 1.0

    def add(self, episode: Episode, first_step: int) -> None:
        """Stores an episode, whose first transition is the run's `first_step`, at the highest priority."""
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
        self._step[first:last] = np.arange(first_step, first_step + rows - 1)
        self._tree.set(np.arange(first, last), priority)  # the last row is never sampled
        self._episodes.append((first, episode.length))
        self._head = last + 1
        self._used = max(self._used, self._head)
        self.transitions += episode.length

    def _overlaps(self, first: int, last: int) -> bool:
        start, length = self._episodes[0]
        return start <= last and first <= start + length

    def _drop_oldest(self) -> None:
        first, length = self._episodes.popleft()
        self._tree.set(np.arange(first, first + length), 0.0)
        self._step[first : first + length] = NO_STEP
        self._highest = None
        self.transitions -= length

    def sample(self, size: int, n_step: int, gamma: float, importance: float) -> Batch:
        """A stratified batch; `importance` is the exponent b."""
        return self.sample_many(1, size, n_step, gamma, importance)[0]

    def sample_many(
        self, batches: int, size: int, n_step: int, gamma: float, importance: float
    ) -> list[Batch]:
        """Stratified batches, each normalised by itself, drawn at one go with the priorities of now."""
        drawn = batches * size
        strata = (np.arange(drawn) + self._rng.random(drawn)) / drawn
        total = self._tree.total
        # neighbouring strata go to different batches, by lot: each batch is stratified, and draws from all
        rows = self._rng.permuted(self._tree.find(strata * total).reshape(size, batches), axis=1).T.ravel()
        weight = (self.transitions / total * self._tree.get(rows).reshape(batches, size)) ** -importance
        weight /= weight.max(axis=1, keepdims=True)
        first, last = self._first.take(rows), self._last.take(rows)
        following = np.minimum(rows + n_step, last)
        ended = (following == last) & self._terminated.take(rows)
        ahead = rows[:, None] + np.arange(n_step)
        rewards = self.columns.reward.take(np.minimum(ahead, last[:, None])) * (ahead < last[:, None])
        powers = gamma ** np.arange(n_step + 1)
        both = observe(
            self.columns, np.concatenate([rows, following]), np.concatenate([first, first]), self._layout
        )
        whole = Batch(
            observation=both.part(slice(drawn)),
            action=self.columns.action.take(rows, axis=0),
            reward=(rewards @ powers[:n_step]).astype(np.float32),
            discount=np.where(ended, 0.0, powers.take(following - rows)).astype(np.float32),
            next_observation=both.part(slice(drawn, None)),
            weight=weight.astype(np.float32).ravel(),
            rows=rows,
            steps=self._step.take(rows),
        )
        return [whole.part(slice(start, start + size)) for start in range(0, drawn, size)]

    def sample_uniformly(self, size: int) -> Observation:
        """Observations of transitions that are all equally likely, whatever their priorities."""
        rows = np.zeros(0, np.int64)
        while len(rows) < size:  # few of the rows that were ever used hold no transition
            drawn = self._rng.integers(0, self._used, size)
            rows = np.concatenate([rows, drawn[self._step[drawn] != NO_STEP]])
        rows = rows[:size]
        return observe(self.columns, rows, self._first[rows], self._layout)

    def update_priorities(self, batch: Batch, errors: NDArray[np.float64]) -> None:
        """Sets p = |error| + 1e-6 of the sampled rows that still hold what was sampled."""
        current = self._step[batch.rows] == batch.steps
        priority = (np.abs(errors[current]) + PRIORITY_FLOOR) ** self.config.priority_exponent
        self._tree.set(batch.rows[current], priority)
        self._highest = None

    def priorities(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The run's steps that are stored, and their p^c, for a checkpoint."""
        rows = np.flatnonzero(self._step != NO_STEP)
        return self._step[rows], self._tree.get(rows)

    def load_priorities(self, steps: NDArray[np.int64], weights: NDArray[np.float64]) -> None:
        """Gives the stored transitions the p^c they had; those that came later get the highest of them.

        Raises ValueError when the arrays do not belong together.
        """
        if steps.shape != weights.shape or steps.ndim != 1:
            raise ValueError(f"priorities of shape {weights.shape} for steps of shape {steps.shape}")
        if not len(steps):
            return
        order = np.argsort(steps)
        rows = np.flatnonzero(self._step != NO_STEP)
        place = np.searchsorted(steps[order], self._step[rows]).clip(max=len(steps) - 1)
        known = steps[order][place] == self._step[rows]
        self._tree.set(rows, np.where(known, weights[order][place], weights.max()))
        self._highest = None
