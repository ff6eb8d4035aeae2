"""The curriculum process: serves proposals, takes outcomes and candidate starts in, saves what it learns."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
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
    Outcome,
    Proposals,
    TaskQuery,
    Version,
    decode,
)
from common.telemetry import Reporter, stop_on_signals
from common.weights import WeightsPuller
from curriculum.curriculum import Curriculum

log = logging.getLogger(__name__)
Report = TypeVar("Report", Outcome, Candidates)
SAVE_SECONDS = 5.0
CRITIC_REST_SECONDS = 6.0
"""Between two pulls of the critic: 3 MB each, and Q(s0, a0) changes slowly."""


class CurriculumService:
    """Serves a Curriculum on the bus. `digest` is the run's contract; None when it stands alone."""

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        config: Config,
        digest: dict[str, str] | None,
        folder: Path | None,
        group: str = LOCAL,
    ) -> None:
        torch.set_num_threads(1)
        self.curriculum = Curriculum(config)
        self._folder = folder
        if folder is not None:
            self.curriculum.restore(folder)
        self._digest = digest
        self._failed_writes, self._failed_at = 0, 0.0
        self._lock = threading.Lock()
        keys = Keys(run)
        member = Member("curriculum", group, "curriculum")
        self._token = announce(session, keys, member)
        self._weights = (
            WeightsPuller(session, keys, "critic", CRITIC_REST_SECONDS) if digest is not None else None
        )
        self._servers = [
            serve(session, keys.task, TaskQuery, self._propose),
            self._receiver(session, keys.result, Outcome, self.curriculum.report),
            self._receiver(session, keys.candidates, Candidates, self.curriculum.add),
        ]
        self._reporter = Reporter(session, keys, member)

    def run(self) -> None:
        """Serves until SIGTERM or SIGINT; keeps weights fresh, reports and saves meanwhile."""
        saved, stopping = time.monotonic(), stop_on_signals()
        while not stopping.wait(0.2):
            newest = self._weights.newest if self._weights else None
            if newest is not None and self.curriculum.critic.version != newest[0]:
                try:
                    with self._lock:
                        self.curriculum.critic.load(*newest)
                except ValueError as error:
                    raise UsageError(
                        f"the learner has other networks than are configured here: {error}"
                    ) from None
            if self._reporter.due:
                self._report()
            if time.monotonic() - saved >= SAVE_SECONDS:
                saved = time.monotonic()
                self.save()

    def save(self) -> None:
        """Writes the state to the folder, if there is one; a full disk must not end the service."""
        if self._folder is None:
            return
        try:
            with self._lock:
                self.curriculum.save(self._folder)
        except OSError as error:
            self._failed_writes, self._failed_at = self._failed_writes + 1, time.monotonic()
            log.error("cannot write to %s: %s; it is tried again", self._folder, error.strerror or error)

    def close(self) -> None:
        """Stops serving and saves."""
        for server in self._servers:
            server.close()
        self.save()

    def _propose(self, query: TaskQuery) -> Message:
        with self._lock:
            return Proposals(tasks=[self.curriculum.propose(query.cell, query.t) for _ in range(query.count)])

    def _receiver(
        self, session: zenoh.Session, channel: str, kind: type[Report], add: Callable[[Report], None]
    ) -> Receiver:
        def take(parcel: Parcel) -> None:
            message = decode(kind, parcel.payload)
            if self._digest is not None:
                check_digest(self._digest, message.digest)
            with self._lock:
                add(message)
                self.curriculum.seen.add(parcel.origin)

        return Receiver(session, channel, take, self.curriculum.seen.seen, kind.max_bytes)

    def _report(self) -> None:
        state, version = self.curriculum, self.curriculum.critic.version or Version()
        values: dict[str, float | int | str] = {
            "candidates": len(state.store),
            "outcomes": state.outcomes,
            "gate_open": int(state.gate.open),
            "gate_success": round(sum(state.gate.outcomes) / max(len(state.gate.outcomes), 1), 3),
            "fits": state.network.fits,
            "weights": f"{version.epoch}.{version.counter}",
            "inbox": sum(map(len, self._servers)),
            "failed_writes": self._failed_writes,
            "refused": sum(sum(server.refused.values()) for server in self._servers),
            **{f"proposed_{name}": count for name, count in dict(state.proposed).items()},
        }
        if self._failed_writes:
            values["failed_s"] = round(time.monotonic() - self._failed_at, 1)
        if math.isfinite(state.network.loss):
            values["loss"] = round(state.network.loss, 4)
        self._reporter.report(values)
