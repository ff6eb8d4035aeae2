"""`navaclq train`: the main job, learner + curriculum + actors on this machine, supervised."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from actor.evaluation.suites import suite
from common.bus import Keys
from common.config import Config, parse
from common.contract import fetch_contract
from common.errors import UsageError
from common.link import make_link, open_client
from common.members import Members
from common.messages import ContractReply
from common.resources import learner_threads
from common.signals import exit_on_signals, signals_held
from deploy.cli import options
from deploy.cli.evaluate import drive
from deploy.launcher import Child, Supervisor, free_port
from deploy.screen import Screen
from deploy.troubles import number


def train(
    run: options.Run = Path("runs/default"),
    minutes: options.Minutes = 40.0,
    actors: Annotated[
        int | None, typer.Option(min=1, max=256, help="Actor processes; default: cores less the learner's.")
    ] = None,
    preset: options.Preset = None,
    variant: options.Variant = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    source: options.Source = None,
    evaluation: Annotated[
        str | None,
        typer.Option("--eval", help="Suite on which to compare untrained and trained policy afterwards."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="TCP port of the hub; default: a free one.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Train: starts learner, curriculum and actors, shows their progress, stops them, sums up."""
    exists = (run / "run.json").exists()
    if exists and source is not None:
        raise UsageError(f"{run} exists; to begin from {source} choose another --run")
    if not exists or any((preset, variant, config, settings, seed is not None)):
        options.configuration(preset, variant, config, settings, seed)
    if evaluation is not None:
        suite(evaluation)
    asked = _arguments(preset, variant, config, settings, seed)
    exit_on_signals()
    load = _supervise(run, minutes or 40.0, actors, f"tcp/127.0.0.1:{port or free_port()}", asked, source)
    result = _summary(run, load)
    _keep(run, result)
    if evaluation is not None:
        result["eval"] = _compare(run, evaluation, result["seed"])
        _keep(run, result)
    if as_json:
        options.print_json(result)
    else:
        _print_summary(result, run)


def _arguments(
    preset: str | None, variant: str | None, config: Path | None, settings: list[str] | None, seed: int | None
) -> list[str]:
    pairs = (("--preset", preset), ("--variant", variant), ("--config", config), ("--seed", seed))
    given = [text for name, value in pairs if value is not None for text in (name, str(value))]
    return given + [text for setting in settings or () for text in ("--set", setting)]


def _supervise(
    run: Path, minutes: float, actors: int | None, address: str, asked: list[str], source: Path | None
) -> float:
    """Runs the processes until the learner's time is over; returns the load average at the end."""
    clock = _Clock()

    def learner() -> list[str]:
        left = max(0.01, minutes - clock.total / 60)
        begin = ["--from", str(source)] if source and not (run / "run.json").exists() else []
        return ["learner", "--run", str(run), "--listen", address, "--minutes", f"{left:.4f}", *begin, *asked]

    screen: Screen | None = None
    early: list[str] = []
    supervisor = Supervisor(lambda event: screen.say(event) if screen else early.append(event))
    main = Child("learner", learner, run / "logs" / "learner.log", may_finish=True)
    try:
        supervisor.add(main)
        while not (run / "run.json").exists():
            supervisor.check()
            time.sleep(0.05)
        cores, config = os.cpu_count() or 2, _config(run)
        count = actors or max(1, cores - learner_threads(config.learner.threads, cores))
        join = ["--connect", address]
        serve = ["curriculum", "serve", "--run", str(run), *join]
        supervisor.add(Child("curriculum", lambda: serve, run / "logs" / "curriculum.log"))
        for i in range(count):
            command = ["actor", "--name", f"local-{i}", "--spool", str(run / "spool"), *join]
            supervisor.add(
                Child(f"local-{i}", lambda command=command: command, run / "logs" / f"local-{i}.log")  # type: ignore[misc]
            )
        with open_client(make_link(address), lambda waited: supervisor.check()) as session:
            monitor = Members(session, Keys(run.resolve().name))
            screen = Screen(
                monitor,
                Console(stderr=True),
                f"navaclq train {run}",
                lambda: [(c.name, c.alive, c.restarts) for c in supervisor.children],
            )
            for event in early:
                screen.say(event)
            contract = fetch_contract(session, lambda waited: supervisor.check())
            screen.say(
                f"training into {run} for {minutes:g} min with {count} actor process(es), hub {address}, "
                f"{_describe_encoder(contract)}"
            )
            while not main.finished:
                supervisor.check()
                clock.read(number(monitor.learner, "elapsed_s"))
                screen.update()
                time.sleep(0.2)
        return os.getloadavg()[0]
    finally:
        with signals_held():
            try:
                if screen:
                    screen.close()
            finally:
                supervisor.stop()


def _describe_encoder(contract: ContractReply) -> str:
    encoder = parse(contract.config).encoder
    if encoder.end_to_end:
        return "encoder trained end to end"
    return f"frozen encoder {encoder.weights} ({contract.digest['encoder']})"


class _Clock:
    """Seconds of training over all lives of the learner, each of which counts from zero."""

    def __init__(self) -> None:
        self._before = self._life = 0.0

    @property
    def total(self) -> float:
        return self._before + self._life

    def read(self, life: float) -> None:
        if life < self._life:
            self._before += self._life
        self._life = life


def _config(run: Path) -> Config:
    return parse((run / "config.toml").read_text("utf-8"))


def _summary(run: Path, load: float) -> dict[str, Any]:
    config = _config(run)
    learned = json.loads((run / "summary.json").read_text("utf-8"))
    return {
        "run": run.resolve().name,
        "seed": config.seed,
        "preset": config.preset,
        "variant": config.variant,
        "encoder": "end to end" if config.encoder.end_to_end else config.encoder.weights,
        "minutes": learned["minutes"],
        "env_steps": learned["env_steps"],
        "episodes": learned["episodes"],
        "updates": learned["updates"],
        "load_average": round(load, 2),
        "training": learned["figures"],
    }


def _keep(run: Path, result: dict[str, Any]) -> None:
    options.write_file(run / "result.json", json.dumps(result, indent=1).encode())


def _compare(run: Path, name: str, seed: int) -> dict[str, Any]:
    """Untrained against trained policy on a suite, greedy; outside the training's clock."""
    from actor.evaluation.examiner import Terms, Trained
    from actor.evaluation.measures import rates

    policies = {"before": run / "snapshots" / "initial", "after": run / "snapshots" / "final"}
    if missing := [path for path in policies.values() if not path.exists()]:
        raise UsageError(f"{missing[0]} is missing: nothing to evaluate")
    examination = suite(name)
    terms = Terms(seed=seed, overrides=examination.overrides)
    work = run / "evaluation" / "episodes.db"
    found = {
        label: rates([one.ending for one in drive(Trained.read(path), examination, terms, work=work)])
        for label, path in policies.items()
    }
    return {"suite": name, "episodes": len(examination.tasks), **found}


def _print_summary(result: dict[str, Any], run: Path) -> None:
    lines = [
        f"{result['env_steps']} environment steps, {result['episodes']} episodes, {result['updates']} "
        f"updates in {result['minutes']:g} min (load average {result['load_average']})",
    ]
    if "eval" in result:
        found = result["eval"]
        for name, label in (("before", "untrained"), ("after", "trained")):
            shares = ", ".join(f"{k.replace('_', ' ')} {100 * v:.0f}%" for k, v in found[name].items())
            lines.append(
                f"{label} policy on suite {found['suite']} ({found['episodes']} tasks, greedy): {shares}"
            )
    lines.append(f"policy: {run / 'snapshots' / 'final'}; curves: tensorboard --logdir {run / 'tensorboard'}")
    sys.stdout.write("\n".join(lines) + "\n")
