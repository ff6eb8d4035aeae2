"""The curriculum's database, SQLite: candidate starts, tasks in somebody's hands, outcomes, f_pi over time.

What is committed survives the death of the process; with `sync` that of the host too. One thread at a time.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from common.delivery import DuplicateFilter
from common.errors import UsageError
from common.messages import Category, Proposal, Requested, encode
from curriculum.algorithms.base import Pick, Result
from curriculum.task_space import Entry

SCHEMA = 1
TABLES = """
CREATE TABLE candidates (
    id INTEGER PRIMARY KEY AUTOINCREMENT, encoder TEXT, entry TEXT, observed BLOB
);
CREATE TABLE leases (
    proposal TEXT PRIMARY KEY, at REAL, until REAL, candidate INTEGER, requested TEXT, category TEXT,
    entry TEXT, q REAL, f REAL
);
CREATE TABLE outcomes (
    id INTEGER PRIMARY KEY, proposal TEXT UNIQUE, at REAL, actor TEXT, requested TEXT, category TEXT,
    entry TEXT, q REAL, f REAL, success INTEGER
);
CREATE TABLE origins (actor TEXT, boot TEXT, next INTEGER, gaps TEXT, PRIMARY KEY (actor, boot));
CREATE TABLE states (name TEXT PRIMARY KEY, text TEXT, tensors BLOB);
CREATE TABLE networks (outcomes INTEGER PRIMARY KEY, text TEXT, tensors BLOB);
"""


class Lease(NamedTuple):
    """A task in somebody's hands."""

    candidate: int | None
    requested: Requested | None
    category: Category
    entry: Entry
    f: float | None


class Outcome(NamedTuple):
    """An outcome on record."""

    id: int
    at: float
    result: Result


class Database:
    """`file` None: in memory. Nothing counts before `commit`. UsageError for a file of another kind."""

    def __init__(self, file: Path | None, sync: bool = False) -> None:
        self.name, self._file = str(file or "the database in memory"), file
        try:
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
            self._sql = sqlite3.connect(file or ":memory:", check_same_thread=False, isolation_level=None)
            self._sql.execute("BEGIN IMMEDIATE")
            version = int(self._sql.execute("PRAGMA user_version").fetchone()[0])
            if version == 0 and not self._sql.execute("SELECT * FROM sqlite_master").fetchone():
                for statement in TABLES.split(";"):
                    self._sql.execute(statement)
                self._sql.execute(f"PRAGMA user_version={SCHEMA}")
                version = SCHEMA
            self._sql.execute("COMMIT")
            if version != SCHEMA:
                raise UsageError(f"{self.name} is of version {version}; this one reads {SCHEMA}")
            self._sql.execute("PRAGMA journal_mode=WAL")
            self._sql.execute("PRAGMA wal_autocheckpoint=0")  # a query would wait; see checkpoint
            self._sql.execute(f"PRAGMA synchronous={'FULL' if sync else 'NORMAL'}")
        except (OSError, sqlite3.DatabaseError) as error:
            raise UsageError(f"cannot open {self.name}: {error}") from None

    def _do(self, statement: str, values: Iterable[Any] = ()) -> sqlite3.Cursor:
        try:
            if not self._sql.in_transaction:
                self._sql.execute("BEGIN IMMEDIATE")
            return self._sql.execute(statement, tuple(values))
        except sqlite3.OperationalError as error:
            raise OSError(f"{self.name}: {error}") from None

    def commit(self) -> None:
        """Makes everything since the last commit last.

        Raises OSError when the disk does not take it, as any method that writes may. `roll_back` then, and
        everything since the last commit is gone.
        """
        try:
            if self._sql.in_transaction:
                self._sql.execute("COMMIT")
        except sqlite3.OperationalError as error:
            raise OSError(f"{self.name}: {error}") from None

    def checkpoint(self) -> int:
        """Moves what was committed from the write-ahead log to its place; may run beside other threads.

        Returns the pages in the log, which begins again only if nothing was committed meanwhile.
        """
        pages = 0
        if self._file is not None:
            with suppress(sqlite3.OperationalError), closing(sqlite3.connect(self._file)) as own:
                _, pages, _ = own.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        return pages

    def roll_back(self) -> None:
        """Forgets everything since the last commit."""
        if self._sql.in_transaction:
            self._sql.execute("ROLLBACK")

    def close(self) -> None:
        """Without a commit."""
        self._sql.close()

    def add_candidate(self, entry: Entry, encoder: str) -> None:
        """Takes a candidate in, and tells it its row."""
        assert entry.observed is not None
        found = self._do(
            "INSERT INTO candidates (encoder, entry, observed) VALUES (?, ?, ?)",
            (encoder, entry.text, encode(entry.observed)),
        )
        entry.row = found.lastrowid

    def drop_candidate(self, row: int) -> None:
        """Takes one out."""
        self._do("DELETE FROM candidates WHERE id = ?", (row,))

    def candidates(self, encoder: str | None) -> list[tuple[int, str]]:
        """(row, text of the Entry) of those of one encoder, None: of any; oldest first."""
        query = "SELECT id, entry FROM candidates WHERE encoder = coalesce(?, encoder) ORDER BY id"
        return self._sql.execute(query, (encoder,)).fetchall()

    def observed(self, rows: Iterable[int]) -> list[tuple[int, bytes]]:
        """(row, encoded Candidate) of some."""
        query = "SELECT id, observed FROM candidates WHERE id = ?"
        return [self._sql.execute(query, (row,)).fetchone() for row in rows]

    def lease(self, proposal: Proposal, pick: Pick, seconds: float) -> None:
        """Notes that a task was handed out."""
        entry, now = pick.entry, time.time()
        entry.lease = now + seconds
        self._do(
            "INSERT INTO leases VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                proposal.id,
                now,
                entry.lease,
                entry.row,
                pick.requested,
                pick.category,
                entry.text,
                entry.q,
                pick.f,
            ),
        )

    def leases(self) -> dict[int, float]:
        """Until when candidates are handed out, by row."""
        query = "SELECT candidate, max(until) FROM leases WHERE candidate NOTNULL GROUP BY candidate"
        return dict(self._sql.execute(query).fetchall())

    def drop_candidates_but(self, encoder: str) -> None:
        """Drops those of other encoders."""
        self._do("DELETE FROM candidates WHERE encoder != ?", (encoder,))

    def drop_leases(self, before: float) -> None:
        """Drops those that ran out before then, seconds since 1970."""
        self._do("DELETE FROM leases WHERE until < ?", (before,))

    def count_leases(self) -> int:
        """Tasks in somebody's hands."""
        query = "SELECT count(*) FROM leases WHERE until >= ?"
        return int(self._sql.execute(query, (time.time(),)).fetchone()[0])

    def has_lease(self, proposal: str) -> bool:
        """Whether something was handed out under this name."""
        query = "SELECT 1 FROM leases WHERE proposal = ?"
        return self._sql.execute(query, (proposal,)).fetchone() is not None

    def end_lease(self, proposal: str) -> Lease | None:
        """What was handed out under this name, from now on no longer."""
        found = self._do("DELETE FROM leases WHERE proposal = ? RETURNING *", (proposal,)).fetchone()
        if found is None:
            return None
        _, _, _, candidate, requested, category, text, q, f = found
        entry = Entry.read(text)
        entry.q = q
        return Lease(candidate, requested, category, entry, f)

    def has_outcome(self, proposal: str) -> bool:
        """Whether it is known how this proposal ended."""
        query = "SELECT 1 FROM outcomes WHERE proposal = ?"
        return self._sql.execute(query, (proposal,)).fetchone() is not None

    def add_outcome(
        self, proposal: str | None, actor: str, result: Result, requested: Requested | None = None
    ) -> None:
        """Keeps an outcome, of a proposal the first."""
        entry = result.entry
        self._do(
            "INSERT INTO outcomes (proposal, at, actor, requested, category, entry, q, f, success) "
            "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                proposal,
                time.time(),
                actor,
                requested,
                result.category,
                entry.text,
                entry.q,
                result.f,
                int(result.success),
            ),
        )

    def outcomes(self, after: int = 0) -> Iterator[Outcome]:
        """Those on record, oldest first."""
        for number, at, category, text, q, f, success in self._sql.execute(
            "SELECT id, at, category, entry, q, f, success FROM outcomes WHERE id > ? ORDER BY id", (after,)
        ):
            entry = Entry.read(text)
            entry.q = q
            yield Outcome(number, at, Result(entry, category, f, bool(success)))

    def last_outcome(self) -> int:
        """Number of the newest; 0 before the first."""
        return int(self._sql.execute("SELECT coalesce(max(id), 0) FROM outcomes").fetchone()[0])

    def keep_origins(self, seen: DuplicateFilter) -> None:
        """Keeps what a filter knows, in place of what was known of the same senders."""
        for actor, boot, following, gaps in seen.state():
            values = (actor, boot, following, json.dumps(gaps))
            self._do("INSERT OR REPLACE INTO origins VALUES (?, ?, ?, ?)", values)

    def origins(self) -> DuplicateFilter:
        """A filter that knows what has arrived."""
        seen = DuplicateFilter()
        for actor, boot, following, gaps in self._sql.execute("SELECT * FROM origins"):
            seen.restore([[actor, boot, following, json.loads(gaps)]])
        return seen

    def save_state(self, name: str, values: Any, tensors: bytes) -> None:
        """Keeps a state, in place of the last one of that name."""
        self._do("INSERT OR REPLACE INTO states VALUES (?, ?, ?)", (name, json.dumps(values), tensors))

    def load_state(self, name: str) -> tuple[Any, bytes] | None:
        """The state of that name."""
        found = self._sql.execute("SELECT text, tensors FROM states WHERE name = ?", (name,)).fetchone()
        return found and (json.loads(found[0]), found[1])

    def save_network(self, outcomes: int, values: Any, tensors: bytes) -> None:
        """Keeps what an algorithm had learned after so many outcomes."""
        self._do("INSERT OR REPLACE INTO networks VALUES (?, ?, ?)", (outcomes, json.dumps(values), tensors))

    def networks(self) -> list[tuple[int, Any, bytes]]:
        """The history of f_pi: outcomes, values, tensors."""
        rows = self._sql.execute("SELECT outcomes, text, tensors FROM networks ORDER BY outcomes").fetchall()
        return [(number, json.loads(text), tensors) for number, text, tensors in rows]
