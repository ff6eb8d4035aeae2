"""The tasks of a cell: candidates in arrays that are kept in step, so that a draw is a few NumPy calls."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.messages import Candidate, MessageError, Version
from common.observation import ObservationLayout
from curriculum.algorithms.base import Drawn
from curriculum.task_space import Entry, Scaling, TaskSpace

UNVALUED = (-1, -1)
"""Version of a Q that is not there; older than any."""


def check_layout(candidate: Candidate, layout: ObservationLayout) -> None:
    """Raises MessageError for a candidate that is not of this run's layout."""
    expected = {"visual": (layout.row_shape, layout.row_dtype), "lidar": ((layout.lidar,), "float16")}
    for name, (shape, dtype) in expected.items():
        array: NDArray[np.generic] = getattr(candidate, name)
        if array.shape != shape or array.dtype != dtype:
            raise MessageError(f"candidate {name} is {array.dtype} {array.shape}, expected {dtype} {shape}")


class Table(NamedTuple):
    """N candidates, oldest first."""

    row: NDArray[np.int64]
    """(N,), in the database; rising."""
    lease: NDArray[np.float64]
    """(N,), until when it is in somebody's hands, seconds since 1970."""
    q: NDArray[np.float64]
    """(N,), NaN where it is not known."""
    version: NDArray[np.int64]
    """(N, 2), epoch and counter of the weights that Q is from."""
    scaled: NDArray[np.float64]
    """(N, P), see Scaling."""

    def part(self, chosen: NDArray[np.bool_] | slice) -> Table:
        """Some of them."""
        row, lease, q, version, scaled = self
        return Table(row[chosen], lease[chosen], q[chosen], version[chosen], scaled[chosen])


class Cell:
    """Candidates that nobody has in hand, and new tasks by geometry alone; the pool of an algorithm."""

    def __init__(
        self, cell: int, space: TaskSpace, scaling: Scaling, share: float, rng: np.random.Generator
    ) -> None:
        """`share` of the new tasks that make up for a lack of candidates are of a random level."""
        self.cell = cell
        self._space, self._scaling, self._share, self._rng = space, scaling, share, rng
        self._texts: dict[int, str] = {}
        self._observed: dict[int, Candidate] = {}
        ints, floats = np.zeros(0, np.int64), np.zeros(0)
        self.table = Table(ints, floats, floats, np.zeros((0, 2), np.int64), scaling([]))

    def __len__(self) -> int:
        return len(self.table.row)

    def draw(self, count: int) -> Drawn:
        """So many as are free and have Q, or, since f_pi does not compare both kinds, as have none."""
        table = self.table
        free = np.flatnonzero(table.lease <= time.time())
        valued = free[~np.isnan(table.q[free])]
        if not len(free):
            new = range(min(count, self._space.at_once))
            entries = [self._space.candidate(self.cell, self._share, self._rng) for _ in new]
            return Drawn.of(entries, self._scaling)
        chosen = self._rng.permutation(valued if len(valued) else free)[:count]
        rows = table.row[chosen]
        return Drawn(table.scaled[chosen], table.q[chosen], lambda index: self.entry(int(rows[index])))

    def new(self, level: float = 1.0) -> Entry:
        """A random task of that level."""
        return self._space.draw(self.cell, level, self._rng)

    def entry(self, row: int) -> Entry:
        """A candidate as a whole."""
        entry, slot = Entry.read(self._texts[row]), self._slot(row)
        entry.row, entry.lease = row, float(self.table.lease[slot])
        if not np.isnan(self.table.q[slot]):
            epoch, counter = self.table.version[slot].tolist()
            entry.q, entry.q_version = float(self.table.q[slot]), Version(epoch=epoch, counter=counter)
        return entry

    def _slot(self, row: int) -> int:
        return int(np.searchsorted(self.table.row, row))

    def add(
        self,
        rows: Sequence[int],
        texts: Sequence[str],
        scaled: NDArray[np.float64],
        most: int,
        observed: Sequence[Candidate] = (),
    ) -> None:
        """Takes newer candidates in, of which the oldest make room when there are more than `most`.

        `texts` as of Entry, `scaled` (M, P); start observations that are not given are read when needed.
        """
        n = len(rows)
        version = np.tile(np.array(UNVALUED, np.int64), (n, 1))
        new = Table(np.array(rows, np.int64), np.zeros(n), np.full(n, np.nan), version, scaled)
        self.table = Table(*(np.concatenate(pair) for pair in zip(self.table, new, strict=True)))
        self._texts.update(zip(rows, texts, strict=True))
        self._observed.update(zip(rows, observed, strict=False))
        for row in self.table.row[:-most].tolist():
            self._forget(row)
        self.table = self.table.part(slice(-most, None))

    def drop(self, row: int) -> None:
        """Takes one out, if it is there."""
        if row in self._texts:
            self._forget(row)
            self.table = self.table.part(self.table.row != row)

    def _forget(self, row: int) -> None:
        del self._texts[row]
        self._observed.pop(row, None)

    def lend(self, row: int, until: float) -> None:
        """Notes that one is in somebody's hands."""
        self.table.lease[self._slot(row)] = until

    def stale(self, version: Version) -> NDArray[np.int64]:
        """(N, 3), version and row of those whose Q is not of these weights, the oldest version first."""
        wanted = (version.epoch, version.counter)
        stale = (self.table.version != wanted).any(axis=1)
        found = np.column_stack([self.table.version[stale], self.table.row[stale]])
        return found[np.lexsort(found.T[::-1])]

    def unread(self, rows: Sequence[int]) -> list[int]:
        """Those that are there without their start observation at hand."""
        return [row for row in rows if row in self._texts and row not in self._observed]

    def observe(self, found: Mapping[int, Candidate]) -> None:
        """Keeps start observations at hand of those that are still there."""
        self._observed.update((row, start) for row, start in found.items() if row in self._texts)

    def observed(self, rows: Sequence[int]) -> dict[int, Candidate]:
        """Start observations that are at hand."""
        return {row: self._observed[row] for row in rows if row in self._observed}

    def value(self, rows: Sequence[int], q: NDArray[np.float64], version: NDArray[np.int64]) -> None:
        """Notes Q (M,) and its weights (M, 2), or (2,) for all, of those that are there."""
        there = np.isin(rows, self.table.row)
        slots = np.searchsorted(self.table.row, np.asarray(rows, np.int64)[there])
        self.table.q[slots] = q[there]
        self.table.version[slots] = np.broadcast_to(version, (len(there), 2))[there]
