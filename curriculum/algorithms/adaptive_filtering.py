"""Algorithm 1, GetDynamicTask-Q, and what surrounds it, as pure functions on success predictions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import CurriculumConfig
from common.messages import Requested

Predictions = NDArray[np.float64]
FRONTIER_POOL = 10
"""NavACL-Q+ picks its frontier task among this many of highest p (1 - p)."""


def task_type_probabilities(t: int, config: CurriculumConfig) -> dict[Requested, float]:
    """GetTaskType(t): P(random) grows with the asking agent's steps; easy and frontier share the rest."""
    random = min(config.random_limit, t / config.random_steps)
    easy = (1 - random) * config.easy_share
    return {"easy": easy, "frontier": 1 - random - easy, "random": random}


def get_task_type(t: int, config: CurriculumConfig, rng: np.random.Generator) -> Requested:
    """A task type drawn with those probabilities."""
    left = rng.random()
    for name, probability in task_type_probabilities(t, config).items():
        left -= probability
        if left < 0:
            return name
    return "frontier"  # they add up to 1 but for rounding


def fit_normal(f: Predictions) -> tuple[float, float]:
    """mu and sigma of the predictions (the maximum-likelihood fit)."""
    return float(f.mean()), float(f.std())


def is_easy(f: float, mu: float, sigma: float, config: CurriculumConfig) -> bool:
    """Algorithm 1, case easy, with the extra threshold chi and the cure for mu + beta sigma >= 1."""
    if mu + config.beta * sigma < 1:
        return f > mu + config.beta * sigma or f > config.chi
    return f > mu


def is_frontier(f: float, mu: float, sigma: float, config: CurriculumConfig) -> bool:
    """Algorithm 1, case frontier."""
    return mu - config.gamma * sigma < f < mu + config.gamma * sigma


def get_dynamic_task(
    requested: Requested, draws: Sequence[float], mu: float, sigma: float, config: CurriculumConfig
) -> int | None:
    """Algorithm 1: index of the first of at most n_T draws that meets the request, None when none does.

    `draws` are f_pi of tasks drawn at random; with None the caller takes one more random task.
    """
    for index, f in enumerate(draws[: config.max_draws]):
        if requested == "random":
            return index
        if requested == "easy" and is_easy(f, mu, sigma, config):
            return index
        if requested == "frontier" and is_frontier(f, mu, sigma, config):
            return index
    return None


def get_anchored_task(
    requested: Requested,
    f: Predictions,
    mu: float,
    sigma: float,
    config: CurriculumConfig,
    rng: np.random.Generator,
) -> int | None:
    """NavACL-Q+: as algorithm 1, but the frontier lies at predicted success 0.5, wherever mu is.

    One of the ten tasks of highest p (1 - p): even when all are too hard or too easy, the least so.
    """
    if requested != "frontier":
        return get_dynamic_task(requested, f.tolist(), mu, sigma, config)
    uncertain = np.argsort(-f * (1 - f), kind="stable")[:FRONTIER_POOL]
    return int(rng.choice(uncertain))
