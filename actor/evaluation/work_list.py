"""The work list of examinations, SQLite: each episode driven is kept once, so that a killed one goes on."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actor.evaluation.measures import Drive
from common.errors import UsageError
from common.files import content_hash
from common.geometry import SE2
from common.messages import ENDINGS, Ending

SCHEMA = 1
TABLES = """
CREATE TABLE examinations (id TEXT PRIMARY KEY, about TEXT NOT NULL);
CREATE TABLE episodes (
    examination TEXT REFERENCES examinations, number INTEGER, ending TEXT NOT NULL, dolly TEXT NOT NULL,
    track BLOB NOT NULL, PRIMARY KEY (examination, number)
);
"""
LONGEST = 10_001
"""Rows that a track may have."""


class WorkList:
    """One examination's part of a file that may hold many.

    `about` says everything on which its drives depend, as JSON can hold it: who drives, which tasks under
    which terms, and the version of the code. Raises UsageError for a file of another kind.
    """

    def __init__(self, file: Path, about: dict[str, Any]) -> None:
        self._name = file
        text = json.dumps(about, sort_keys=True)
        self.id = content_hash(text.encode())
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._sql = sqlite3.connect(file, timeout=60.0)
            with self._sql:
                self._sql.execute("BEGIN IMMEDIATE")
                version = self._sql.execute("PRAGMA user_version").fetchone()[0]
                empty = self._sql.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
                if version == 0 and empty:
                    for statement in TABLES.split(";"):
                        self._sql.execute(statement)
                    self._sql.execute(f"PRAGMA user_version={SCHEMA}")
                elif version != SCHEMA:
                    raise UsageError(f"{file} is no work list of this version; name another file")
                self._sql.execute("INSERT OR IGNORE INTO examinations VALUES (?, ?)", (self.id, text))
        except (OSError, sqlite3.DatabaseError) as error:
            raise UsageError(f"cannot use {file} as a work list: {error}") from None

    def load(self) -> dict[int, Drive]:
        """What was driven, by the number of its task."""
        query = "SELECT number, ending, dolly, track FROM episodes WHERE examination = ?"
        try:
            return {number: _drive(*rest) for number, *rest in self._sql.execute(query, (self.id,))}
        except (sqlite3.DatabaseError, ValueError, TypeError, RecursionError) as error:
            raise UsageError(f"{self._name} is damaged: {error}; remove it to drive again") from None

    def add(self, first: int, drives: Sequence[Drive]) -> None:
        """Keeps the drives of the tasks from number `first` on, all or none; what is there stays."""
        rows = [
            (self.id, first + k, d.ending, json.dumps([d.dolly.x, d.dolly.y, d.dolly.yaw]), d.track.tobytes())
            for k, d in enumerate(drives)
        ]
        self._write("INSERT OR IGNORE INTO episodes VALUES (?, ?, ?, ?, ?)", rows)

    def forget(self) -> None:
        """Drops what was driven."""
        self._write("DELETE FROM episodes WHERE examination = ?", [(self.id,)])

    def _write(self, statement: str, rows: Sequence[tuple[Any, ...]]) -> None:
        try:
            with self._sql:
                self._sql.executemany(statement, rows)
        except sqlite3.DatabaseError as error:
            raise UsageError(f"cannot write to {self._name}: {error}; what it holds is kept") from None

    def close(self) -> None:
        """Frees the file."""
        self._sql.close()


def _drive(ending: Ending, dolly: str, track: bytes) -> Drive:
    """A row as a drive; ValueError when it is none."""
    if ending not in ENDINGS:
        raise ValueError(f"{ending!r} is no ending")
    rows = np.frombuffer(track, np.float32).reshape(-1, 4)
    if not 2 <= len(rows) <= LONGEST or not np.isfinite(rows).all():
        raise ValueError("a track that cannot be")
    x, y, yaw = map(float, json.loads(dolly))
    if not np.isfinite([x, y, yaw]).all():
        raise ValueError("a dolly that cannot be")
    return Drive(ending, rows, SE2(x, y, yaw))
