"""What `navaclq evaluate` says and writes: JSON, lines, tables, episodes and figures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from actor.evaluation.measures import Drive, Measures
from actor.evaluation.report import (
    Result,
    as_rows,
    as_text,
    measure_table,
    over_policies,
    success_table,
)
from actor.evaluation.suites import Examination
from common.config import resolve
from deploy.cli import options


def as_json_object(results: dict[str, Result], paired: dict[str, Any] | None) -> dict[str, Any]:
    """One policy's result; of several theirs and what they have in common."""
    found = list(results.values())
    if paired:
        return {**found[0], "compared": paired}
    if len(found) == 1:
        return found[0]
    common = {key: found[0][key] for key in ("suite", "seed", "episodes", "sampled")}
    return {**common, "policies": found, "over_policies": over_policies(found)}


def as_lines(results: dict[str, Result], paired: dict[str, Any] | None) -> str:
    """The same for people."""
    lines = []
    for label, result in results.items():
        how = "sampled" if result["sampled"] else "greedy"
        lines.append(f"{label} on {result['suite']}, {result['episodes']} episodes, {how}\n")
        lines += [f"  in a world of its own: {key} = {value}\n" for key, value in result["own_rules"].items()]
        lines.append(as_text(result))
    if paired:
        low, high = (100 * bound for bound in paired["ci95"])
        first, points = next(iter(results)), f"{100 * paired['difference']:+.1f} points"
        lines += [
            f"{first} less {paired['policy']}, in pairs: {points} (95% interval {low:+.1f} to {high:+.1f}), ",
            f"p = {paired['p_value']:.2g}; the first alone docked {paired['only_ours']} times, the second ",
            f"{paired['only_theirs']} times\n",
        ]
    elif len(results) > 1:
        lines.append(f"over {len(results)} policies, success in all rows: mean, standard deviation, range\n")
        for name, row in over_policies(list(results.values())).items():
            mean, sd, low, high = (100 * row[key] for key in ("mean", "sd", "min", "max"))
            lines.append(f"{name:>10}: {mean:.1f}%, {sd:.1f}, {low:.1f} to {high:.1f}%\n")
    return "".join(lines)


def write_report(
    out: Path,
    examination: Examination,
    driven: dict[str, list[Drive]],
    rows: dict[str, list[Measures]],
    results: dict[str, Result],
    paired: dict[str, Any] | None,
) -> None:
    """Tables, episodes and, where matplotlib is installed, figures."""
    name = examination.name
    text = f"# {name}\n\n{success_table(results)}\n{measure_table(results)}"
    if paired:
        text += f"\n{as_lines(results, paired).splitlines()[-1]}\n"
    options.write_file(out / f"{name}.md", text.encode())
    for index, label in enumerate(driven):
        file = out / f"{name}-{index}-{Path(label).name}.csv"
        options.write_file(file, as_rows(examination.tasks, rows[label]).encode())
    try:
        from actor.evaluation import figures
    except ImportError:
        sys.stderr.write("no figures: they need matplotlib, pip install 'navaclq[plots]'\n")
        return
    is_grid = name.startswith("grid-")
    for index, (label, drives) in enumerate(driven.items()):
        ending = f"{index}-{Path(label).name}.png"
        title = f"{label} on {name}: {100 * results[label]['all']['success']:.1f}%"
        if is_grid:
            pictures = {
                "map": figures.grid_map(examination.tasks, drives, title),
                "failures": figures.failure_map(examination.tasks, drives, title),
            }
        else:
            pictures = {"drives": figures.suite_map(drives, title)}
        for kind, picture in pictures.items():
            picture.savefig(out / f"{name}-{kind}-{ending}", dpi=100)
    world = resolve(overrides=examination.overrides).world
    chosen = figures.pictured(examination.tasks)
    picture = figures.trajectories(examination.tasks, driven, chosen, world)
    picture.savefig(out / f"{name}-trajectories.png", dpi=100)
