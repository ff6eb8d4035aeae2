"""Geometric properties of random tasks, cell by cell: what the training distribution really is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from common.cells import CELLS
from common.config import Config
from common.tasks import GeometricProperties, Task, build_scene, geometric_properties, random_task

ANGLES = ("relative_angle", "approach_angle")
QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def properties_of_cells(
    config: Config, tasks: int, progress: Callable[[int], None] | None = None
) -> list[dict[str, Any]]:
    """Of each training cell, quantiles 0, 5, 50, 95, 100% of all properties (m, degrees) of `tasks` tasks."""
    rng, found = np.random.default_rng([config.seed, 6]), []
    for index, cell in enumerate(CELLS):
        rows = []
        for count in range(tasks):
            task = random_task(index, config, rng)
            rows.append(geometric_properties(task, build_scene(task, config.world)))
            if progress:
                progress(index * tasks + count + 1)
        quantiles = {
            name: np.quantile([_in_units(name, row) for row in rows], QUANTILES).round(3).tolist()
            for name in GeometricProperties.model_fields
        }
        found.append({"cell": index, "name": cell.name, **quantiles})
    return found


def starts_to_solve(config: Config, count: int) -> list[Task]:
    """Random training starts, over the cells in turn."""
    rng = np.random.default_rng([config.seed, 5])
    return [random_task(i % len(CELLS), config, rng) for i in range(count)]


def _in_units(name: str, row: GeometricProperties) -> float:
    value: float = getattr(row, name)
    return math.degrees(value) if name in ANGLES else value


def as_markdown(table: list[dict[str, Any]]) -> str:
    """The table, `least [5% median 95%] largest` in every field."""
    names = [name for name in table[0] if name not in ("cell", "name")]
    units = ["deg" if name in ANGLES else "m" for name in names]
    titles = [f"{name.replace('_', ' ')} ({unit})" for name, unit in zip(names, units, strict=True)]
    lines = ["| cell | " + " | ".join(titles) + " |", "|---" * (len(names) + 1) + "|"]
    for row in table:
        digits = {"deg": 0, "m": 2}
        fields = [
            "{} [{} {} {}] {}".format(*(f"{value:.{digits[unit]}f}" for value in row[name]))
            for name, unit in zip(names, units, strict=True)
        ]
        lines.append(f"| {row['cell']} {row['name']} | " + " | ".join(fields) + " |")
    return "\n".join(lines) + "\n"
