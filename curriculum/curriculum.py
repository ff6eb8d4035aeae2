"""The curriculum: gate, algorithm, task database and critic behind a few methods. Free of the bus."""

from __future__ import annotations

import logging
import sqlite3
import time
import uuid
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice

import numpy as np
import safetensors.torch

from common.config import Config
from common.errors import UsageError
from common.messages import (
    Candidates,
    MessageError,
    Origin,
    Outcome,
    Proposal,
    Scored,
    ScoreQuery,
    Scores,
    Snapshot,
)
from curriculum.algorithms import make_algorithm
from curriculum.algorithms.base import Pick, Result, State
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.calibration import brier_score, reliability
from curriculum.critic import CriticView
from curriculum.database import Database, Lease
from curriculum.task_space import Entry, make_space

log = logging.getLogger(__name__)
STATE = "curriculum"
HISTORY = 200
"""Outcomes after which f_pi is kept for the pictures."""
DAMAGE = sqlite3.DatabaseError, safetensors.SafetensorError, LookupError, ValueError, TypeError
"""What reading a database may raise that is not of this run, or not whole."""
JUDGED = 1000
"""Outcomes over which the predictions made before them are judged."""


class Gate:
    """Favourable starts until they succeed (section 5.3): open for good once enough of the last ones did."""

    def __init__(self, config: Config) -> None:
        self.config = config.curriculum.gate
        self.open = not self.config.enabled
        self.outcomes: deque[bool] = deque(maxlen=self.config.window)

    def add(self, success: bool) -> None:
        """Takes the outcome of a favourable start."""
        self.outcomes.append(success)
        if len(self.outcomes) == self.config.window:
            self.open = self.open or sum(self.outcomes) >= self.config.threshold * self.config.window


class _Cell:
    """The tasks of a cell, for an algorithm: candidates that nobody has in hand, oldest first."""

    def __init__(self, curriculum: Curriculum, cell: int) -> None:
        self.cell, self._owner = cell, curriculum
        self.entries: OrderedDict[int, Entry] = OrderedDict()

    def draw(self, count: int) -> list[Entry]:
        owner, now, entries = self._owner, time.time(), list(self.entries.values())
        order = owner.rng.permutation(len(entries)).tolist()

        def free(valued: bool) -> list[Entry]:
            """As many as are asked for; f_pi does not compare those with Q and without."""
            fit = (e for i in order if (e := entries[i]).lease <= now and (e.q is not None) == valued)
            return list(islice(fit, count))

        found = free(valued=True) or free(valued=False)
        if found:
            return found
        share = owner.config.curriculum.narrowed_candidates
        return [
            owner.space.candidate(self.cell, share, owner.rng) for _ in range(min(count, owner.space.at_once))
        ]

    def new(self, level: float = 1.0) -> Entry:
        return self._owner.space.draw(self.cell, level, self._owner.rng)


class Curriculum:
    """What a database holds, and what to propose from it; `encoder` is that of the candidates in it.

    What changes it is in the database before it is learned: after an OSError nothing has happened. One thread
    at a time.
    """

    def __init__(self, config: Config, database: Database | None = None, encoder: str = "") -> None:
        self.config, self.encoder = config, encoder
        self.database = database or Database(None)
        self.space = make_space(config)
        self.critic = CriticView(config)
        self._load()
        with suppress(OSError), self._writing():
            self.database.drop_candidates_but(encoder)

    def _load(self) -> None:
        """Everything from the database: a saved state, and what came after it."""
        self.rng = np.random.default_rng([self.config.seed, 3])
        self.algorithm = make_algorithm(self.config, self.space)
        self.gate = Gate(self.config)
        self.proposed: Counter[str] = Counter()
        self.outcomes = self.history = 0
        self.judged: deque[tuple[float, bool]] = deque(maxlen=JUDGED)
        self.cells = [_Cell(self, index) for index in range(self.space.cells)]
        try:
            self._load_tasks()
            for outcome in self.database.outcomes(after=self._load_state()):
                self._learn(outcome.result)
        except DAMAGE as error:
            raise UsageError(f"{self.database.name} does not fit: {error}; move it to start afresh") from None

    def _load_tasks(self) -> None:
        self.seen, leases = self.database.origins(), self.database.leases()
        for entry in self.database.candidates(self.encoder):
            assert entry.row is not None
            entry.lease = leases.get(entry.row, 0.0)
            self.cells[entry.cell].entries[entry.row] = entry

    @property
    def _kind(self) -> list[object]:
        """What a saved state must agree with."""
        settings = self.config.curriculum
        scales = [list(scale) for scale in self.space.scales.values()]
        return [settings.algorithm, list(self.space.inputs), list(settings.hidden), scales]

    def _load_state(self) -> int:
        """Takes a saved state; returns the number of the last outcome in it."""
        found = self.database.load_state(STATE)
        if found is None:
            return 0
        values, tensors = found
        if values["kind"] != self._kind:
            log.warning(
                "another algorithm than before: it learns from the outcomes in %s", self.database.name
            )
            return 0
        self.rng.bit_generator.state = values["rng"]
        self.algorithm.restore(State(safetensors.torch.load(tensors), values["algorithm"]))
        self.gate.open = self.gate.open or bool(values["gate_open"])
        self.gate.outcomes.extend(values["gate_outcomes"])
        self.proposed = Counter(values["proposed"])
        self.judged.extend((float(f), bool(success)) for f, success in values["judged"])
        self.outcomes = int(values["outcomes"])
        self.history = self.outcomes - self.outcomes % HISTORY
        return int(values["last"])

    def save(self) -> None:
        """Keeps the state."""
        state = self.algorithm.snapshot()
        values = {
            "kind": self._kind,
            "rng": self.rng.bit_generator.state,
            "algorithm": dict(state.values),
            "gate_open": self.gate.open,
            "gate_outcomes": list(self.gate.outcomes),
            "proposed": self.proposed,
            "judged": list(self.judged),
            "outcomes": self.outcomes,
            "last": self.database.last_outcome(),
        }
        tensors = safetensors.torch.save(state.tensors)
        with self._writing():
            self.database.save_state(STATE, values, tensors)
            self.database.drop_leases(before=time.time() - self.config.curriculum.lease)
            if self.outcomes >= self.history + HISTORY:
                about = {"kind": self._kind, "algorithm": dict(state.values)}
                self.database.save_network(self.outcomes, about, tensors)
                self.history = self.outcomes - self.outcomes % HISTORY

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """All of it lasts afterwards, or after an error nothing."""
        try:
            yield
            self.database.commit()
        except BaseException:
            self.database.roll_back()
            raise

    def __len__(self) -> int:
        """Candidates in the database."""
        return sum(len(cell.entries) for cell in self.cells)

    def propose(self, cell: int, t: int) -> Proposal:
        """A task for a cell, asked at the agent's own step t (algorithm 2); MessageError for no such cell."""
        if cell >= len(self.cells):
            raise MessageError(f"cell: {cell} does not exist here; 0 to {len(self.cells) - 1} do")
        if not self.gate.open:
            done, of = sum(self.gate.outcomes), len(self.gate.outcomes)
            why = f"favourable starts until they succeed: {done} of the last {of} did"
            pick = Pick(self.cells[cell].new(0.0), "gate", why)
        else:
            pick = self.algorithm.propose(t, self.cells[cell], self.rng)
        self.proposed[pick.category] += 1
        proposal = self._proposal(pick)
        with suppress(OSError), self._writing():  # an outcome without a lease counts by its task
            self.database.lease(proposal, pick, self.config.curriculum.lease)
        return proposal

    def _proposal(self, pick: Pick) -> Proposal:
        entry = pick.entry
        if pick.f is None:
            reason = f"not used by {pick.category}"
        elif "q" not in self.space.inputs:
            reason = "not an input of f_pi"
        elif entry.q is not None:
            reason = "critic"
        elif entry.observed is None:
            reason = "no candidate in the database; by geometry alone"
        else:
            reason = "no critic yet"
        version = entry.q_version
        return Proposal(
            id=uuid.uuid4().hex,
            task=entry.task,
            requested=pick.requested,
            category=pick.category,
            why=pick.why,
            properties=dict(entry.properties),
            q=entry.q,
            q_version=f"{version.epoch}.{version.counter}" if version else None,
            q_reason=reason,
            f=pick.f,
            mu=pick.mu,
            sigma=pick.sigma,
            robot=entry.poses and entry.poses[0],
            dolly=entry.poses and entry.poses[1],
        )

    def report(self, outcome: Outcome, origin: Origin) -> None:
        """Takes how a task ended, once for each proposal; MessageError for an impossible task."""
        with self._writing():
            lease = self.database.end_lease(outcome.proposal) if outcome.proposal else None
            if lease is None:
                lease = Lease(None, None, "unserved", self._entry(outcome.task), None)
            result = Result(lease.entry, lease.category, lease.f, outcome.success)
            if lease.candidate is not None:
                self.database.drop_candidate(lease.candidate)
            is_new = self.database.add_outcome(outcome.proposal, origin.actor, result, lease.requested)
            self.database.keep_origin(self.seen, origin)
        self.seen.add(origin)
        self.cells[lease.entry.cell].entries.pop(lease.candidate or 0, None)
        if is_new:
            self._learn(result)

    def _entry(self, task: object) -> Entry:
        try:
            return self.space.entry(task)  # type: ignore[arg-type]
        except UsageError as error:
            raise MessageError(f"task: {error}") from None

    def _learn(self, result: Result) -> None:
        self.outcomes += 1
        if result.category == "gate":
            self.gate.add(result.success)
        if result.f is not None:
            self.judged.append((result.f, result.success))
        self.algorithm.report(result)

    def check(self, message: Candidates) -> list[Entry]:
        """Candidates with their geometry; raises MessageError for one that does not fit.

        Touches nothing, and may run beside other threads: a millisecond for each.
        """
        entries = []
        for candidate in message.candidates:
            self.critic.check(candidate)
            entry = self._entry(candidate.task)
            entry.observed = candidate
            entries.append(entry)
        return entries

    def add(self, entries: Iterable[Entry], origin: Origin) -> None:
        """Takes candidates into the database, where the oldest of their cell make room."""
        most, after = self.config.curriculum.store_per_cell, [cell.entries.copy() for cell in self.cells]
        with self._writing():
            for entry in entries:
                self.database.add_candidate(entry, self.encoder)
                assert entry.row is not None
                held = after[entry.cell]
                held[entry.row] = entry
                if len(held) > most:
                    self.database.drop_candidate(held.popitem(last=False)[0])
            self.database.keep_origin(self.seen, origin)
        self.seen.add(origin)
        for cell, held in zip(self.cells, after, strict=True):
            cell.entries = held

    def stale(self) -> list[Entry]:
        """Candidates whose Q could be newer, for `critic.refresh`, which may run beside other threads."""
        return self.critic.stale(chain.from_iterable(cell.entries.values() for cell in self.cells))

    def properties(self, query: ScoreQuery) -> list[dict[str, float]]:
        """What f_pi sees of tasks; MessageError that names the field which does not fit.

        Touches nothing, and may run beside other threads: a millisecond for each.
        """
        return [self._scored(index, item) for index, item in enumerate(query.tasks)]

    def score(self, query: ScoreQuery, properties: list[dict[str, float]]) -> Scores:
        """Predicted success of tasks with those properties."""
        f = self.algorithm.score(properties, [item.q for item in query.tasks])
        if f is None:
            raise MessageError(f"{self.config.curriculum.algorithm} predicts nothing")
        return Scores(f=f.tolist(), properties=properties, outcomes=self.outcomes)

    def _scored(self, index: int, item: Scored) -> dict[str, float]:
        if (item.task is None) == (item.properties is None):
            raise MessageError(f"tasks.{index}: either task or properties")
        if item.properties is None:
            try:
                return dict(self._entry(item.task).properties)
            except MessageError as error:
                raise MessageError(f"tasks.{index}.{error}") from None
        needed = [name for name in self.space.inputs if name != "q"]
        for name in needed:
            if name not in item.properties:
                raise MessageError(
                    f"tasks.{index}.properties.{name}: missing; needed are {', '.join(needed)}"
                )
        for name in item.properties:
            if name not in self.space.scales:
                raise MessageError(f"tasks.{index}.properties.{name}: no property of these tasks")
        return item.properties

    def snapshot(self) -> Snapshot:
        """The state for whoever asks."""
        learned = self.algorithm if isinstance(self.algorithm, NavaclQ) else None
        network = learned.network.file(learned.calibration) if learned else b""
        f, success = zip(*self.judged, strict=True) if self.judged else ((), ())
        return Snapshot(
            algorithm=self.config.curriculum.algorithm,
            outcomes=self.outcomes,
            candidates=[len(cell.entries) for cell in self.cells],
            leases=self.database.count_leases(),
            gate_open=self.gate.open,
            proposed=dict(self.proposed),
            inputs=list(self.space.inputs) if network else [],
            brier=brier_score(f, success) if f else None,
            reliability=reliability(f, success) if f else [],
            network=network,
        )
