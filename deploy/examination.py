"""What `navaclq evaluate` says and writes: JSON, lines, tables, episodes and figures."""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from common.world_config import WorldConfig
from deploy.cli import options

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        where = f" in the {result['arena']} arena" if "arena" in result else ""
        lines.append(f"{label} on {result['suite']}{where}, {result['episodes']} episodes, {how}\n")
        lines += [f"  not the default world: {key} = {value}\n" for key, value in result["own_rules"].items()]
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
    world: WorldConfig,
    driven: dict[str, list[Drive]],
    rows: dict[str, list[Measures]],
    results: dict[str, Result],
    paired: dict[str, Any] | None,
) -> None:
    """Tables, episodes and, where matplotlib is installed, figures; scenes are drawn as in `world`."""
    first = next(iter(results.values()))
    how = "sampled" if first["sampled"] else "greedy"
    title = ", ".join([examination.name, *([f"{first['arena']} arena"] if examination.is_grid else []), how])
    stem = f"{title.replace(' arena', '').replace(', ', '-')}-seed{first['seed']}"
    text = f"# {title}\n\n{success_table(results)}\n{measure_table(results)}\n"
    if paired or len(results) > 1:
        text += "```\n" + as_lines(results, paired) + "```\n"
    options.write_file(out / f"{stem}.md", text.encode())
    for index, name in enumerate(driven):
        file = out / f"{stem}-{index}-{Path(name).name}.csv"
        options.write_file(file, as_rows(examination.tasks, rows[name]).encode())
    try:
        from actor.evaluation import figures
    except ImportError:
        sys.stderr.write("no figures: they need matplotlib, pip install 'navaclq[plots]'\n")
        return
    tasks = examination.tasks
    for index, (name, drives) in enumerate(driven.items()):
        said = f"{name} on {title}: {100 * results[name]['all']['success']:.1f}%".replace("$", r"\$")
        if examination.is_grid:
            pictures = {"map": figures.grid_map(tasks, drives, said)}
            pictures["failures"] = figures.failure_map(tasks, drives, said)
        else:
            pictures = {"drives": figures.suite_map(drives, said)}
        for kind, picture in pictures.items():
            _write_figure(out / f"{stem}-{kind}-{index}-{Path(name).name}.png", picture)
    ways = figures.trajectories(tasks, driven, figures.pictured(tasks), world)
    _write_figure(out / f"{stem}-trajectories.png", ways)


def _write_figure(file: Path, picture: Figure) -> None:
    content = BytesIO()
    picture.savefig(content, dpi=100)
    options.write_file(file, content.getvalue())
