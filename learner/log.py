"""The durable log of episodes, a run's only truth: append-only segments of checksummed records."""

from __future__ import annotations

import json
import logging
import os
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgpack

from common.delivery import DuplicateFilter
from common.messages import Origin

log = logging.getLogger(__name__)
HEADER = struct.Struct("<4sII")
"""Magic, length and CRC-32 of the record that follows."""
MAGIC = b"NVQ1"


class Record(NamedTuple):
    """One episode as it arrived, with the run's counts after it."""

    origin: Origin
    env_steps: int
    episodes: int
    length: int
    payload: bytes


class EpisodeLog:
    """Appends survive the death of the process; whole segments go when the ring no longer needs them."""

    def __init__(self, folder: Path, capacity: int, segment_bytes: int = 64 * 2**20) -> None:
        self.seen = DuplicateFilter()
        self.env_steps = self.episodes = 0
        self._folder, self._capacity, self._segment_bytes = folder, capacity, segment_bytes
        self._sizes: deque[tuple[Path, int]] = deque()
        """Closed segments, oldest first, with the transitions that each holds."""
        self._current = 0
        folder.mkdir(parents=True, exist_ok=True)
        self._number = max((int(path.stem) for path in folder.glob("*.log")), default=0)
        self._file = None if self._number == 0 else self._path().open("ab", buffering=0)

    def restore(self) -> Iterator[Record]:
        """All records, oldest first; cuts a torn tail and says so. Exhaust it before the first append."""
        saved = self._folder / "seen.json"
        if saved.exists():
            self.seen.restore(json.loads(saved.read_text()))
        paths = sorted(self._folder.glob("*.log"))
        for path in paths:
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

    def append(self, origin: Origin, length: int, payload: bytes) -> Record:
        """Writes an episode of `length` transitions; it is on record when this returns.

        Raises OSError when it cannot be written, and leaves no trace of it then.
        """
        record = Record(origin, self.env_steps + length, self.episodes + 1, length, payload)
        body = msgpack.packb([*origin.model_dump().values(), *record[1:]])
        if self._file is None or self._file.tell() >= self._segment_bytes:
            self._next_segment()
        assert self._file is not None
        data = HEADER.pack(MAGIC, len(body), zlib.crc32(body)) + body
        start = self._file.seek(0, os.SEEK_END)  # after a cut the position lies beyond the end
        try:
            if self._file.write(data) != len(data):
                raise OSError(f"{self._path()}: only a part could be written; is the disk full?")
        except OSError:
            self._file.truncate(start)
            raise
        self.seen.add(origin)
        self.env_steps, self.episodes = record.env_steps, record.episodes
        self._current += length
        return record

    def close(self) -> None:
        """Closes the current segment."""
        if self._file is not None:
            self._file.close()

    def _path(self) -> Path:
        return self._folder / f"{self._number:08d}.log"

    def _next_segment(self) -> None:
        part = self._folder / "seen.json.part"  # what the dropped segments knew of duplicates stays known
        part.write_text(json.dumps(self.seen.state()))
        part.replace(self._folder / "seen.json")
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

    def _read(self, path: Path) -> Iterator[Record]:
        end = 0
        with path.open("r+b") as file:
            while True:
                header = file.read(HEADER.size)
                if not header:
                    return
                magic, size, crc = HEADER.unpack(header) if len(header) == HEADER.size else (b"", 0, 0)
                body = file.read(size) if magic == MAGIC else b""
                if magic != MAGIC or len(body) < size or zlib.crc32(body) != crc:
                    break
                actor, boot, seq, env_steps, episodes, length, payload = msgpack.unpackb(body)
                yield Record(Origin(actor=actor, boot=boot, seq=seq), env_steps, episodes, length, payload)
                end = file.tell()
            lost = path.stat().st_size - end
            log.warning("%s: cut a torn tail of %d bytes after its last whole record", path, lost)
            file.truncate(end)
