"""Fixtures of all tests: the same examples of Hypothesis in every run, and a hub with a client."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling

from common.link import make_link, open_client, open_hub
from tests.crew import Crew
from tests.helpers import free_endpoint

settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")


WHOLE_SYSTEMS = ("chaos", "cli_pretrain", "damage", "hosts", "interrupt", "kills", "system", "top")
"""Files whose tests start several processes: never two of them at a time."""


class Files(LoadScopeScheduling):
    """Gives xdist's workers whole files, and all those of whole systems to one of them."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return "systems" if Path(file).stem.removeprefix("test_") in WHOLE_SYSTEMS else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> Files:
    return Files(config, log)


@pytest.fixture
def endpoint() -> str:
    """A loopback endpoint that nobody listens on yet."""
    return free_endpoint()


@pytest.fixture
def hub(endpoint: str) -> Iterator[zenoh.Session]:
    """A hub that listens on `endpoint`."""
    with open_hub(make_link(endpoint)) as session:
        yield session


@pytest.fixture
def client(endpoint: str, hub: zenoh.Session) -> Iterator[zenoh.Session]:
    """A client of `hub`."""
    with open_client(make_link(endpoint), patience=10.0) as session:
        yield session


@pytest.fixture
def crew(tmp_path: Path) -> Iterator[Crew]:
    """A system whose processes a test starts, kills and stops."""
    found = Crew(tmp_path)
    yield found
    found.close()


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """For networks that are too small for more threads of torch, when the machine may be busy."""
    import torch  # heavy, and few tests need it

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
