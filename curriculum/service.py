"""The curriculum process: serves proposals, takes outcomes and candidate starts in, saves what it learns."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
import zenoh

from common.bus import Keys, QueryServer, announce, serve
from common.config import Config
from common.contract import check_digest
from common.delivery import unpack_header
from common.errors import UsageError
from common.messages import (
    Acknowledgement,
    Candidates,
    Message,
    Outcome,
    Proposals,
    TaskQuery,
    decode,
    encode,
)
from common.telemetry import Reporter
from common.weights import WeightsPuller
from curriculum.curriculum import Curriculum

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
    ) -> None:
        torch.set_num_threads(1)
        self.curriculum = Curriculum(config)
        self._folder = folder
        if folder is not None:
            self.curriculum.restore(folder)
        self._digest = digest
        self._lock = threading.Lock()
        keys = Keys(run)
        self._token = announce(session, keys, "curriculum", "curriculum")
        self._weights = (
            WeightsPuller(session, keys, "critic", CRITIC_REST_SECONDS) if digest is not None else None
        )
        self._servers = [
            serve(session, keys.task, TaskQuery, self._propose),
            QueryServer(session, keys.result, partial(self._take, Outcome, self.curriculum.report)),
            QueryServer(session, keys.candidates, partial(self._take, Candidates, self.curriculum.add)),
        ]
        self._reporter = Reporter(session, keys, "curriculum", "curriculum")

    def run(self) -> None:
        """Serves until SystemExit; keeps weights fresh, reports and saves meanwhile."""
        saved = time.monotonic()
        while True:
            time.sleep(0.2)
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
        """Writes the state to the folder, if there is one."""
        if self._folder is not None:
            with self._lock:
                self.curriculum.save(self._folder)

    def close(self) -> None:
        """Stops serving and saves."""
        for server in self._servers:
            server.close()
        self.save()

    def _propose(self, query: TaskQuery) -> Message:
        with self._lock:
            return Proposals(tasks=[self.curriculum.propose(query.cell, query.t) for _ in range(query.count)])

    def _take(
        self, kind: type[Report], add: Callable[[Report], None], payload: bytes, attachment: bytes
    ) -> bytes:
        """Acknowledges a delivered message after `add` has taken it; one that came before changes nothing."""
        origin = unpack_header(attachment, payload)
        message = decode(kind, payload)
        if self._digest is not None:
            check_digest(self._digest, message.digest)
        with self._lock:
            duplicate = self.curriculum.seen.seen(origin)
            if not duplicate:
                add(message)
                self.curriculum.seen.add(origin)
        return encode(Acknowledgement(duplicate=duplicate))

    def _report(self) -> None:
        state = self.curriculum
        values: dict[str, float | int | str] = {
            "candidates": len(state.store),
            "outcomes": state.outcomes,
            "gate_open": int(state.gate.open),
            "gate_success": round(sum(state.gate.outcomes) / max(len(state.gate.outcomes), 1), 3),
            "fits": state.network.fits,
            "weights": state.critic.version.counter if state.critic.version else 0,
            "refused": sum(sum(server.refused.values()) for server in self._servers),
            **{f"proposed_{name}": count for name, count in dict(state.proposed).items()},
        }
        if math.isfinite(state.network.loss):
            values["loss"] = round(state.network.loss, 4)
        self._reporter.report(values)
