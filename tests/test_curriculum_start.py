"""How a curriculum begins: it answers before torch is loaded, which only Q of candidates needs."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from common.bus import Keys, QueryServer, ask, publish, serve
from common.contract import make_contract
from common.encoders import pack_encoder
from common.messages import Candidates, Nothing, Proposals, TaskQuery, Version, encode
from common.networks import make_encoder
from common.weights import pack
from learner.sac import SAC
from tests.crew import Processes
from tests.helpers import STORED, deliver, small_config, wait_until
from tests.test_curriculum import make_candidate

CONFIG = small_config("curriculum.gate.enabled=false", "curriculum.lease=1e-9")
CONTRACT = make_contract("run-1", CONFIG, pack_encoder(make_encoder(CONFIG)))
KEYS = Keys("run-1")
HEAVY = ("torch", "scipy", "matplotlib", "pybullet", "onnxruntime", "gymnasium", "PIL", "tensorboard")


@pytest.fixture
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Processes]:
    """Processes that write down what they import."""
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    found = Processes(tmp_path)
    yield found
    found.close()


def imported(processes: Processes) -> set[str]:
    """Top-level modules that the curriculum has loaded so far."""
    return set(re.findall(r"^import time: .*\| +(\w+)", processes.words("curriculum"), re.MULTILINE))


def test_first_answer_needs_nothing_heavy(processes, endpoint, hub, client):
    _contract = serve(hub, KEYS.contract, Nothing, lambda _: CONTRACT)
    processes.start("curriculum", "curriculum", "serve", "--connect", endpoint)
    ask(client, KEYS.task, TaskQuery(cell=0), Proposals, timeout=5, patience=60)
    message = Candidates(
        digest=CONTRACT.digest, candidates=[make_candidate(CONFIG, seed) for seed in range(2)]
    )
    assert deliver(client, KEYS.candidates, message, 0) == STORED
    (proposal,) = ask(client, KEYS.task, TaskQuery(cell=0), Proposals).tasks
    assert proposal.q_reason == "no critic yet"
    assert "zenoh" in imported(processes)
    assert not imported(processes) & set(HEAVY)


def test_q_is_there_once_there_are_weights(processes, endpoint, hub: zenoh.Session, client):
    blob = encode(pack(Version(epoch=1, counter=5), SAC(CONFIG).critic_state()))
    _contract = serve(hub, KEYS.contract, Nothing, lambda _: CONTRACT)
    _learner = QueryServer(hub, KEYS.weights("critic"), lambda *_: blob)
    processes.start("curriculum", "curriculum", "serve", "--connect", endpoint)
    ask(client, KEYS.task, TaskQuery(cell=0), Proposals, timeout=5, patience=60)
    message = Candidates(
        digest=CONTRACT.digest, candidates=[make_candidate(CONFIG, seed) for seed in range(2)]
    )
    assert deliver(client, KEYS.candidates, message, 0) == STORED
    publish(client, KEYS.version, Version(epoch=1, counter=5))

    def version() -> str | None:
        return ask(client, KEYS.task, TaskQuery(cell=0), Proposals).tasks[0].q_version

    assert wait_until(version, timeout=30, what="Q under the learner's weights") == "1.5"
    assert "torch" in imported(processes)
