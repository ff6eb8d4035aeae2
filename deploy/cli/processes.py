"""`navaclq learner` and `navaclq actor`: the processes of a run, started by hand or by `navaclq train`."""

from __future__ import annotations

import logging
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from common.bus import open_client, open_hub
from common.contract import accept_contract, fetch_contract
from common.errors import UsageError
from common.telemetry import exit_on_signals, start_logging
from deploy.cli import options

log = logging.getLogger("navaclq")


def learner(
    run: options.Run,
    listen: Annotated[str, typer.Option(help="Endpoint to listen on.")] = options.DEFAULT_ENDPOINT,
    minutes: options.Minutes = None,
    preset: options.Preset = None,
    variant: options.Variant = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    insecure: options.Insecure = False,
) -> None:
    """Run the learner: replay, SAC, weights. It listens; actors and curriculum connect to it."""
    from learner.checkpoint import RunDirectory
    from learner.service import LearnerService

    address = options.endpoint(listen, insecure)
    wanted = None
    if not (run / "run.json").exists() or any((preset, variant, config, settings, seed is not None)):
        wanted = options.configuration(preset, variant, config, settings, seed)
    directory = RunDirectory(run, wanted)
    start_logging()
    exit_on_signals()
    with open_hub(address) as session:
        service = LearnerService(session, directory, minutes if minutes is not None else math.inf)
        log.info("learner of run %r listens on %s", directory.name, address)
        try:
            service.run()
        finally:
            service.close()


def actor(
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    count: Annotated[int, typer.Option(min=1, max=256, help="Actor processes to start on this host.")] = 1,
    cells: Annotated[str, typer.Option(help="Cells to drive in, for example 0,3-5.")] = "0-8",
    name: Annotated[str | None, typer.Option(help="Name of the actor; default: host and process id.")] = None,
    spool: Annotated[
        Path | None, typer.Option(help="Folder for undelivered episodes; default: under ~/.cache/navaclq.")
    ] = None,
    settings: options.Settings = None,
    insecure: options.Insecure = False,
) -> None:
    """Run actors: simulation, policy, delivery. Everything else they need comes from the hub."""
    address = options.endpoint(connect, insecure)
    chosen = options.parse_cells(cells)
    base = name or f"{socket.gethostname()}-{os.getpid()}"
    if count > 1:
        _start_many(count, base)
        return
    from actor.service import ActorService

    start_logging()
    exit_on_signals()
    with open_client(address, say_waiting(f"the hub at {address}")) as session:
        contract = fetch_contract(session, say_waiting("a learner at the hub"))
        resolved = accept_contract(contract, tuple(settings or ()))
        folder = (spool or Path.home() / ".cache" / "navaclq" / "spool" / contract.run) / base
        service = ActorService(session, contract, resolved, base, folder, chosen)
        log.info("actor %s drives %d worlds for run %r", base, resolved.actor.worlds, contract.run)
        try:
            service.run()
        finally:
            service.close()


def say_waiting(whom: str) -> Callable[[float], None]:
    """Tells every five seconds who is missing."""
    said = -5.0

    def say(waited: float) -> None:
        nonlocal said
        if waited - said >= 5.0:
            said = waited
            log.info("waiting for %s since %.0f s", whom, waited)

    return say


def _start_many(count: int, base: str) -> None:
    """Runs `count` actors as processes of their own and passes a signal on to them."""
    arguments = _without(sys.argv[1:], "--count", "--name")
    command = [sys.executable, "-m", "deploy.cli.main", *arguments]
    children = [
        subprocess.Popen([*command, "--name", f"{base}.{i}"], start_new_session=True) for i in range(count)
    ]
    exit_on_signals()
    try:
        while any(child.poll() is None for child in children):
            time.sleep(0.2)
    finally:
        for child in children:
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
        for child in children:
            try:
                child.wait(timeout=5)
            except subprocess.TimeoutExpired:
                child.kill()
    failed = sum(child.returncode not in (0, -signal.SIGTERM) for child in children)
    if failed:
        raise UsageError(f"{failed} of {count} actors ended with an error; it stands above")


def _without(arguments: list[str], *names: str) -> list[str]:
    """The arguments less these options and their values."""
    kept: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        if argument in names:
            next(rest, None)
        elif argument.partition("=")[0] not in names:
            kept.append(argument)
    return kept
