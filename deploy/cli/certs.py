"""`navaclq certs`: certificates for mutual TLS between the processes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from deploy.cli import options

app = typer.Typer(help="Make certificates for processes on several hosts.", no_args_is_help=True)

SOON = 30
"""Days before its end from which a certificate is marked."""

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the certificate authority.")]
Days = Annotated[
    int, typer.Option(min=1, max=3650, help="Days that certificates are valid; the authority: ten years.")
]


@app.callback()
def _group() -> None:
    """Make certificates for processes on several hosts: a private authority and one folder for each."""


@app.command()
def init(
    folder: Folder,
    hosts: Annotated[
        list[str] | None,
        typer.Option(
            "--host",
            help="Hostname or IP address at which learner, curriculum and router are reached; may be "
            "repeated. Default: this host's name and loopback.",
        ),
    ] = None,
    groups: Annotated[
        list[str] | None,
        typer.Option("--group", help="Group of actors, actor-NAME; may be repeated. Default: actor-local."),
    ] = None,
    days: Days = 825,
) -> None:
    """Make an authority with certificates for learner, curriculum, router, operator and groups of actors."""
    from deploy import certs

    certs.create(folder, groups or (), hosts or (), days)
    show(folder)
    sys.stdout.write(
        f"copy the folder of each name to its host, for --certs there; {folder / 'ca.key'} stays here\n"
    )


@app.command()
def issue(
    folder: Folder,
    name: Annotated[str, typer.Argument(help="learner, curriculum, router, operator, or actor-NAME.")],
    hosts: Annotated[
        list[str] | None,
        typer.Option(
            "--host",
            help="Hostname or IP address at which learner, curriculum or router is reached; may be "
            "repeated. Default: those of its last certificate, else this host's name and loopback.",
        ),
    ] = None,
    days: Days = 825,
) -> None:
    """Issue one more certificate, or renew one with a new key."""
    from deploy import certs

    changed = certs.issue(folder, name, hosts or (), days)
    sys.stdout.write(f"{folder / name}: copy this folder to the host of {name}; it is read at a start\n")
    for file in changed:
        sys.stdout.write(f"{file} now admits {name}: copy it to the host of {file.parent.name}\n")
    if changed:
        sys.stdout.write(f"the learner reads its list at its start: restart it to admit {name}\n")


@app.command()
def show(folder: Folder, as_json: options.Json = False) -> None:
    """List the certificates: name, end, days left (! below 30), hosts."""
    from deploy import certs

    entries = certs.read(folder)
    if as_json:
        rows = [
            {"name": e.name, "hosts": e.hosts, "valid_until": e.until.isoformat(), "days_left": e.days_left}
            for e in entries
        ]
        return options.print_json({"certificates": rows})
    width = max(len(entry.name) for entry in entries)
    for entry in entries:
        mark = "!" if entry.days_left < SOON else " "
        line = f"{entry.name:{width}}  {entry.until:%Y-%m-%d}  {entry.days_left:5} days left {mark}  "
        sys.stdout.write((line + ", ".join(entry.hosts)).rstrip() + "\n")
    if any(entry.days_left < SOON for entry in entries):
        sys.stdout.write(
            f"! ends soon: `navaclq certs issue {folder} NAME` renews it, only `init` elsewhere replaces ca\n"
        )
