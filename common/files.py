"""Files that are written whole or not at all."""

from __future__ import annotations

from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Replaces a small file by way of a temporary name; raises OSError when it cannot."""
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    part.replace(path)
