"""A small perceptron with one logit, and Adam, in plain NumPy: for its sizes many times as fast as torch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8
"""Of Adam, torch's defaults."""


def sigmoid(x: Floats) -> Floats:
    """1 / (1 + exp(-x)), which does not overflow."""
    return np.asarray(0.5 * (1 + np.tanh(0.5 * x)))


def cross_entropy(logits: Floats, labels: Floats) -> float:
    """Mean binary cross-entropy of B predictions sigmoid(logits) of labels in [0, 1]."""
    return float(np.mean(np.logaddexp(0.0, logits) - labels * logits))


class Perceptron:
    """Hidden layers with ReLU, then one linear unit; weights (outputs, inputs) and biases as in nn.Linear.

    `values` holds all parameters in one vector, of which `layers` are views, so that an optimiser takes a
    few operations for all of them.
    """

    def __init__(self, sizes: Sequence[int], rng: np.random.Generator) -> None:
        """`sizes`: inputs, hidden units. Drawn as nn.Linear draws: uniform within 1 / sqrt(inputs)."""
        self._sizes = (*sizes, 1)
        bounds = [np.full((a + 1) * b, a**-0.5) for a, b in pairwise(self._sizes)]
        bound = np.concatenate(bounds)
        self.values: Floats = rng.uniform(-bound, bound)
        self.layers = self.views(self.values)

    def views(self, vector: Floats) -> list[tuple[Floats, Floats]]:
        """Weight and bias of each layer in a vector of the size of `values`."""
        found, start = [], 0
        for a, b in pairwise(self._sizes):
            weight, bias = vector[start : start + a * b], vector[start + a * b : start + (a + 1) * b]
            found.append((weight.reshape(b, a), bias))
            start += (a + 1) * b
        return found

    def logits(self, x: Floats) -> Floats:
        """(B, inputs) -> (B,)."""
        return self._activations(x)[1]

    def gradient(self, x: Floats, labels: Floats) -> tuple[Floats, Floats]:
        """That of the mean cross-entropy with labels (B,), of the shape of `values`, and the logits (B,)."""
        inputs, logits = self._activations(x)
        found = np.empty_like(self.values)
        delta = ((sigmoid(logits) - labels) / len(labels))[:, None]
        for (weight, _), (d_weight, d_bias), h in zip(
            reversed(self.layers), reversed(self.views(found)), reversed(inputs), strict=True
        ):
            np.matmul(delta.T, h, out=d_weight)
            delta.sum(axis=0, out=d_bias)
            if h is not x:
                delta = (delta @ weight) * (h > 0)
        return found, logits

    def _activations(self, x: Floats) -> tuple[list[Floats], Floats]:
        """What each layer takes in, and the logits."""
        inputs = [x]
        for weight, bias in self.layers[:-1]:
            inputs.append(np.maximum(inputs[-1] @ weight.T + bias, 0.0))
        weight, bias = self.layers[-1]
        return inputs, (inputs[-1] @ weight.T + bias)[:, 0]


class Adam:
    """Adam (Kingma and Ba 2015) for a vector of parameters, which it changes in place."""

    def __init__(self, values: Floats, learning_rate: float) -> None:
        self._values, self._rate = values, learning_rate
        self.steps = 0
        self.mean, self.square = np.zeros_like(values), np.zeros_like(values)
        """Running means of the gradient and of its square."""

    def step(self, gradient: Floats) -> None:
        """One step down the gradient."""
        self.steps += 1
        self.mean += (1 - BETA_1) * (gradient - self.mean)
        self.square += (1 - BETA_2) * (gradient * gradient - self.square)
        rate = self._rate / (1 - BETA_1**self.steps)
        scale = (1 - BETA_2**self.steps) ** -0.5
        self._values -= rate * self.mean / (scale * np.sqrt(self.square) + EPSILON)
