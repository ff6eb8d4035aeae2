"""The run's contract: what every actor, curriculum and learner of a run must agree on.

The digest holds one short hash per field, so that a refusal can name the field that differs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import reduce
from operator import getitem
from typing import Any

import zenoh

from common.bus import Keys, ask
from common.cells import CELLS
from common.config import Config, differing_keys, override, parse
from common.errors import UsageError
from common.files import content_hash
from common.messages import PROTOCOL, ContractReply, MessageError, Nothing
from common.observation import HISTORY

CONTRACT_DIFFERS = "contract differs"
"""How a refusal for that begins."""
AGREED = {
    "observation": ("world.camera", "world.lidar", "world.randomization", "encoder"),
    "dynamics": (
        "world.version",
        "world.robot",
        "world.dolly",
        "world.obstacles",
        "world.control_period",
        "world.substeps",
    ),
    "reward": ("world.reward", "world.max_episode_steps"),
}
"""The settings behind each field of the digest; obstacles, because a task's scene follows from them."""


def _short(value: Any) -> str:
    data = value if isinstance(value, bytes) else json.dumps(value, sort_keys=True).encode()
    return content_hash(data)


def digest(config: Config, encoder: bytes) -> dict[str, str]:
    """Hashes of all that must agree, by field; `encoder` is the frozen encoder's weights."""
    values = config.model_dump(mode="json")
    settings: dict[str, list[Any]] = {
        field: [reduce(getitem, path.split("."), values) for path in paths] for field, paths in AGREED.items()
    }
    settings["observation"].append(HISTORY)
    settings["dynamics"].append(repr(CELLS))
    return {
        "protocol": str(PROTOCOL),
        "encoder": _short(values["encoder"]) if config.encoder.end_to_end else _short(encoder),
        **{field: _short(value) for field, value in settings.items()},
    }


def check_digest(ours: dict[str, str], theirs: dict[str, str]) -> None:
    """Raises MessageError naming the first field in which a sender differs from this run."""
    for field, value in ours.items():
        if theirs.get(field) != value:
            raise MessageError(
                f"{CONTRACT_DIFFERS} in {field!r}: this run has {value}, got {theirs.get(field)}"
            )


def make_contract(run: str, config: Config, encoder: bytes) -> ContractReply:
    """The contract of a run with these weights of its frozen encoder."""
    return ContractReply(run=run, config=config.to_toml(), encoder=encoder, digest=digest(config, encoder))


def accept_contract(contract: ContractReply, overrides: tuple[str, ...] = ()) -> Config:
    """The configuration to work with: the run's, with local overrides that do not touch the contract.

    Raises UsageError naming the field, and the key within it, when an override (or another version of the
    code) would make this process differ from the run.
    """
    theirs = parse(contract.config)
    ours = override(theirs.model_dump(mode="json"), overrides)
    mine = digest(ours, contract.encoder)
    for field, value in contract.digest.items():
        if mine.get(field) != value:
            found = differing_keys(ours, theirs, AGREED.get(field, (field,)))
            detail = f": {found[0][0]} is {found[0][1]} here and {found[0][2]} there" if found else ""
            raise UsageError(f"refused by run {contract.run!r}: {field} differs{detail}")
    return ours


def fetch_contract(
    session: zenoh.Session, on_wait: Callable[[float], None] | None = None, patience: float = math.inf
) -> ContractReply:
    """Asks whoever serves this endpoint for the run's contract, until somebody answers."""
    return ask(session, Keys("*").contract, Nothing(), ContractReply, 5.0, patience, on_wait)
