"""The local launcher: starts the processes of a run as separate commands, watches and restarts them."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from common.errors import RunError, UsageError
from common.signals import signals_held

STOP_SECONDS = 4.0
LONGEST_BACK_OFF = 30.0


FREE_PORTS = range(15_000, 32_000)
"""Below those that a system gives to connections, which may take one before its process listens."""


def free_port() -> int:
    """A TCP port on loopback that nobody listens on now."""
    for port in random.SystemRandom().choices(FREE_PORTS, k=100):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise RunError(f"of a hundred ports from {FREE_PORTS[0]} to {FREE_PORTS[-1]} none is free")


@dataclass
class Child:
    """A supervised process. `command` is asked anew at every start, for arguments that depend on the time."""

    name: str
    command: Callable[[], list[str]]
    log_file: Path
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    may_finish: bool = False
    """Whether exit code 0 is its proper end; otherwise any end is a death."""
    finished: bool = False
    next_start: float = 0.0
    started: float = 0.0
    back_off: float = 0.5

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process is not None and self.process.poll() is None

    def start(self) -> None:
        """Starts the process in a group of its own, its output appended to the log file."""
        self.log_file.parent.mkdir(parents=True, exist_ok=True)
        with self.log_file.open("ab") as output, signals_held():
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deploy.cli", *self.command()],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                process_group=0,  # Ctrl-C reaches the launcher, which stops its children in order
            )
        self.started = time.monotonic()

    def last_words(self) -> str:
        """The last line that it wrote."""
        lines = (
            self.log_file.read_text("utf-8", "replace").strip().splitlines() if self.log_file.exists() else []
        )
        return lines[-1] if lines else "it wrote nothing"


class Supervisor:
    """Keeps children running: one that dies is restarted after a back-off that doubles up to 30 s."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.children: list[Child] = []
        self._report = report

    def add(self, child: Child) -> None:
        """Starts a child and supervises it from now on."""
        self.children.append(child)
        child.start()

    def check(self) -> None:
        """Looks after all children; raises UsageError with its words when one refuses at its first start."""
        now = time.monotonic()
        for child in self.children:
            if child.finished or child.process is None:
                continue
            code = child.process.poll()
            if code is None:
                if now - child.started > 60:
                    child.back_off = 0.5
            elif code == 0 and child.may_finish:
                child.finished = True
            elif child.next_start == 0.0:
                if code == 2 and child.restarts == 0:
                    raise UsageError(f"{child.name}: {child.last_words().removeprefix('error: ')}")
                child.next_start = now + child.back_off
                self._report(
                    f"{child.name} ended with {_reason(code)}; restart in {child.back_off:.1f} s "
                    f"(log: {child.log_file})"
                )
                child.back_off = min(2 * child.back_off, LONGEST_BACK_OFF)
            elif now >= child.next_start:
                child.restarts += 1
                child.next_start = 0.0
                child.start()

    def stop(self) -> None:
        """SIGTERM to all, last added first; SIGKILL to those that still run after 4 s."""
        for child in reversed(self.children):
            if child.alive and child.process:
                child.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + STOP_SECONDS
        for child in reversed(self.children):
            if child.process is None:
                continue
            try:
                child.process.wait(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                self._report(f"{child.name} did not stop within {STOP_SECONDS:.0f} s; killed")
                child.process.kill()
                child.process.wait()


def _reason(code: int) -> str:
    if code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"
