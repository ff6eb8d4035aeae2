"""NavACL-Q (algorithm 2), to the letter or as NavACL-Q+; with other inputs also NavACL and Q alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import CurriculumConfig
from curriculum.algorithms.adaptive_filtering import (
    fit_normal,
    get_anchored_task,
    get_dynamic_task,
    get_task_type,
)
from curriculum.algorithms.base import Algorithm, Pick, Pool, Result, State
from curriculum.calibration import Calibration
from curriculum.success_network import SuccessNetwork
from curriculum.task_space import Entry, Properties, TaskSpace


class NavaclQ(Algorithm):
    """Adaptive filtering by f_pi over tasks from the database."""

    def __init__(self, config: CurriculumConfig, space: TaskSpace, seed: int) -> None:
        self.config = config
        self.network = SuccessNetwork(config, space.inputs, space.scales, seed)
        self.calibration = Calibration(config.calibration_window if config.calibrate else 0)

    def propose(self, t: int, pool: Pool, rng: np.random.Generator) -> Pick:
        """Fits a normal to f_pi over tasks, then draws until one meets the request, at most n_T times."""
        config = self.config
        requested = get_task_type(t, config, rng)
        drawn = pool.draw(config.filter_samples + config.max_draws)
        predicted = self._predict(drawn)
        mu, sigma = fit_normal(predicted[: config.filter_samples])
        draws, f = drawn[-config.max_draws :], predicted[-config.max_draws :]  # when few are left, the same
        if config.algorithm == "navacl-q+":
            found = get_anchored_task(requested, f, mu, sigma, config, rng)
        else:
            found = get_dynamic_task(requested, f.tolist(), mu, sigma, config)
        if found is None:
            index = int(rng.integers(len(draws)))
            why = f"no task of {len(draws)} was {requested}, so a random one"
            return Pick(draws[index], "random", why, requested, float(f[index]), mu, sigma)
        why = {"random": "the first that was drawn", "easy": "the first of {} that is likely enough"}.get(
            requested,
            "among the ten of {} whose outcome is least certain"
            if config.algorithm == "navacl-q+"
            else "the first of {} that is about as likely as most",
        )
        why = f"{requested}: {why.format(len(draws))}; predicted success {f[found]:.2f}"
        return Pick(draws[found], requested, why, requested, float(f[found]), mu, sigma)

    def report(self, result: Result) -> None:
        """Learns from how a task ended."""
        if self.config.calibrate:  # f_pi has not seen this outcome yet
            self.calibration.add(self._raw([result.entry])[0], result.success)
        self.network.add(result.entry.properties, result.entry.q, result.success)

    def score(self, properties: Sequence[Properties], q: Sequence[float | None]) -> NDArray[np.float64]:
        """f_pi of N tasks."""
        return self.calibration.correct(self.network.predict(properties, q))

    def _predict(self, entries: list[Entry]) -> NDArray[np.float64]:
        return self.calibration.correct(self._raw(entries))

    def _raw(self, entries: list[Entry]) -> NDArray[np.float64]:
        return self.network.predict([e.properties for e in entries], [e.q for e in entries])

    def snapshot(self) -> State:
        """f_pi with what it learns from, and the calibration."""
        tensors, values = self.network.state()
        return State(tensors, {**values, "calibration": self.calibration.state()})

    def restore(self, state: State) -> None:
        """Goes on from a snapshot."""
        values = dict(state.values)
        self.calibration.restore(values.pop("calibration"))
        self.network.restore(state.tensors, values)
