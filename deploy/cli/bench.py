"""`navaclq bench`: measurements that anybody can repeat."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from common.errors import UsageError
from deploy.bench.report import Report
from deploy.cli import options

app = typer.Typer(help="Measure parts against their rivals and limits.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Measure parts against their rivals and limits, all in one run; ratios, higher is better."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # its processes end with it, as by Ctrl-C


@app.command()
def bus(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; about 4 s each.")] = 20,
    load: Annotated[
        int, typer.Option(min=0, max=256, help="Actors that send to a real learner at full rate; 0: none.")
    ] = 64,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long they send.")] = 12.0,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Acknowledged, logged delivery against bare Zenoh and ZeroMQ; a learner under load."""
    resolved = options.configuration("fast", None, None, None, seed)
    from deploy.bench.bus import bench_bus

    with options.progress("rounds", rounds) as done:
        report = bench_bus(resolved, rounds, load, seconds, done)
    _print(report, as_json)


@app.command()
def curriculum(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; about 3 s each.")] = 10,
    actors: Annotated[int, typer.Option(min=1, max=1024, help="Actors that ask in the third window.")] = 64,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """How long a task takes beside a learner that updates, against a bare query; with many actors."""
    resolved = options.configuration("fast", None, None, None, seed)
    from deploy.bench.curriculum import bench_curriculum

    with options.progress("rounds", rounds) as done:
        report = bench_curriculum(resolved, rounds, actors, done)
    _print(report, as_json)


@app.command()
def encoder(
    frames: Annotated[Path, typer.Option(help="Folder of frames that `navaclq pretrain` has gathered.")],
    epochs: Annotated[int, typer.Option(min=1, help="Epochs for each size.")] = 4,
    preset: options.Preset = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Sizes of the image encoder: what linear probes read in the validation arena against time per frame."""
    chosen = [*(settings or ()), f"pretraining.epochs={epochs}"]
    resolved = options.configuration(preset, None, config, chosen, seed)
    from deploy.bench.encoder import SIZES, bench_encoder
    from deploy.pretraining import film_probes
    from learner.pretraining.frame_store import FrameStore

    if not frames.is_dir():
        raise UsageError(f"--frames {frames} is no folder; `navaclq pretrain` makes one")
    store = FrameStore(frames, resolved)
    if not store.complete:
        raise UsageError(f"{frames} holds {store.sequences} sequences; `navaclq pretrain` gathers the rest")
    with options.progress("drives filmed", 3 * resolved.pretraining.probe_drives) as done:
        tables = film_probes(resolved, done)
    with options.progress("sizes", len(SIZES)) as report:
        found = bench_encoder(resolved, store, tables, report)
    _print(found, as_json)


@app.command()
def learner(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; about 2 s each.")] = 20,
    soak: Annotated[
        int, typer.Option(min=0, help="Updates of small networks at the end to see how much memory grows.")
    ] = 0,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """SAC updates per second, batches of 256, against stable-baselines3 and the matrix products alone."""
    alike = ["sac.batch_size=256", "sac.policy_delay=1", "sac.n_step=1", "network.layer_norm=false"]
    resolved = options.configuration("fast", None, None, alike, seed)
    from deploy.bench.learner import bench_learner, soak_learner

    with options.progress("rounds", rounds) as done:
        report = bench_learner(resolved, rounds, done)
    if soak:
        with options.progress("updates", soak) as done:
            report.add(f"rss_growth_over_{soak}_updates", soak_learner(resolved, soak, done), "MB")
    else:
        report.skipped.append("growth of memory: ask for it with --soak UPDATES")
    _print(report, as_json)


@app.command()
def replay(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; about 0.1 s each.")] = 100,
    capacity: Annotated[
        int, typer.Option(min=10_000, help="Transitions; rivals take 2.7 KB each, this one 0.7 KB.")
    ] = 2**20,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Sampling, gathering and priorities of batches of 256, against cpprb and TorchRL."""
    chosen = [f"replay.capacity={capacity}", "sac.batch_size=256", "sac.policy_delay=1"]
    resolved = options.configuration("fast", None, None, chosen, seed)
    from deploy.bench.replay import bench_replay

    with options.progress("rounds", rounds) as done:
        report = bench_replay(resolved, rounds, done)
    _print(report, as_json)


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
    _print(report, as_json)


def _print(report: Report, as_json: bool) -> None:
    if as_json:
        options.print_json(report.to_json())
    else:
        sys.stdout.write(report.to_text())
