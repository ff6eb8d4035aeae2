"""The curriculum process: serves tasks and scores, takes outcomes and candidate starts into its database."""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zenoh

from common.access import LOCAL
from common.bus import Keys, Member, announce, serve
from common.config import Config
from common.contract import check_digest
from common.delivery import Parcel, Receiver
from common.errors import UsageError
from common.messages import (
    Candidates,
    Message,
    Nothing,
    Origin,
    Outcome,
    Proposals,
    ScoreQuery,
    TaskQuery,
    Version,
    decode,
)
from common.telemetry import Reporter, stop_on_signals
from common.weights import WeightsPuller
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.curriculum import Curriculum
from curriculum.database import Database

log = logging.getLogger(__name__)
DATABASE = "curriculum.db"
SAVE_SECONDS = 5.0
CRITIC_REST_SECONDS = 6.0
"""Between two pulls of the critic: 3 MB each, and Q(s0, a0) changes slowly."""
TICK = 0.2
"""Seconds between two looks around."""
Q_SECONDS, Q_BATCH, Q_REST = 0.03, 16, 0.0005
"""Of a tick at most for Q of candidates, so few at a time that a question hardly waits for them."""
SWITCH_SECONDS = 0.0005
"""After which Python lets another thread in: its own 5 ms are a task's whole time."""


class CurriculumService:
    """Serves a Curriculum on the bus, from RUN/curriculum.db or, with `folder` None, from memory.

    `digest` is the run's contract; None when it stands alone.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        config: Config,
        digest: dict[str, str] | None,
        folder: Path | None,
        group: str = LOCAL,
    ) -> None:
        sys.setswitchinterval(SWITCH_SECONDS)
        sync = config.learner.durability == "host"
        database = Database(folder / DATABASE if folder else None, sync)
        self.curriculum = Curriculum(config, database, (digest or {}).get("encoder", ""))
        self._digest = digest
        self._failed_writes, self._failed_at, self._closed = 0, 0.0, False
        self._lock = threading.Lock()
        keys = Keys(run)
        member = Member("curriculum", group, "curriculum")
        self._token = announce(session, keys, member)
        self._weights = (
            WeightsPuller(session, keys, "critic", CRITIC_REST_SECONDS) if digest is not None else None
        )
        self._servers = [
            serve(session, keys.task, TaskQuery, self._propose),
            serve(session, keys.score, ScoreQuery, self._score),
            serve(session, keys.snapshot, Nothing, self._snapshot),
            self._receiver(session, keys.result, self._take_outcome, Outcome.max_bytes),
            self._receiver(session, keys.candidates, self._take_candidates, Candidates.max_bytes),
        ]
        self._reporter = Reporter(session, keys, member)

    def run(self) -> None:
        """Serves until SIGTERM or SIGINT; keeps weights and Q fresh, reports and saves meanwhile."""
        saved, stopping = time.monotonic(), stop_on_signals()
        while not stopping.wait(TICK):
            self._refresh_q()
            if self._reporter.due:
                self._report()
            if time.monotonic() - saved >= SAVE_SECONDS:
                saved = time.monotonic()
                self.save()
                self.curriculum.database.checkpoint()

    def _refresh_q(self) -> None:
        """Takes newer weights, and values candidates by them, a while at a time."""
        critic, newest = self.curriculum.critic, self._weights.newest if self._weights else None
        if newest is not None and critic.version != newest[0]:
            try:
                critic.load(*newest)
            except ValueError as error:
                raise UsageError(
                    f"the learner has other networks than are configured here: {error}"
                ) from None
        until = time.monotonic() + Q_SECONDS
        with self._lock:
            stale = self.curriculum.stale()
        while stale and time.monotonic() < until:
            with self._lock:  # beside a question's many small operations it would cost more than before it
                critic.refresh(stale[:Q_BATCH])
            del stale[:Q_BATCH]
            time.sleep(Q_REST)  # for whoever waits for the lock

    def save(self) -> None:
        """Keeps the state; a full disk must not end the service."""
        with suppress(OSError), self._writing():
            self.curriculum.save()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """With the curriculum to itself; an OSError is noted, after which the curriculum is as it was."""
        with self._lock:
            try:
                yield
            except OSError as error:
                self._failed_writes, self._failed_at = self._failed_writes + 1, time.monotonic()
                log.error("cannot write: %s; it is tried again", error.strerror or error)
                raise

    def close(self) -> None:
        """Stops serving and saves; once is enough."""
        if self._closed:
            return
        self._closed = True
        for server in self._servers:
            server.close()
        self.save()
        self.curriculum.database.close()

    def _propose(self, query: TaskQuery) -> Message:
        with self._lock:
            return Proposals(tasks=[self.curriculum.propose(query.cell, query.t) for _ in range(query.count)])

    def _score(self, query: ScoreQuery) -> Message:
        properties = self.curriculum.properties(query)
        with self._lock:
            return self.curriculum.score(query, properties)

    def _snapshot(self, question: Nothing) -> Message:
        with self._lock:
            return self.curriculum.snapshot()

    def _receiver(
        self, session: zenoh.Session, channel: str, take: Callable[[Parcel], None], max_bytes: int
    ) -> Receiver:
        def seen(origin: Origin) -> bool:
            return self.curriculum.seen.seen(origin)

        return Receiver(session, channel, take, seen, max_bytes)

    def _take_outcome(self, parcel: Parcel) -> None:
        message = decode(Outcome, parcel.payload)
        self._check(message.digest)
        with self._writing():
            self.curriculum.report(message, parcel.origin)

    def _take_candidates(self, parcel: Parcel) -> None:
        message = decode(Candidates, parcel.payload)
        self._check(message.digest)
        entries = self.curriculum.check(message)
        with self._writing():
            self.curriculum.add(entries, parcel.origin)

    def _check(self, digest: dict[str, str]) -> None:
        if self._digest is not None:
            check_digest(self._digest, digest)

    def _report(self) -> None:
        state, version = self.curriculum, self.curriculum.critic.version or Version()
        values: dict[str, float | int | str] = {
            "candidates": len(state),
            "outcomes": state.outcomes,
            "gate_open": int(state.gate.open),
            "gate_success": round(sum(state.gate.outcomes) / max(len(state.gate.outcomes), 1), 3),
            "weights": f"{version.epoch}.{version.counter}",
            "inbox": sum(map(len, self._servers)),
            "failed_writes": self._failed_writes,
            "refused": sum(sum(server.refused.values()) for server in self._servers),
            **{f"proposed_{name}": count for name, count in dict(state.proposed).items()},
        }
        if self._failed_writes:
            values["failed_s"] = round(time.monotonic() - self._failed_at, 1)
        if isinstance(state.algorithm, NavaclQ):
            network = state.algorithm.network
            values["fits"] = network.fits
            if math.isfinite(network.loss):
                values["loss"] = round(network.loss, 4)
        self._reporter.report(values)
