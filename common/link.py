"""How a process meets the others: endpoints, credentials, and Zenoh sessions that end in good time.

One hub listens (the learner, or a curriculum that stands alone), everything else is a client of it.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, NamedTuple, NoReturn

import zenoh

from common.access import LOCAL, Credentials, access_control, explain_refusal
from common.errors import NoAnswerError, UsageError
from common.messages import MEGABYTE
from common.signals import LEAVE

log = logging.getLogger(__name__)
LARGEST_MESSAGE = 320 * MEGABYTE
"""More than any message has; Zenoh drops what is larger before it is put together."""
CLOSE_SECONDS = 1.5
"""Until a session that cannot be closed is given up."""
LEASE_MS = 3000
"""A frozen or unreachable peer is given up after this."""


class Link(NamedTuple):
    """Where and how a process meets the others."""

    endpoints: tuple[str, ...]
    """Hubs in order of preference; for one that listens, its addresses."""
    credentials: Credentials | None = None

    @property
    def group(self) -> str:
        """That of the processes which use it."""
        return self.credentials.name if self.credentials else LOCAL

    def __str__(self) -> str:
        return ", ".join(self.endpoints)


def make_link(text: str, credentials: Credentials | None = None, insecure: bool = False) -> Link:
    """The link to endpoints separated by commas, each tcp/HOST:PORT or tls/HOST:PORT.

    Raises UsageError for anything else, for TLS without credentials, and for TCP beyond loopback unless
    `insecure`.
    """
    endpoints = tuple(part.strip() for part in text.split(","))
    for endpoint in endpoints:
        match = re.fullmatch(r"(tcp|tls)/(?:\[([0-9a-fA-F:]+)\]|([A-Za-z0-9_.-]+)):(\d{1,5})", endpoint)
        if not match or not 0 < int(match[4]) < 65536:
            raise UsageError(
                f"{endpoint!r} is no endpoint; write tcp/HOST:PORT or tls/HOST:PORT, "
                "for example tcp/127.0.0.1:7447"
            )
        if match[1] == "tls":
            if credentials is None:
                raise UsageError(f"{endpoint} needs --certs, a folder that `navaclq certs` makes")
        elif not (insecure or _is_loopback(match[2] or match[3])):
            raise UsageError(
                f"plain TCP to {match[2] or match[3]} is readable by anybody on the way; use a loopback "
                "address, tls/HOST:PORT with --certs, or say --insecure on a network that you trust"
            )
    if credentials and any(endpoint.startswith("tcp/") for endpoint in endpoints):
        raise UsageError(f"--certs is for tls/HOST:PORT; {text} has an endpoint without")
    return Link(endpoints, credentials)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _session_config(mode: str, listen: Link | None, connect: Link | None) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": listen.endpoints if listen else [],
        "connect/endpoints": connect.endpoints if connect else [],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/rx/max_message_size": LARGEST_MESSAGE,
    }
    credentials = next((link.credentials for link in (listen, connect) if link and link.credentials), None)
    if credentials:
        settings["transport/link/tls"] = credentials.tls()
        if listen:
            settings["access_control"] = access_control(credentials.groups)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_hub(link: Link) -> AbstractContextManager[zenoh.Session]:
    """A session that listens; raises UsageError when the address cannot be had."""
    return _open("router", link, None)  # a peer would not tell clients of two routers of each other


def open_client(
    link: Link, on_wait: Callable[[float], None] | None = None, patience: float = float("inf")
) -> AbstractContextManager[zenoh.Session]:
    """A session connected to the first hub that answers; waits up to `patience` s, telling `on_wait` the
    seconds so far.

    Raises NoAnswerError when patience ends first, and UsageError when certificates are the reason. A
    connection lost later is renewed by Zenoh itself.
    """
    return _open("client", None, link, on_wait, patience)


def open_router(
    listen: Link, connect: Link | None, on_wait: Callable[[float], None] | None = None
) -> AbstractContextManager[zenoh.Session]:
    """A session that passes messages on between its clients and the hub that it is connected to, if any."""
    return _open("router", listen, connect, on_wait)


@contextmanager
def _open(
    mode: str,
    listen: Link | None,
    connect: Link | None,
    on_wait: Callable[[float], None] | None = None,
    patience: float = float("inf"),
) -> Iterator[zenoh.Session]:
    began = time.monotonic()
    while True:
        try:
            session = zenoh.open(_session_config(mode, listen, connect))
            break
        except zenoh.ZError as error:
            if connect is None or "listener" in str(error):
                raise UsageError(f"cannot listen on {listen}: is it in use? ({str(error)[:200]})") from None
            if connect.credentials:
                for endpoint in connect.endpoints:
                    if refusal := explain_refusal(endpoint, connect.credentials):
                        raise UsageError(refusal) from None  # waiting would not help
            waited = time.monotonic() - began
            if waited > patience:
                raise NoAnswerError(f"no hub answers at {connect}") from None
            if on_wait:
                on_wait(waited)
            time.sleep(0.2)
    try:
        yield session
    finally:
        closing = threading.Thread(target=session.close, daemon=True)
        closing.start()
        closing.join(CLOSE_SECONDS)
        if closing.is_alive():  # the other side is frozen or unreachable, with much on the way to it
            log.warning("the connection is stuck, and given up")


def end_process(code: int) -> NoReturn:
    """Flushes and exits at once: threads of Zenoh that still run may hold up the interpreter's own end."""
    for number in LEAVE:
        signal.signal(number, signal.SIG_DFL)
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # closed by whoever read it
            stream.flush()
    os._exit(code)
