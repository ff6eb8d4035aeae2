"""Whether memory and disk suffice, asked before they are needed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from common.errors import UsageError


def learner_threads(wanted: int | str, cores: int) -> int:
    """Threads of torch for a learner that shares its cores with actors."""
    return wanted if isinstance(wanted, int) else max(1, min(4, cores // 2))


def one_torch_thread() -> None:
    """Before torch is loaded: its operations use one thread each, whichever thread of ours calls them.

    More of them wait for each other by spinning: beside a learner on two cores a task of the curriculum took
    10 ms with two and 2.4 ms with one. Whoever set OMP_NUM_THREADS is obeyed.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def give_way() -> None:
    """The calling thread, and what it starts from now on, lets others go first.

    What computes for hours must not hold up what answers within milliseconds: the session's threads, which
    are there already, and the curriculum.
    """
    os.nice(10)


def check_memory(what: str, need: float, cure: str) -> None:
    """Raises UsageError when `what` needs more bytes than are free, where the system tells."""
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return
    if need > free:
        raise UsageError(f"{what} needs {need / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB are free; {cure}")


def check_disk(folder: Path, what: str, need: float, cure: str) -> None:
    """Raises UsageError when `what` needs more bytes than are free where `folder` is or is to be."""
    there = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if need > free:
        raise UsageError(
            f"{what} needs {need / 1e9:.1f} GB on the disk of {folder}, {free / 1e9:.1f} GB are free; {cure}"
        )
