"""How far predictions of success can be believed: measures, and a correction by the last outcomes."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
SMALLEST = 1e-4
"""Predictions are cut off so far from 0 and 1."""
PRIOR = 4.0
"""Weight, in outcomes, of the belief that predictions are right."""
STEPS = 3
"""Of the fit after each outcome, which moves it little."""


def brier_score(predicted: ArrayLike, success: ArrayLike) -> float:
    """Mean squared error of N predictions (Brier 1950); 0 is perfect, 0.25 is that of a coin."""
    return float(np.mean((np.asarray(predicted, float) - np.asarray(success, float)) ** 2))


def reliability(predicted: ArrayLike, success: ArrayLike, bins: int = 10) -> list[tuple[float, float, int]]:
    """(mean prediction, share of successes, outcomes) of each tenth of [0, 1] that has any."""
    p, y = np.asarray(predicted, float), np.asarray(success, float)
    index = np.minimum((p * bins).astype(int), bins - 1)
    found = []
    for i in range(bins):
        chosen = index == i
        if chosen.any():
            found.append((float(p[chosen].mean()), float(y[chosen].mean()), int(chosen.sum())))
    return found


class Calibration:
    """Platt scaling: the odds of a prediction become exp(b) odds^a, fitted to the last `window` outcomes.

    With a window of 0 it changes nothing. A weak prior holds a = 1 and b = 0.
    """

    def __init__(self, window: int) -> None:
        self._last: deque[tuple[float, bool]] = deque(maxlen=window)
        self.a, self.b = 1.0, 0.0

    def add(self, predicted: float, success: bool) -> None:
        """Takes what became of an uncorrected prediction."""
        if self._last.maxlen:
            self._last.append((float(predicted), bool(success)))
            self._fit()

    def correct(self, predicted: Floats) -> Floats:
        """Corrected predictions, (N,)."""
        if not self._last:
            return predicted
        return _sigmoid(self.a * _logit(predicted) + self.b)

    def _fit(self) -> None:
        """Logistic regression from the present a and b, in turns, by steps that are never too far."""
        pairs = np.array(self._last, float)
        x, y = _logit(pairs[:, 0]), pairs[:, 1]
        for _ in range(STEPS):
            slope = x @ (_sigmoid(self.a * x + self.b) - y) + PRIOR * (self.a - 1)
            self.a = float(np.clip(self.a - slope / (x @ x / 4 + PRIOR), 0.1, 10.0))
            slope = (_sigmoid(self.a * x + self.b) - y).sum() + PRIOR * self.b
            self.b = float(np.clip(self.b - slope / (len(x) / 4 + PRIOR), -5.0, 5.0))

    def state(self) -> list[Any]:
        """What `restore` takes."""
        return [self.a, self.b, list(self._last)]

    def restore(self, state: list[Any]) -> None:
        """Goes on from a state."""
        self.a, self.b = float(state[0]), float(state[1])
        self._last.extend((float(p), bool(y)) for p, y in state[2])


def _logit(p: Floats) -> Floats:
    cut = np.clip(p, SMALLEST, 1 - SMALLEST)
    return np.asarray(np.log(cut / (1 - cut)))


def _sigmoid(x: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-x)))
