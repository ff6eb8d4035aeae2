"""`navaclq doctor`: what this machine has and whether the hub answers."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from common.access import ROLES
from common.bus import Keys, Member, list_members
from common.errors import NoAnswerError, RefusedError, RunError, UsageError
from common.link import Link, open_client
from common.messages import PROTOCOL, MessageError
from deploy.cli import options

PACKAGES = ("navaclq", "eclipse-zenoh", "torch", "pybullet", "numpy", "onnxruntime", "gymnasium", "pydantic")


def doctor(
    connect: Annotated[
        str | None, typer.Option(envvar="NAVACLQ_CONNECT", help="Endpoint of the hub; exit 1 if silent.")
    ] = None,
    certs: options.Certs = None,
    insecure: options.Insecure = False,
    only_hub: Annotated[
        bool, typer.Option("--only-hub", help="Ask the hub and nothing else, for probes; exit 1 if silent.")
    ] = False,
    member: Annotated[
        str | None,
        typer.Option(metavar="ROLE[/NAME]", help="Exit 1 unless such a process is connected to the hub."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Check versions, cores, pybullet's numpy support, torch's threads, free disk, and a named hub."""
    link = options.make_link(connect or options.DEFAULT_ENDPOINT, certs, insecure)
    wanted = _parse_member(member, link) if member is not None else None
    found = {} if only_hub else examine()
    found["hub"] = _ask_hub(link, wanted, patience=0.0 if only_hub else 1.0)
    if as_json:
        options.print_json(found)
    else:
        for key, value in found.items():
            sys.stdout.write(f"{key:18} {value}\n")
    if not found["hub"]["answers"] and (connect or only_hub or wanted):
        raise typer.Exit(1)
    if wanted and not found["hub"]["members"]:
        raise RunError(f"no {member} is connected to the hub at {link}")


def _parse_member(text: str, link: Link) -> Member:
    """Whom ROLE[/NAME] covers, as far as these credentials may see."""
    match = re.fullmatch(r"([A-Za-z0-9_.-]{1,64})(?:/([A-Za-z0-9_.-]{1,64}))?", text)
    if not match:
        raise UsageError(f"--member {text!r} must be ROLE or ROLE/NAME, for example actor/host-a-0")
    group = "*" if link.credentials is None or link.group in ROLES else link.group
    return Member(match[1], group, match[2] or "*")


def examine() -> dict[str, Any]:
    """Versions and resources of this machine."""
    import torch

    from actor.world.bullet import has_numpy

    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "versions": {name: version(name) for name in PACKAGES},
        "protocol": PROTOCOL,
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2),
        "pybullet_numpy": has_numpy(),
        "torch_threads": torch.get_num_threads(),
        "cuda": torch.cuda.is_available(),
        "free_disk_gb": round(shutil.disk_usage(Path.cwd()).free / 1e9, 1),
    }


def _ask_hub(link: Link, wanted: Member | None, patience: float) -> dict[str, Any]:
    """Whether it is there, and who of the wanted; else the run, for which it waits up to `patience` s."""
    from common.contract import fetch_contract

    answer: dict[str, Any] = {"endpoint": str(link), "answers": False}
    try:
        with open_client(link, patience=1.0) as session:
            answer["answers"] = True
            if wanted:
                found = list_members(session, Keys("*"), wanted)
                answer["members"] = sorted(str(member) for member in found)
            else:
                answer["run"] = fetch_contract(session, patience=patience).run
    except (NoAnswerError, RefusedError, MessageError, UsageError) as error:
        answer["reason"] = str(error)
    return answer
