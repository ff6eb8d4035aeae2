"""Real processes of the command for the time of a benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from common.contract import fetch_contract
from common.errors import RunError
from common.link import make_link, open_client
from common.messages import ContractReply
from deploy.launcher import Child

PATIENCE = 60.0
"""Seconds after which something is broken."""


@contextmanager
def running(name: str, command: list[str], log_file: Path) -> Iterator[Child]:
    """A command of navaclq, ended by SIGTERM; raises RunError when it fails then."""
    child = Child(name, lambda: command, log_file)
    try:
        child.start()
        yield child
        assert child.process is not None
        child.process.terminate()
        if child.process.wait(PATIENCE):
            raise RunError(f"the {name} failed: {child.last_words()}")
    finally:
        if child.process:
            child.process.kill()
            child.process.wait()


def look_after(child: Child) -> Callable[[float], None]:
    """What waits for a process calls: raises RunError when it is dead, or too much time has gone."""

    def look(waited: float) -> None:
        if not child.alive or waited > PATIENCE:
            raise RunError(f"the {child.name} does not start: {child.last_words()}")

    return look


@contextmanager
def running_learner(run: Path, config: Path, endpoint: str) -> Iterator[tuple[int, ContractReply]]:
    """Process id of a learner that listens, and its contract."""
    command = ["learner", "--run", str(run), "--config", str(config), "--listen", endpoint]
    with running("learner", command, run.with_suffix(".log")) as child:
        assert child.process is not None
        with open_client(make_link(endpoint), look_after(child)) as session:
            contract = fetch_contract(session, look_after(child))
        yield child.process.pid, contract
