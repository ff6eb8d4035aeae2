"""`navaclq pretrain`: an image encoder from frames of random drives, and figures of any encoder."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from common.config import Config, Objective
from common.link import Link
from common.signals import exit_on_signals
from deploy.cli import options
from deploy.launcher import free_port

if TYPE_CHECKING:
    from learner.pretraining.trainer import Trainer

COLUMNS = {
    "visibility_accuracy": ("visibility %", 100.0),
    "bearing_mae_deg": ("bearing deg", 1.0),
    "distance_mae_m": ("distance m", 1.0),
    "yaw_mae_deg": ("yaw deg", 1.0),
    "reconstruction_mse": ("pixels MSE", 1.0),
    "mask_iou": ("mask IoU", 1.0),
}


def pretrain(
    run: options.Run = Path("runs/eyes"),
    out: Annotated[
        Path | None, typer.Option(help="Folder for the finished encoder; default: RUN/encoder.")
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option(help="Folder of the frames, which several runs may share; default: RUN/frames."),
    ] = None,
    examined: Annotated[
        str | None,
        typer.Option(
            "--evaluate", help="Train nothing; examine this encoder: fast, paper, or an encoder's folder."
        ),
    ] = None,
    objective: Annotated[
        Objective | None,
        typer.Option(help="reconstruction (the paper's) or semantic; default: the preset's."),
    ] = None,
    sequences: Annotated[
        int | None, typer.Option(min=100, help="Four-frame sequences to gather (default 50000; 1 GB).")
    ] = None,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Times to go through them; default: the preset's.")
    ] = None,
    actors: Annotated[
        int | None, typer.Option(min=0, max=256, help="Actor processes; default: one per core.")
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help="Endpoint for actors of other hosts to join; default: a free port on loopback."),
    ] = None,
    insecure: options.Insecure = False,
    preset: options.Preset = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Pre-train the image encoder: actors gather frames, then it learns; repeat the command to resume."""
    if examined is not None:
        from common.encoders import encoder_folder

        result = _examine(encoder_folder(examined))
        result = {"encoder": examined, **result}
    else:
        link = options.make_link(listen or f"tcp/127.0.0.1:{free_port()}", None, insecure)
        given = {"objective": objective, "sequences": sequences, "epochs": epochs}
        extra = [f"pretraining.{key}={value}" for key, value in given.items() if value is not None]
        directory = _open(run, preset, config, [*(settings or ()), *extra], seed)
        result = _pretrain(directory, out, frames, actors, link)
    if as_json:
        options.print_json(result)
    else:
        _print(result)


def _open(
    run: Path, preset: str | None, file: Path | None, settings: list[str], seed: int | None
) -> tuple[Path, str, Config]:
    """Folder, name and configuration of a run, a new one or one to resume."""
    from common.encoders import RANDOM
    from learner.checkpoint import RunDirectory

    wanted = None
    if not (run / "run.json").exists() or any((preset, file, settings, seed is not None)):
        begin = f"encoder.weights={RANDOM}"  # whatever the preset trains with
        wanted = options.configuration(preset, None, file, [*settings, begin], seed)
    directory = RunDirectory(run, wanted, "pretraining")
    return directory.folder, directory.name, directory.config


def _pretrain(
    directory: tuple[Path, str, Config],
    out: Path | None,
    frames: Path | None,
    actors: int | None,
    link: Link,
) -> dict[str, Any]:
    from deploy.pretraining import check_out, export, gather
    from learner.pretraining.frame_store import FrameStore
    from learner.pretraining.trainer import Trainer

    folder, name, config = directory
    own, out = config.pretraining, out or folder / "encoder"
    count = (os.cpu_count() or 1) if actors is None else actors
    check_out(out)
    store = FrameStore(frames or folder / "frames", config)
    exit_on_signals()
    if not store.complete:
        with options.progress(f"frames from hub {link}", own.sequences) as report:
            gather(store, folder, name, count, link, report, _say)
    table, held_out = store.load()
    trainer = Trainer(config, table, held_out, folder)
    _train(trainer, own.epochs, len(trainer.train_rows))
    with options.progress("drives filmed to examine it", 3 * own.probe_drives) as report:
        quality = export(trainer, out, report)
    return {"encoder": str(out), **quality}


def _train(trainer: Trainer, epochs: int, samples: int) -> None:
    """Trains to the end; a Ctrl-C says what is left of it."""
    try:
        with options.progress("training", epochs * samples) as report:
            trainer.run(
                lambda p: report(
                    p.samples,
                    f"epoch {p.epoch} of {epochs}, loss {p.losses['total']:.4f}, {p.samples_per_s:.0f}/s",
                )
            )
    except SystemExit:
        _say(
            f"interrupted; {trainer.folder / 'checkpoint'} is an encoder that can be used, "
            "and the same command goes on from there"
        )
        raise


def _examine(folder: Path) -> dict[str, Any]:
    from deploy.pretraining import examine, read_model

    config, model = read_model(folder)
    with options.progress("drives filmed to examine it", 3 * config.pretraining.probe_drives) as report:
        return examine(config, model, report)


def _say(words: str) -> None:
    sys.stderr.write(f"{words}\n")


def _print(result: dict[str, Any]) -> None:
    console = Console(width=120)
    console.print(
        f"{result['encoder']} ({result['hash']}): {result['objective']}, {result['sequences']} sequences, "
        f"{result['epochs']} epochs",
        highlight=False,
    )
    table = Table("linear probes", "in", *(title for title, _ in COLUMNS.values()))
    for name, places in result["probes"].items():
        for place, found in places.items():
            values = [f"{found[key] * scale:.3g}" for key, (_, scale) in COLUMNS.items()]
            table.add_row(name, place, *values)
    for place, found in result["decoder"].items():
        values = [f"{found[key] * scale:.3g}" if key in found else "" for key, (_, scale) in COLUMNS.items()]
        table.add_row("own decoder", place, *values)
    console.print(table)
