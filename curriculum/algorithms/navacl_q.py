"""NavACL-Q (algorithm 2), to the letter or as NavACL-Q+; with other inputs also NavACL and Q alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import CurriculumConfig
from common.messages import Requested
from curriculum.algorithms.adaptive_filtering import (
    fit_normal,
    get_anchored_task,
    get_dynamic_task,
    get_task_type,
)
from curriculum.algorithms.base import Algorithm, Pick, Pool, Result, State
from curriculum.calibration import Calibration
from curriculum.success_network import SuccessNetwork
from curriculum.task_space import Properties, TaskSpace

SAID: dict[Requested, str] = {
    "random": "the first that was drawn",
    "easy": "the first of {} that is likely enough",
    "frontier": "the first of {} that is about as likely as most",
}
"""Of a task that meets a request, why it does."""


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
        predicted = self.calibration.correct(self.network.predict_scaled(drawn.scaled, drawn.q))
        mu, sigma = fit_normal(predicted[: config.filter_samples])
        f = predicted[-config.max_draws :]  # when few are left, the same
        if config.algorithm == "navacl-q+":
            found = get_anchored_task(requested, f, mu, sigma, config, rng)
        else:
            found = get_dynamic_task(requested, f.tolist(), mu, sigma, config)
        if found is None:
            index = int(rng.integers(len(f)))
            category: Requested = "random"
            why = f"no task of {len(f)} was {requested}, so a random one"
        else:
            index, category, said = found, requested, SAID[requested]
            if requested == "frontier" and config.algorithm == "navacl-q+":
                said = "among the ten of {} whose outcome is least certain"
            why = f"{requested}: {said.format(len(f))}; predicted success {f[found]:.2f}"
        entry = drawn.entry(len(predicted) - len(f) + index)
        return Pick(entry, category, why, requested, float(f[index]), mu, sigma)

    def report(self, result: Result) -> None:
        """Learns from how a task ended."""
        if self.config.calibrate:  # f_pi has not seen this outcome yet
            (raw,) = self.network.predict([result.entry.properties], [result.entry.q])
            self.calibration.add(raw, result.success)
        self.network.add(result.entry.properties, result.entry.q, result.success)

    def score(self, properties: Sequence[Properties], q: Sequence[float | None]) -> NDArray[np.float64]:
        """f_pi of N tasks."""
        return self.calibration.correct(self.network.predict(properties, q))

    def snapshot(self) -> State:
        """f_pi with what it learns from, and the calibration."""
        arrays, values = self.network.state()
        return State(arrays, {**values, "calibration": self.calibration.state()})

    def restore(self, state: State) -> None:
        """Goes on from a snapshot."""
        values = dict(state.values)
        self.calibration.restore(values.pop("calibration"))
        self.network.restore(state.arrays, values)
