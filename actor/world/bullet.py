"""Pybullet without its chatter: it prints from C, also to stdout, which belongs to readers of `--json`."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _silence() -> Iterator[None]:
    """Sends file descriptors 1 and 2 to nowhere for a while, C's own buffers included."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    sys.stderr.flush()
    libc.fflush(None)
    saved, nowhere = [os.dup(fd) for fd in (1, 2)], os.open(os.devnull, os.O_WRONLY)
    for fd in (1, 2):
        os.dup2(nowhere, fd)
    try:
        yield
    finally:
        sys.stderr.flush()
        libc.fflush(None)
        for fd, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, fd)
            os.close(copy)
        os.close(nowhere)


with _silence():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient as BulletClient


def connect() -> BulletClient:
    """A new physics server in this process, without a window."""
    with _silence():
        return BulletClient(pybullet.DIRECT)


def has_numpy() -> bool:
    """Whether this build hands images over as arrays; without it a frame costs several times more."""
    return bool(pybullet.isNumpyEnabled())
