"""Training with several encoders, seed and minutes alike: success on suite `train` over environment steps.

    python benchmarks/encoder_curves.py --out docs/encoder_curves.png fast runs/plain/encoder random

trains one run after another into runs/curve-NAME (nothing else should run beside it), then examines every
snapshot. What is there already is not done again. Needs matplotlib: pip install 'navaclq[plots]'.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import typer

SNAPSHOT_STEPS = 15_000


def navaclq(*arguments: object) -> dict[str, Any]:
    """What a command prints as JSON; its progress is seen on stderr."""
    command = [sys.executable, "-m", "deploy.cli.main", *map(str, arguments), "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)
    return found


def train(weights: str, folder: Path, minutes: float, seed: int) -> Path:
    """The run with this encoder."""
    run = folder / f"curve-{weights.replace('/', '-')}"
    if not (run / "result.json").exists():
        settings = (f"encoder.weights={weights}", f"learner.snapshot_steps={SNAPSHOT_STEPS}")
        options = [part for setting in settings for part in ("--set", setting)]
        navaclq("train", "--run", run, "--minutes", minutes, "--seed", seed, *options)
    return run


def examine(run: Path) -> dict[int, dict[str, Any]]:
    """Summaries on suite `train` by environment steps, one for each snapshot."""
    found = {}
    for snapshot in sorted((run / "snapshots").glob("[0-9f]*")):  # not the untrained one
        kept = run / "evaluation" / f"{snapshot.name}.json"
        if not kept.exists():
            kept.parent.mkdir(exist_ok=True)
            kept.write_text(json.dumps(navaclq("evaluate", snapshot, "--suite", "train")["all"]))
        steps = json.loads((snapshot / "state.json").read_text())["env_steps"]
        found[steps] = json.loads(kept.read_text())
    return dict(sorted(found.items()))


def main(
    encoders: Annotated[list[str], typer.Argument(help="fast, paper, random, or encoders' folders.")],
    out: Annotated[Path, typer.Option(help="PNG file to draw.")],
    folder: Annotated[Path, typer.Option(help="Where the runs are kept.")] = Path("runs"),
    minutes: Annotated[float, typer.Option(help="Minutes of each training.")] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of each training.")] = 1,
) -> None:
    """Trains, examines and draws."""
    runs = {weights: train(weights, folder, minutes, seed) for weights in encoders}
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for weights, run in runs.items():
        curve = examine(run)
        success = [100 * found["success"] for found in curve.values()]
        low, high = zip(*(found["ci95"] for found in curve.values()), strict=True)
        axes.plot(curve.keys(), success, marker="o", label=weights)
        axes.fill_between(curve.keys(), [100 * v for v in low], [100 * v for v in high], alpha=0.15)
        last = list(curve.items())[-1]
        sys.stdout.write(f"{weights}: {json.dumps({'env_steps': last[0], **last[1]})}\n")
    axes.set(xlabel="environment steps", ylabel="success on suite train, %", ylim=(0, None))
    axes.set_title(f"{minutes:g} minutes, seed {seed}; bands: 95% intervals of 400 tasks", fontsize=10)
    axes.legend(title="frozen encoder")
    axes.grid(alpha=0.3)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    typer.run(main)
