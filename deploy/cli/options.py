"""Options that several commands share, and the error handling of all."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.progress import Progress, TextColumn

from common import link
from common.access import load_credentials
from common.cells import ROOM_NAMES, check_cell
from common.config import Config, resolve
from common.errors import UsageError
from common.files import write_atomically
from common.link import Link
from common.tasks import DollyShift, PlacedStart, Task
from common.world_config import StartRanges, WorldConfig

if TYPE_CHECKING:
    from PIL import Image

Run = Annotated[Path, typer.Option("--run", help="Run directory; made when it does not exist, else resumed.")]
Preset = Annotated[str | None, typer.Option(help="Starting configuration: fast (default), paper or smoke.")]
Variant = Annotated[
    str | None, typer.Option(help="navacl-q (default), rnd (uniform starts) or e2e (the encoder trains too).")
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="TOML file on top of the preset.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="section.key=value on top of all; may be repeated.")
]
Source = Annotated[
    Path | None,
    typer.Option("--from", help="Begin a new run from the weights of this checkpoint, or of a run's newest."),
]
Seed = Annotated[
    int | None, typer.Option(min=0, max=2**32 - 1, help="Seed of everything random (default 0).")
]
Connect = Annotated[
    str,
    typer.Option(
        envvar="NAVACLQ_CONNECT",
        help="Endpoint of the hub, tcp/HOST:PORT or tls/HOST:PORT; several in order, separated by commas.",
    ),
]
Listen = Annotated[str, typer.Option(help="Endpoint to listen on, tcp/HOST:PORT or tls/HOST:PORT.")]
Certs = Annotated[
    Path | None,
    typer.Option(envvar="NAVACLQ_CERTS", help="Folder of this process's certificate, for tls/HOST:PORT."),
]
Insecure = Annotated[
    bool, typer.Option("--insecure", help="Allow plain TCP beyond loopback: anybody on the way can read it.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Processes = Annotated[
    int | None, typer.Option(min=1, max=64, help="Worker processes; default: one per core.")
]
Minutes = Annotated[
    float | None, typer.Option(min=0.01, help="Minutes from the first environment step to the last update.")
]

Room = Annotated[
    str, typer.Option("--cell", help="Training cell 0 to 8, or the arena `validation` or `test`.")
]
TaskSeed = Annotated[int, typer.Option("--seed", min=0, max=2**53 - 1, help="Seed of the task.")]
Place = Annotated[
    str | None,
    typer.Option(help="Start at X,Y,YAW in the dolly's frame (m, m, degrees; Y < 0 is in front of it)."),
]
Shift = Annotated[
    str | None,
    typer.Option(help="Move the dolly after STEP control steps by X,Y,YAW (m, m, degrees): STEP,X,Y,YAW."),
]

LINE_SECONDS = 10.0
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def configuration(
    preset: str | None, variant: str | None, file: Path | None, settings: list[str] | None, seed: int | None
) -> Config:
    """The configuration that the common options ask for."""
    return resolve(preset, file, tuple(settings or ()), variant, seed)


def make_link(text: str, certs: Path | None, insecure: bool) -> Link:
    """The link that the options --connect or --listen, --certs and --insecure ask for."""
    return link.make_link(text, load_credentials(certs) if certs else None, insecure)


def make_task(world: WorldConfig, room: str, seed: int, place: str | None, shift: str | None) -> Task:
    """The task that the options of `world preview` and `world record` ask for."""
    start: StartRanges | PlacedStart = world.start
    try:
        if place is not None:
            x, y, yaw = (float(part) for part in place.split(","))
            start = PlacedStart(x=x, y=y, yaw=yaw)
    except ValueError:  # pydantic's is one
        raise UsageError(f"--place {place!r} must be X,Y,YAW within 20 m and 180 degrees") from None
    moves = None
    try:
        if shift is not None:
            step, x, y, yaw = (float(part) for part in shift.split(","))
            moves = DollyShift.model_validate({"step": step, "x": x, "y": y, "yaw": yaw})
    except ValueError:
        raise UsageError(
            f"--shift {shift!r} must be STEP,X,Y,YAW: from step 1 on, within 10 m and 180 degrees"
        ) from None
    if room not in ROOM_NAMES:
        raise UsageError(f"--cell {room!r} does not exist; choose one of {', '.join(ROOM_NAMES)}")
    return Task(cell=ROOM_NAMES.index(room), seed=seed, start=start, shift=moves)


def parse_cells(text: str) -> list[int]:
    """Cells from a list such as `0,3-5`; raises UsageError for anything else."""
    cells: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise UsageError(f"--cells {text!r} is no list of cells; write for example 0,3-5")
        cells += range(check_cell(int(first)), check_cell(int(last or first)) + 1)
    if not cells:
        raise UsageError(f"--cells {text!r} names no cell; write for example 0,3-5")
    return cells


def check_file(option: str, file: Path, *suffixes: str) -> None:
    """Raises UsageError unless `file` can be written and says what it is."""
    if file.suffix.lower() not in suffixes:
        raise UsageError(f"{option} {file} must end in {' or '.join(suffixes)}")
    if file.is_dir():
        raise UsageError(f"{option} {file} is a folder; name a file")
    folder = file.resolve().parent
    if not folder.is_dir():
        raise UsageError(f"{option} {file}: the folder {folder} does not exist")
    if not os.access(folder, os.W_OK):
        raise UsageError(f"{option} {file}: the folder {folder} cannot be written to")


def write_file(file: Path, content: bytes) -> None:
    """Writes a file whole or not at all; raises UsageError when it cannot."""
    try:
        write_atomically(file, content)
    except OSError as error:
        raise UsageError(f"cannot write {file}: {error.strerror}") from None


def write_picture(file: Path, picture: Image.Image) -> None:
    """Writes a picture in the format of its suffix, whole or not at all."""
    content = BytesIO()
    picture.save(content, "JPEG" if file.suffix.lower() == ".jpg" else "PNG")
    write_file(file, content.getvalue())


class Report(Protocol):
    """Hears how much of something is done, and maybe more about it."""

    def __call__(self, done: int, note: str = "") -> None:
        """Shows it."""


@contextmanager
def progress(label: str, total: int) -> Iterator[Report]:
    """A bar on stderr with the time left; where that is no terminal, a line every ten seconds."""
    console, began = Console(stderr=True), time.monotonic()
    said = began
    columns = (*Progress.get_default_columns(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        row = bar.add_task(label, total=total, note="")
        first: int | None = None

        def report(done: int, note: str = "") -> None:
            nonlocal said, first
            first = done if first is None else first
            bar.update(row, completed=done, note=note)
            now = time.monotonic()
            if not console.is_terminal and now - said >= LINE_SECONDS:
                said = now
                words = [f"{label}: {done} of {total}"]
                if done > first:
                    words.append(f"{(total - done) * (now - began) / (done - first) / 60:.1f} min left")
                sys.stderr.write(", ".join([*words, *([note] if note else [])]) + "\n")

        yield report


def print_json(value: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")
    sys.stdout.flush()
