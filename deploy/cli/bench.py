"""`navaclq bench`: measurements that anybody can repeat."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from deploy.cli import options

app = typer.Typer(help="Measure parts against their rivals and limits.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Measure parts against their rivals and limits, all in one run; ratios, higher is better."""


@app.command()
def sim(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; about 1.5 s each.")] = 40,
    soak: Annotated[
        int, typer.Option(min=0, help="Steps to drive at the end to see how much memory grows.")
    ] = 0,
    preset: options.Preset = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """The simulator against the raw pybullet calls of its steps, on one core."""
    resolved = options.configuration(preset, None, config, settings, seed)
    from deploy.bench.sim import bench_sim

    with options.progress("rounds", rounds) as done:
        report = bench_sim(resolved, rounds, soak, done)
    if as_json:
        options.print_json(report.to_json())
    else:
        sys.stdout.write(report.to_text())
