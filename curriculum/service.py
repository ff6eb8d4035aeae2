"""The curriculum process: serves tasks and scores, takes outcomes and candidate starts into its database."""

from __future__ import annotations

import gc
import logging
import math
import sys
import threading
import time
from collections.abc import Iterator
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
from common.signals import stop_on_signals
from common.telemetry import Reporter
from common.weights import WeightsPuller
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.curriculum import Curriculum, Report
from curriculum.database import Database

log = logging.getLogger(__name__)
DATABASE = "curriculum.db"
SAVE_SECONDS = 5.0
CRITIC_REST_SECONDS = 6.0
"""Between two pulls of the critic: 3 MB each, and Q(s0, a0) changes slowly."""
TICK = 0.2
"""Seconds between two looks around."""
LOG_PAGES = 4096
"""Of 4 kB in the database's write-ahead log, from which on it is made to begin again."""
Q_SECONDS, Q_BATCH = 0.03, 64
"""Of a tick at most for Q of candidates, and how many are computed together."""
REPORTS = 16
"""Outcomes that are committed together at most: a question waits for them."""
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
        self.curriculum = Curriculum(config, database, digest.get("encoder") if digest else None)
        self._digest = digest
        self._failed_writes, self._failed_at, self._closed = 0, 0.0, False
        self._arrived: dict[Origin, Report] = {}
        """Outcomes that are neither committed nor acknowledged yet."""
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
            Receiver(
                session, keys.result, self._take_outcome, self._seen, Outcome.max_bytes, self._commit_outcomes
            ),
            Receiver(session, keys.candidates, self._take_candidates, self._seen, Candidates.max_bytes),
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
                if self.curriculum.database.checkpoint() > LOG_PAGES:
                    with self._lock:  # the little that came meanwhile
                        self.curriculum.database.checkpoint()

    def _refresh_q(self) -> None:
        """Takes newer weights, and values candidates by them, a while at a time."""
        newest = self._weights.newest if self._weights else None
        if newest is not None and self.curriculum.version != newest[0]:
            first = self.curriculum.version is None
            try:
                self.curriculum.load_critic(*newest)
            except ValueError as error:
                raise UsageError(
                    f"the learner has other networks than are configured here: {error}"
                ) from None
            if first:
                gc.freeze()  # torch's objects, which stay: a collection of all held every answer up 0.1 s
        until = time.monotonic() + Q_SECONDS
        with self._lock:
            stale = self.curriculum.stale(Q_BATCH)
        for cell, rows in stale:
            if time.monotonic() > until:
                break
            self.curriculum.refresh(cell, rows, self._lock)

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
        tasks = []
        for _ in range(query.count):
            with self._lock:
                tasks.append(self.curriculum.propose(query.cell, query.t))
        return Proposals(tasks=tasks)

    def _score(self, query: ScoreQuery) -> Message:
        properties = self.curriculum.properties(query)
        with self._lock:
            return self.curriculum.score(query, properties)

    def _snapshot(self, question: Nothing) -> Message:
        with self._lock:
            return self.curriculum.snapshot()

    def _seen(self, origin: Origin) -> bool:
        return origin in self._arrived or self.curriculum.seen.seen(origin)

    def _take_outcome(self, parcel: Parcel) -> None:
        message = decode(Outcome, parcel.payload)
        self._check(message.digest)
        with self._lock:
            known = self.curriculum.knows(message)
        entry = None if known else self.curriculum.entry(message.task)
        self._arrived[parcel.origin] = Report(message, parcel.origin, entry)

    def _commit_outcomes(self) -> None:
        """Those that came together; after an error none of the rest is acknowledged, and all come again."""
        reports, self._arrived = list(self._arrived.values()), {}
        for start in range(0, len(reports), REPORTS):
            with self._writing():
                self.curriculum.report(reports[start : start + REPORTS])

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
        state, version = self.curriculum, self.curriculum.version or Version()
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
