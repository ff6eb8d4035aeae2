"""All algorithms of the curriculum on the synthetic world: tasks until its learner solves 90%.

    python benchmarks/algorithms.py --seeds 5 --most 10000 > table.md

Each from the same seeds; see curriculum/synthetic_world.py. The Brier score is that of the predictions made
before each outcome, over the best possible one (1 is perfect). Some minutes on one core.
"""

from __future__ import annotations

import sys
import time
from statistics import median
from typing import Annotated

import numpy as np
import typer

from common.config import Config, resolve
from curriculum.synthetic_world import SyntheticWorld

NO_GATE = "curriculum.gate.enabled=false"
PAPER_INPUTS = "curriculum.inputs=['distance','agent_clearance','goal_clearance','relative_angle','q']"
ROWS: dict[str, tuple[str, tuple[str, ...]]] = {
    "NavACL-Q+": ("navacl-q", (NO_GATE,)),
    "NavACL-Q+, calibrated": ("navacl-q", (NO_GATE, "curriculum.calibrate=true")),
    "NavACL-Q+, calibrated, averaged": (
        "navacl-q",
        (NO_GATE, "curriculum.calibrate=true", "curriculum.average=0.99"),
    ),
    "NavACL-Q+, class-balanced": ("navacl-q", (NO_GATE, "curriculum.balanced=true")),
    "NavACL-Q+, both": ("navacl-q", (NO_GATE, "curriculum.balanced=true", "curriculum.calibrate=true")),
    "NavACL-Q+, the paper's inputs": ("navacl-q", (NO_GATE, PAPER_INPUTS)),
    "NavACL-Q+, full ranges only": ("navacl-q", (NO_GATE, "curriculum.narrowed_candidates=0")),
    "NavACL-Q+ on Q alone": ("q-only", (NO_GATE,)),
    "NavACL+ (four properties, no Q)": ("navacl", (NO_GATE,)),
    "NavACL-Q to the letter": ("navacl-q-letter", ()),
    "NavACL-Q to the letter, f_pi fitted fast": (
        "navacl-q-letter",
        ("curriculum.fit_steps=8", "curriculum.learning_rate=4e-3"),
    ),
    "schedule": ("schedule", ()),
    "SFL": ("sfl", ()),
    "RND": ("rnd", ()),
}


def teach(config: Config, seed: int, most: int) -> tuple[int | None, float | None]:
    """Tasks needed, None if more than `most`; and Brier score over the best one, None without predictions."""
    world = SyntheticWorld(config, seed)
    errors, best = list[float](), list[float]()
    while world.tasks < most and world.success < 0.9:
        for _ in range(10):
            before = world.skill
            pick = world.step()
            if pick.f is not None:
                p = world.probability(pick.entry, before)
                errors.append((pick.f - p) ** 2)
                best.append(p * (1 - p))
    ratio = 1 + float(np.sum(errors) / np.sum(best)) if errors else None
    return (world.tasks if world.success >= 0.9 else None), ratio


def main(
    seeds: Annotated[int, typer.Option(min=1, help="Lessons of each algorithm.")] = 5,
    most: Annotated[int, typer.Option(min=10, help="Tasks after which a lesson is given up.")] = 10_000,
    only: Annotated[str, typer.Option(help="Rows whose name contains this.")] = "",
) -> None:
    """Prints the table as Markdown; progress on stderr."""
    print("| algorithm | tasks to 90%: median | of each seed | Brier score over the best |")
    print("|---|---|---|---|")
    for name, (variant, overrides) in ROWS.items():
        if only not in name:
            continue
        config, began = resolve("fast", variant=variant, overrides=overrides), time.monotonic()
        found = [teach(config, seed, most) for seed in range(seeds)]
        tasks = sorted(n if n is not None else most + 1 for n, _ in found)
        ratios = [ratio for _, ratio in found if ratio is not None]
        said = ["> " + f"{most:,}" if n > most else f"{n:,}" for n in (median(tasks), *tasks)]
        brier = f"{median(ratios):.2f}" if ratios else "-"
        print(f"| {name} | {said[0]} | {', '.join(said[1:])} | {brier} |", flush=True)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    typer.run(main)
