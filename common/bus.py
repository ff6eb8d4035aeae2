"""The bus: the only module that knows Zenoh's keys, sessions and query mechanics.

One hub listens (the learner, or a curriculum that stands alone), everything else is a client of it. What must
arrive is a query whose reply is the acknowledgement. A callback of Zenoh never does work: it hands the query
to a bounded queue, and a thread of ours answers, because the runtime has two threads and a blocked callback
stops every other channel of the process.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

import zenoh

from common.errors import UsageError
from common.messages import M, Message, MessageError, decode, encode

log = logging.getLogger(__name__)
T = TypeVar("T")

BUSY = "BUSY"
"""The one refusal that means: again, later."""
GROUP = 64
"""Queries that are answered together at most, where that spares work."""
INTERNAL_ERROR = "internal error"
LEASE_MS = 3000
"""A frozen or unreachable peer is given up after this."""


class Keys:
    """The key expressions of a run."""

    def __init__(self, run: str) -> None:
        self.root = f"navaclq/{run}"
        self.trajectory = f"{self.root}/trajectory"
        self.frames = f"{self.root}/frames"
        self.contract = f"{self.root}/contract"
        self.version = f"{self.root}/weights/version"
        self.task = f"{self.root}/curriculum/task"
        self.result = f"{self.root}/curriculum/result"
        self.candidates = f"{self.root}/curriculum/candidates"

    def weights(self, kind: str) -> str:
        """Newest weights: `policy` for actors, `critic` (policy and critics) for the curriculum."""
        return f"{self.root}/weights/latest/{kind}"

    def live(self, role: str, name: str) -> str:
        """Liveliness token of a process."""
        return f"{self.root}/live/{role}/{name}"

    def stat(self, role: str, name: str) -> str:
        """Figures of a process."""
        return f"{self.root}/stat/{role}/{name}"


class NoAnswerError(Exception):
    """Nobody answered: no receiver, a timeout, or a dead peer."""


class RefusedError(Exception):
    """The receiver answered with an error; the text is its reason."""


def check_endpoint(endpoint: str, insecure: bool = False) -> str:
    """The endpoint itself; raises UsageError unless it is tcp/HOST:PORT, on loopback or `insecure`."""
    match = re.fullmatch(r"tcp/(?:\[([0-9a-fA-F:]+)\]|([A-Za-z0-9_.-]+)):(\d{1,5})", endpoint)
    if not match or not 0 < int(match[3]) < 65536:
        raise UsageError(f"{endpoint!r} is no endpoint; write tcp/HOST:PORT, for example tcp/127.0.0.1:7447")
    host = match[1] or match[2]
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = host == "localhost"
    if not (loopback or insecure):
        raise UsageError(
            f"plain TCP to {host} is readable by anybody on the way; use a loopback address, "
            "or say --insecure on a network that you trust"
        )
    return endpoint


def _session_config(mode: str, listen: str | None, connect: str | None) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def open_hub(endpoint: str) -> Iterator[zenoh.Session]:
    """A session that listens on `endpoint`; raises UsageError when the address cannot be had."""
    try:
        session = zenoh.open(_session_config("peer", endpoint, None))
    except zenoh.ZError as error:
        raise UsageError(f"cannot listen on {endpoint}: is it in use? ({str(error)[:200]})") from None
    with session:
        yield session


@contextmanager
def open_client(
    endpoint: str, on_wait: Callable[[float], None] | None = None, patience: float = float("inf")
) -> Iterator[zenoh.Session]:
    """A session connected to a hub; waits for it up to `patience` s, telling `on_wait` the seconds so far.

    Raises NoAnswerError when patience ends first. A connection lost later is renewed by Zenoh itself.
    """
    began = time.monotonic()
    while True:
        try:
            session = zenoh.open(_session_config("client", None, endpoint))
            break
        except zenoh.ZError:
            waited = time.monotonic() - began
            if waited > patience:
                raise NoAnswerError(f"no hub answers at {endpoint}") from None
            if on_wait:
                on_wait(waited)
            time.sleep(0.2)
    with session:
        yield session


class QueryServer:
    """Answers the queries on one key expression from a thread of its own.

    `handler` gets (payload, attachment) and returns the reply; a MessageError it raises is sent back as the
    refusal. With `capacity` queries waiting the next one is told BUSY at once. Refusals but that one are
    counted in `refused` by reason and logged at most once a second.

    With `commit`, queries that wait together are handled one after the other, then `commit` is called once,
    and only then are they answered: a disk that is slow to confirm confirms many at a time.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        handler: Callable[[bytes, bytes], bytes],
        capacity: int = 256,
        commit: Callable[[], None] | None = None,
    ) -> None:
        self.refused: Counter[str] = Counter()
        self._key, self._handler, self._commit = key, handler, commit
        self._inbox: queue.Queue[zenoh.Query | None] = queue.Queue(capacity)
        self._logged, self._closed = 0.0, False
        self._thread = threading.Thread(target=self._serve, name=f"serve {key}", daemon=True)
        self._thread.start()
        self._queryable = session.declare_queryable(key, self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        try:
            self._inbox.put_nowait(query)
        except queue.Full:
            self._refuse(query, BUSY)

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
            try:
                if isinstance(answer, str):
                    self._refuse(query, answer)
                else:
                    with query:
                        query.reply(self._key, answer)  # the query's own expression may hold wildcards
            except Exception:  # this thread must outlive whatever one query brings, a lost session included
                log.exception("could not answer %s", self._key)

    def _handle(self, query: zenoh.Query) -> zenoh.ZBytes | str:
        """The answer, or the reason of a refusal."""
        try:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            attachment = query.attachment.to_bytes() if query.attachment is not None else b""
            return zenoh.ZBytes(self._handler(payload, attachment))
        except MessageError as error:
            return str(error)
        except Exception:
            log.exception("error while answering %s", query.key_expr)
            return INTERNAL_ERROR

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        if reason != BUSY:
            self.refused[reason.split(":")[0][:40] if len(self.refused) < 100 else "other"] += 1
            now = time.monotonic()
            if now - self._logged >= 1.0:
                self._logged = now
                log.warning("refused a message on %s: %s", query.key_expr, reason)
        with query:
            query.reply_err(reason.encode())

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
    return QueryServer(session, key, lambda payload, _: encode(handler(decode(kind, payload))))


def _read(reply: zenoh.Reply) -> bytes:
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    reason = reply.err.payload.to_bytes().decode(errors="replace") if reply.err is not None else ""
    if reason == "Timeout":
        raise NoAnswerError("timeout")
    raise RefusedError(reason[:400])


def ask_bytes(
    session: zenoh.Session, key: str, payload: bytes, attachment: bytes = b"", timeout: float = 10.0
) -> bytes:
    """The one reply to a query; raises NoAnswerError or RefusedError."""
    replies = session.get(
        key,
        payload=payload,
        attachment=attachment,
        timeout=timeout,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    for reply in replies:
        return _read(reply)
    raise NoAnswerError(f"nobody serves {key}")


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
    question: Message,
    kind: type[M],
    answer: Callable[[M | None], None],
    timeout: float,
) -> None:
    """Asks without waiting; `answer` is called once from Zenoh's thread, with None if nothing usable came."""
    found: list[M] = []

    def collect(reply: zenoh.Reply) -> None:
        try:
            found.append(decode(kind, _read(reply)))
        except (NoAnswerError, RefusedError, MessageError) as error:
            log.info("no usable answer on %s: %s", key, error)

    session.get(
        key,
        zenoh.handlers.Callback(collect, lambda: answer(found[0] if found else None)),
        payload=encode(question),
        timeout=timeout,
        consolidation=zenoh.ConsolidationMode.NONE,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
        express=True,
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
    """Calls `handler`, which must not block, for well-formed messages; counts the others in `ignored`."""

    def __init__(self, session: zenoh.Session, key: str, kind: type[M], handler: Callable[[M], None]) -> None:
        self.ignored = 0
        self._logged = 0.0

        def receive(sample: zenoh.Sample) -> None:
            try:
                handler(decode(kind, sample.payload.to_bytes()))
            except MessageError as error:
                self._ignore(str(sample.key_expr), error)

        self._subscriber = session.declare_subscriber(key, receive)

    def _ignore(self, key: str, error: MessageError) -> None:
        self.ignored += 1
        if time.monotonic() - self._logged >= 1.0:
            self._logged = time.monotonic()
            log.warning("ignored a message on %s: %s", key, error)


def announce(session: zenoh.Session, keys: Keys, role: str, name: str) -> zenoh.LivelinessToken:
    """Declares this process alive until the returned token is undeclared, or lost.

    Raises UsageError when the name is taken.
    """
    key = keys.live(role, name)
    if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=2.0)):
        raise UsageError(f"a {role} named {name!r} is already connected; choose another --name")
    return session.liveliness().declare_token(key)


def watch_members(session: zenoh.Session, keys: Keys, handler: Callable[[str, str, bool], None]) -> object:
    """Calls `handler(role, name, alive)` for every process present, joining or leaving; keep the result."""

    def receive(sample: zenoh.Sample) -> None:
        role, name = str(sample.key_expr).split("/")[-2:]
        handler(role, name, sample.kind == zenoh.SampleKind.PUT)

    return session.liveliness().declare_subscriber(keys.live("*", "*"), receive, history=True)
