"""Signals: how a process leaves on one, and how none is lost or leaves a child behind."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType

LEAVE = (signal.SIGTERM, signal.SIGINT)


class Stop:
    """Whether a signal has come. A threading.Event that is set by a handler may wait for itself for ever."""

    def __init__(self) -> None:
        self._came = False

    def set(self, *_: object) -> None:
        """A signal has come."""
        self._came = True

    def is_set(self) -> bool:
        """Whether one has come."""
        return self._came

    def wait(self, seconds: float = math.inf) -> bool:
        """Sleeps so long, or until one comes; whether one has."""
        until = time.monotonic() + seconds
        while not self._came and (left := until - time.monotonic()) > 0:
            time.sleep(min(left, 0.05))  # which goes on after a handler
        return self._came


def stop_on_signals() -> Stop:
    """From now on SIGTERM and SIGINT only take note: for a loop that is to end between two of its rounds."""
    stop = Stop()
    for number in LEAVE:
        signal.signal(number, stop.set)
    return stop


def exit_on_signals() -> None:
    """Turns SIGTERM and SIGINT into SystemExit, once, so that sessions and files are closed on leaving."""
    leaving = False

    def leave(number: int, frame: FrameType | None) -> None:
        nonlocal leaving
        if not leaving:
            leaving = True
            raise SystemExit(0)

    def stay() -> None:
        nonlocal leaving
        leaving = False

    give_again(SystemExit, signal.SIGTERM, stay)
    for number in LEAVE:
        signal.signal(number, leave)


@contextmanager
def signals_held() -> Iterator[None]:
    """SIGTERM and SIGINT wait, in the main thread: a child that is started is known, or all are ended."""
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in LEAVE}
    try:
        for number in LEAVE:
            signal.signal(number, lambda number, _: came.append(number))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for late in came:
            signal.raise_signal(late)


@contextmanager
def workers_start() -> Iterator[None]:
    """Processes of multiprocessing started in it never see SIGINT, in their imports neither.

    Ctrl-C is their parent's affair, which ends them.
    """
    resource_tracker.ensure_running()  # started later, it would lift the mask
    with signals_held():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


_again: dict[type[BaseException], tuple[int, Callable[[], None]]] = {}


def give_again(error: type[BaseException], number: int, before: Callable[[], None] = lambda: None) -> None:
    """Where Python ignores exceptions, in a callback of an import for example, a signal's is not lost.

    The signal `number`, whose handler raised `error`, is given again a moment later.
    """
    _again[error] = number, before
    sys.unraisablehook = _unraisable


def _unraisable(what: sys.UnraisableHookArgs) -> None:
    if what.exc_type not in _again:
        sys.__unraisablehook__(what)
        return
    number, before = _again[what.exc_type]
    before()
    threading.Timer(0.05, os.kill, (os.getpid(), number)).start()
