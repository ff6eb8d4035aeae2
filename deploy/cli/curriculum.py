"""`navaclq curriculum`: the service, beside a learner or alone, and queries to it."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from common.bus import Keys, ask
from common.cells import check_cell
from common.errors import UsageError
from common.link import Link, open_client, open_hub
from common.messages import Proposals, TaskQuery
from common.telemetry import exit_on_signals, start_logging
from deploy.cli import options
from deploy.cli.processes import say_waiting

if TYPE_CHECKING:
    from curriculum.service import CurriculumService

app = typer.Typer(help="Run or ask the curriculum.", no_args_is_help=True)
log = logging.getLogger("navaclq")


@app.callback()
def _group() -> None:
    """Run or ask the curriculum."""


@app.command("serve")
def serve_curriculum(
    connect: Annotated[str | None, typer.Option(help="Endpoint of a learner to join.")] = None,
    listen: Annotated[str | None, typer.Option(help="Endpoint to listen on, standing alone.")] = None,
    run: Annotated[
        Path | None, typer.Option(help="Run directory; the state is kept in its folder curriculum/.")
    ] = None,
    preset: options.Preset = None,
    variant: options.Variant = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    certs: options.Certs = None,
    insecure: options.Insecure = False,
) -> None:
    """Answer task queries: beside a learner (--connect), or alone (--listen, the default)."""
    from common.contract import accept_contract, fetch_contract
    from curriculum.service import CurriculumService

    if connect and listen:
        raise UsageError("--connect and --listen exclude each other: join a learner, or stand alone")
    if connect and any((preset, variant, config, seed is not None)):
        raise UsageError("beside a learner the configuration is the learner's; only --set may differ from it")
    known = run is None or (run / "run.json").exists() or (run / "curriculum").exists()
    if run and not known and run.exists() and any(run.iterdir()):
        raise UsageError(f"{run} is not empty and no run directory; choose another --run")
    folder = run / "curriculum" if run else None
    start_logging()
    exit_on_signals()
    if connect:
        link = options.make_link(connect, certs, insecure)
        with open_client(link, say_waiting(f"the hub at {link}")) as session:
            contract = fetch_contract(session, say_waiting("a learner at the hub"))
            resolved = accept_contract(contract, tuple(settings or ()))
            service = CurriculumService(session, contract.run, resolved, contract.digest, folder, link.group)
            _serve(service, link)
    else:
        link = options.make_link(listen or options.DEFAULT_ENDPOINT, certs, insecure)
        if run is not None and config is None and (run / "config.toml").exists():
            config = run / "config.toml"
        resolved = options.configuration(preset, variant, config, settings, seed)
        with open_hub(link) as session:
            name = run.resolve().name if run else "standalone"
            _serve(CurriculumService(session, name, resolved, None, folder, link.group), link)


def _serve(service: CurriculumService, link: Link) -> None:
    log.info("curriculum answers at %s", link)
    try:
        service.run()
    finally:
        service.close()


@app.command()
def query(
    cell: Annotated[int, typer.Option(help="Training cell, 0 to 8.")],
    count: Annotated[int, typer.Option(min=1, max=1000, help="Tasks to ask for.")] = 1,
    t: Annotated[int, typer.Option(min=0, help="The asking agent's environment steps so far.")] = 0,
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait.")] = 10.0,
    certs: options.Certs = None,
    as_json: options.Json = False,
    insecure: options.Insecure = False,
) -> None:
    """Ask a running curriculum for tasks."""
    check_cell(cell)
    with open_client(options.make_link(connect, certs, insecure), patience=timeout) as session:
        question = TaskQuery(cell=cell, t=t, count=count)
        answer = ask(session, Keys("*").task, question, Proposals, timeout, patience=timeout)
    if as_json:
        tasks = [{**p.task.model_dump(), **p.model_dump(exclude={"task"})} for p in answer.tasks]
        options.print_json({"tasks": tasks})
        return
    table = Table("cell", "seed", "requested", "category", "distance m", "angle deg", "Q", "f", "mu", "sigma")
    for p in answer.tasks:
        numbers = ["-" if v is None else f"{v:.3f}" for v in (p.q, p.f, p.mu, p.sigma)]
        angle = math.degrees(p.properties.relative_angle)
        place = (str(p.task.cell), str(p.task.seed), p.requested, p.category)
        table.add_row(*place, f"{p.properties.distance:.2f}", f"{angle:.1f}", *numbers)
    Console().print(table)
