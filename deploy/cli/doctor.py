"""`navaclq doctor`: what this machine has and whether the hub answers."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from common.bus import NoAnswerError, RefusedError, check_endpoint, open_client
from common.messages import SCHEMA_VERSION, MessageError
from deploy.cli import options

PACKAGES = ("navaclq", "eclipse-zenoh", "torch", "pybullet", "numpy", "onnxruntime", "gymnasium", "pydantic")


def doctor(
    connect: Annotated[str | None, typer.Option(help="Endpoint of the hub; exit 1 if silent.")] = None,
    insecure: options.Insecure = False,
    as_json: options.Json = False,
) -> None:
    """Check versions, cores, pybullet's numpy support, torch's threads, free disk, and a named hub."""
    address = check_endpoint(connect or options.DEFAULT_ENDPOINT, insecure)
    found = examine()
    found["hub"] = _ask_hub(address)
    if as_json:
        options.print_json(found)
    else:
        for key, value in found.items():
            sys.stdout.write(f"{key:18} {value}\n")
    if connect and not found["hub"]["answers"]:
        raise typer.Exit(1)


def examine() -> dict[str, Any]:
    """Versions and resources of this machine."""
    import torch

    from actor.world.bullet import has_numpy

    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "versions": {name: version(name) for name in PACKAGES},
        "protocol": SCHEMA_VERSION,
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2),
        "pybullet_numpy": has_numpy(),
        "torch_threads": torch.get_num_threads(),
        "cuda": torch.cuda.is_available(),
        "free_disk_gb": round(shutil.disk_usage(Path.cwd()).free / 1e9, 1),
    }


def _ask_hub(address: str) -> dict[str, Any]:
    from common.contract import fetch_contract

    answer: dict[str, Any] = {"endpoint": address, "answers": False}
    try:
        with open_client(address, patience=1.0) as session:
            answer["answers"] = True
            answer["run"] = fetch_contract(session, patience=1.0).run
    except (NoAnswerError, RefusedError, MessageError) as error:
        answer["reason"] = str(error)
    return answer
