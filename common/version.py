"""Which version of the program a process runs."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("common", "actor", "learner", "curriculum", "deploy")


@cache
def code_version() -> str:
    """The package's version and a hash of its source: hosts that differ in a line are told apart."""
    root, content = Path(__file__).parents[1], hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            content.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"{version('navaclq')}+{content.hexdigest()[:8]}"
