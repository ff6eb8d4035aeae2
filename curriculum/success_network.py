"""f_pi, the network that predicts whether the present policy solves a task (section 3.4, appendix B)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from common.config import CurriculumConfig
from curriculum.calibration import Calibration
from curriculum.perceptron import Adam, Floats, Perceptron, cross_entropy, sigmoid
from curriculum.task_space import Properties, Scales, Scaling

Arrays = dict[str, NDArray[Any]]


class SuccessNetwork:
    """f_pi with its optimiser and the outcomes it learns from.

    Inputs are properties of the task and Q(s0, a0), scaled to about [-1, 1], Q by its running range. A task
    without Q is predicted at the running mean of Q; fits never mix outcomes with and without it.
    """

    def __init__(self, config: CurriculumConfig, inputs: Sequence[str], scales: Scales, seed: int) -> None:
        self.config = config
        self.inputs, self._scales = tuple(sorted(inputs, key=lambda name: name == "q")), scales  # q is last
        self.scaling = Scaling(self.inputs, scales)
        self._reservoir_fits = config.algorithm == "navacl-q+"
        sizes = (len(self.inputs), *config.hidden)
        self.net = Perceptron(sizes, np.random.default_rng([seed, 1]))
        self.mean = Perceptron(sizes, np.random.default_rng([seed, 1])) if config.average else self.net
        """What predicts: of the running mean of the weights, if there is to be one."""
        self._adam = Adam(self.net.values, config.learning_rate)
        self._rng = np.random.default_rng([seed, 2])
        self._fresh: list[Floats] = []
        self._reservoir: Floats = np.empty((config.reservoir, len(self.inputs) + 1))
        """Outcomes as rows of inputs, Q as it is, and success; `_taken` of them so far, round and round."""
        self._taken = 0
        self._q_low, self._q_high, self._q_mean = math.inf, -math.inf, 0.0
        self.fits = 0
        self.loss = math.nan

    def predict(self, properties: Sequence[Properties], q: Sequence[float | None]) -> Floats:
        """f_pi of N tasks, (N,) in [0, 1]; KeyError for one without a property that is an input."""
        return self.predict_scaled(self.scaling(properties), np.array(q, float))

    def predict_scaled(self, scaled: Floats, q: Floats) -> Floats:
        """The same from scaled properties (N, P), and Q (N,), NaN where it is not known."""
        return sigmoid(self.mean.logits(self._inputs(self._rows(scaled, q))))

    def add(self, properties: Properties, q: float | None, success: bool) -> bool:
        """Takes an outcome; after every m of them fits, and says so."""
        if q is not None:
            share = 0.02 if self._q_low <= self._q_high else 1.0  # the first Q is the mean
            self._q_mean += share * (q - self._q_mean)
            self._q_low, self._q_high = min(self._q_low, q), max(self._q_high, q)
        row = np.append(self._rows(self.scaling([properties]), np.array([q], float))[0], float(success))
        self._fresh.append(row)
        self._reservoir[self._taken % len(self._reservoir)] = row
        self._taken += 1
        if len(self._fresh) < self.config.batch_size:
            return False
        self._fit()
        self._fresh.clear()
        return True

    def _fit(self) -> None:
        """`navacl-q`: one step on the m fresh outcomes. `navacl-q+`: several, on draws from the reservoir."""
        rows = self._reservoir[: self._taken] if self._reservoir_fits else np.array(self._fresh)
        if "q" in self.inputs:
            real = ~np.isnan(rows[:, -2])
            enough = real.sum() >= (self.config.batch_size if self._reservoir_fits else 1)
            rows = rows[real] if enough or real.all() else rows[~real]
        inputs, labels = self._inputs(rows[:, :-1]), rows[:, -1]
        for _ in range(self.config.fit_steps):
            chosen = self._draw(labels > 0) if self._reservoir_fits else np.arange(len(rows))
            gradient, logits = self.net.gradient(inputs[chosen], labels[chosen])
            self._adam.step(gradient)
            if self.config.average:
                keep = min(self.config.average, self._adam.steps / (self._adam.steps + 9))
                self.mean.values += (1 - keep) * (self.net.values - self.mean.values)
        self.loss = cross_entropy(logits, labels[chosen])
        self.fits += 1

    def _draw(self, success: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Rows of the reservoir for one step, of which so many succeeded."""
        size = self.config.fit_batch
        if not self.config.balanced or success.all() or not success.any():
            return self._rng.integers(len(success), size=size)
        halves = (np.flatnonzero(success), size // 2), (np.flatnonzero(~success), size - size // 2)
        return np.concatenate([half[self._rng.integers(len(half), size=n)] for half, n in halves])

    def _rows(self, scaled: Floats, q: Floats) -> Floats:
        """The inputs of N tasks, Q last as it is."""
        return np.column_stack([scaled, q]) if "q" in self.inputs else scaled

    def _inputs(self, rows: Floats) -> Floats:
        """Rows with Q brought to [-1, 1] by its running range, and missing ones to its mean."""
        if "q" not in self.inputs:
            return rows
        scaled = rows.copy()
        half = max((self._q_high - self._q_low) / 2, 1e-6)
        middle = (self._q_high + self._q_low) / 2 if half > 1e-6 else self._q_mean
        q = np.where(np.isnan(rows[:, -1]), self._q_mean, rows[:, -1])
        scaled[:, -1] = np.clip((q - middle) / half, -1.5, 1.5) if half > 1e-6 else 0.0
        return scaled

    def file(self, calibration: Calibration) -> bytes:
        """f_pi as safetensors; inputs, scales, the range of Q and the correction in the metadata."""
        about = {
            "inputs": self.inputs,
            "scales": {name: self._scales[name] for name in self.scaling.names},
            "q_mean": self._q_mean,
            "calibration": (calibration.a, calibration.b),
        }
        if self._q_low <= self._q_high:
            about["q_range"] = (self._q_low, self._q_high)
        tensors = self._named("", self.mean.values.astype(np.float32))
        return bytes(safetensors.numpy.save(tensors, {"f_pi": json.dumps(about)}))

    def _named(self, kind: str, vector: Floats) -> Arrays:
        """A vector like that of the parameters, by the names of the layers in torch."""
        found: Arrays = {}
        for i, (weight, bias) in enumerate(self.net.views(vector)):
            found |= {f"{kind}{2 * i}.weight": weight, f"{kind}{2 * i}.bias": bias}
        return found

    def _arrays(self) -> Arrays:
        """All of the state but fresh outcomes: the arrays themselves."""
        networks = self._named("net.", self.net.values) | self._named("mean.", self.mean.values)
        adam = self._named("adam.mean.", self._adam.mean) | self._named("adam.square.", self._adam.square)
        return networks | adam | {"reservoir": self._reservoir[: self._taken]}

    def state(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and values to save."""
        fresh = np.array(self._fresh).reshape(-1, self._reservoir.shape[1])
        numbers: dict[str, Any] = {"q_mean": self._q_mean, "fits": self.fits, "taken": self._taken}
        numbers |= {"steps": self._adam.steps, "rng": self._rng.bit_generator.state}
        if self._q_low <= self._q_high:
            numbers |= {"q_low": self._q_low, "q_high": self._q_high}
        return self._arrays() | {"fresh": fresh}, numbers

    def restore(self, arrays: Arrays, numbers: dict[str, Any]) -> None:
        """Takes what `state` gave; raises ValueError or KeyError when it does not fit."""
        self._taken, self._adam.steps, self.fits = (int(numbers[name]) for name in ("taken", "steps", "fits"))
        for name, own in self._arrays().items():
            if arrays[name].shape != own.shape:
                raise ValueError(f"{name} is of shape {arrays[name].shape}, expected {own.shape}")
            own[:] = arrays[name]
        self._fresh = list(arrays["fresh"])
        self._q_mean = numbers["q_mean"]
        self._rng.bit_generator.state = numbers["rng"]
        self._q_low, self._q_high = numbers.get("q_low", math.inf), numbers.get("q_high", -math.inf)
