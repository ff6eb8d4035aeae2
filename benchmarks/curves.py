"""Trainings that differ in a few settings: success on suite `train` over environment steps.

    python benchmarks/curves.py --out docs/recipe.png default 1-step:sac.n_step=1 rnd:variant=rnd

trains one run after another, seed and minutes alike, into runs/curve-NAME-MINUTES-SEED (nothing else should
run beside), then examines every snapshot. What is there already is not done again. Of a single training it
draws how the episodes ended, too. Needs matplotlib: pip install 'navaclq[plots]'.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import typer

from actor.evaluation.figures import COLOURS

SNAPSHOT_STEPS = 15_000
Curve = dict[int, dict[str, Any]]


def navaclq(*arguments: object) -> dict[str, Any]:
    """What a command prints as JSON; its progress is seen on stderr."""
    command = [sys.executable, "-m", "deploy.cli", *map(str, arguments), "--json"]
    found: dict[str, Any] = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)
    return found


def train(variant: str, folder: Path, minutes: float, seed: int) -> tuple[str, Path]:
    """The name and the run of NAME:section.key=value;..., or NAME:variant=VARIANT;..."""
    name, _, settings = variant.partition(":")
    run = folder / f"curve-{name}-{minutes:g}min-seed{seed}"
    if not (run / "result.json").exists():
        if (run / "run.json").exists():
            raise typer.BadParameter(f"{run} was interrupted; remove it, and it is trained anew")
        chosen = [f"learner.snapshot_steps={SNAPSHOT_STEPS}", *filter(None, settings.split(";"))]
        options = [
            part
            for setting in chosen
            for part in (["--variant", setting[8:]] if setting.startswith("variant=") else ["--set", setting])
        ]
        navaclq("train", "--run", run, "--minutes", minutes, "--seed", seed, *options)
    return name, run


def examine(run: Path, every: int) -> Curve:
    """Summaries on suite `train` by environment steps, one for every so-many-th snapshot and the last."""
    found = {}
    snapshots = sorted(path for path in (run / "snapshots").iterdir() if path.name.isdecimal())
    for snapshot in [*snapshots[every - 1 :: every], run / "snapshots" / "final"]:
        kept = run / "evaluation" / f"{snapshot.name}.json"
        if not kept.exists():
            kept.parent.mkdir(exist_ok=True)
            kept.write_text(json.dumps(navaclq("evaluate", snapshot, "--suite", "train")["all"]))
        steps = json.loads((snapshot / "state.json").read_text())["env_steps"]
        found[steps] = json.loads(kept.read_text())
    return dict(sorted(found.items()))


def draw_success(axes: plt.Axes, name: str, curve: Curve) -> None:
    """Success over steps, with its interval."""
    low, high = zip(*(found["ci95"] for found in curve.values()), strict=True)
    axes.plot(curve.keys(), [100 * found["success"] for found in curve.values()], marker="o", label=name)
    axes.fill_between(curve.keys(), [100 * v for v in low], [100 * v for v in high], alpha=0.15)


def draw_endings(axes: plt.Axes, curve: Curve) -> None:
    """How the episodes ended, one above the other."""
    shares = [[100 * found[ending] for found in curve.values()] for ending in COLOURS]
    labels = [ending.replace("_", " ") for ending in COLOURS]
    axes.stackplot(list(curve), shares, labels=labels, colors=list(COLOURS.values()))
    axes.set(xlabel="environment steps", ylabel="episodes, %", ylim=(0, 100))
    axes.legend(loc="lower right")


def main(
    variants: Annotated[
        list[str], typer.Argument(help="NAME, or NAME: and section.key=value or variant=VARIANT, split by ;")
    ],
    out: Annotated[Path, typer.Option(help="PNG file to draw.")],
    folder: Annotated[Path, typer.Option(help="Where the runs are kept.")] = Path("runs"),
    minutes: Annotated[float, typer.Option(help="Minutes of each training.")] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of each training.")] = 1,
    every: Annotated[int, typer.Option(min=1, help="Examine every so-many-th snapshot.")] = 1,
) -> None:
    """Trains, examines and draws."""
    curves = {name: examine(run, every) for name, run in [train(v, folder, minutes, seed) for v in variants]}
    alone = len(curves) == 1
    figure, panels = plt.subplots(
        1, 1 + alone, figsize=(7 + 4 * alone, 4), layout="constrained", squeeze=False
    )
    for name, curve in curves.items():
        draw_success(panels[0, 0], name, curve)
        for steps, found in curve.items():
            sys.stdout.write(f"{name}: {json.dumps({'env_steps': steps, **found})}\n")
    panels[0, 0].set(xlabel="environment steps", ylabel="success on suite train, %", ylim=(0, 100))
    panels[0, 0].set_title(
        f"{minutes:g} minutes, seed {seed}; bands: 95% intervals of 400 tasks", fontsize=10
    )
    panels[0, 0].grid(alpha=0.3)
    if alone:
        draw_endings(panels[0, 1], next(iter(curves.values())))
    else:
        panels[0, 0].legend()
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    typer.run(main)
