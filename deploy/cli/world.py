"""`navaclq world`: looking at the docking world, recording drives in it, checking its tasks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from common.cells import CELLS, ROOM_NAMES
from common.errors import UsageError
from deploy.cli import options

if TYPE_CHECKING:
    from PIL import Image

app = typer.Typer(help="Look at the docking world.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Look at the docking world, record drives, check that its tasks can be solved."""


@app.command()
def preview(
    out: Annotated[Path, typer.Option(help="PNG or JPEG file to write.")],
    cell: Annotated[
        str,
        typer.Option(help="Training cell 0 to 8, the arena `validation` or `test`, or `all` side by side."),
    ] = "0",
    seed: options.TaskSeed = 0,
    place: options.Place = None,
    shift: options.Shift = None,
    steps: Annotated[int, typer.Option(min=0, max=1000, help="Random control steps to drive first.")] = 0,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """Draw a start: from above with LiDAR beams, from behind, through the camera, with the task's numbers."""
    options.check_file("--out", out, ".png", ".jpg")
    if cell == "all" and steps:
        raise UsageError("--steps does not go with --cell all, which shows starts")
    resolved = options.configuration(None, None, config, settings, None)
    rooms = ROOM_NAMES if cell == "all" else (cell,)
    tasks = [options.make_task(resolved.world, room, seed, place, shift) for room in rooms]
    from actor.world.views import gallery
    from actor.world.views import preview as draw
    from actor.world.world import DockingWorld

    world = DockingWorld(resolved.world, max_steps=steps + 1)
    try:
        if cell == "all":
            options.write_picture(out, gallery(world, tasks))
            sys.stdout.write(f"{out}\n")
            return
        sensed = world.reset(tasks[0])
        rng = np.random.default_rng(seed)
        for _ in range(steps):
            step = world.step(rng.uniform(-1, 1, 2))
            sensed = step.sensed
            if step.ending:
                break
        options.write_picture(out, draw(world, sensed))
    finally:
        world.close()
    sys.stdout.write(f"{out}\n")


@app.command()
def record(
    policy: Annotated[str, typer.Option(help="Run directory, checkpoint, snapshot, or b0 (scripted).")],
    out: Annotated[Path, typer.Option(help="MP4 file to write.")],
    cell: options.Room = "0",
    seed: options.TaskSeed = 0,
    place: options.Place = None,
    shift: options.Shift = None,
    sampled: Annotated[
        bool, typer.Option("--sampled", help="Sample actions, as in training, instead of the greedy ones.")
    ] = False,
    still: Annotated[Path | None, typer.Option(help="PNG file for one frame.")] = None,
    still_at: Annotated[
        float, typer.Option(min=0, help="Second of the drive that it shows, or its last frame.")
    ] = 3.0,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
) -> None:
    """Film one drive: camera, bird's eye with LiDAR and trail, chase view, action, reward; in real time.

    A trained policy drives in the world that it was trained in; --config and --set are for b0.
    """
    options.check_file("--out", out, ".mp4")
    if still:
        options.check_file("--still", still, ".png")
    from actor.baseline.registry import BASELINES
    from actor.evaluation.examiner import Terms, load_driver
    from actor.recording import drive, write_video
    from deploy.cli.evaluate import find_subject

    if policy not in BASELINES and (config or settings):
        raise UsageError("--config and --set go with a baseline; a trained policy brings its own world")
    subject = find_subject(policy, options.configuration(None, None, config, settings, None))
    rollout, actor = load_driver(subject, Terms(greedy=not sampled), 1)
    world = rollout.worlds[0].config
    task = options.make_task(world, cell, seed, place, shift)
    kept: list[Image.Image] = []
    ending = None

    def frames() -> Iterator[Image.Image]:
        nonlocal ending
        for index, (frame, found) in enumerate(drive(rollout, actor, task)):
            ending = found
            if index <= still_at / world.control_period:
                kept[:] = [frame]
            yield frame

    try:
        count = write_video(out, frames(), world.control_period)
    finally:
        rollout.close()
    if still:
        options.write_picture(still, kept[0])
    sys.stdout.write(f"{out}: {count} frames, {count * world.control_period:.1f} s, {ending}\n")


@app.command()
def check(
    tasks: Annotated[int, typer.Option(min=1, help="Random tasks for each training cell.")] = 1000,
    solve: Annotated[
        int, typer.Option(min=0, help="Random training starts that the scripted controller must dock from.")
    ] = 0,
    processes: options.Processes = None,
    out: Annotated[Path | None, typer.Option(help="Markdown file for the table.")] = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Draw random tasks of every training cell, show their geometric properties, and drive some of them."""
    if out:
        options.check_file("--out", out, ".md")
    resolved = options.configuration(None, None, config, settings, seed)
    from deploy.cli.evaluate import drive
    from deploy.task_table import as_markdown, properties_of_cells, starts_to_solve

    with options.progress("tasks", len(CELLS) * tasks) as report:
        table = properties_of_cells(resolved, tasks, report)
    result = {"seed": resolved.seed, "tasks_per_cell": tasks, "cells": table}
    text = as_markdown(table)
    if solve:
        starts, limit = starts_to_solve(resolved, solve), resolved.world.max_episode_steps
        from actor.evaluation.examiner import Rival, Terms
        from actor.evaluation.measures import rates
        from actor.evaluation.suites import Examination

        examination = Examination("training starts", tuple(starts))
        drives = drive(Rival("b0", resolved), examination, Terms(max_steps=limit), processes)
        found = rates([one.ending for one in drives])
        result["solved"] = {"tasks": solve, "max_steps": limit, **found}
        text += (
            f"\nThe scripted controller (b0), {solve} more such tasks, at most {limit} steps: "
            + ", ".join(f"{name.replace('_', ' ')} {100 * rate:.1f}%" for name, rate in found.items())
        )
    text = text.rstrip() + "\n"
    if out:
        options.write_file(out, text.encode())
    if as_json:
        options.print_json(result)
    else:
        sys.stdout.write(text)
