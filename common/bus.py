"""The bus: the only module that knows Zenoh's keys and query mechanics. Sessions come from common/link.py.

One hub listens (the learner, or a curriculum that stands alone), everything else is a client of it. What must
arrive is a query whose reply is the acknowledgement. A callback of Zenoh never does work: it hands the query
to a bounded queue, and a thread of ours answers, because the runtime has two threads and a blocked callback
stops every other channel of the process.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import zenoh

from common.access import LOCAL
from common.errors import NoAnswerError, RefusedError, UsageError
from common.messages import MEGABYTE, M, Message, MessageError, decode, encode

log = logging.getLogger(__name__)

BUSY = "BUSY"
"""The one refusal that means: again, later."""
GROUP = 64
"""Queries that are answered together at most, where that spares work."""
INBOX_BYTES = 256 * MEGABYTE
"""Queries that wait for one server hold no more than this, besides the one that reaches it."""
LOGGED = 1000
"""Refusals that are logged, each once, before they are only counted."""
INTERNAL_ERROR = "internal error"


class Member(NamedTuple):
    """A process of a run."""

    role: str
    group: str
    """Common name of its certificate; `local` without one."""
    name: str

    @property
    def address(self) -> str:
        """Under which it delivers."""
        return f"{self.group}/{self.name}"

    @property
    def label(self) -> str:
        """What people call it."""
        return self.name if self.group in (LOCAL, self.role) else self.address

    def __str__(self) -> str:
        return self.role if self.name == self.role else f"{self.role} {self.label}"


class Keys:
    """The key expressions of a run. Members deliver on `CHANNEL/GROUP/NAME`."""

    def __init__(self, run: str) -> None:
        self.root = f"navaclq/{run}"
        self.trajectory = f"{self.root}/trajectory"
        self.frames = f"{self.root}/frames"
        self.contract = f"{self.root}/contract"
        self.version = f"{self.root}/weights/version"
        self.task = f"{self.root}/curriculum/task"
        self.score = f"{self.root}/curriculum/score"
        self.snapshot = f"{self.root}/curriculum/snapshot"
        self.result = f"{self.root}/curriculum/result"
        self.candidates = f"{self.root}/curriculum/candidates"

    def weights(self, kind: str) -> str:
        """Newest weights: `policy` for actors, `critic` (policy and critics) for the curriculum."""
        return f"{self.root}/weights/latest/{kind}"

    def live(self, member: Member, life: str) -> str:
        """Liveliness token of a process, and of which of its lives."""
        return f"{self.root}/live/{member.role}/{member.address}/{life}"

    def stat(self, member: Member) -> str:
        """Figures of a process."""
        return f"{self.root}/stat/{member.role}/{member.address}"


EVERYBODY = Member("*", "*", "*")


class QueryServer:
    """Answers the queries on one key expression from a thread of its own.

    `handler` gets (payload, attachment, key) and returns the reply; a MessageError it raises is sent back as
    the refusal, as one is for a payload larger than `max_bytes`. With `capacity` queries waiting, or as many
    as fill INBOX_BYTES, the next one is told BUSY at once. Refusals but that one are counted in `refused` by
    reason, and logged once for each sender and reason.

    With `commit`, queries that wait together are handled one after the other, then `commit` is called once,
    and only then are they answered: a disk that is slow to confirm confirms many at a time.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        handler: Callable[[bytes, bytes, str], bytes],
        capacity: int = 256,
        commit: Callable[[], None] | None = None,
        max_bytes: int = MEGABYTE,
    ) -> None:
        self.refused: Counter[str] = Counter()
        self._key, self._handler, self._commit, self._max_bytes = key, handler, commit, max_bytes
        self._inbox: queue.Queue[zenoh.Query | None] = queue.Queue(capacity)
        self._waiting_bytes, self._bytes_lock = 0, threading.Lock()
        self._logged: set[tuple[str, str]] = set()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name=f"serve {key}", daemon=True)
        self._thread.start()
        self._queryable = session.declare_queryable(key, self._receive)

    def __len__(self) -> int:
        """Queries that wait."""
        return self._inbox.qsize()

    def _receive(self, query: zenoh.Query) -> None:
        size = _size(query)
        if size > self._max_bytes:
            self._refuse(query, f"too large: {size} bytes; at most {self._max_bytes} are taken here")
            return
        with self._bytes_lock:
            room = self._waiting_bytes < INBOX_BYTES
            self._waiting_bytes += size if room else 0
        try:
            if not room:
                raise queue.Full
            self._inbox.put_nowait(query)
        except queue.Full:
            if room:
                self._release(size)
            self._refuse(query, BUSY)

    def _release(self, size: int) -> None:
        with self._bytes_lock:
            self._waiting_bytes -= size

    def _serve(self) -> None:
        while (query := self._inbox.get()) is not None:
            queries = [query]
            while self._commit and len(queries) < GROUP and not self._inbox.empty():
                query = self._inbox.get()
                if query is None:
                    self._inbox.put(None)
                    break
                queries.append(query)
            self._answer(queries)
            del query, queries  # an undropped query would hold its reply back until the timeout

    def _answer(self, queries: list[zenoh.Query]) -> None:
        answers = [self._handle(query) for query in queries]
        try:
            if self._commit:
                self._commit()
        except Exception:
            log.exception("could not commit what came on %s", self._key)
            answers = [INTERNAL_ERROR] * len(queries)
        for query, answer in zip(queries, answers, strict=True):
            self._release(_size(query))
            try:
                if isinstance(answer, str):
                    self._refuse(query, answer)
                else:
                    # a query's own expression may hold wildcards, that of a server for many senders does
                    key = self._key if "*" not in self._key else str(query.key_expr)
                    with query:
                        query.reply(key, answer)
            except Exception:  # this thread must outlive whatever one query brings, a lost session included
                log.exception("could not answer %s", self._key)

    def _handle(self, query: zenoh.Query) -> zenoh.ZBytes | str:
        """The answer, or the reason of a refusal."""
        try:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            attachment = query.attachment.to_bytes() if query.attachment is not None else b""
            return zenoh.ZBytes(self._handler(payload, attachment, str(query.key_expr)))
        except MessageError as error:
            return str(error)
        except Exception:
            log.exception("error while answering %s", query.key_expr)
            return INTERNAL_ERROR

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        if reason != BUSY:
            self.note_refusal(str(query.key_expr), reason)
        with query:
            query.reply_err(reason.encode())

    def note_refusal(self, key: str, reason: str) -> None:
        """Counts a refusal, and logs it when it is the first of its kind."""
        kind = reason.split(":")[0][:40] if len(self.refused) < 100 else "other"
        self.refused[kind] += 1
        if (key, kind) not in self._logged and len(self._logged) < LOGGED:
            self._logged.add((key, kind))
            log.warning("refused a message on %s: %s", key, reason)

    def close(self) -> None:
        """Stops taking queries and ends the thread after those already taken; once is enough."""
        if self._closed:
            return
        self._closed = True
        self._queryable.undeclare()  # type: ignore[no-untyped-call]
        with suppress(queue.Full):  # behind a handler that is stuck; its thread, a daemon, is abandoned
            self._inbox.put(None, timeout=1.0)
            self._thread.join(timeout=2.0)


def serve(session: zenoh.Session, key: str, kind: type[M], handler: Callable[[M], Message]) -> QueryServer:
    """A QueryServer for messages of one type."""
    return QueryServer(
        session, key, lambda payload, *_: encode(handler(decode(kind, payload))), max_bytes=kind.max_bytes
    )


def _size(query: zenoh.Query) -> int:
    """Bytes that a query carries, which are not copied to count them."""
    return sum(len(part) for part in (query.payload, query.attachment) if part is not None)


def _read(reply: zenoh.Reply) -> bytes | Exception:
    """What a reply says. Raised here, an error would keep the reply in its traceback, in a cycle."""
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    reason = reply.err.payload.to_bytes().decode(errors="replace") if reply.err is not None else ""
    return NoAnswerError("timeout") if reason == "Timeout" else RefusedError(reason[:400])


def ask_bytes(
    session: zenoh.Session, key: str, payload: bytes, attachment: bytes = b"", timeout: float = 10.0
) -> bytes:
    """The one reply to a query; raises NoAnswerError or RefusedError."""
    answers: queue.SimpleQueue[bytes | Exception] = queue.SimpleQueue()
    ask_later(session, key, payload, answers.put, timeout, attachment)
    answer = answers.get()
    if isinstance(answer, Exception):
        raise answer
    return answer


def ask(
    session: zenoh.Session,
    key: str,
    question: Message,
    kind: type[M],
    timeout: float = 10.0,
    patience: float = 0.0,
    on_wait: Callable[[float], None] | None = None,
) -> M:
    """Asks and waits for a reply of type `kind`; raises NoAnswerError, RefusedError or MessageError.

    While nobody answers it asks again, for `patience` s, and tells `on_wait` the seconds so far.
    """
    began = time.monotonic()
    while True:
        try:
            return decode(kind, ask_bytes(session, key, encode(question), timeout=timeout))
        except NoAnswerError:
            waited = time.monotonic() - began
            if waited > patience:
                raise
            if on_wait:
                on_wait(waited)
            time.sleep(0.2)


def ask_later(
    session: zenoh.Session,
    key: str,
    payload: bytes,
    answer: Callable[[bytes | Exception], None],
    timeout: float,
    attachment: bytes = b"",
    urgent: bool = False,
) -> None:
    """Asks without waiting; `answer` is called once, from a thread of Zenoh that it must not block.

    It gets the reply, or the NoAnswerError or RefusedError in its place.
    """
    found: list[bytes | Exception] = []

    def collect(reply: zenoh.Reply) -> None:
        found.append(_read(reply))

    session.get(
        key,
        zenoh.handlers.Callback(
            collect, lambda: answer(found[0] if found else NoAnswerError(f"nobody serves {key}"))
        ),
        payload=payload,
        attachment=attachment,
        timeout=timeout,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
        express=urgent,
    )


def publish(session: zenoh.Session, key: str, message: Message) -> None:
    """Tells whoever listens, without any promise."""
    session.put(
        key,
        encode(message),
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
    )


class Subscription:
    """Calls `handler`, which must not block, for well-formed messages; counts the others in `ignored`.

    With `signed`, a message counts only on a key that ends with what this makes of it: who may publish on
    that key has no other voice.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        kind: type[M],
        handler: Callable[[M], None],
        signed: Callable[[M], str] | None = None,
    ) -> None:
        self.ignored = 0
        self._logged = 0.0

        def receive(sample: zenoh.Sample) -> None:
            try:
                if len(sample.payload) > kind.max_bytes:
                    raise MessageError(f"too large: {len(sample.payload)} bytes")
                message = decode(kind, sample.payload.to_bytes())
                if signed and not str(sample.key_expr).endswith(f"/{signed(message)}"):
                    raise MessageError(f"under another's name: {signed(message)}")
                handler(message)
            except MessageError as error:
                self._ignore(str(sample.key_expr), error)

        self._subscriber = session.declare_subscriber(key, receive)

    def _ignore(self, key: str, error: MessageError) -> None:
        self.ignored += 1
        if time.monotonic() - self._logged >= 1.0:
            self._logged = time.monotonic()
            log.warning("ignored a message on %s: %s", key, error)


def announce(session: zenoh.Session, keys: Keys, member: Member) -> zenoh.LivelinessToken:
    """Declares this process alive until the returned token is undeclared, or lost.

    Raises UsageError when the name is taken: of two that come to one hub at once, at least the second. Behind
    different routers both may pass, as long as neither has heard of the other.
    """
    own = keys.live(member, uuid.uuid4().hex[:12])
    token = session.liveliness().declare_token(own)
    for reply in session.liveliness().get(keys.live(member, "*"), timeout=2.0):
        if reply.ok is not None and str(reply.ok.key_expr) != own:
            token.undeclare()  # type: ignore[no-untyped-call]
            raise UsageError(
                f"a {member.role} named {member.name!r} is already connected; choose another --name"
            )
    return token


def watch_members(session: zenoh.Session, keys: Keys, handler: Callable[[Member, str, bool], None]) -> object:
    """Calls `handler(member, life, alive)` for each process present, joining or leaving; keep the result."""

    def receive(sample: zenoh.Sample) -> None:
        *_, role, group, name, life = str(sample.key_expr).split("/")
        handler(Member(role, group, name), life, sample.kind == zenoh.SampleKind.PUT)

    return session.liveliness().declare_subscriber(keys.live(EVERYBODY, "*"), receive, history=True)


def list_members(session: zenoh.Session, keys: Keys, who: Member = EVERYBODY) -> set[Member]:
    """The processes that are alive at the hub now, of those that `who` covers."""
    replies = session.liveliness().get(keys.live(who, "*"), timeout=2.0)
    return {Member(*str(reply.ok.key_expr).split("/")[-4:-1]) for reply in replies if reply.ok is not None}
