"""Frames of random drives and what the simulator knows of each: what pre-training and its probes are fed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.errors import UsageError
from common.resources import check_memory

VISIBLE_PIXELS = 10
"""The dolly counts as visible in a frame that shows at least so many pixels of it."""


class Film(NamedTuple):
    """One drive of T frames."""

    frame: NDArray[np.uint8]
    """(T, S, S, 3)."""
    mask: NDArray[np.uint8]
    """(T, S * S / 8): one bit for each pixel, set where it shows the dolly."""
    goal: NDArray[np.float32]
    """(T, 3) of the dolly: bearing (rad, positive to the left), distance of the centres (m), yaw relative to
    the robot's (rad)."""


PART = 256


def in_parts(rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows of a table, a few at a time, for what would not fit into memory at once."""
    return [rows[first : first + PART] for first in range(0, len(rows), PART)]


@dataclass(frozen=True, slots=True)
class FrameTable:
    """Frames of many films, one after the other; each is stored once."""

    frame: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    goal: NDArray[np.float32]
    start: NDArray[np.int64]
    """(N,) row of the first frame of each frame's film."""

    @classmethod
    def of(cls, films: Iterable[Film], rows: int, size: int) -> FrameTable:
        """A table of `rows` frames of `size` pixels a side; of the last film as much as fits.

        Raises UsageError when the memory or the films do not suffice.
        """
        check_memory(f"a table of {rows} frames", rows * (size * size * 25 // 8 + 20), "take fewer")
        table = cls(
            np.empty((rows, size, size, 3), np.uint8),
            np.empty((rows, size * size // 8), np.uint8),
            np.empty((rows, 3), np.float32),
            np.empty(rows, np.int64),
        )
        row = 0
        for film in films:
            end = min(row + len(film.frame), rows)
            table.frame[row:end] = film.frame[: end - row]
            table.mask[row:end] = film.mask[: end - row]
            table.goal[row:end] = film.goal[: end - row]
            table.start[row:end] = row
            row = end
        if row < rows:
            raise UsageError(f"{row} frames where {rows} are needed")
        return table

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def rows(self) -> NDArray[np.int64]:
        """(N,) all rows."""
        return np.arange(len(self))

    @property
    def visible(self) -> NDArray[np.bool_]:
        """(N,) whether the dolly is in the picture."""
        pixels: NDArray[np.int64] = np.bitwise_count(self.mask).sum(1)
        return pixels >= VISIBLE_PIXELS

    def masks(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        """(B, S, S) 1 where a pixel shows the dolly."""
        size = self.frame.shape[1]
        return np.unpackbits(self.mask[rows], axis=1).reshape(len(rows), size, size)

    def stacks(self, rows: NDArray[np.int64], count: int) -> NDArray[np.uint8]:
        """(B, count, S, S, 3) the newest `count` frames at each row, oldest first; the first is repeated."""
        back = np.arange(count - 1, -1, -1)
        stacks: NDArray[np.uint8] = self.frame[np.maximum(rows[:, None] - back, self.start[rows][:, None])]
        return stacks
