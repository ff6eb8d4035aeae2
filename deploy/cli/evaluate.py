"""`navaclq evaluate`: policies and classical controllers on a suite or on the grid test, with intervals."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from actor.evaluation.suites import NEAREST, SUITES, Examination, grid, suite
from common.config import Config, differing_keys, resolve
from common.errors import UsageError
from common.tasks import PlacedStart, build_scene
from common.version import code_version
from common.world_config import WorldConfig
from deploy.cli import options

if TYPE_CHECKING:
    from actor.evaluation.examiner import Subject, Terms
    from actor.evaluation.measures import Drive
    from actor.evaluation.report import Result

WORK = Path("runs/evaluation/episodes.db")
"""Where what was driven is kept unless the policy lies in a run."""
LIBRARIES = "numpy", "torch", "onnxruntime", "pybullet"
"""On whose versions a drive depends."""


def find_subject(name: str, config: Config) -> Subject:
    """Who is meant by `name`: a policy's folder, of a run its newest snapshot, `shipped`, or a baseline.

    A baseline drives in the world of `config`, with the sensors that it asks for.
    """
    from actor.baseline.registry import BASELINES
    from actor.evaluation.examiner import Rival, Trained

    if name in BASELINES:
        return Rival(name, BASELINES[name].configure(config))
    if name == "shipped":
        found = Trained.read(Path(str(resources.files("common") / "policies" / "shipped")))
        return replace(found, name="shipped")
    path = Path(name)
    if not path.exists():
        raise UsageError(
            f"policy {path} does not exist; give a run directory, a checkpoint, a snapshot, `shipped`, "
            f"or one of {', '.join(BASELINES)}"
        )
    return Trained.read(_newest_snapshot(path) if (path / "run.json").exists() else path)


def _newest_snapshot(run: Path) -> Path:
    """That of most environment steps."""

    def steps(snapshot: Path) -> tuple[int, int]:
        try:
            state = json.loads((snapshot / "state.json").read_text("utf-8"))
            return int(state["env_steps"]), snapshot.stat().st_mtime_ns
        except (OSError, ValueError, KeyError, TypeError):
            return -1, snapshot.stat().st_mtime_ns

    found = [path.parent for path in (run / "snapshots").glob("*/config.toml")]
    if not (found := [path for path in found if path.suffix != ".part"]):
        raise UsageError(f"{run} holds no snapshot of a policy yet")
    return max(found, key=steps)


def work_file(subject: Subject) -> Path:
    """The work list of a subject: in its run, if it has one."""
    from actor.evaluation.examiner import Trained

    if isinstance(subject, Trained):
        for folder in Path(subject.name).resolve().parents:
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
    processes: int | None = None,
    work: Path | None = None,
    afresh: bool = False,
) -> list[Drive]:
    """A subject's drives, with a progress bar on stderr; by default one process per core.

    With a `work` file they are kept there, and those that are there are not driven again unless `afresh`.
    """
    from actor.evaluation.examiner import examine
    from actor.evaluation.work_list import WorkList

    kept, tasks = None, list(examination.tasks)
    if work:
        about = {
            "subject": subject.identity,
            "tasks": [task.model_dump(mode="json") for task in tasks],
            "terms": [terms.greedy, terms.greedy or terms.seed, terms.overrides, terms.max_steps],
            "code": [code_version(), *(f"{name} {version(name)}" for name in LIBRARIES)],
        }
        kept = WorkList(work, about)
        if afresh:
            kept.forget()
    try:
        with options.progress(f"{subject.name} on {examination.name}", len(tasks)) as report:
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
            "(map), b1-wide (finer sensors), b2 (no map). Several are summed up, as of several seeds.",
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
    if grid_test:
        nearest = NEAREST if nearest is None else nearest
        examination = grid(grid_test, arena or "validation", seed, nearest)
        check_starts(examination)
    else:
        examination = suite(suite_name or "train")
    from actor.evaluation.examiner import Rival, Terms, load_driver, world_of
    from actor.evaluation.measures import measure, paired_difference
    from actor.evaluation.report import groups
    from deploy.examination import as_json_object, as_lines, write_report

    world = resolve(overrides=examination.overrides)
    subjects = [find_subject(name, world) for name in ([*policies, compare] if compare else policies)]
    if len({subject.name for subject in subjects}) < len(subjects):
        raise UsageError("the same policy is named twice; name each once")
    terms = [
        Terms(not sampled, seed, () if isinstance(subject, Rival) else examination.overrides)
        for subject in subjects
    ]
    worlds = [world_of(subject, own).world for subject, own in zip(subjects, terms, strict=True)]
    if compare:
        check_pairs(*worlds)
    for subject, own in zip(subjects, terms, strict=True):
        load_driver(subject, own, 0)  # none is found to be wrong after others have driven for hours
    if out:
        make_folder(out)
    driven: dict[str, list[Drive]] = {}
    results: dict[str, Result] = {}
    rows = {}
    for subject, own, its in zip(subjects, terms, worlds, strict=True):
        name = subject.name
        driven[name] = drive(subject, examination, own, processes, work or work_file(subject), afresh)
        rows[name] = [measure(one, its) for one in driven[name]]
        results[name] = {
            "policy": name,
            "suite": examination.name,
            "seed": seed,
            "episodes": len(examination.tasks),
            "sampled": sampled,
            "own_rules": own_rules(Config(world=its)),
            **({"arena": arena or "validation", "nearest": nearest} if grid_test else {}),
            **groups(examination, rows[name], its.start),
        }
    paired = None
    if compare:
        ours, theirs = ([one.ending for one in found] for found in rows.values())
        paired = {**results[subjects[1].name], **paired_difference(ours, theirs)}
    if out:
        write_report(out, examination, worlds[0], driven, rows, results, paired)
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
    if not os.access(out, os.W_OK):
        raise UsageError(f"--out {out} cannot be written to")


def check_starts(examination: Examination) -> None:
    """Raises UsageError when a start of a grid is not free, in whatever repeat."""
    for task in {task.start: task for task in examination.tasks}.values():
        try:
            build_scene(task, Config().world)
        except UsageError as error:
            assert isinstance(task.start, PlacedStart)
            raise UsageError(
                f"the grid does not fit the arena: at {task.start.x:g}, {task.start.y:g} m from the dolly "
                f"there is {error}; choose another --nearest"
            ) from None


def check_pairs(ours: WorldConfig, theirs: WorldConfig) -> None:
    """Raises UsageError where two worlds differ in what makes an episode the same."""
    same = (
        "robot",
        "dolly",
        "obstacles",
        "control_period",
        "max_evaluation_steps",
        "reward.success_distance",
    )
    keys = [key for key, *_ in differing_keys(ours, theirs, same) if not key.startswith("robot.mounts")]
    if keys:
        raise UsageError(f"--compare needs one world for both, and theirs differ in world.{keys[0]}")
