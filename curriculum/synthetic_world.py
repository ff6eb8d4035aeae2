"""A made-up learner on made-up tasks, to compare algorithms in seconds: its true success is known.

A task is four numbers in [0, 1], drawn uniformly: difficulty grows with distance and angle, and with lateral
offset the more the nearer it is. The learner solves it with probability
sigmoid((skill - difficulty) / WIDTH), and its skill grows with p (1 - p) of the tasks that it gets: not on
those it always or never solves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import Config
from curriculum.algorithms import make_algorithm
from curriculum.algorithms.base import Drawn, Pick, Result
from curriculum.task_space import AnyTask, Entry, Properties, Scales, Scaling, TaskSpace

PARAMETERS = ("distance", "relative_angle", "lateral_offset", "approach_angle")
VISIBLE = (*PARAMETERS, "agent_clearance", "goal_clearance")
"""The clearances have nothing to do with success, here."""
WIDTH = 0.03
FIRST_SKILL = 0.0
GROWTH = 0.004
"""Of the skill, by a task of p = 0.5."""
Q_NOISE, Q_LAG = 3.0, 0.05
"""Deviation of Q, whose range is -10 to 10, and by how much skill the critic lags behind."""
AGENTS, STEPS = 9, 20
"""Agents that share the learner, and environment steps of an episode."""
CANDIDATES = 300
EXAMINED = 4000
"""Tasks over which the success of the learner is averaged."""


def difficulty(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of tasks (N, 4), in [0, 1]."""
    distance, angle, lateral, approach = np.asarray(x, float).T
    return np.asarray(
        0.35 * distance + 0.25 * angle + 0.3 * lateral * (1.3 - distance) / 1.3 + 0.1 * approach
    )


class SyntheticSpace(TaskSpace):
    """Those tasks, with the names of the docking world's properties."""

    def __init__(self, config: Config) -> None:
        self.cells, self.inputs = 1, config.curriculum.inputs
        self.scales: Scales = dict.fromkeys(VISIBLE, (0.5, 0.5))

    def draw(self, cell: int, level: float, rng: np.random.Generator) -> Entry:
        """A random task, its numbers up to a fifth at level 0."""
        most = 0.2 + 0.8 * level
        return self.entry({name: float(rng.uniform(0, most)) for name in PARAMETERS})

    def entry(self, task: AnyTask) -> Entry:
        """A given task; its clearances follow from it as if at random."""
        assert isinstance(task, dict)
        noise = np.modf(1e4 * sum(task.values()))[0]
        return Entry(0, task, {**task, "agent_clearance": noise, "goal_clearance": 1 - noise})


class SyntheticWorld:
    """A curriculum, and a learner who is taught by it; all from one seed."""

    def __init__(self, config: Config, seed: int, skill: float = FIRST_SKILL, growth: float = GROWTH) -> None:
        self.cell, self.skill, self._growth = 0, skill, growth
        self.config = config.model_copy(update={"seed": seed})
        self.space = SyntheticSpace(config)
        self.algorithm = make_algorithm(self.config, self.space)
        self.rng = np.random.default_rng(seed)
        self._scaling = Scaling(self.space.inputs, self.space.scales)
        self.candidates = [self._draw() for _ in range(CANDIDATES)]
        for row, entry in enumerate(self.candidates):
            entry.row = row
        properties = [entry.properties for entry in self.candidates]
        self._scaled, self._x = self._scaling(properties), self._numbers(properties)
        self._exam = np.random.default_rng(7).uniform(size=(EXAMINED, len(PARAMETERS)))
        self.tasks = 0

    def _draw(self) -> Entry:
        return self.space.candidate(0, self.config.curriculum.narrowed_candidates, self.rng)

    def probability(self, entry: Entry, skill: float | None = None) -> float:
        """True success."""
        x = self._numbers([entry.properties])
        return float(self._solve(x, self.skill if skill is None else skill)[0])

    @staticmethod
    def _numbers(properties: Sequence[Properties]) -> NDArray[np.float64]:
        """Those of N tasks that difficulty depends on, (N, 4)."""
        return np.array([[p[name] for name in PARAMETERS] for p in properties])

    @staticmethod
    def _solve(x: NDArray[np.float64], skill: float) -> NDArray[np.float64]:
        return np.asarray(1 / (1 + np.exp(-(skill - difficulty(x)) / WIDTH)))

    @property
    def success(self) -> float:
        """Over all tasks alike."""
        return float(self._solve(self._exam, self.skill).mean())

    def draw(self, count: int) -> Drawn:
        """Candidates, each with the critic's noisy belief."""
        chosen = self.rng.permutation(CANDIDATES)[:count]
        believed = self._solve(self._x[chosen], self.skill - Q_LAG)
        q = 20 * believed - 10 + self.rng.normal(0, Q_NOISE, len(chosen))

        def entry(index: int) -> Entry:
            found = self.candidates[int(chosen[index])]
            found.q = float(q[index])
            return found

        return Drawn(self._scaled[chosen], q, entry)

    def new(self, level: float = 1.0) -> Entry:
        """A task that was no candidate."""
        return self.space.draw(0, level, self.rng)

    def step(self) -> Pick:
        """Proposes a task, tries it, reports it, learns from it."""
        pick = self.algorithm.propose(STEPS * self.tasks // AGENTS, self, self.rng)
        p = self.probability(pick.entry)
        self.algorithm.report(Result(pick.entry, pick.category, pick.f, bool(self.rng.random() < p)))
        if pick.entry.row is not None:
            fresh, row = self._draw(), pick.entry.row
            fresh.row, self.candidates[row] = row, fresh
            self._scaled[row] = self._scaling([fresh.properties])[0]
            self._x[row] = self._numbers([fresh.properties])[0]
        self.skill += self._growth * 4 * p * (1 - p)
        self.tasks += 1
        return pick

    def tasks_until(self, success: float, most: int) -> int | None:
        """Tasks after which the learner has reached that success; None if not after `most`."""
        while self.tasks < most:
            if self.tasks % 10 == 0 and self.success >= success:
                return self.tasks
            self.step()
        return None
