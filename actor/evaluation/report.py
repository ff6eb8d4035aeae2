"""What an examination found: groups of drives in numbers, rows for a spreadsheet, tables in Markdown."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from actor.evaluation.measures import Measures, conditional_value_at_risk, summarize
from actor.evaluation.suites import GRID_HEADINGS, Examination, is_inside_training_support
from common.tasks import PlacedStart, Task
from common.world_config import StartRanges

Result = dict[str, Any]
PAPER: dict[str, tuple[float, float, float, float]] = {
    "0": (86.6, 58.5, 50.3, 16.5),
    "-45": (93.7, 55.6, 25.5, 3.3),
    "45": (88.0, 52.2, 53.5, 5.0),
    "-90": (90.5, 43.2, 8.9, 0.0),
    "90": (18.5, 45.5, 32.0, 0.0),
    "-135": (48.2, 36.9, 2.2, 0.0),
    "135": (11.9, 37.1, 19.8, 0.0),
    "180": (15.7, 34.2, 8.0, 0.0),
    "inside": (75.5, 51.1, 34.1, 5.0),
    "outside": (25.3, 36.1, 10.0, 0.0),
    "all": (56.6, 45.4, 25.0, 3.1),
}
"""Success (%) in the paper's table: NavACL-Q p.t., RND, NavACL-Q e.t.e., map-based baseline."""
PAPER_COLUMNS = ("paper NavACL-Q p.t.", "paper RND", "paper e.t.e.", "paper map-based")
WORDS = {
    "inside": "inside the training range",
    "outside": "outside it",
    "support": "starts that training can draw",
}


def groups(examination: Examination, drives: Sequence[Measures], ranges: StartRanges) -> Result:
    """Summaries of all drives, and of a grid's: by heading, inside (up to 90 deg) and outside the training
    range, and of the starts that training with `ranges` can draw (`support`, None when there are none).
    """
    if not examination.is_grid:
        return {"all": summarize(drives)}
    starts = [task.start for task in examination.tasks if isinstance(task.start, PlacedStart)]

    def of(chosen: list[bool]) -> Result:
        return summarize([drive for drive, is_in in zip(drives, chosen, strict=True) if is_in])

    def with_risk(chosen: list[bool]) -> Result:
        risk = conditional_value_at_risk(
            [drive for drive, is_in in zip(drives, chosen, strict=True) if is_in],
            [(start.x, start.y) for start, is_in in zip(starts, chosen, strict=True) if is_in],
        )
        return {**of(chosen), "cvar10": risk}

    inside = [abs(start.yaw) <= 90 for start in starts]
    support = [is_inside_training_support(start, ranges) for start in starts]
    found = {str(heading): [round(s.yaw) == heading for s in starts] for heading in GRID_HEADINGS}
    return {
        "all": with_risk([True] * len(starts)),
        "headings": {heading: of(chosen) for heading, chosen in found.items() if any(chosen)},
        "inside": with_risk(inside),
        "outside": with_risk([not is_in for is_in in inside]),
        "support": of(support) if any(support) else None,
    }


def labelled(result: Result) -> dict[str, Result]:
    """The summaries of a result, by their names in the order of a table."""
    rows = {**result.get("headings", {}), "inside": result.get("inside"), "outside": result.get("outside")}
    rows |= {"support": result.get("support"), "all": result["all"]}
    return {name: row for name, row in rows.items() if row}


def over_policies(results: Sequence[Result]) -> dict[str, Result]:
    """Mean, standard deviation, least and most of success over policies, for each row that all have."""
    tables = [labelled(result) for result in results]
    found = {}
    for name in tables[0]:
        values = [table[name]["success"] for table in tables if name in table]
        if len(values) == len(tables):
            spread = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
            found[name] = {
                "mean": float(np.mean(values)),
                "sd": spread,
                "min": min(values),
                "max": max(values),
            }
    return found


def as_rows(tasks: Sequence[Task], drives: Sequence[Measures]) -> str:
    """One line of CSV for each episode: its task and everything measured."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for index, (task, drive) in enumerate(zip(tasks, drives, strict=True)):
        start = task.start
        place = (start.x, start.y, start.yaw) if isinstance(start, PlacedStart) else ("", "", "")
        measured = asdict(drive)
        if index == 0:
            writer.writerow(["number", "cell", "seed", "x", "y", "heading_deg", *measured])
        numbers = (f"{v:.4g}" if isinstance(v, float) else v for v in measured.values())
        writer.writerow([index, task.cell, task.seed, *place, *numbers])
    return out.getvalue()


def percent(row: Result) -> str:
    """A success rate with its interval."""
    low, high = row["ci95"]
    return f"{100 * row['success']:.1f}% ({100 * low:.1f} to {100 * high:.1f}%)"


def success_table(results: Mapping[str, Result]) -> str:
    """Success of several on one examination, in Markdown; a grid's beside the paper's."""
    tables = {name: labelled(result) for name, result in results.items()}
    is_grid = any("headings" in result for result in results.values())
    head = ["heading" if is_grid else "", *tables, *(PAPER_COLUMNS if is_grid else ())]
    lines = [head, ["---"] * len(head)]
    for row in next(iter(tables.values())):
        cells = [percent(table[row]) if row in table else "" for table in tables.values()]
        if is_grid:
            cells += [f"{value:.1f}%" for value in PAPER[row]] if row in PAPER else [""] * len(PAPER_COLUMNS)
        lines.append([WORDS.get(row, row), *cells])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


MEASURED = {
    "dolly_contact": ("dolly contact", 100, "%"),
    "other_contact": ("other contact", 100, "%"),
    "timeout": ("time-out", 100, "%"),
    "spl": ("SPL", 1, ""),
    "sct": ("SCT", 1, ""),
    "cvar10": ("success at the worst tenth of positions", 100, "%"),
    "time": ("time to dock", 1, " s"),
    "path_length": ("path", 1, " m"),
    "lateral_error": ("lateral error", 1000, " mm"),
    "yaw_error_deg": ("yaw error", 1, " deg"),
    "far_side": ("docked from the far side", 100, "%"),
    "reversals": ("reversals", 1, ""),
    "jerk": ("jerk (RMS)", 1, " m/s^3"),
}
"""Measures with their name in tables, factor and unit; means over successes but for the first six."""


def measure_table(results: Mapping[str, Result]) -> str:
    """Everything else of several on one examination, in Markdown."""
    lines = [["", *results], ["---"] * (1 + len(results))]
    for key, (name, factor, unit) in MEASURED.items():
        values = [result["all"].get(key) for result in results.values()]
        if any(value is not None for value in values):
            lines.append([name, *("-" if v is None else f"{factor * v:.3g}{unit}" for v in values)])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def as_text(result: Result) -> str:
    """A result in lines for a terminal."""
    lines = []
    for name, row in labelled(result).items():
        kinds = ("dolly_contact", "other_contact", "timeout")
        others = ", ".join(f"{kind.replace('_', ' ')} {100 * row[kind]:.1f}%" for kind in kinds)
        lines.append(f"{WORDS.get(name, name):>29}: success {percent(row)}, {others}")
    measured = [
        f"{name} {factor * value:.3g}{unit}"
        for key, (name, factor, unit) in list(MEASURED.items())[3:]
        if (value := result["all"].get(key)) is not None and math.isfinite(value)
    ]
    return "\n".join([*lines, "  " + ", ".join(measured)]) + "\n"
