"""The observation: which rows of an episode an agent sees at time t, and in which order.

An episode of T transitions has T + 1 rows, each stored once. Row t holds what was sensed at t (`visual`,
`lidar`) and, for t < T, the action taken at t and the reward it brought. Frame stacks and histories are read
by index, by the actor while it drives and by the learner when it samples, through the one function here, so
that what is learned from is what was seen. The action taken at t is never part of the observation at t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.config import Config

HISTORY = 4
"""Frames, actions and rewards that an observation reaches back (table 1)."""
ACTION_SIZE = 2


@dataclass(frozen=True, slots=True)
class ObservationLayout:
    """Sizes of the parts of an observation, and of one stored row of the visual column."""

    row_shape: tuple[int, ...]
    """One row of `visual`: (code,) float16, or (size, size, 3) uint8 when the encoder trains end to end."""
    row_dtype: str
    stack: int
    """Rows of `visual` that make one observation."""
    visual: int
    """Features that the encoder gives for one observation."""
    lidar: int
    history: int = HISTORY * (ACTION_SIZE + 1)

    @property
    def size(self) -> int:
        """Length of the flat vector [visual, lidar, actions, rewards] that the networks take."""
        return self.visual + self.lidar + self.history

    @classmethod
    def of(cls, config: Config) -> ObservationLayout:
        """The layout that a configuration asks for."""
        encoder, size = config.encoder, config.world.camera.size
        code = (size // 16) ** 2 * encoder.channels[-1]
        codes = HISTORY // encoder.frames_per_code
        lidar = 2 * config.world.lidar.beams
        if encoder.end_to_end:
            return cls((size, size, 3), "uint8", HISTORY, codes * code, lidar)
        return cls((code,), "float16", codes, codes * code, lidar)


@dataclass(slots=True)
class Columns:
    """Rows of one or many episodes; N rows.

    visual: (N, *row_shape) uint8 or float16; lidar: (N, beams) float16 in [0, 1]; action: (N, 2) float32 in
    [-1, 1]; reward: (N,) float32.
    """

    visual: NDArray[Any]
    lidar: NDArray[np.float16]
    action: NDArray[np.float32]
    reward: NDArray[np.float32]

    @classmethod
    def empty(cls, rows: int, layout: ObservationLayout) -> Columns:
        """Zeroed columns."""
        return cls(
            np.zeros((rows, *layout.row_shape), layout.row_dtype),
            np.zeros((rows, layout.lidar), np.float16),
            np.zeros((rows, ACTION_SIZE), np.float32),
            np.zeros(rows, np.float32),
        )

    def parts(self) -> tuple[NDArray[Any], ...]:
        """The columns, in the order of the fields."""
        return self.visual, self.lidar, self.action, self.reward

    @property
    def nbytes(self) -> int:
        """Memory of all columns."""
        return sum(part.nbytes for part in self.parts())


class Observation(NamedTuple):
    """A batch of B observations: visual (B, stack, *row_shape), lidar (B, beams), history (B, 12)."""

    visual: NDArray[Any]
    lidar: NDArray[np.float16]
    history: NDArray[np.float32]

    def part(self, rows: slice) -> Observation:
        """Some of them."""
        return Observation(self.visual[rows], self.lidar[rows], self.history[rows])


def observe(
    columns: Columns, rows: NDArray[np.int64], starts: NDArray[np.int64], layout: ObservationLayout
) -> Observation:
    """The observations at `rows` (B,) of the episodes that begin at rows `starts` (B,).

    Visual rows before the start repeat the first one (replicate padding); actions and rewards before it are
    zero (appendix A). Oldest first.
    """
    reach = rows[:, None] - np.arange(HISTORY, -1, -1)
    inside = np.maximum(reach, starts[:, None])
    past, stack = inside[:, :HISTORY], inside[:, HISTORY + 1 - layout.stack :]
    before = reach[:, :HISTORY] < starts[:, None]
    # take is several times as fast as indexing for rows of a few bytes
    actions, rewards = columns.action.take(past, axis=0), columns.reward.take(past)
    actions[before] = rewards[before] = 0
    history = np.concatenate([actions.reshape(len(rows), -1), rewards], axis=1)
    return Observation(columns.visual.take(stack, axis=0), columns.lidar.take(rows, axis=0), history)
