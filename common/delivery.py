"""Acknowledged delivery: a spool on the sender's disk, retries with one id, duplicates dropped on arrival.

Used for everything that must arrive: episodes, outcomes, candidates. A message leaves the spool only when the
receiver has acknowledged it, and keeps its id (`Origin`) through every retry, also by a later incarnation of
the sender; so nothing is lost and nothing counts twice.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import zlib
from collections import Counter, defaultdict
from pathlib import Path

import msgpack
import zenoh

from common.bus import BUSY, INTERNAL_ERROR, NoAnswerError, RefusedError, ask_bytes
from common.messages import Message, MessageError, Origin, encode

log = logging.getLogger(__name__)


def pack_header(origin: Origin, payload: bytes) -> bytes:
    """The attachment that identifies a message and guards its payload."""
    data: bytes = msgpack.packb([origin.actor, origin.boot, origin.seq, zlib.crc32(payload)])
    return data


def unpack_header(header: bytes, payload: bytes) -> Origin:
    """The origin of a message; raises MessageError for a malformed header or a damaged payload."""
    try:
        actor, boot, seq, crc = msgpack.unpackb(header)
        origin = Origin(actor=actor, boot=boot, seq=seq)
    except Exception:  # msgpack and pydantic each raise their own kinds; all mean the same here
        raise MessageError("header: expected [actor, boot, seq, crc32]") from None
    if crc != zlib.crc32(payload):
        raise MessageError("payload damaged: its checksum does not match")
    return origin


class Spool:
    """Messages waiting on disk, `boot/seq` each, oldest first; they outlive the process that wrote them."""

    def __init__(self, folder: Path, max_bytes: float) -> None:
        self.folder, self.max_bytes = folder, max_bytes
        folder.mkdir(parents=True, exist_ok=True)
        for torn in folder.glob("*/*.part"):
            torn.unlink()
        found = sorted(folder.glob("*/*.msg"), key=lambda path: (path.stat().st_mtime_ns, path.name))
        self._waiting = {path: path.stat().st_size for path in found}
        self._bytes = sum(self._waiting.values())
        self._lock = threading.Lock()
        self.changed = threading.Event()

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether the waiting messages have reached the limit."""
        return self._bytes >= self.max_bytes

    def put(self, origin: Origin, key: str, payload: bytes) -> None:
        """Adds a message; the caller looks at `full` first."""
        path = self.folder / origin.boot / f"{origin.seq:012d}.msg"
        path.parent.mkdir(exist_ok=True)
        record = msgpack.packb([key, pack_header(origin, payload), payload])
        part = path.with_suffix(".part")
        part.write_bytes(record)
        part.rename(path)
        with self._lock:
            self._waiting[path] = len(record)
            self._bytes += len(record)
        self.changed.set()

    def first(self) -> tuple[Path, str, bytes, bytes] | None:
        """The oldest message: its file, key, header and payload; unreadable ones are set aside and logged."""
        while True:
            with self._lock:
                path = next(iter(self._waiting), None)
            if path is None:
                return None
            try:
                key, header, payload = msgpack.unpackb(path.read_bytes())
                unpack_header(header, payload)
                return path, key, header, payload
            except (OSError, ValueError, TypeError) as error:  # TypeError: msgpack of something else
                log.warning("spool: %s is unreadable (%s); set aside", path, error)
                self._forget(path)
                if path.exists():
                    path.rename(path.with_suffix(".bad"))

    def remove(self, path: Path) -> None:
        """Drops a message that was acknowledged or refused for good."""
        self._forget(path)
        path.unlink(missing_ok=True)

    def _forget(self, path: Path) -> None:
        with self._lock:
            self._bytes -= self._waiting.pop(path)


def count_life(folder: Path) -> int:
    """The how many-th incarnation of an actor this is, counted in its spool folder from 0."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "lives"
    lives = int(file.read_text()) if file.exists() and file.read_text().isdigit() else 0
    file.write_text(str(lives + 1))
    return lives


class Sender:
    """Sends what is in a spool, in order, from a thread of its own, until acknowledged.

    No reply, BUSY and an error within the receiver mean: again, later, with the same id. Any other refusal is
    final: the message is dropped, counted in `refused` by reason and logged, and `last_refusal` holds the
    reason. `held_back` while the receiver says BUSY: whoever produces messages had better pause.
    """

    def __init__(
        self, session: zenoh.Session, spool: Spool, actor: str, boot: str, timeout: float = 10.0
    ) -> None:
        self.spool, self.sent = spool, 0
        self.refused: Counter[str] = Counter()
        self.last_refusal = ""
        self.waiting_since: float | None = None
        self.held_back = False
        self._session, self._actor, self._boot, self._timeout = session, actor, boot, timeout
        self._seq, self._lock = 0, threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)
        self._thread.start()

    def put(self, key: str, message: Message) -> None:
        """Hands a message over for delivery on `key`."""
        payload = encode(message)
        with self._lock:
            origin = Origin(actor=self._actor, boot=self._boot, seq=self._seq)
            self.spool.put(origin, key, payload)
            self._seq += 1

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._deliver()
            except Exception:  # a full disk, say: the spool stays as it is, and is tried again
                log.exception("delivery stopped; it goes on in a second")
                self._stop.wait(1.0)

    def _deliver(self) -> None:
        pause, jitter = 0.1, random.Random()
        while not self._stop.is_set():
            self.spool.changed.clear()
            head = self.spool.first()
            if head is None:
                self.spool.changed.wait(0.2)
                continue
            path, key, header, payload = head
            try:
                ask_bytes(self._session, key, payload, header, self._timeout)
                self.spool.remove(path)
                self.sent += 1
            except (NoAnswerError, RefusedError, zenoh.ZError) as error:
                self.held_back = str(error) == BUSY
                if not isinstance(error, RefusedError) or str(error) in (BUSY, INTERNAL_ERROR):
                    self.waiting_since = self.waiting_since or time.monotonic()
                    self._stop.wait(pause * jitter.uniform(0.5, 1.5))
                    pause = min(2 * pause, 2.0)
                    continue
                self.spool.remove(path)
                self.last_refusal = str(error)
                self.refused[str(error).split(":")[0][:60]] += 1
                log.warning("refused for good on %s: %s", key, error)
            self.waiting_since, self.held_back, pause = None, False, 0.1

    def close(self, patience: float) -> int:
        """Tries for `patience` s to empty the spool, then stops; returns how many stay on disk."""
        deadline = time.monotonic() + patience
        while len(self.spool) and time.monotonic() < deadline:
            time.sleep(0.02)
        self._stop.set()
        self.spool.changed.set()
        self._thread.join(timeout=1.0)
        return len(self.spool)


MAX_GAP = 10_000
"""Numbers by which a message may be ahead of the last one of its incarnation."""


class DuplicateFilter:
    """Remembers what has arrived: per incarnation a high-water mark and the gaps below it.

    An incarnation that is heard for the first time may begin anywhere, for it may have served another
    receiver before.
    """

    def __init__(self) -> None:
        self._next: dict[tuple[str, str], int] = {}
        self._gaps: dict[tuple[str, str], set[int]] = defaultdict(set)

    def seen(self, origin: Origin) -> bool:
        """Whether this message was added before; MessageError for a number too far ahead to be honest."""
        key = origin.actor, origin.boot
        high = self._next.get(key)
        if high is not None and origin.seq > high + MAX_GAP:
            raise MessageError(f"seq {origin.seq} jumps too far ahead of {high}")
        return origin.seq < (high or 0) and origin.seq not in self._gaps[key]

    def add(self, origin: Origin) -> None:
        """Remembers a message, for which `seen` was asked before."""
        key = origin.actor, origin.boot
        high = self._next.get(key, max(0, origin.seq - MAX_GAP))
        self._gaps[key].discard(origin.seq)
        if origin.seq >= high:
            self._gaps[key].update(range(high, origin.seq))
            self._next[key] = origin.seq + 1

    def state(self) -> list[list[object]]:
        """What `restore` takes, in plain lists."""
        return [[*key, high, sorted(self._gaps[key])] for key, high in self._next.items()]

    def restore(self, state: list[list[object]]) -> None:
        """Takes over what another filter had seen, in place of what is known of the same incarnations."""
        for actor, boot, high, gaps in state:
            key = str(actor), str(boot)
            self._next[key] = int(high)  # type: ignore[call-overload]
            self._gaps[key] = set(gaps)  # type: ignore[call-overload]
