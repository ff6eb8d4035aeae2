"""f_pi, the network that predicts whether the present policy solves a task (section 3.4, appendix B)."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from common.config import CurriculumConfig
from curriculum.calibration import Calibration
from curriculum.task_space import Properties, Scales

HUGE = 1e6
"""Properties beyond it, from whoever asks for a score, count as it."""


class SuccessNetwork:
    """f_pi with its optimiser and the outcomes it learns from.

    Inputs are properties of the task and Q(s0, a0), scaled to about [-1, 1], Q by its running range. A task
    without Q is predicted at the running mean of Q; fits never mix outcomes with and without it.
    """

    def __init__(self, config: CurriculumConfig, inputs: Sequence[str], scales: Scales, seed: int) -> None:
        self.config = config
        self.inputs, self._scales = tuple(sorted(inputs, key=lambda name: name == "q")), scales  # q is last
        self._names = [name for name in self.inputs if name != "q"]
        self._centres, self._halves = np.array([scales[n] for n in self._names]).reshape(-1, 2).T
        self._reservoir_fits = config.algorithm == "navacl-q+"
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            sizes = (len(self.inputs), *config.hidden)
            layers: list[nn.Module] = []
            for a, b in pairwise(sizes):
                layers += [nn.Linear(a, b), nn.ReLU()]
            self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))
        self._optimizer = torch.optim.Adam(self.net.parameters(), config.learning_rate, fused=True)
        self._rng = np.random.default_rng([seed, 2])
        self._fresh: list[NDArray[np.float64]] = []
        self._reservoir: deque[NDArray[np.float64]] = deque(maxlen=config.reservoir)
        self._q_low, self._q_high, self._q_mean = math.inf, -math.inf, 0.0
        self.fits = 0
        self.loss = math.nan

    def predict(self, properties: Sequence[Properties], q: Sequence[float | None]) -> NDArray[np.float64]:
        """f_pi of N tasks, (N,) in [0, 1]; KeyError for one without a property that is an input."""
        rows = self._rows(properties, q)
        with torch.no_grad():
            return torch.sigmoid(self.net(self._scale(rows))).squeeze(-1).double().numpy()

    def add(self, properties: Properties, q: float | None, success: bool) -> bool:
        """Takes an outcome; after every m of them fits, and says so."""
        if q is not None:
            share = 0.02 if self._q_low <= self._q_high else 1.0  # the first Q is the mean
            self._q_mean += share * (q - self._q_mean)
            self._q_low, self._q_high = min(self._q_low, q), max(self._q_high, q)
        row = np.append(self._rows([properties], [q])[0], float(success))
        self._fresh.append(row)
        self._reservoir.append(row)
        if len(self._fresh) < self.config.batch_size:
            return False
        self._fit()
        self._fresh.clear()
        return True

    def _fit(self) -> None:
        """`navacl-q`: one step on the m fresh outcomes. `navacl-q+`: several, on draws from the reservoir."""
        rows = np.array(self._reservoir if self._reservoir_fits else self._fresh)
        if "q" in self.inputs:
            real = ~np.isnan(rows[:, -2])
            enough = real.sum() >= (self.config.batch_size if self._reservoir_fits else 1)
            rows = rows[real] if enough or real.all() else rows[~real]
        inputs, labels = self._scale(rows[:, :-1]), torch.from_numpy(rows[:, -1]).float()
        for _ in range(self.config.fit_steps):
            draw = self._draw(rows[:, -1] > 0) if self._reservoir_fits else np.arange(len(rows))
            chosen = torch.from_numpy(draw)
            logits = self.net(inputs[chosen]).squeeze(-1)
            loss = F.binary_cross_entropy_with_logits(logits, labels[chosen])
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            self.loss = loss.item()
        self.fits += 1

    def _draw(self, success: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Rows of the reservoir for one step, of which so many succeeded."""
        size = self.config.fit_batch
        if not self.config.balanced or success.all() or not success.any():
            return self._rng.integers(len(success), size=size)
        halves = (np.flatnonzero(success), size // 2), (np.flatnonzero(~success), size - size // 2)
        return np.concatenate([half[self._rng.integers(len(half), size=n)] for half, n in halves])

    def _rows(self, properties: Sequence[Properties], q: Sequence[float | None]) -> NDArray[np.float64]:
        """The inputs of N tasks, properties scaled, Q last as it is."""
        values = np.array([p[name] for p in properties for name in self._names], float)
        values = np.clip(values, -HUGE, HUGE).reshape(len(properties), len(self._names))
        rows = (values - self._centres) / self._halves
        if "q" in self.inputs:
            rows = np.column_stack([rows, [math.nan if value is None else value for value in q]])
        return np.asarray(rows)

    def _scale(self, rows: NDArray[np.float64]) -> Tensor:
        """Rows with Q brought to [-1, 1] by its running range, and missing ones to its mean."""
        if "q" not in self.inputs:
            return torch.from_numpy(rows).float()
        scaled = rows.copy()
        half = max((self._q_high - self._q_low) / 2, 1e-6)
        middle = (self._q_high + self._q_low) / 2 if half > 1e-6 else self._q_mean
        q = np.where(np.isnan(rows[:, -1]), self._q_mean, rows[:, -1])
        scaled[:, -1] = np.clip((q - middle) / half, -1.5, 1.5) if half > 1e-6 else 0.0
        return torch.from_numpy(scaled).float()

    def file(self, calibration: Calibration) -> bytes:
        """f_pi as safetensors; inputs, scales, the range of Q and the correction in the metadata."""
        tensors = {key: value.contiguous() for key, value in self.net.state_dict().items()}
        scales = {name: self._scales[name] for name in self._names}
        about = {
            "inputs": self.inputs,
            "scales": scales,
            "q_mean": self._q_mean,
            "calibration": (calibration.a, calibration.b),
        }
        if self._q_low <= self._q_high:
            about["q_range"] = (self._q_low, self._q_high)
        return safetensors.torch.save(tensors, {"f_pi": json.dumps(about)})

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and values to save."""
        tensors = {f"net.{key}": value for key, value in self.net.state_dict().items()}
        for index, slots in self._optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{key}": value for key, value in slots.items()}
        width = len(self.inputs) + 1
        tensors["reservoir"] = torch.from_numpy(np.array(self._reservoir).reshape(-1, width))
        tensors["fresh"] = torch.from_numpy(np.array(self._fresh).reshape(-1, width))
        numbers: dict[str, Any] = {"q_mean": self._q_mean, "fits": self.fits}
        numbers["rng"] = self._rng.bit_generator.state
        if self._q_low <= self._q_high:
            numbers |= {"q_low": self._q_low, "q_high": self._q_high}
        return tensors, numbers

    def restore(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
        """Takes what `state` gave; raises ValueError when it does not fit."""
        try:
            self.net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
        except RuntimeError as error:
            raise ValueError(str(error).splitlines()[-1].strip()) from None
        adam = self._optimizer.state_dict()
        for name, value in tensors.items():
            if name.startswith("adam."):
                _, index, key = name.split(".")
                adam["state"].setdefault(int(index), {})[key] = value.clone()
        self._optimizer.load_state_dict(adam)
        self._reservoir.extend(tensors["reservoir"].numpy())
        self._fresh = list(tensors["fresh"].numpy())
        self._q_mean, self.fits = numbers["q_mean"], int(numbers["fits"])
        self._rng.bit_generator.state = numbers["rng"]
        self._q_low, self._q_high = numbers.get("q_low", math.inf), numbers.get("q_high", -math.inf)
