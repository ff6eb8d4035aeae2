"""`navaclq evaluate`: policies and classical controllers on a suite or on the grid test, with intervals."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from actor.evaluation.suites import NEAREST, SUITES, Examination, grid, suite
from common.config import Config, differing_keys, resolve
from common.errors import UsageError
from common.version import code_version
from deploy.cli import options

if TYPE_CHECKING:
    from actor.evaluation.examiner import Subject, Terms
    from actor.evaluation.measures import Drive

WORK = Path("runs/evaluation/episodes.db")
"""Where what was driven is kept unless the policy lies in a run."""


def find_subject(name: str, config: Config) -> Subject:
    """Who is meant by `name`: a policy's folder, of a run its newest snapshot, `shipped`, or a baseline.

    A baseline drives in the world of `config`, with the sensors that it asks for.
    """
    from actor.baseline.registry import BASELINES
    from actor.evaluation.examiner import Rival

    if name in BASELINES:
        return Rival(name, BASELINES[name].configure(config))
    if name == "shipped":
        return Path(str(resources.files("common") / "policies" / "shipped"))
    path = Path(name)
    if not path.exists():
        raise UsageError(
            f"policy {path} does not exist; give a run directory, a checkpoint, a snapshot, `shipped`, "
            f"or one of {', '.join(BASELINES)}"
        )
    if not (path / "run.json").exists():
        return path
    found = [p for p in (path / "snapshots").glob("*") if p.suffix != ".part"]
    if not found:
        raise UsageError(f"{path} holds no snapshot of a policy yet")
    return max(found, key=lambda snapshot: snapshot.stat().st_mtime_ns)


def work_file(subject: Subject) -> Path:
    """The work list of a subject: in its run, if it has one."""
    if isinstance(subject, Path):
        for folder in subject.resolve().parents:
            if (folder / "run.json").exists():
                return folder / "evaluation" / "episodes.db"
    return WORK


def own_rules(config: Config) -> dict[str, Any]:
    """The settings of a world other than the default: a policy is examined in its own world."""
    return {key: value for key, value, _ in differing_keys(config, Config(), ("world.",))}


def drive(
    subject: Subject,
    examination: Examination,
    terms: Terms,
    label: str,
    processes: int | None = None,
    work: Path | None = None,
    afresh: bool = False,
) -> list[Drive]:
    """A subject's drives, with a progress bar on stderr; by default one process per core.

    With a `work` file they are kept there, and those that are there are not driven again unless `afresh`.
    """
    from actor.evaluation.examiner import examine, identity, world_of
    from actor.evaluation.work_list import WorkList

    kept = None
    tasks = list(examination.tasks)
    if work:
        world_of(subject, terms)  # a bad subject leaves no file
        about = {
            "subject": identity(subject),
            "tasks": [task.model_dump(mode="json") for task in tasks],
            "terms": [terms.greedy, terms.seed, terms.overrides, terms.max_steps],
            "code": code_version(),
        }
        kept = WorkList(work, about)
        if afresh:
            kept.forget()
    try:
        with options.progress(f"{label} on {examination.name}", len(tasks)) as report:
            return examine(subject, tasks, processes or os.cpu_count() or 1, terms, report, kept)
    finally:
        if kept:
            kept.close()


def evaluate(
    policies: Annotated[
        list[str],
        typer.Argument(
            metavar="POLICY...",
            help="Run directories, checkpoints, snapshots, `shipped`, or baselines: b0 (true poses), b1 "
            "(map), b2 (no map). Several, as of several seeds, are summed up together.",
        ),
    ],
    suite_name: Annotated[
        str | None, typer.Option("--suite", help=" ".join(f"{k}: {v}." for k, v in SUITES.items()))
    ] = None,
    grid_test: Annotated[
        Literal["quick", "paper"] | None,
        typer.Option(
            "--grid", help="Instead of a suite the grid test: quick 968 starts, paper 9 times each."
        ),
    ] = None,
    arena: Annotated[
        str | None,
        typer.Option(help="Where the grid is: validation (the default), or test for final results."),
    ] = None,
    nearest: Annotated[
        float | None,
        typer.Option(min=0.0, max=15.0, help="Nearest row of the grid from the dolly's centre, m [1.5]."),
    ] = None,
    sampled: Annotated[
        bool, typer.Option("--sampled", help="Sample actions, as in training, instead of the greedy ones.")
    ] = False,
    compare: Annotated[
        str | None, typer.Option(help="Another policy to compare with on the same episodes, in pairs.")
    ] = None,
    processes: options.Processes = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**20, help="Seed of sampled actions and of a grid's scenes.")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables (Markdown), episodes (CSV) and figures (PNG).")
    ] = None,
    work: Annotated[
        Path | None,
        typer.Option(
            help="SQLite file that keeps what was driven, so that an interrupted evaluation goes on; "
            f"default: evaluation/episodes.db of the policy's run, else {WORK}."
        ),
    ] = None,
    afresh: Annotated[bool, typer.Option("--afresh", help="Drive again what is kept there.")] = False,
    as_json: options.Json = False,
) -> None:
    """Drive policies through fixed, seeded tasks and measure how the episodes end."""
    if grid_test and suite_name:
        raise UsageError("--suite and --grid exclude each other; drop one of them")
    for option, value in (("--arena", arena), ("--nearest", nearest)):
        if value is not None and not grid_test:
            raise UsageError(f"{option} says where a grid is; add --grid quick or --grid paper")
    if compare and len(policies) > 1:
        raise UsageError("--compare compares one policy with another; name one POLICY")
    if out:
        make_folder(out)
    if grid_test:
        examination = grid(grid_test, arena or "validation", seed, NEAREST if nearest is None else nearest)
        check_starts(examination)
    else:
        examination = suite(suite_name or "train")
    from actor.evaluation.examiner import Rival, Terms, world_of
    from actor.evaluation.measures import measure, paired_difference
    from actor.evaluation.report import groups
    from deploy.examination import as_json_object, as_lines, write_report

    names = [*policies, compare] if compare else policies
    world = resolve(overrides=examination.overrides)
    subjects = [find_subject(name, world) for name in names]
    labels = _labels(names, subjects)
    driven: dict[str, list[Drive]] = {}
    results: dict[str, dict[str, Any]] = {}
    rows = {}
    for label, subject in zip(labels, subjects, strict=True):
        overrides = () if isinstance(subject, Rival) else examination.overrides
        terms = Terms(not sampled, seed, overrides)
        config = world_of(subject, terms)
        kept = work or work_file(subject)
        driven[label] = drive(subject, examination, terms, label, processes, kept, afresh)
        rows[label] = [measure(one, config.world) for one in driven[label]]
        results[label] = {
            "policy": label,
            "suite": examination.name,
            "seed": seed,
            "episodes": len(examination.tasks),
            "sampled": sampled,
            "own_rules": own_rules(config),
            **({"arena": arena or "validation"} if grid_test else {}),
            **groups(examination.tasks, rows[label], config.world.start),
        }
    paired = None
    if compare:
        ours, theirs = ([one.ending for one in rows[label]] for label in labels)
        paired = {"policy": labels[1], "all": results[labels[1]]["all"], **paired_difference(ours, theirs)}
    if out:
        write_report(out, examination, driven, rows, results, paired)
    if as_json:
        options.print_json(as_json_object(results, paired))
    else:
        sys.stdout.write(as_lines(results, paired))


def make_folder(out: Path) -> None:
    """Before hours are spent on what it is for; raises UsageError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out} cannot be made: {error.strerror}") from None


def check_starts(examination: Examination) -> None:
    """Raises UsageError when a start of a grid lies outside its room."""
    from common.cells import ROOMS
    from common.tasks import PlacedStart

    for task in examination.tasks:
        room = ROOMS[task.cell]
        assert isinstance(task.start, PlacedStart)
        x, y = room.dolly.apply(task.start.x, task.start.y)
        if not room.contains(x, y):
            raise UsageError(
                f"the grid leaves the arena {room.name}: the start {task.start.x:g}, {task.start.y:g} m from "
                "the dolly lies outside; choose a smaller --nearest"
            )


def _labels(names: Sequence[str], subjects: Sequence[Subject]) -> list[str]:
    labels = ["shipped" if n == "shipped" else str(s) for n, s in zip(names, subjects, strict=True)]
    if len(set(labels)) < len(labels):
        raise UsageError("the same policy is named twice; name each once")
    return labels
