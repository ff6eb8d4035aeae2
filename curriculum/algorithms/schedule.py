"""A plain schedule: the ranges of all parameters widen together as their tasks succeed."""

from __future__ import annotations

from collections import deque

import numpy as np

from common.config import ScheduleConfig
from curriculum.algorithms.base import Algorithm, Pick, Pool, Result, State


class Schedule(Algorithm):
    """In the docking world distance, yaw, bearing and dolly yaw, from the gate's ranges to the full ones."""

    def __init__(self, config: ScheduleConfig) -> None:
        self.config = config
        self.level = config.first_level
        self._last: deque[bool] = deque(maxlen=config.window)

    def propose(self, t: int, pool: Pool, rng: np.random.Generator) -> Pick:
        """A random task of the present level."""
        return Pick(pool.new(self.level), "schedule", f"drawn at level {self.level:.2f} of the schedule")

    def report(self, result: Result) -> None:
        """After a window of which enough succeeded the level grows, and a new window begins."""
        if result.category != "schedule":
            return
        self._last.append(result.success)
        full = len(self._last) == self.config.window
        if full and sum(self._last) >= self.config.threshold * self.config.window:
            self.level = min(1.0, self.level + self.config.step)
            self._last.clear()

    def snapshot(self) -> State:
        """Level and window."""
        return State({}, {"level": self.level, "last": list(self._last)})

    def restore(self, state: State) -> None:
        """Goes on from a snapshot."""
        self.level = float(state.values["level"])
        self._last.extend(map(bool, state.values["last"]))
