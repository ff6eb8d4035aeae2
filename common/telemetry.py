"""What processes tell about themselves: figures on the bus once a second, and logging to stderr."""

from __future__ import annotations

import logging
import os
import socket
import sys
import time
from collections import deque

import numpy as np
import zenoh

from common.bus import Keys, Member, publish
from common.messages import PROTOCOL, Stat
from common.version import code_version


class Reporter:
    """Publishes a process's figures at most once a second."""

    def __init__(self, session: zenoh.Session, keys: Keys, member: Member) -> None:
        self._session, self._key = session, keys.stat(member)
        self._told = Stat(
            **member._asdict(),
            host=socket.gethostname(),
            pid=os.getpid(),
            since=time.time(),
            code=code_version(),
            protocol=PROTOCOL,
            values={},
        )
        self._last = 0.0

    @property
    def due(self) -> bool:
        """Whether a second has passed since the last report."""
        return time.monotonic() - self._last >= 1.0

    def report(self, values: dict[str, float | int | str]) -> None:
        """Publishes the figures."""
        self._last = time.monotonic()
        publish(self._session, self._key, self._told.model_copy(update={"values": values}))


class Rate:
    """Events per second, over the time between two readings."""

    def __init__(self) -> None:
        self._count, self._time, self.value = 0.0, time.monotonic(), 0.0

    def read(self, count: float) -> float:
        """The rate at which `count` has grown, renewed at most once a second."""
        now = time.monotonic()
        if now - self._time >= 1.0:
            self.value = (count - self._count) / (now - self._time)
            self._count, self._time = count, now
        return self.value


class Quantiles:
    """Median and 99th percentile of the last 500 values."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=500)

    def add(self, value: float) -> None:
        """Takes note of a value."""
        self._values.append(value)

    def figures(self, name: str, unit: str) -> dict[str, float]:
        """`NAME_p50_UNIT` and `NAME_p99_UNIT`; empty before the first value."""
        if not self._values:
            return {}
        p50, p99 = np.percentile(list(self._values), (50, 99))
        return {f"{name}_p50_{unit}": round(float(p50), 2), f"{name}_p99_{unit}": round(float(p99), 2)}


def start_logging(level: int = logging.INFO) -> None:
    """Log lines on stderr."""
    logging.basicConfig(
        level=level, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s", force=True
    )
