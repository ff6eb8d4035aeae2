"""A binary sum tree over numpy arrays: a whole batch is written, or descends, at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class SumTree:
    """Non-negative weights of `capacity` leaves with prefix sampling in O(log capacity) per batch.

    >>> tree = SumTree(4)
    >>> tree.set(np.array([0, 2]), np.array([1.0, 3.0]))
    >>> tree.find(np.array([0.5, 1.5, 3.9]))
    array([0, 2, 2])
    """

    def __init__(self, capacity: int) -> None:
        self._leaves = 1 << max(capacity - 1, 1).bit_length()
        self._nodes = np.zeros(2 * self._leaves)
        self.capacity = capacity

    @property
    def total(self) -> float:
        """Sum of all weights."""
        return float(self._nodes[1])

    @property
    def weights(self) -> NDArray[np.float64]:
        """(capacity,) view of the leaves."""
        return self._nodes[self._leaves : self._leaves + self.capacity]

    def get(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Weights of leaves, same shape as `indices`."""
        found: NDArray[np.float64] = self._nodes[self._leaves + indices]
        return found

    def set(self, indices: NDArray[np.int64], weights: NDArray[np.float64] | float) -> None:
        """Writes leaves; of an index that stands twice the last weight counts. Raises ValueError below 0."""
        if np.any(np.asarray(weights) < 0) or not np.all(np.isfinite(weights)):
            raise ValueError("weights must be finite and not negative")
        nodes = self._leaves + np.asarray(indices)
        self._nodes[nodes] = weights
        while len(nodes) and nodes[0] > 1:
            nodes = np.unique(nodes >> 1)
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def find(self, prefixes: NDArray[np.float64]) -> NDArray[np.int64]:
        """For each prefix in [0, total) the leaf i with sum(weights[:i]) <= prefix < sum(weights[:i + 1])."""
        prefixes = np.array(prefixes, np.float64)
        nodes = np.ones(len(prefixes), np.int64)
        while nodes[0] < self._leaves:
            nodes <<= 1
            left = self._nodes[nodes]
            # a rounded-up prefix must not end in an empty subtree
            right = (prefixes >= left) & (self._nodes[nodes + 1] > 0)
            prefixes -= np.where(right, left, 0.0)
            nodes += right
        found: NDArray[np.int64] = nodes - self._leaves
        return found
