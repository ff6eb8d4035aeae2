"""The rate limiter between what is inserted into the replay and what is sampled from it."""

from __future__ import annotations

from common.config import ReplayConfig
from common.errors import UsageError


class RateLimiter:
    """Holds the transitions sampled per transition inserted near a target (Reverb's SampleToInsertRatio).

    Its balance is `samples_per_insert` for every transition inserted after the first `warmup_steps`, less the
    transitions sampled. Sampling waits when it would fall below -`error_buffer`. Inserting waits when it
    would rise above `error_buffer`; without `hold_actors` it never waits, and what exceeds is forgotten.
    The balance is all that a restart needs: it neither bursts to catch up nor stalls.
    """

    def __init__(self, config: ReplayConfig, batch_size: int, max_steps: int) -> None:
        """Raises UsageError for a band in which neither side could go on."""
        least = (config.samples_per_insert * max_steps + batch_size) / 2
        if config.error_buffer < least:
            raise UsageError(
                f"replay.error_buffer = {config.error_buffer:g} is too narrow for episodes of {max_steps} "
                f"steps and batches of {batch_size}; it must be at least {least:g}"
            )
        self._config, self._batch_size = config, batch_size
        self.inserted = 0
        self.balance = 0.0

    def may_insert(self, transitions: int) -> bool:
        """Whether so many more transitions may come now."""
        warming_up = self.inserted < self._config.warmup_steps
        free = warming_up or not self._config.hold_actors
        return free or self._after(transitions) <= self._config.error_buffer

    def insert(self, transitions: int) -> None:
        """Counts transitions that have come."""
        self.balance = min(self._after(transitions), self._config.error_buffer)
        self.inserted += transitions

    def may_sample(self) -> bool:
        """Whether a batch may be sampled now."""
        enough = self.inserted >= self._config.warmup_steps
        return enough and self.balance - self._batch_size >= -self._config.error_buffer

    def sample(self) -> None:
        """Counts a batch that was sampled."""
        self.balance -= self._batch_size

    def _after(self, transitions: int) -> float:
        warm = min(transitions, self.inserted + transitions - self._config.warmup_steps)
        return self.balance + self._config.samples_per_insert * max(0, warm)
