"""The result of a benchmark: rows, ratios (higher is better), what was skipped and where it ran."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import quantiles
from typing import Any


def rss() -> float:
    """Memory of this process, MB."""
    status = Path("/proc/self/status").read_text("ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


@dataclass(frozen=True, slots=True)
class Row:
    """One measured value."""

    name: str
    value: float
    unit: str


@dataclass(slots=True)
class Report:
    """All that one benchmark says, as `navaclq bench NAME --json` prints it."""

    bench: str
    rows: list[Row] = field(default_factory=list)
    ratios: dict[str, float] = field(default_factory=dict)
    quartiles: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Of each ratio over the rounds: a wide range tells of a busy machine."""
    skipped: list[str] = field(default_factory=list)

    def add(self, name: str, value: float, unit: str) -> None:
        """Appends a row."""
        self.rows.append(Row(name, value, unit))

    def compare(self, name: str, limit: list[float], ours: list[float]) -> None:
        """Appends the ratio of two times measured in the same rounds: its median, and its quartiles."""
        low, middle, high = quantiles([a / b for a, b in zip(limit, ours, strict=True)] * 2, n=4)
        self.ratios[name], self.quartiles[name] = middle, (low, high)

    def to_json(self) -> dict[str, Any]:
        """The report and the host, in numbers of four digits."""
        host = {
            "cores": os.cpu_count(),
            "load_average": round(os.getloadavg()[0], 2),
            "machine": platform.machine(),
            "python": platform.python_version(),
        }
        rows = [asdict(row) | {"value": float(f"{row.value:.4g}")} for row in self.rows]
        return {
            "bench": self.bench,
            "rows": rows,
            "ratios": {name: round(value, 3) for name, value in self.ratios.items()},
            "quartiles": {name: [round(v, 3) for v in pair] for name, pair in self.quartiles.items()},
            "skipped": self.skipped,
            "host": host,
        }

    def to_text(self) -> str:
        """The same for people."""
        lines = [f"{row.name:32} {row.value:10.4g} {row.unit}" for row in self.rows]
        for name, value in self.ratios.items():
            low, high = self.quartiles[name]
            lines.append(f"{name:32} {value:10.3f} (quartiles {low:.3f} to {high:.3f})")
        return "\n".join([*lines, *(f"skipped: {reason}" for reason in self.skipped)]) + "\n"
