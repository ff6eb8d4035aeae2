"""Acknowledged delivery: a spool on the sender's disk, retries with one id, duplicates dropped on arrival.

Used for everything that must arrive: episodes, outcomes, candidates, frames. A message leaves the spool only
when the receiver has acknowledged it, and keeps its id (`Origin`) through every retry, also by a later
incarnation of the sender; so nothing is lost and nothing counts twice.
"""

from __future__ import annotations

import logging
import queue
import random
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import msgpack
import zenoh
from isal.isal_zlib import crc32

from common.bus import BUSY, INTERNAL_ERROR, Member, QueryServer, ask_later
from common.errors import RefusedError
from common.messages import BUNDLE, Message, MessageError, Origin, Receipt, decode, encode
from common.telemetry import Quantiles

log = logging.getLogger(__name__)

DAMAGED = "payload damaged: its checksum does not match"
LATER = (BUSY, INTERNAL_ERROR, DAMAGED)
"""Answers that mean: again, later. Any other refusal of a message is final."""
HEADER_BYTES = 300
"""More than the header of one message has."""
BUNDLE_BYTES = 256 * 1024
"""Small messages that wait go together until they are as large as this."""
FIRST_PAUSE, LONGEST_PAUSE = 0.1, 2.0
"""Seconds until a delivery that failed is tried again; doubled each time."""


class Parcel(NamedTuple):
    """A message on its way, with what identifies it and the checksum that guards it."""

    origin: Origin
    crc: int
    payload: bytes

    @classmethod
    def of(cls, origin: Origin, payload: bytes) -> Parcel:
        """A message with the checksum that belongs to it."""
        return cls(origin, crc32(payload), payload)


Bundle = dict[Path, Parcel]
"""What goes in one delivery, by its files in the spool."""


def pack_bundle(parcels: list[Parcel]) -> tuple[bytes, bytes]:
    """(payload, attachment) of a delivery: the messages in a row, and the header of each."""
    headers = [[p.origin.actor, p.origin.boot, p.origin.seq, len(p.payload), p.crc] for p in parcels]
    payload = parcels[0].payload if len(parcels) == 1 else b"".join(p.payload for p in parcels)
    return payload, msgpack.packb(headers)


def unpack_bundle(payload: bytes, attachment: bytes) -> list[Parcel]:
    """The messages of a delivery, checksums not yet compared; MessageError if malformed."""
    try:
        if len(attachment) > BUNDLE * HEADER_BYTES:
            raise ValueError
        headers = msgpack.unpackb(attachment)
        parcels, start = [], 0
        for actor, boot, seq, size, crc in headers:
            if type(size) is not int or type(crc) is not int or size < 0:
                raise TypeError
            origin = Origin(actor=actor, boot=boot, seq=seq)
            parcels.append(Parcel(origin, crc, payload[start : start + size]))
            start += size
    except Exception:  # msgpack and pydantic each raise their own kinds; all mean the same here
        raise MessageError("header: expected [actor, boot, seq, size, crc32] of each message") from None
    if not 1 <= len(parcels) <= BUNDLE or start != len(payload):
        raise MessageError(f"header: {len(parcels)} messages of {start} bytes, got {len(payload)}")
    return parcels


class Receiver(QueryServer):
    """Takes in what Senders deliver on `CHANNEL/GROUP/NAME`, each message once.

    `take` gets a message whose checksum fits, which is acknowledged after it and `commit` have returned. It
    may raise MessageError, which refuses the message for good unless the reason is BUSY; any other error
    means: later. A message that `seen` knows is acknowledged again. A sender may speak only for itself.
    """

    def __init__(
        self,
        session: zenoh.Session,
        channel: str,
        take: Callable[[Parcel], None],
        seen: Callable[[Origin], bool],
        max_bytes: int,
        commit: Callable[[], None] | None = None,
    ) -> None:
        self.duplicates = 0
        self._channel, self._take, self._seen = channel, take, seen
        super().__init__(
            session, f"{channel}/*/*", self._receive_bundle, commit=commit, max_bytes=max_bytes + BUNDLE_BYTES
        )

    def _receive_bundle(self, payload: bytes, attachment: bytes, key: str) -> bytes:
        parcels = unpack_bundle(payload, attachment)
        for parcel in parcels:
            if key != f"{self._channel}/{parcel.origin.actor}":
                raise MessageError(f"under another's name: {parcel.origin.actor}")
        return encode(Receipt(answers=[self._receive_one(parcel, key) for parcel in parcels]))

    def _receive_one(self, parcel: Parcel, key: str) -> str:
        """Empty when it is here, else why not."""
        try:
            if parcel.crc != crc32(parcel.payload):
                raise MessageError(DAMAGED)
            if self._seen(parcel.origin):
                self.duplicates += 1
            else:
                self._take(parcel)
            return ""
        except MessageError as error:
            if str(error) != BUSY:
                self.note_refusal(key, str(error))
            return str(error)[:400]
        except Exception:
            log.exception("error while taking a message on %s", key)
            self.note_refusal(key, INTERNAL_ERROR)
            return INTERNAL_ERROR


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

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def full(self) -> bool:
        """Whether the waiting messages have reached the limit."""
        return self._bytes >= self.max_bytes

    def put(self, origin: Origin, channel: str, payload: bytes) -> None:
        """Adds a message; the caller looks at `full` first."""
        path = self.folder / origin.boot / f"{origin.seq:012d}.msg"
        path.parent.mkdir(exist_ok=True)
        record = msgpack.packb([channel, origin.actor, origin.boot, origin.seq, crc32(payload), payload])
        part = path.with_suffix(".part")
        part.write_bytes(record)
        part.rename(path)
        with self._lock:
            self._waiting[path] = len(record)
            self._bytes += len(record)

    def bundle(self, without: set[Path]) -> tuple[str, Bundle]:
        """The oldest messages that go together, in order: one channel, small ones only; maybe none.

        Passes over `without`, those that are on their way. Unreadable ones are set aside and logged.
        """
        with self._lock:
            waiting = list(islice((i for i in self._waiting.items() if i[0] not in without), BUNDLE))
        channel, found, room = "", Bundle(), BUNDLE_BYTES
        for path, size in waiting:
            if found and size > room:
                break
            read = self._read(path)
            if read is None:
                continue
            if found and read[0] != channel:
                break
            channel, found[path] = read
            room -= size
        return channel, found

    def _read(self, path: Path) -> tuple[str, Parcel] | None:
        try:
            channel, actor, boot, seq, crc, payload = msgpack.unpackb(path.read_bytes())
            if crc != crc32(payload):
                raise ValueError("its checksum does not match")
            return str(channel), Parcel(Origin(actor=actor, boot=boot, seq=seq), crc, payload)
        except (OSError, ValueError, TypeError) as error:  # TypeError: msgpack of something else
            log.warning("spool: %s is unreadable (%s); set aside", path, error)
            self._forget(path)
            if path.exists():
                path.rename(path.with_suffix(".bad"))
            return None

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
    """Sends what is in a spool, oldest first, from a thread of its own, until acknowledged.

    At most `in_flight` deliveries are on their way at a time. No receipt, BUSY and an error within the
    receiver mean: again, later, with the same id. Any other refusal of a message is final: it is dropped,
    counted in `refused` by reason and logged, and `last_refusal` holds the reason. `held_back` while the
    receiver says BUSY: whoever produces messages had better pause.
    """

    def __init__(
        self,
        session: zenoh.Session,
        spool: Spool,
        member: Member,
        boot: str,
        timeout: float = 10.0,
        in_flight: int = 2,
    ) -> None:
        self.spool, self.sent = spool, 0
        self.refused: Counter[str] = Counter()
        self.last_refusal = ""
        self.trouble = ""
        """Why the last delivery did not succeed; empty after one that did."""
        self.waiting_since: float | None = None
        self.held_back = False
        self.latency = Quantiles()
        self._session, self._address, self._boot = session, member.address, boot
        self._timeout, self._in_flight = timeout, in_flight
        self._seq, self._lock = 0, threading.Lock()
        self._flying: set[Path] = set()
        self._flights = 0
        self._pause, self._resume, self._jitter = FIRST_PAUSE, 0.0, random.Random()
        self._events: queue.SimpleQueue[tuple[Bundle, float, bytes | Exception] | None] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)
        self._thread.start()

    def put(self, channel: str, message: Message) -> None:
        """Hands a message over for delivery on `channel`."""
        payload = encode(message)
        with self._lock:
            self.spool.put(Origin(actor=self._address, boot=self._boot, seq=self._seq), channel, payload)
            self._seq += 1
        self._events.put(None)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._send()
                self._settle()
            except Exception:  # a full disk, say: the spool stays as it is, and is tried again
                log.exception("delivery stopped; it goes on in a second")
                self._stop.wait(1.0)

    def _send(self) -> None:
        while self._flights < self._in_flight and time.monotonic() >= self._resume:
            channel, bundle = self.spool.bundle(self._flying)
            if not bundle:
                return
            payload, attachment = pack_bundle(list(bundle.values()))
            began = time.monotonic()
            answer = partial(self._hear, bundle, began)
            self._flying |= bundle.keys()
            self._flights += 1
            try:
                ask_later(
                    self._session, f"{channel}/{self._address}", payload, answer, self._timeout, attachment
                )
            except zenoh.ZError as error:
                answer(error)

    def _hear(self, bundle: Bundle, began: float, answer: bytes | Exception) -> None:
        self._events.put((bundle, began, answer))

    def _settle(self) -> None:
        """Waits for something to happen, and deals with it."""
        left = self._resume - time.monotonic()
        try:
            event = self._events.get(timeout=min(left, 0.2) if left > 0 else 0.2)
        except queue.Empty:
            return
        if event is None:
            return
        bundle, began, answer = event
        self._flying -= bundle.keys()
        self._flights -= 1
        answers = _answers(answer, len(bundle))
        later = ""
        for (path, parcel), reason in zip(bundle.items(), answers, strict=True):
            if reason is None or reason in LATER:
                later = reason or str(answer) or "no receipt"
                continue
            self.spool.remove(path)
            if reason:
                self.last_refusal = reason
                self.refused[reason.split(":")[0][:60]] += 1
                log.warning("refused for good, %s of %s: %s", parcel.origin.seq, parcel.origin.boot, reason)
            else:
                self.sent += 1
        self.trouble, self.held_back = later, later == BUSY
        if later:
            self._back_off()
        else:
            self.latency.add(1000 * (time.monotonic() - began))
            self.waiting_since, self._pause = None, FIRST_PAUSE

    def _back_off(self) -> None:
        now = time.monotonic()
        self.waiting_since = self.waiting_since or now
        if now >= self._resume:  # of several that were on their way together one counts
            self._resume = now + self._pause * self._jitter.uniform(0.5, 1.5)
            self._pause = min(2 * self._pause, LONGEST_PAUSE)

    def close(self, patience: float) -> int:
        """Tries for `patience` s to empty the spool, then stops; returns how many stay on disk."""
        deadline = time.monotonic() + patience
        while len(self.spool) and time.monotonic() < deadline:
            time.sleep(0.02)
        self._stop.set()
        self._events.put(None)
        self._thread.join(timeout=1.0)
        return len(self.spool)


def _answers(answer: bytes | Exception, count: int) -> list[str | None]:
    """What a receipt says of each message; None for all when there is no receipt that makes sense."""
    if isinstance(answer, RefusedError) and str(answer) == BUSY:
        return [BUSY] * count
    if isinstance(answer, bytes):
        try:
            receipt = decode(Receipt, answer)
        except MessageError as error:
            log.warning("no receipt: %s", error)
        else:
            if len(receipt.answers) == count:
                return [*receipt.answers]
    return [None] * count


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
        self.restore([self.after(origin)])

    def after(self, origin: Origin) -> list[object]:
        """What will be known of the sender of a message once that is added: an element of `state`."""
        key = origin.actor, origin.boot
        high = self._next.get(key, max(0, origin.seq - MAX_GAP))
        gaps = self._gaps[key] | set(range(high, origin.seq))
        return [*key, max(high, origin.seq + 1), sorted(gaps - {origin.seq})]

    def state(self) -> list[list[object]]:
        """What `restore` takes, in plain lists."""
        return [[*key, high, sorted(self._gaps[key])] for key, high in self._next.items()]

    def restore(self, state: list[list[object]]) -> None:
        """Takes over what another filter had seen, in place of what is known of the same incarnations."""
        for actor, boot, high, gaps in state:
            key = str(actor), str(boot)
            self._gaps[key] = set(gaps)  # type: ignore[call-overload]  # first, for who asks beside
            self._next[key] = int(high)  # type: ignore[call-overload]
