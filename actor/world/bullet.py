"""Pybullet without its chatter: it prints from C to stdout, which belongs to programs that read `--json`."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Sends file descriptor 1 to nowhere for a while, C's own buffer included."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    libc.fflush(None)
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        libc.fflush(None)
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)


with _silent_stdout():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient as BulletClient


def connect() -> BulletClient:
    """A new physics server in this process, without a window."""
    with _silent_stdout():
        return BulletClient(pybullet.DIRECT)


def has_numpy() -> bool:
    """Whether this build hands images over as arrays; without it a frame costs several times more."""
    return bool(pybullet.isNumpyEnabled())
