"""`navaclq curriculum`: the service, beside a learner or alone, and queries to it."""

from __future__ import annotations

import json
import logging
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.table import Table

from common.bus import Keys, ask
from common.cells import check_cell
from common.errors import UsageError
from common.files import write_atomically
from common.link import Link, open_client, open_hub
from common.messages import Nothing, Proposal, Proposals, ScoreQuery, Scores, Snapshot, TaskQuery
from common.resources import one_torch_thread
from common.signals import exit_on_signals
from common.tasks import Task
from common.telemetry import start_logging
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
        Path | None,
        typer.Option(
            help="Run directory; all is kept in its curriculum.db, standing alone also in config.toml."
        ),
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
    one_torch_thread()
    from common.contract import accept_contract, fetch_contract
    from curriculum.service import CurriculumService

    if connect and listen:
        raise UsageError("--connect and --listen exclude each other: join a learner, or stand alone")
    if connect and any((preset, variant, config, seed is not None)):
        raise UsageError("beside a learner the configuration is the learner's; only --set may differ from it")
    known = run is None or (run / "run.json").exists() or (run / "curriculum.db").exists()
    if run and not known and run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise UsageError(f"{run} is not empty and no run directory; choose another --run")
    start_logging()
    exit_on_signals()
    if connect:
        link = options.make_link(connect, certs, insecure)
        with open_client(link, say_waiting(f"the hub at {link}")) as session:
            contract = fetch_contract(session, say_waiting("a learner at the hub"))
            resolved = accept_contract(contract, tuple(settings or ()))
            service = CurriculumService(session, contract.run, resolved, contract.digest, run, link.group)
            _serve(service, link)
    else:
        link = options.make_link(listen or options.DEFAULT_ENDPOINT, certs, insecure)
        if run is not None and config is None and (run / "config.toml").exists():
            config = run / "config.toml"
        resolved = options.configuration(preset, variant, config, settings, seed)
        with open_hub(link) as session:
            name = run.resolve().name if run else "standalone"
            if run and not (run / "run.json").exists():  # else it is a training's, which has its own
                run.mkdir(parents=True, exist_ok=True)
                write_atomically(run / "config.toml", resolved.to_toml().encode())
            _serve(CurriculumService(session, name, resolved, None, run, link.group), link)


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
        options.print_json({"tasks": [_flat(proposal) for proposal in answer.tasks]})
        return
    table = Table("task", "requested", "category", "distance m", "angle deg", "Q", "f", "mu", "sigma")
    for p in answer.tasks:
        numbers = ["-" if v is None else f"{v:.3f}" for v in (p.q, p.f, p.mu, p.sigma)]
        distance, angle = (p.properties.get(name, math.nan) for name in ("distance", "relative_angle"))
        row = (_name(p.task), p.requested, p.category, f"{distance:.2f}", f"{math.degrees(angle):.1f}")
        table.add_row(*row, *numbers)
    Console().print(table)
    for number, p in enumerate(answer.tasks, 1):
        Console().print(f"{number}: {p.why}")


def _flat(proposal: Proposal) -> dict[str, Any]:
    """A docking task's fields stand beside the proposal's; another environment's names might be the same."""
    values = proposal.model_dump()
    return {**values.pop("task"), **values} if isinstance(proposal.task, Task) else values


def _name(task: Task | dict[str, float]) -> str:
    if isinstance(task, Task):
        return f"cell {task.cell}, seed {task.seed}"
    return ", ".join(f"{name} {value:.3g}" for name, value in task.items())


@app.command()
def score(
    file: Annotated[
        Path,
        typer.Argument(
            help="JSON list of tasks {cell, seed, start}, or of {properties: {...}, q}.", metavar="TASKS"
        ),
    ],
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait.")] = 10.0,
    certs: options.Certs = None,
    as_json: options.Json = False,
    insecure: options.Insecure = False,
) -> None:
    """Ask a running curriculum how likely the present policy is to solve tasks, seen or not."""
    question = _read_tasks(file)
    with open_client(options.make_link(connect, certs, insecure), patience=timeout) as session:
        answer = ask(session, Keys("*").score, question, Scores, timeout, patience=timeout)
    if as_json:
        options.print_json(answer.model_dump())
        return
    table = Table("f", *answer.properties[0], title=f"f_pi after {answer.outcomes} outcomes; m and rad")
    for f, properties in zip(answer.f, answer.properties, strict=True):
        table.add_row(f"{f:.3f}", *(f"{value:.3f}" for value in properties.values()))
    Console().print(table)


def _read_tasks(file: Path) -> ScoreQuery:
    try:
        content = json.loads(file.read_text("utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(f"{file} is not JSON: {error}") from None
    content = content.get("tasks") if isinstance(content, dict) else content
    if not isinstance(content, list) or not all(isinstance(item, dict) for item in content):
        raise UsageError(
            f'{file}: a list of tasks is expected, or {{"tasks": [...]}} as `query --json` prints'
        )
    try:
        return ScoreQuery.model_validate({"tasks": [_scored(item) for item in content]})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise UsageError(f"{file}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _scored(item: dict[str, Any]) -> dict[str, Any]:
    """What is to be scored of a task, of one of `query --json`, or of properties."""
    if "cell" in item:
        return {"task": {key: item[key] for key in item if key in Task.model_fields}}
    if "properties" in item:
        return {key: item[key] for key in ("properties", "q") if key in item}
    return {"task": item}


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(help="Run directory with a curriculum.db.", metavar="RUN")],
    rival: Annotated[Path | None, typer.Option(help="Run whose tasks are shown beside.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the pictures; default RUN/plots.")] = None,
    formats: Annotated[str, typer.Option("--format", help="png, svg or both.")] = "png,svg",
) -> None:
    """Draw f_pi, the tasks proposed, their mix and the reliability of predictions, also during a run."""
    from curriculum.plots import draw, read, render

    kinds = formats.split(",")
    if not set(kinds) <= {"png", "svg"}:
        raise UsageError(f"--format {formats!r} must be png, svg or png,svg")
    figures, left_out = draw(read(run), read(rival) if rival else None)
    folder = out or run / "plots"
    if figures:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"cannot make {folder}: {error.strerror}") from None
    for name, figure in figures.items():
        for kind in kinds:
            file = folder / f"{name}.{kind}"
            options.write_file(file, render(figure, kind))
            sys.stdout.write(f"{file}\n")
    for name, why in left_out.items():
        sys.stderr.write(f"left out {name}: {why}\n")


@app.command()
def snapshot(
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait.")] = 10.0,
    out: Annotated[
        Path | None,
        typer.Option(help="File for f_pi, safetensors; its inputs and scales are in the metadata."),
    ] = None,
    certs: options.Certs = None,
    as_json: options.Json = False,
    insecure: options.Insecure = False,
) -> None:
    """What a running curriculum has, has proposed, and how good its predictions were."""
    with open_client(options.make_link(connect, certs, insecure), patience=timeout) as session:
        answer = ask(session, Keys("*").snapshot, Nothing(), Snapshot, timeout, patience=timeout)
    if out is not None:
        if not answer.network:
            raise UsageError(f"{answer.algorithm} has no f_pi that --out could save")
        options.write_file(out, answer.network)
    values = answer.model_dump(exclude={"network"})
    if as_json:
        options.print_json(values)
        return
    table = Table(show_header=False)
    for name, value in values.items():
        text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
        table.add_row(name, text)
    Console().print(table)
