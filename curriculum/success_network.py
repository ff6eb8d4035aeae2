"""f_pi, the network that predicts whether the present policy solves a task (section 3.4, appendix B)."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from common.config import CurriculumConfig
from common.tasks import GeometricProperties

PAPER_PROPERTIES = ("distance", "agent_clearance", "goal_clearance", "relative_angle")
PLUS_PROPERTIES = (*PAPER_PROPERTIES, "lateral_offset", "approach_angle")
SCALES = {
    "distance": (3.25, 1.75),
    "agent_clearance": (3.0, 2.0),
    "goal_clearance": (3.0, 2.0),
    "relative_angle": (math.pi / 4, math.pi / 4),
    "lateral_offset": (0.75, 0.75),
    "approach_angle": (math.pi / 12, math.pi / 12),
}
"""Centre and half width that bring each property to about [-1, 1]; m and rad."""


class SuccessNetwork:
    """f_pi with its optimiser and the outcomes it learns from.

    Inputs are the task's properties and Q(s0, a0), scaled to about [-1, 1], Q by its running range. A task
    without Q is predicted at the running mean of Q; fits never mix outcomes with and without it.
    """

    def __init__(self, config: CurriculumConfig, seed: int) -> None:
        self.config = config
        self.plus = config.algorithm == "navacl-q+"
        self._properties = PLUS_PROPERTIES if self.plus else PAPER_PROPERTIES
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            sizes = (len(self._properties) + 1, *config.hidden)
            layers: list[nn.Module] = []
            for a, b in pairwise(sizes):
                layers += [nn.Linear(a, b), nn.ReLU()]
            self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))
        self._optimizer = torch.optim.Adam(self.net.parameters(), config.learning_rate)
        self._rng = np.random.default_rng([seed, 2])
        self._fresh: list[NDArray[np.float64]] = []
        self._reservoir: deque[NDArray[np.float64]] = deque(maxlen=config.reservoir)
        self._q_low, self._q_high, self._q_mean = math.inf, -math.inf, 0.0
        self.fits = 0
        self.loss = math.nan

    def predict(self, properties: list[GeometricProperties], q: list[float | None]) -> NDArray[np.float64]:
        """f_pi of N tasks, (N,) in [0, 1]."""
        rows = np.array([self._row(p, value) for p, value in zip(properties, q, strict=True)])
        with torch.no_grad():
            return torch.sigmoid(self.net(self._scale(rows))).squeeze(-1).double().numpy()

    def add(self, properties: GeometricProperties, q: float | None, success: bool) -> bool:
        """Takes an outcome; after every m of them fits, and says so."""
        if q is not None:
            share = 0.02 if self._q_low <= self._q_high else 1.0  # the first Q is the mean
            self._q_mean += share * (q - self._q_mean)
            self._q_low, self._q_high = min(self._q_low, q), max(self._q_high, q)
        row = np.append(self._row(properties, q), float(success))
        self._fresh.append(row)
        self._reservoir.append(row)
        if len(self._fresh) < self.config.batch_size:
            return False
        self._fit()
        self._fresh.clear()
        return True

    def _fit(self) -> None:
        """`navacl-q`: one step on the m fresh outcomes. `navacl-q+`: several, on draws from the reservoir."""
        for _ in range(self.config.fit_steps):
            rows = np.array(self._reservoir if self.plus else self._fresh)
            real = ~np.isnan(rows[:, -2])
            enough = real.sum() >= (self.config.batch_size if self.plus else 1)
            rows = rows[real] if enough or real.all() else rows[~real]
            if self.plus:
                rows = rows[self._rng.integers(len(rows), size=self.config.fit_batch)]
            logits = self.net(self._scale(rows[:, :-1])).squeeze(-1)
            labels = torch.from_numpy(rows[:, -1]).float()
            loss = F.binary_cross_entropy_with_logits(logits, labels)
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            self.loss = loss.item()
        self.fits += 1

    def _row(self, properties: GeometricProperties, q: float | None) -> NDArray[np.float64]:
        values = [
            (getattr(properties, name) - SCALES[name][0]) / SCALES[name][1] for name in self._properties
        ]
        return np.array([*values, math.nan if q is None else q])

    def _scale(self, rows: NDArray[np.float64]) -> Tensor:
        """Rows with Q brought to [-1, 1] by its running range, and missing ones to its mean."""
        scaled = rows.copy()
        half = max((self._q_high - self._q_low) / 2, 1e-6)
        middle = (self._q_high + self._q_low) / 2 if half > 1e-6 else self._q_mean
        q = np.where(np.isnan(rows[:, -1]), self._q_mean, rows[:, -1])
        scaled[:, -1] = np.clip((q - middle) / half, -1.5, 1.5) if half > 1e-6 else 0.0
        return torch.from_numpy(scaled).float()

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Tensors and numbers to save."""
        tensors = {f"net.{key}": value for key, value in self.net.state_dict().items()}
        for index, slots in self._optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{key}": value for key, value in slots.items()}
        width = len(self._properties) + 2
        tensors["reservoir"] = torch.from_numpy(np.array(self._reservoir).reshape(-1, width))
        tensors["fresh"] = torch.from_numpy(np.array(self._fresh).reshape(-1, width))
        numbers = {"q_mean": self._q_mean, "fits": float(self.fits)}
        if self._q_low <= self._q_high:
            numbers |= {"q_low": self._q_low, "q_high": self._q_high}
        return tensors, numbers

    def restore(self, tensors: dict[str, Tensor], numbers: dict[str, float]) -> None:
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
        self._q_low, self._q_high = numbers.get("q_low", math.inf), numbers.get("q_high", -math.inf)
