"""`navaclq learner` and `navaclq actor`: the processes of a run, started by hand or by `navaclq train`."""

from __future__ import annotations

import logging
import math
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Annotated

import typer

from common.bus import Member
from common.errors import UsageError
from common.files import lock
from common.link import open_client, open_hub, open_router
from common.resources import give_way, one_torch_thread
from common.signals import exit_on_signals, signals_held, stop_on_signals
from common.telemetry import start_logging
from deploy.cli import options

log = logging.getLogger("navaclq")


def learner(
    run: options.Run,
    listen: options.Listen = options.DEFAULT_ENDPOINT,
    certs: options.Certs = None,
    minutes: options.Minutes = None,
    preset: options.Preset = None,
    variant: options.Variant = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    source: options.Source = None,
    insecure: options.Insecure = False,
) -> None:
    """Run the learner: replay, SAC, weights. It listens; actors and curriculum connect to it."""
    from learner.checkpoint import RunDirectory
    from learner.service import LearnerService

    link = options.make_link(listen, certs, insecure)
    wanted = None
    if not (run / "run.json").exists() or any((preset, variant, config, settings, seed is not None)):
        wanted = options.configuration(preset, variant, config, settings, seed)
    directory = RunDirectory(run, wanted, source=source)
    start_logging()
    exit_on_signals()
    with open_hub(link) as session:
        give_way()
        service = LearnerService(session, directory, minutes if minutes is not None else math.inf, link.group)
        log.info("learner of run %r listens on %s", directory.name, link)
        service.run()
        service.close()  # not after an exception: the state is not to be trusted then


def actor(
    connect: options.Connect = options.DEFAULT_ENDPOINT,
    certs: options.Certs = None,
    count: Annotated[int, typer.Option(min=1, max=256, help="Actor processes to start on this host.")] = 1,
    cells: Annotated[str, typer.Option(help="Cells to drive in, for example 0,3-5.")] = "0-8",
    name: Annotated[
        str | None, typer.Option(help="Name of the actor; default: the first free of HOST-0, HOST-1, ...")
    ] = None,
    spool: Annotated[
        Path | None, typer.Option(help="Folder for undelivered episodes; default: under ~/.cache/navaclq.")
    ] = None,
    settings: options.Settings = None,
    insecure: options.Insecure = False,
) -> None:
    """Run actors: simulation, policy, delivery. Everything else they need comes from the hub."""
    link = options.make_link(connect, certs, insecure)
    chosen = options.parse_cells(cells)
    if count > 1:
        _start_many(count, name)
        return
    one_torch_thread()
    from actor.frames import FrameService
    from actor.service import ActorService
    from common.contract import accept_contract, fetch_contract

    start_logging()
    exit_on_signals()
    with open_client(link, say_waiting(f"the hub at {link}")) as session:
        give_way()
        leave = f", or to be admitted as {link.group}" if link.credentials else ""
        contract = fetch_contract(session, say_waiting(f"a learner at the hub{leave}"))
        resolved = accept_contract(contract, tuple(settings or ()))
        spools = (spool or Path.home() / ".cache" / "navaclq" / "spool" / contract.run) / link.group
        own, lock = claim_name(spools, name)
        member = Member("actor", link.group, own)
        kind = ActorService if contract.job == "training" else FrameService
        service = kind(session, contract, resolved, member, spools / own, chosen)
        log.info("%s drives %d worlds for run %r", member, service.worlds, contract.run)
        try:
            service.run()
        finally:
            service.close()
            lock.close()


def router(
    listen: options.Listen,
    connect: Annotated[
        str | None, typer.Option(envvar="NAVACLQ_CONNECT", help="Endpoint of the hub to pass on to, if any.")
    ] = None,
    certs: options.Certs = None,
    insecure: options.Insecure = False,
) -> None:
    """Join networks: pass messages on between the clients that connect here and the learner's hub."""
    here = options.make_link(listen, certs, insecure)
    hub = options.make_link(connect, certs, insecure) if connect else None
    start_logging()
    exit_on_signals()
    with open_router(here, hub, say_waiting(f"the hub at {hub}")):
        log.info("router listens on %s%s", here, f", connected to {hub}" if hub else "")
        stop_on_signals().wait()


def claim_name(spools: Path, wanted: str | None) -> tuple[str, IO[bytes]]:
    """A name whose spool no other live actor of this host holds, with the lock on it.

    Without a wanted one, the first free of HOST-0, HOST-1, ...: a new actor so finds what its predecessor
    left undelivered. Raises UsageError when the wanted one is taken.
    """
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname())[:48]
    for name in [wanted] if wanted else (f"{host}-{i}" for i in range(1000)):
        (spools / name).mkdir(parents=True, exist_ok=True)
        try:
            return name, lock(spools / name / "lock")
        except BlockingIOError:
            continue
    raise UsageError(f"an actor named {wanted!r} is already connected; choose another --name")


def say_waiting(whom: str) -> Callable[[float], None]:
    """Tells every five seconds who is missing."""
    said = -5.0

    def say(waited: float) -> None:
        nonlocal said
        if waited - said >= 5.0:
            said = waited
            log.info("waiting for %s since %.0f s", whom, waited)

    return say


def _start_many(count: int, base: str | None) -> None:
    """Runs `count` actors as processes of their own and passes a signal on to them."""
    arguments = _without(sys.argv[1:], "--count", "--name")
    command = [sys.executable, "-m", "deploy.cli", *arguments]
    exit_on_signals()
    children: list[subprocess.Popen[bytes]] = []
    try:
        for i in range(count):
            named = ["--name", f"{base}.{i}"] if base else []
            with signals_held():
                children.append(subprocess.Popen([*command, *named], process_group=0))
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
