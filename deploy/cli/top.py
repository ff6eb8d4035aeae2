"""`navaclq top`: the live screen of any running system, from any host."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import typer
import zenoh
from rich.console import Console

from common.bus import Keys, ask_later, list_members
from common.link import Link, open_client
from common.members import Members
from common.messages import ContractReply, MessageError, Nothing, decode, encode
from common.signals import exit_on_signals
from deploy.cli import options
from deploy.screen import Census, Screen, picture
from deploy.troubles import Process, find_troubles

EVERY_RUN = Keys("*")
"""A hub knows one run, and those who wait for its learner do not know its name yet."""
PATIENCE = 3.0
"""Seconds to wait for the hub, and then for every process to speak, before a single picture is drawn."""


def top(
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    certs: options.Certs = None,
    insecure: options.Insecure = False,
    once: Annotated[
        bool, typer.Option("--once", help="Print one picture and end, as without a terminal.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Show who takes part in a run, how it goes, and what is wrong, in words."""
    link, console = options.make_link(connect, certs, insecure), Console()
    exit_on_signals()
    if once or as_json or not console.is_terminal:
        _show_once(link, console, as_json)
    else:
        _show_live(link, console)


def _show_once(link: Link, console: Console, as_json: bool) -> None:
    with open_client(link, patience=PATIENCE) as session:
        members = Members(session, EVERY_RUN)
        census, deadline = Census(members), time.monotonic() + PATIENCE
        run, present = _Run(session), list_members(session, EVERY_RUN)
        while time.monotonic() < deadline:
            run.ask()
            processes = [p for p in census.take() if p.alive]
            led = any(p.role == "learner" for p in processes)
            if present <= members.alive and all(p.stat for p in processes) and (run.name or not led):
                break
            time.sleep(0.05)
        processes = census.take()
    if as_json:
        options.print_json(describe(processes, run.name))
    else:
        console.print(picture(processes, _title(run, link), console))


def _show_live(link: Link, console: Console) -> None:
    with open_client(link, _say_waiting(link)) as session:
        run = _Run(session)
        screen = Screen(Members(session, EVERY_RUN), console, _title(run, link))
        try:
            while True:
                run.ask()
                screen.title = _title(run, link)
                screen.update()
                time.sleep(0.1)
        finally:
            screen.close()


class _Run:
    """The name of the run, once a learner has told it; `ask` as often as you like."""

    def __init__(self, session: zenoh.Session) -> None:
        self.name: str | None = None
        self._session, self._asking = session, False

    def ask(self) -> None:
        """Asks for it, without waiting, unless it is known or on its way."""
        if self.name is None and not self._asking:
            self._asking = True
            ask_later(self._session, EVERY_RUN.contract, encode(Nothing()), self._hear, timeout=5.0)

    def _hear(self, answer: bytes | Exception) -> None:
        with suppress(MessageError):
            self.name = decode(ContractReply, answer).run if isinstance(answer, bytes) else None
        self._asking = False


def _title(run: _Run, link: Link) -> str:
    return f"navaclq top: {f'run {run.name}' if run.name else 'no run'} at {link}"


def _say_waiting(link: Link) -> Callable[[float], None]:
    said = False

    def say(waited: float) -> None:
        nonlocal said
        if not said:
            said = True
            sys.stderr.write(f"waiting for the hub at {link}\n")

    return say


def describe(processes: list[Process], run: str | None) -> dict[str, Any]:
    """The processes and what is wrong, for programs."""
    return {
        "run": run,
        "processes": [
            {
                **p.member._asdict(),
                **{key: getattr(p.stat, key, None) for key in ("host", "pid", "since", "code", "protocol")},
                "alive": p.alive,
                "silent_s": round(p.silent, 1),
                "values": p.values,
            }
            for p in processes
        ],
        "troubles": find_troubles(processes),
    }
