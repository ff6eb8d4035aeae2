"""`navaclq world`: looking at the docking world."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from common.errors import UsageError
from common.tasks import Task, check_cell
from deploy.cli import options

app = typer.Typer(help="Look at the docking world.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Look at the docking world."""


@app.command()
def preview(
    out: Annotated[Path, typer.Option(help="PNG file to write.")],
    cell: Annotated[int, typer.Option(help="Training cell, 0 to 8.")] = 0,
    seed: Annotated[int, typer.Option(min=0, max=2**53 - 1, help="Seed of the task.")] = 0,
    steps: Annotated[int, typer.Option(min=0, max=1000, help="Random control steps to drive first.")] = 0,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """Draw a start: from above with LiDAR beams, from behind, through the camera, with the task's numbers."""
    check_cell(cell)
    if out.suffix.lower() != ".png":
        raise UsageError(f"--out {out} must end in .png")
    if not out.resolve().parent.is_dir():
        raise UsageError(f"--out {out}: the folder {out.resolve().parent} does not exist")
    resolved = options.configuration(None, None, config, settings, None)
    from actor.world.views import preview as draw
    from actor.world.world import DockingWorld

    world = DockingWorld(resolved.world, max_steps=steps + 1)
    try:
        world.reset(Task(cell=cell, seed=seed, start=resolved.world.start))
        rng = np.random.default_rng(seed)
        for _ in range(steps):
            if world.step(rng.uniform(-1, 1, 2)).ending:
                break
        draw(world).save(out)
    finally:
        world.close()
    sys.stdout.write(f"{out}\n")
