"""RND, the paper's rival: every task alike."""

from __future__ import annotations

import numpy as np

from curriculum.algorithms.base import Algorithm, Pick, Pool, Result


class Rnd(Algorithm):
    """Uniform over the full distribution."""

    def propose(self, t: int, pool: Pool, rng: np.random.Generator) -> Pick:
        """A random task."""
        return Pick(pool.new(), "rnd", "drawn from the full distribution")

    def report(self, result: Result) -> None:
        """Learns nothing."""
