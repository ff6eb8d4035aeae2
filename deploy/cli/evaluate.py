"""`navaclq evaluate`: a policy on a fixed suite of tasks."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from common.config import resolve
from common.errors import UsageError
from common.tasks import suite as suite_tasks
from deploy.cli import options


def find_policy(path: Path) -> Path:
    """The policy folder meant by `path`: itself, or of a run its newest snapshot."""
    if not path.exists():
        raise UsageError(f"policy {path} does not exist; give a run directory, a checkpoint or a snapshot")
    if not (path / "run.json").exists():
        return path
    found = [p for p in (path / "snapshots").glob("*") if p.suffix != ".part"]
    if not found:
        raise UsageError(f"{path} holds no snapshot of a policy yet")
    return max(found, key=lambda snapshot: snapshot.stat().st_mtime_ns)


def run_suite(
    policy: Path, suite: str, processes: int, greedy: bool, seed: int, label: str
) -> dict[str, float]:
    """Rates of the endings of a policy on a suite, with a progress bar on stderr."""
    from actor.evaluation import evaluate, rates
    from common.policy_files import load_policy

    config = load_policy(policy)[0]
    tasks = suite_tasks(suite, config)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        row = bar.add_task(f"{label} on {suite}", total=len(tasks))
        endings = evaluate(
            policy, tasks, processes, greedy, seed, lambda done: bar.update(row, completed=done)
        )
    return rates(endings)


def evaluate(
    policy: Annotated[Path, typer.Argument(help="Run directory, checkpoint or snapshot.")],
    suite: Annotated[
        str, typer.Option(help="short: 100 near, straight starts; train: 400 of the full distribution.")
    ] = "train",
    sampled: Annotated[
        bool, typer.Option("--sampled", help="Sample actions, as in training, instead of the greedy ones.")
    ] = False,
    processes: Annotated[
        int | None, typer.Option(min=1, max=64, help="Worker processes; default: one per core.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of sampled actions.")] = 0,
    as_json: options.Json = False,
) -> None:
    """Drive a policy through a fixed suite of seeded tasks and count how the episodes end."""
    from actor.evaluation import wilson_interval

    suite_tasks(suite, resolve())
    folder = find_policy(policy)
    workers = processes or os.cpu_count() or 1
    found = run_suite(folder, suite, workers, not sampled, seed, str(folder))
    size = len(suite_tasks(suite, resolve()))
    low, high = wilson_interval(round(found["success"] * size), size)
    result: dict[str, Any] = {"policy": str(folder), "suite": suite, "seed": seed, "episodes": size}
    result |= {"sampled": sampled, "all": {**found, "ci95": [low, high]}}
    if as_json:
        options.print_json(result)
    else:
        text = ", ".join(f"{name.replace('_', ' ')} {100 * rate:.1f}%" for name, rate in found.items())
        interval = f"95% interval of success {100 * low:.1f} to {100 * high:.1f}%"
        sys.stdout.write(f"{folder} on suite {suite} ({size} episodes): {text}; {interval}\n")
