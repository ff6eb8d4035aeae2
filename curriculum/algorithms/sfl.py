"""Sampling for learnability (Rutherford et al., "No Regrets", NeurIPS 2024), fed by the episodes themselves.

In turns for each cell: a survey tries random tasks several times each; then tasks are proposed from those of
highest p (1 - p), p the share of successes, mixed with random ones. The original estimates p by episodes from
which nothing is learned, so ours is kinder to it.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from common.config import SflConfig
from curriculum.algorithms.base import Algorithm, Pick, Pool, Result, State
from curriculum.task_space import Entry


class _Level:
    """A task on trial."""

    def __init__(self, entry: Entry) -> None:
        self.entry, self.asked, self.trials, self.successes = entry, 0, 0, 0

    @property
    def learnability(self) -> float:
        """p (1 - p)."""
        p = self.successes / max(self.trials, 1)
        return p * (1 - p)


class _Cell:
    def __init__(self) -> None:
        self.survey: list[_Level] = []
        self.kept: list[_Level] = []
        self.pause = 0


class Sfl(Algorithm):
    """Survey, keep the most learnable, propose them half of the time."""

    def __init__(self, config: SflConfig) -> None:
        self.config = config
        self._cells: defaultdict[int, _Cell] = defaultdict(_Cell)

    def propose(self, t: int, pool: Pool, rng: np.random.Generator) -> Pick:
        """A task of the survey, one that is kept, or a random one."""
        cell = self._cells[pool.cell]
        if cell.pause == 0:
            if not cell.survey:
                cell.survey = [_Level(pool.new()) for _ in range(self.config.levels)]
            waiting = [level for level in cell.survey if level.asked < self.config.trials]
            if waiting:
                level = waiting[int(rng.integers(len(waiting)))]
                level.asked += 1
                return Pick(level.entry, "sfl", f"trial {level.asked} of {self.config.trials} of a survey")
            self._choose(cell)
        cell.pause -= 1
        if cell.kept and rng.random() < self.config.share:
            level = cell.kept[int(rng.integers(len(cell.kept)))]
            return Pick(level.entry, "sfl", f"p (1 - p) was {level.learnability:.2f} in the last survey")
        return Pick(pool.new(), "random", "drawn from the full distribution")

    def _choose(self, cell: _Cell) -> None:
        """Ends a survey; what was not reported by now counts by what was."""
        learnable = [level for level in cell.survey if level.learnability > 0]
        cell.kept = sorted(learnable, key=lambda level: -level.learnability)[: self.config.kept]
        cell.survey, cell.pause = [], self.config.pause

    def report(self, result: Result) -> None:
        """Counts a trial."""
        for level in self._cells[result.entry.cell].survey:
            if level.entry.task == result.entry.task:
                level.trials += 1
                level.successes += result.success

    def snapshot(self) -> State:
        """Surveys and kept tasks."""
        return State({}, {str(index): _dump(cell) for index, cell in self._cells.items()})

    def restore(self, state: State) -> None:
        """Goes on from a snapshot."""
        for index, values in state.values.items():
            cell = self._cells[int(index)]
            cell.pause = int(values["pause"])
            cell.survey, cell.kept = ([_load(x) for x in values[name]] for name in ("survey", "kept"))


def _dump(cell: _Cell) -> dict[str, Any]:
    def dump(level: _Level) -> list[Any]:
        return [level.entry.text, level.asked, level.trials, level.successes]

    kept, survey = map(dump, cell.kept), map(dump, cell.survey)
    return {"pause": cell.pause, "survey": list(survey), "kept": list(kept)}


def _load(values: list[Any]) -> _Level:
    level = _Level(Entry.read(values[0]))
    level.asked, level.trials, level.successes = map(int, values[1:])
    return level
