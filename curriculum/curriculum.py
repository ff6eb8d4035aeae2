"""The curriculum: gate, algorithm, task database and critic behind a few methods. Free of the bus."""

from __future__ import annotations

import json
import logging
import sqlite3
import time
import uuid
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import safetensors.numpy

from common.config import Config
from common.delivery import DuplicateFilter
from common.errors import UsageError
from common.messages import (
    Candidate,
    Candidates,
    MessageError,
    Origin,
    Outcome,
    Proposal,
    Scored,
    ScoreQuery,
    Scores,
    Snapshot,
    Version,
    decode,
)
from common.observation import ObservationLayout
from curriculum.algorithms import make_algorithm
from curriculum.algorithms.base import Pick, Result, State
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.calibration import brier_score, reliability
from curriculum.candidates import Cell, check_layout
from curriculum.database import Database, Lease
from curriculum.task_space import AnyTask, Entry, Properties, Scaling, make_space

if TYPE_CHECKING:
    from torch import Tensor

    from curriculum.critic import CriticView

log = logging.getLogger(__name__)
STATE, VALUES = "curriculum", "q"
"""Names of what is saved: what was learned, and Q of candidates."""
FORMAT = 2
"""Of what algorithms save."""
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


class Report(NamedTuple):
    """An outcome, and who brought it."""

    outcome: Outcome
    origin: Origin
    entry: Entry | None = None
    """Of its task, where `knows` denies the proposal; made when it is needed if it is missing here."""


class Curriculum:
    """What a database holds, and what to propose from it.

    Candidates of another `encoder` than the run's are dropped; None takes them as they are, standing alone.
    What changes it is in the database before it is learned: after an OSError nothing has happened. One thread
    at a time.
    """

    def __init__(self, config: Config, database: Database | None = None, encoder: str | None = None) -> None:
        self.config, self.encoder = config, encoder
        self.database = database or Database(None)
        self.space = make_space(config)
        self._layout = ObservationLayout.of(config)
        self._critic: CriticView | None = None
        self.version: Version | None = None
        """Of the weights that Q is computed by; None before the first."""
        self._load()
        if encoder is not None:
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
        self._scaling = Scaling(self.space.inputs, self.space.scales)
        share = self.config.curriculum.narrowed_candidates
        self.cells = [Cell(i, self.space, self._scaling, share, self.rng) for i in range(self.space.cells)]
        try:
            self._load_tasks()
            for outcome in self.database.outcomes(after=self._load_state()):
                self._learn(outcome.result)
        except DAMAGE as error:
            raise UsageError(f"{self.database.name} does not fit: {error}; move it to start afresh") from None

    def _load_tasks(self) -> None:
        """Candidates in their arrays, from which a task is made only when it is chosen."""
        found: list[list[tuple[int, str, Properties]]] = [[] for _ in self.cells]
        for row, text in self.database.candidates(self.encoder):
            cell, _, properties, _ = json.loads(text)
            found[cell].append((row, text, properties))
        for cell, candidates in zip(self.cells, found, strict=True):
            if candidates:
                rows, texts, properties = zip(*candidates, strict=True)
                cell.add(rows, texts, self._scaling(properties), len(rows))
        leases, valued = self.database.leases(), self.database.load_state(VALUES)
        known = safetensors.numpy.load(valued[1]) if valued else {}
        for cell in self.cells:
            for row in leases.keys() & set(cell.table.row.tolist()):
                cell.lend(row, leases[row])
            if known:
                cell.value(known["row"].tolist(), known["q"], known["version"])
        self.seen = self.database.origins()

    @property
    def _kind(self) -> list[object]:
        """What a saved state must agree with."""
        settings = self.config.curriculum
        scales = [list(scale) for scale in self.space.scales.values()]
        inputs, hidden = list(self.space.inputs), list(settings.hidden)
        return [settings.algorithm, inputs, hidden, scales, FORMAT, settings.reservoir]

    def _load_state(self) -> int:
        """Takes a saved state; returns the number of the last outcome in it."""
        found = self.database.load_state(STATE)
        if found is None:
            return 0
        values, arrays = found
        if values["kind"] != self._kind:
            why = "another algorithm or format than before"
            log.warning("%s: it learns from the outcomes in %s", why, self.database.name)
            return 0
        self.rng.bit_generator.state = values["rng"]
        self.algorithm.restore(State(safetensors.numpy.load(arrays), values["algorithm"]))
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
        arrays = safetensors.numpy.save(state.arrays)
        tables = [cell.table._asdict() for cell in self.cells]
        known = {name: np.concatenate([t[name] for t in tables]) for name in ("row", "q", "version")}
        with self._writing():
            self.database.save_state(STATE, values, arrays)
            self.database.save_state(VALUES, {}, safetensors.numpy.save(known))
            self.database.drop_leases(before=time.time() - self.config.curriculum.lease)
            if self.outcomes >= self.history + HISTORY:
                about = {"kind": self._kind, "algorithm": dict(state.values)}
                self.database.save_network(self.outcomes, about, arrays)
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
        return sum(map(len, self.cells))

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
        if pick.entry.row is not None:
            self.cells[cell].lend(pick.entry.row, pick.entry.lease)
        return proposal

    def _proposal(self, pick: Pick) -> Proposal:
        entry = pick.entry
        if pick.f is None:
            reason = f"not used by {pick.category}"
        elif "q" not in self.space.inputs:
            reason = "not an input of f_pi"
        elif entry.q is not None:
            reason = "critic"
        elif entry.row is None:
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

    def knows(self, outcome: Outcome) -> bool:
        """Whether what was proposed is on record, so that what it says of the task does not matter."""
        name, database = outcome.proposal, self.database
        return name is not None and (database.has_lease(name) or database.has_outcome(name))

    def entry(self, task: AnyTask) -> Entry:
        """A task with its geometry, a millisecond; MessageError for an impossible one. Touches nothing."""
        try:
            return self.space.entry(task)
        except UsageError as error:
            raise MessageError(f"task: {error}") from None

    def report(self, reports: Iterable[Report]) -> None:
        """Takes how tasks ended, all or none, once for each proposal; MessageError for an impossible task."""
        ended: list[tuple[int | None, Result]] = []
        heard, senders = DuplicateFilter(), set[tuple[str, str]]()
        with self._writing():
            for outcome, origin, entry in reports:
                sender = origin.actor, origin.boot
                heard.restore([(heard if sender in senders else self.seen).after(origin)])
                senders.add(sender)
                if outcome.proposal and self.database.has_outcome(outcome.proposal):
                    continue
                lease = self.database.end_lease(outcome.proposal) if outcome.proposal else None
                if lease is None:
                    lease = Lease(None, None, "unserved", entry or self.entry(outcome.task), None)
                result = Result(lease.entry, lease.category, lease.f, outcome.success)
                if lease.candidate is not None:
                    self.database.drop_candidate(lease.candidate)
                self.database.add_outcome(outcome.proposal, origin.actor, result, lease.requested)
                ended.append((lease.candidate, result))
            self.database.keep_origins(heard)
        self.seen.restore(heard.state())
        for candidate, result in ended:
            if candidate is not None:
                self.cells[result.entry.cell].drop(candidate)
            self._learn(result)

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
            check_layout(candidate, self._layout)
            entry = self.entry(candidate.task)
            entry.observed = candidate
            entries.append(entry)
        return entries

    def add(self, entries: Iterable[Entry], origin: Origin) -> None:
        """Takes candidates into the database, where the oldest of their cell make room."""
        most, new = self.config.curriculum.store_per_cell, defaultdict[int, list[Entry]](list)
        heard = DuplicateFilter()
        heard.restore([self.seen.after(origin)])
        with self._writing():
            for entry in entries:
                self.database.add_candidate(entry, self.encoder or "")
                new[entry.cell].append(entry)
            for cell, added in new.items():
                held = [*self.cells[cell].table.row.tolist(), *(entry.row for entry in added)]
                for row in held[:-most]:
                    self.database.drop_candidate(row)
            self.database.keep_origins(heard)
        self.seen.restore(heard.state())
        for cell, added in new.items():
            rows, texts, properties, observed = zip(
                *((e.row, e.text, e.properties, e.observed) for e in added), strict=True
            )
            self.cells[cell].add(rows, texts, self._scaling(properties), most, observed)

    def load_critic(self, version: Version, tensors: dict[str, Tensor]) -> None:
        """Takes newer weights; ValueError when they do not fit."""
        if self._critic is None:
            from curriculum.critic import CriticView  # brings torch, for which no answer is to wait

            self._critic = CriticView(self.config)
        self._critic.load(tensors)
        self.version = version

    def stale(self, size: int) -> list[tuple[Cell, list[int]]]:
        """Candidates whose Q could be newer, rows of a cell, so many together at most; the oldest Q first."""
        if self.version is None:
            return []
        found = [(cell, cell.stale(self.version)) for cell in self.cells]
        batches = [(cell, stale[i : i + size]) for cell, stale in found for i in range(0, len(stale), size)]
        batches.sort(key=lambda batch: batch[1][0].tolist())
        return [(cell, stale[:, -1].tolist()) for cell, stale in batches]

    def refresh(self, cell: Cell, rows: list[int], alone: AbstractContextManager[object]) -> None:
        """Renews Q of candidates that are still there; beside other threads but for what is done `alone`."""
        critic, version = self._critic, self.version
        assert critic is not None and version is not None
        with alone:
            stored = self.database.observed(cell.unread(rows))
        read = {row: decode(Candidate, blob) for row, blob in stored}
        with alone:
            cell.observe(read)
            starts = cell.observed(rows)
        if starts:
            q = critic.value(list(starts.values()))
            with alone:
                cell.value(list(starts), q, np.array([version.epoch, version.counter]))

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
            assert item.task is not None
            try:
                return dict(self.entry(item.task).properties)
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
            candidates=[len(cell) for cell in self.cells],
            leases=self.database.count_leases(),
            gate_open=self.gate.open,
            proposed=dict(self.proposed),
            inputs=list(self.space.inputs) if network else [],
            brier=brier_score(f, success) if f else None,
            reliability=reliability(f, success) if f else [],
            network=network,
        )
