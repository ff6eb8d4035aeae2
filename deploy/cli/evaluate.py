"""`navaclq evaluate`: a policy on a fixed suite, or on the grid test, with confidence intervals."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from common.config import Config, differing_keys, resolve
from common.errors import UsageError
from common.messages import Ending
from common.tasks import GRID_HEADINGS, PlacedStart, Task, grid
from common.tasks import suite as suite_tasks
from deploy.cli import options

if TYPE_CHECKING:
    from actor.evaluation import Scripted

REPEATS = {"quick": 1, "paper": 9}


def find_policy(name: str, config: Config) -> Path | Scripted:
    """The policy meant by `name`: a folder, of a run its newest snapshot, or b0 in the world of `config`."""
    if name == "b0":
        from actor.evaluation import Scripted

        return Scripted(config)
    path = Path(name)
    if not path.exists():
        raise UsageError(
            f"policy {path} does not exist; give a run directory, a checkpoint, a snapshot, or b0"
        )
    if not (path / "run.json").exists():
        return path
    found = [p for p in (path / "snapshots").glob("*") if p.suffix != ".part"]
    if not found:
        raise UsageError(f"{path} holds no snapshot of a policy yet")
    return max(found, key=lambda snapshot: snapshot.stat().st_mtime_ns)


def own_rules(policy: Path | Scripted) -> dict[str, Any]:
    """The settings of a policy's world other than the default: it is examined in its own world."""
    if not isinstance(policy, Path):
        return {}
    from common.policy_files import load_policy

    return {key: value for key, value, _ in differing_keys(load_policy(policy)[0], Config(), ("world.",))}


def run_tasks(
    policy: Path | Scripted,
    tasks: list[Task],
    processes: int | None,
    label: str,
    greedy: bool = True,
    seed: int = 0,
    max_steps: int | None = None,
) -> list[Ending]:
    """How a policy ends each task, with a progress bar on stderr; by default one process per core."""
    from actor.evaluation import evaluate

    with options.progress(label, len(tasks)) as report:
        return evaluate(policy, tasks, processes or os.cpu_count() or 1, greedy, seed, report, max_steps)


def summary(endings: list[Ending]) -> dict[str, Any]:
    """Rates of the endings, and the 95% interval of success."""
    from actor.evaluation import rates, wilson_interval

    return {**rates(endings), "ci95": list(wilson_interval(endings.count("success"), len(endings)))}


def by_heading(tasks: list[Task], endings: list[Ending]) -> dict[str, Any]:
    """Summaries of a grid test: of every heading, inside the training range (up to 90 deg) and outside it."""
    groups: dict[str, list[Ending]] = {str(heading): [] for heading in GRID_HEADINGS}
    for task, ending in zip(tasks, endings, strict=True):
        assert isinstance(task.start, PlacedStart)
        groups[str(round(task.start.yaw))].append(ending)
    parts = {True: list[Ending](), False: list[Ending]()}
    for heading, found in groups.items():
        parts[abs(int(heading)) <= 90] += found
    return {
        "headings": {heading: summary(found) for heading, found in groups.items()},
        "inside": summary(parts[True]),
        "outside": summary(parts[False]),
    }


def evaluate(
    policy: Annotated[
        str, typer.Argument(help="Run directory, checkpoint, snapshot, or b0: the scripted controller.")
    ],
    suite: Annotated[
        str | None,
        typer.Option(
            help="short: 100 near, straight starts; train: 400 of the full distribution (the default)."
        ),
    ] = None,
    grid_test: Annotated[
        Literal["quick", "paper"] | None,
        typer.Option(
            "--grid", help="Instead of a suite the grid test: quick 968 starts, paper 9 times each."
        ),
    ] = None,
    arena: Annotated[
        str | None,
        typer.Option(help="Where the grid is: validation (the default), or test for final results."),
    ] = None,
    sampled: Annotated[
        bool, typer.Option("--sampled", help="Sample actions, as in training, instead of the greedy ones.")
    ] = False,
    processes: options.Processes = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**20, help="Seed of sampled actions and of a grid's scenes.")
    ] = 0,
    as_json: options.Json = False,
) -> None:
    """Drive a policy through fixed, seeded tasks and count how the episodes end."""
    config = resolve()
    if grid_test and suite:
        raise UsageError("--suite and --grid exclude each other; drop one of them")
    if arena and not grid_test:
        raise UsageError("--arena says where a grid is; add --grid quick or --grid paper")
    suite, arena = suite or "train", arena or "validation"
    tasks = grid(arena, REPEATS[grid_test], seed) if grid_test else suite_tasks(suite, config)
    name = f"grid-{grid_test}" if grid_test else suite
    found = find_policy(policy, config)
    label = policy if policy == "b0" else str(found)
    endings = run_tasks(found, tasks, processes, f"{label} on {name}", not sampled, seed)
    result: dict[str, Any] = {"policy": label, "suite": name, "seed": seed, "episodes": len(tasks)}
    result |= {"sampled": sampled, "all": summary(endings), "own_rules": own_rules(found)}
    if grid_test:
        result |= {"arena": arena, **by_heading(tasks, endings)}
    if as_json:
        options.print_json(result)
        return
    sys.stdout.write(f"{label} on {name}, {len(tasks)} episodes\n")
    for key, value in result["own_rules"].items():
        sys.stdout.write(f"  in a world of its own: {key} = {value}\n")
    rows = {"all": result["all"]}
    if grid_test:
        rows |= {"inside": result["inside"], "outside": result["outside"], **result["headings"]}
    for row, rates in rows.items():
        low, high = rates["ci95"]
        others = ", ".join(
            f"{k.replace('_', ' ')} {100 * rates[k]:.1f}%" for k in rates if k not in ("success", "ci95")
        )
        sys.stdout.write(
            f"{row:>8}: success {100 * rates['success']:.1f}% "
            f"(95% interval {100 * low:.1f} to {100 * high:.1f}%), {others}\n"
        )
