"""Whether memory and disk suffice, asked before they are needed."""

from __future__ import annotations

import shutil
from pathlib import Path

from common.errors import UsageError


def learner_threads(wanted: int | str, cores: int) -> int:
    """Threads of torch for a learner that shares its cores with actors."""
    return wanted if isinstance(wanted, int) else max(1, min(4, cores // 2))


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
