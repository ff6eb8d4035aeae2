"""The durable log of episodes, a run's only truth: append-only segments of checksummed records."""

from __future__ import annotations

import json
import logging
import os
import struct
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgpack
from isal.isal_zlib import crc32

from common.delivery import DuplicateFilter, Parcel
from common.errors import UsageError
from common.files import sync, write_atomically
from common.messages import Episode, Origin

log = logging.getLogger(__name__)
HEADER = struct.Struct("<4sIIII")
"""Magic; length and CRC-32 of the counts, length and CRC-32 of the payload, which follow."""
MAGIC, EARLIER = b"NVQ2", b"NVQ1"
LARGEST = 2 * Episode.max_bytes
"""More bytes than a record has."""


class Record(NamedTuple):
    """One episode as it arrived, with the run's counts after it."""

    origin: Origin
    env_steps: int
    episodes: int
    length: int
    payload: bytes


class EpisodeLog:
    """Appends survive the death of the process; whole segments go when the ring no longer needs them.

    With `sync` they survive that of the host too, once `commit` has returned.
    """

    def __init__(
        self, folder: Path, capacity: int, segment_bytes: int = 64 * 2**20, sync: bool = False
    ) -> None:
        self.seen = DuplicateFilter()
        self.env_steps = self.episodes = 0
        self._folder, self._capacity, self._segment_bytes = folder, capacity, segment_bytes
        self._sync = self._unsynced = sync  # a former life may have ended between an append and its commit
        self.broken: OSError | None = None
        """Why the disk may lack what was appended: nothing can be written or committed after that."""
        self._sizes: deque[tuple[Path, int]] = deque()
        """Closed segments, oldest first, with the transitions that each holds."""
        self._current = 0
        folder.mkdir(parents=True, exist_ok=True)
        self._number = max((int(path.stem) for path in self._segments()), default=0)
        self._file = None if self._number == 0 else self._path().open("ab", buffering=0)

    def restore(self) -> Iterator[Record]:
        """All whole records, oldest first; skips damage, cuts a torn tail, and says so.

        Exhaust it before the first append. Raises UsageError for a file that cannot be read at all.
        """
        saved = self._folder / "seen.json"
        if saved.exists():
            try:
                self.seen.restore(json.loads(saved.read_text()))
            except (OSError, ValueError, TypeError) as error:
                raise UsageError(
                    f"{saved} is damaged ({error}); without it the run goes on, but an episode that was "
                    "dropped from the log long ago and is sent again would count twice"
                ) from None
        for path in self._segments():
            transitions = 0
            for record in self._read(path):
                transitions += record.length
                self.seen.add(record.origin)
                self.env_steps, self.episodes = record.env_steps, record.episodes
                yield record
            if path == self._path():
                self._current = transitions
            else:
                self._sizes.append((path, transitions))

    def append(self, parcel: Parcel, length: int) -> Record:
        """Writes an episode of `length` transitions; it is in the file when this returns.

        Raises OSError when it cannot be written, and leaves no trace of it then.
        """
        if self.broken:
            raise self.broken
        origin, crc, payload = parcel
        record = Record(origin, self.env_steps + length, self.episodes + 1, length, payload)
        counts = msgpack.packb([origin.actor, origin.boot, origin.seq, *record[1:-1]])
        head = HEADER.pack(MAGIC, len(counts), crc32(counts), len(payload), crc) + counts
        if self._file is None or self._file.tell() >= self._segment_bytes:
            self._next_segment()
        assert self._file is not None
        start = self._file.seek(0, os.SEEK_END)  # after a cut the position lies beyond the end
        try:
            written = os.writev(self._file.fileno(), (head, payload))
            while written < len(head) + len(payload):  # a disk that fills up says why at the next attempt
                written += self._file.write((head + payload)[written:])
        except OSError:
            self._file.truncate(start)
            raise
        self.seen.add(origin)
        self.env_steps, self.episodes = record.env_steps, record.episodes
        self._current += length
        self._unsynced = self._sync
        return record

    def commit(self) -> None:
        """Waits, with `sync`, until the disk has all that was appended: one wait for many appends.

        After an OSError what the disk has is unknown, whatever it says the next time: the log is `broken`.
        """
        if self.broken:
            raise self.broken
        if self._unsynced and self._file is not None:
            try:
                os.fdatasync(self._file.fileno())
            except OSError as error:
                self.broken = error
                raise
            self._unsynced = False

    def close(self) -> None:
        """Closes the current segment."""
        if self._file is not None:
            self._file.close()

    def _segments(self) -> list[Path]:
        return sorted(path for path in self._folder.glob("*.log") if path.stem.isdecimal())

    def _path(self) -> Path:
        return self._folder / f"{self._number:08d}.log"

    def _next_segment(self) -> None:
        self.commit()
        # what the dropped segments knew of duplicates stays known
        write_atomically(self._folder / "seen.json", json.dumps(self.seen.state()).encode())
        if self._file is not None:
            self._file.close()
            self._file = None
            self._sizes.append((self._path(), self._current))
        kept = sum(size for _, size in self._sizes)
        while self._sizes and kept - self._sizes[0][1] >= self._capacity:
            path, size = self._sizes.popleft()
            kept -= size
            path.unlink()
        self._number += 1
        self._current = 0
        self._file = self._path().open("ab", buffering=0)
        if self._sync:
            sync(self._folder)

    def _read(self, path: Path) -> Iterator[Record]:
        try:
            whole = path.stat().st_size
            with path.open("rb") as file:
                data = file.read(self._segment_bytes + LARGEST)
        except OSError as error:
            raise UsageError(f"cannot read {path}: {error.strerror}") from None
        if data.startswith(EARLIER):
            raise UsageError(f"{path} is of an earlier version of navaclq; start a new run")
        position = end = 0
        while (start := data.find(MAGIC, position)) >= 0:
            parts = _parts(data, start)
            if parts is None:
                position = start + 1
                continue
            if start > end:
                log.warning("%s: skipped %d damaged bytes before a whole record", path, start - end)
            counts, payload = parts
            actor, boot, seq, env_steps, episodes, length = msgpack.unpackb(counts)
            yield Record(Origin(actor=actor, boot=boot, seq=seq), env_steps, episodes, length, payload)
            position = end = start + HEADER.size + len(counts) + len(payload)
        if end < whole:
            log.warning("%s: cut a torn tail of %d bytes after its last whole record", path, whole - end)
            os.truncate(path, end)


def _parts(data: bytes, start: int) -> tuple[bytes, bytes] | None:
    """Counts and payload of the record that begins at `start`; None when it is not whole."""
    if len(data) - start < HEADER.size:
        return None
    _, size, crc, payload_size, payload_crc = HEADER.unpack_from(data, start)
    middle = start + HEADER.size + size
    counts = data[start + HEADER.size : middle]
    if not 0 < size == len(counts) or crc32(counts) != crc:
        return None
    payload = data[middle : middle + payload_size]
    return (counts, payload) if len(payload) == payload_size and crc32(payload) == payload_crc else None
