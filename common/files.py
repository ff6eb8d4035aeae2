"""Files that are written whole or not at all, that belong to one process, and what identifies them."""

from __future__ import annotations

import fcntl
import hashlib
import os
from pathlib import Path
from typing import IO


def write_atomically(path: Path, content: bytes) -> None:
    """Replaces a small file, on the disk too when this returns; raises OSError when it cannot."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Waits until the disk has the content of a file, or the names in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def content_hash(content: bytes) -> str:
    """What identifies a content: the beginning of its SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def lock(path: Path) -> IO[bytes]:
    """A file that is this process's own until it is closed, or the process ends in whatever way.

    Raises BlockingIOError when another has it, any other OSError when it cannot be had.
    """
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise
    return file
