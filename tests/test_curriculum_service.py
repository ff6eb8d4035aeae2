import json
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from common.bus import INTERNAL_ERROR, Keys, Member, QueryServer, ask, ask_bytes, publish
from common.config import Config
from common.contract import make_contract
from common.delivery import DAMAGED, Sender, Spool, pack_bundle
from common.encoders import pack_encoder
from common.errors import RefusedError, UsageError
from common.messages import (
    Candidates,
    Origin,
    Outcome,
    Proposal,
    Proposals,
    TaskQuery,
    Version,
    encode,
)
from common.networks import make_encoder
from common.weights import pack
from curriculum.curriculum import Curriculum, Report
from curriculum.database import Database
from curriculum.service import CurriculumService
from deploy.cli.main import app
from learner.sac import SAC
from tests.helpers import STORED, deliver, deliver_all, largest_file, parcel, reason, small_config, wait_until
from tests.test_curriculum import make_candidate

CONFIG = small_config("curriculum.gate.window=4")
ENCODER = pack_encoder(make_encoder(CONFIG))
OPEN = small_config("curriculum.gate.enabled=false")
KEYS = Keys("run-1")
DIGEST = make_contract("run-1", CONFIG, ENCODER).digest


@pytest.fixture
def started(hub: zenoh.Session) -> Iterator[Callable[..., CurriculumService]]:
    """Starts a curriculum on the hub: no learner, no actor."""
    services: list[CurriculumService] = []

    def start(
        config: Config = CONFIG, digest: dict[str, str] | None = None, folder: Path | None = None
    ) -> CurriculumService:
        services.append(CurriculumService(hub, "run-1", config, digest, folder))
        return services[-1]

    yield start
    for service in services:
        service.close()


def query(client: zenoh.Session, cell: int = 0, count: int = 1, key: str = KEYS.task) -> list[Proposal]:
    return ask(client, key, TaskQuery(cell=cell, t=0, count=count), Proposals).tasks


def outcome_of(proposal: Proposal, success: bool = True, digest: dict[str, str] = DIGEST) -> Outcome:
    return Outcome(digest=digest, proposal=proposal.id, task=proposal.task, success=success)


def test_tasks_are_proposed_without_a_learner(client, started):
    started()
    for cell in (0, 8):
        (proposal,) = query(client, cell)
        assert proposal.task.cell == cell
        assert proposal.category == "gate"


def test_five_tasks_are_proposed_at_once_and_by_a_query_that_does_not_know_the_run(client, started):
    started()
    tasks = query(client, cell=3, count=5, key=Keys("*").task)
    assert [p.task.cell for p in tasks] == [3] * 5
    assert len({p.task.seed for p in tasks}) == len({p.id for p in tasks}) == 5


@pytest.mark.parametrize(
    "payload",
    [b"", b"junk" * 100, encode(TaskQuery(cell=1))[:-3], b"\x93\x01\xa9TaskQuery\x81\xa4cell\x63"],
)
def test_malformed_queries_are_refused_and_the_service_goes_on(client, started, payload):
    service = started()
    with pytest.raises(RefusedError):
        ask_bytes(client, KEYS.task, payload)
    for channel in (KEYS.result, KEYS.candidates):
        with pytest.raises(RefusedError, match=r"^header: "):
            ask_bytes(client, f"{channel}/local/a1", payload)
        assert reason(deliver(client, channel, payload, 0)) not in ("BUSY", INTERNAL_ERROR)
    assert len(query(client, count=2)) == 2
    assert [sum(server.refused.values()) for server in service._servers] == [1, 0, 0, 2, 2]
    assert (service.curriculum.outcomes, len(service.curriculum)) == (0, 0)


def test_impossible_cell_is_refused_with_the_reason(client, started):
    started()
    wrong = encode(TaskQuery(cell=1)).replace(b"\xa4cell\x01", b"\xa4cell\x09")
    with pytest.raises(RefusedError, match=r"TaskQuery\.cell: Input should be less than 9"):
        ask_bytes(client, KEYS.task, wrong)


def test_outcome_is_acknowledged_and_a_duplicate_counts_once(client, started):
    service = started()
    proposals = query(client, count=2)
    assert deliver(client, KEYS.result, outcome_of(proposals[0]), 0) == STORED
    assert service.curriculum.outcomes == 1
    for _ in range(3):
        assert deliver(client, KEYS.result, outcome_of(proposals[0]), 0) == STORED
    assert duplicates(service) == [3, 0]
    assert service.curriculum.outcomes == 1
    assert list(service.curriculum.gate.outcomes) == [True]
    assert deliver(client, KEYS.result, outcome_of(proposals[1], success=False), 1) == STORED
    assert deliver(client, KEYS.result, outcome_of(proposals[1]), 0, boot="b2") == STORED
    assert list(service.curriculum.gate.outcomes) == [True, False], "a proposal ends once, whoever says so"
    assert service.curriculum.outcomes == 2
    assert duplicates(service) == [3, 0]


def duplicates(service: CurriculumService) -> list[int]:
    """Of outcomes and of candidates."""
    return [server.duplicates for server in service._servers[3:]]


def test_outcomes_that_come_together_are_taken_one_by_one(client, started):
    service = started(digest=DIGEST)
    good, again, foreign, other = query(client, count=4)
    messages = [
        (outcome_of(good), 0),
        (outcome_of(foreign, digest=DIGEST | {"reward": "0123"}), 1),
        (outcome_of(other, success=False), 2),
        (outcome_of(again), 0),
    ]
    receipt = deliver_all(client, KEYS.result, [parcel(message, seq) for message, seq in messages])
    assert receipt.answers[0] == receipt.answers[2] == receipt.answers[3] == ""
    assert "contract differs in 'reward'" in receipt.answers[1]
    assert list(service.curriculum.gate.outcomes) == [True, False]
    assert duplicates(service) == [1, 0]


def test_outcomes_that_come_together_are_committed_by_sixteens(client, started, tmp_path, monkeypatch):
    service = started(OPEN, folder=tmp_path)
    proposals, commits = query(client, count=40), []
    commit = service.curriculum.database.commit
    monkeypatch.setattr(service.curriculum.database, "commit", lambda: commits.append(commit()))
    parcels = [parcel(outcome_of(proposal), seq) for seq, proposal in enumerate(proposals)]
    assert deliver_all(client, KEYS.result, parcels).answers == [""] * 40
    assert len(commits) == 3
    assert service.curriculum.outcomes == 40


def test_outcomes_open_the_gate_for_the_next_query(client, started):
    started()
    for seq, proposal in enumerate(query(client, count=4)):
        assert proposal.category == "gate"
        assert deliver(client, KEYS.result, outcome_of(proposal), seq) == STORED
    assert query(client)[0].category != "gate"


def count(service: CurriculumService, cell: int) -> int:
    """Candidates of a cell in the database."""
    return service.curriculum.snapshot().candidates[cell]


def test_candidates_are_stored_once_and_proposed(client, started):
    service = started(OPEN)
    message = Candidates(digest=DIGEST, candidates=[make_candidate(OPEN, seed, cell=2) for seed in range(4)])
    assert [deliver(client, KEYS.candidates, message, 7) for _ in range(2)] == [STORED, STORED]
    assert duplicates(service) == [0, 1]
    assert count(service, 2) == 4
    proposals = query(client, cell=2, count=4)
    assert sorted(p.task.seed for p in proposals) == [0, 1, 2, 3]
    assert count(service, 2) == 4
    for seq, proposal in enumerate(proposals):
        assert deliver(client, KEYS.result, outcome_of(proposal), seq) == STORED
        assert count(service, 2) == 3 - seq, "what was reported has left"


def test_candidate_of_another_layout_is_refused_and_the_service_goes_on(client, started):
    service = started(OPEN)
    other = small_config("world.camera.size=32")
    message = Candidates(digest={}, candidates=[make_candidate(other, 0)])
    refused = reason(deliver(client, KEYS.candidates, message, 0))
    assert "candidate visual is float16 (16,), expected float16 (4,)" in refused
    assert len(service.curriculum) == 0
    good = Candidates(digest={}, candidates=[make_candidate(OPEN, 0)])
    assert deliver(client, KEYS.candidates, good, 1) == STORED
    assert len(service.curriculum) == 1


@pytest.mark.parametrize("field", ["protocol", "encoder", "observation", "dynamics", "reward"])
def test_message_of_a_foreign_contract_is_refused_naming_the_field(client, started, field):
    service = started(digest=DIGEST)
    (proposal,) = query(client)
    foreign = DIGEST | {field: "0123"}
    for key, message in (
        (KEYS.result, outcome_of(proposal, digest=foreign)),
        (KEYS.candidates, Candidates(digest=foreign, candidates=[make_candidate(CONFIG, 0)])),
    ):
        refused = reason(deliver(client, key, message, 0))
        assert refused.startswith(f"contract differs in '{field}': ")
        assert refused.endswith(" got 0123")
    assert (service.curriculum.outcomes, len(service.curriculum)) == (0, 0)
    assert deliver(client, KEYS.result, outcome_of(proposal), 0) == STORED
    assert duplicates(service) == [0, 0], "a refusal uses no number up"
    assert service.curriculum.outcomes == 1


def test_damaged_payload_is_refused(client, started):
    service = started()
    whole = parcel(outcome_of(query(client)[0]), 0)
    flipped = whole.payload[:-1] + bytes([whole.payload[-1] ^ 1])
    assert deliver_all(client, KEYS.result, [whole._replace(payload=flipped)]).answers == [DAMAGED]
    payload, header = pack_bundle([whole])
    with pytest.raises(RefusedError, match=r"^header: 1 messages of \d+ bytes, got \d+$"):
        ask_bytes(client, f"{KEYS.result}/local/a1", payload + b"x", header)
    assert service.curriculum.outcomes == 0
    assert deliver_all(client, KEYS.result, [whole]) == STORED
    assert service.curriculum.outcomes == 1


def test_outcome_under_anothers_name_is_refused(client, started):
    service = started()
    outcome = parcel(outcome_of(query(client)[0]), 0, address="local/a2")
    with pytest.raises(RefusedError, match="under another's name: local/a2"):
        deliver_all(client, KEYS.result, [outcome], "local/a1")
    assert service.curriculum.outcomes == 0
    assert deliver_all(client, KEYS.result, [outcome], "local/a2") == STORED


def test_actors_spool_is_emptied_by_the_service(client, started, tmp_path):
    service = started()
    sender = Sender(client, Spool(tmp_path / "spool", 2.0**20), Member("actor", "local", "a1"), "b1")
    for proposal in query(client, count=6):
        sender.put(KEYS.result, outcome_of(proposal, success=False))
    wait_until(lambda: sender.sent == 6, what="all outcomes acknowledged")
    assert sender.close(patience=5.0) == 0
    assert service.curriculum.outcomes == 6


def test_restarted_service_remembers_outcomes_and_what_came_before(hub, client, started, tmp_path):
    first = CurriculumService(hub, "run-1", CONFIG, None, tmp_path / "run")
    for seq, proposal in enumerate(query(client, count=3)):
        assert deliver(client, KEYS.result, outcome_of(proposal), seq) == STORED
    (waiting,) = query(client)
    first.close()
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["curriculum.db"]
    first._token.undeclare()
    second = started(folder=tmp_path / "run")
    assert second.curriculum.outcomes == 3
    assert not second.curriculum.gate.open
    assert deliver(client, KEYS.result, outcome_of(waiting), 2) == STORED
    assert duplicates(second) == [1, 0], "its acknowledgement had got lost"
    assert deliver(client, KEYS.result, outcome_of(waiting), 3) == STORED
    assert second.curriculum.outcomes == 4
    assert second.curriculum.gate.open, "the proposal of before counts as a favourable start"


def test_acknowledged_is_what_survives_a_service_that_is_killed(client, started, tmp_path):
    started(OPEN, folder=tmp_path)
    message = Candidates(digest=DIGEST, candidates=[make_candidate(OPEN, seed) for seed in range(3)])
    assert deliver(client, KEYS.candidates, message, 0) == STORED
    taken, waiting = query(client, count=2)
    assert deliver(client, KEYS.result, outcome_of(taken), 1) == STORED
    dead = tmp_path / "dead"
    dead.mkdir()
    for suffix in ("", "-wal"):  # as they would be left behind
        shutil.copy(tmp_path / f"curriculum.db{suffix}", dead)
    left = Curriculum(OPEN, Database(dead / "curriculum.db"))
    assert (left.outcomes, len(left), left.snapshot().leases) == (1, 2, 1)
    left.report([Report(outcome_of(waiting), Origin(actor="local/a1", boot="b1", seq=2))])
    assert (left.outcomes, len(left), left.snapshot().leases) == (2, 1, 0)
    assert [outcome.result.category for outcome in left.database.outcomes()] == [
        taken.category,
        waiting.category,
    ]


def test_tasks_are_given_on_a_full_disk_and_what_could_not_be_kept_is_taken_later(client, started, tmp_path):
    service = started(folder=tmp_path)
    proposals = query(client, count=2)
    with largest_file(1000):
        assert [p.category for p in query(client, count=3)] == ["gate"] * 3
        with pytest.raises(RefusedError, match=INTERNAL_ERROR):
            deliver(client, KEYS.result, outcome_of(proposals[0]), 0)
        assert service._failed_writes == 1
        assert service.curriculum.outcomes == 0
        service.save()
    assert deliver(client, KEYS.result, outcome_of(proposals[0]), 0) == STORED
    assert (service.curriculum.outcomes, duplicates(service)) == (1, [0, 0])
    assert list(service.curriculum.gate.outcomes) == [True], "the lease of before is still known"
    (proposal,) = query(client)
    assert deliver(client, KEYS.result, outcome_of(proposal), 1) == STORED
    assert service.curriculum.outcomes == 2


def test_second_curriculum_of_a_run_is_refused(started):
    started()
    with pytest.raises(UsageError, match="a curriculum named 'curriculum' is already connected"):
        started()


def run_during(service: CurriculumService, action: Callable[[], None]) -> None:
    """Runs a service, here as signals want it, while a thread does the action and then ends it by SIGTERM."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    ended, failures = threading.Event(), list[BaseException]()

    def act() -> None:
        try:
            action()
        except BaseException as failure:
            failures.append(failure)
        while not ended.wait(0.1):  # again if that was before the service listened to signals
            os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGTERM, lambda *_: None)
    thread = threading.Thread(target=act)
    thread.start()
    try:
        service.run()
    finally:
        ended.set()
        thread.join()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for failure in failures:
        raise failure


def valued_by(service: CurriculumService, version: Version) -> bool:
    versions = service.curriculum.cells[0].table.version.tolist()
    return bool(versions) and all(found == [version.epoch, version.counter] for found in versions)


def test_q_follows_the_weights_that_the_learner_publishes(hub, client):
    sac, version = SAC(OPEN), Version(epoch=1, counter=5)
    weights = {"blob": encode(pack(version, sac.critic_state()))}
    service = CurriculumService(hub, "run-1", OPEN, DIGEST, None)
    _learner = QueryServer(client, KEYS.weights("critic"), lambda *_: weights["blob"])

    def learn() -> None:
        message = Candidates(digest=DIGEST, candidates=[make_candidate(OPEN, seed) for seed in range(2)])
        assert deliver(client, KEYS.candidates, message, 0) == STORED
        for seq, newer in enumerate((version, Version(epoch=2, counter=0)), start=1):
            weights["blob"] = encode(pack(newer, sac.critic_state()))
            publish(client, KEYS.version, newer)
            wait_until(lambda newer=newer: valued_by(service, newer), what=f"Q under weights {newer}")
            (proposal,) = query(client)
            assert (proposal.q_reason, proposal.q_version) == ("critic", f"{newer.epoch}.{newer.counter}")
            assert proposal.q is not None
            assert deliver(client, KEYS.result, outcome_of(proposal), seq) == STORED
            assert len(service.curriculum) == 2 - seq

    run_during(service, learn)
    service.close()


def test_command_prints_one_json_object_with_the_keys_that_programs_read(endpoint, hub, started):
    started(OPEN)
    command = ["curriculum", "query", "--connect", endpoint, "--cell", "3", "--count", "5", "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer.keys() == {"tasks"}
    assert len(answer["tasks"]) == 5
    for task in answer["tasks"]:
        keys = ("id", "cell", "seed", "requested", "category", "why", "properties", "robot", "dolly")
        assert {*keys, "q", "q_version", "q_reason", "f", "mu", "sigma"} <= task.keys()
        assert task["cell"] == 3
        assert task["q"] is None
        assert "geometry" in task["q_reason"]
        names = {"distance", "agent_clearance", "goal_clearance", "relative_angle"}
        assert names <= task["properties"].keys()
        assert len(task["robot"]) == len(task["dolly"]) == 3


def test_json_of_tasks_of_another_environment_keeps_their_numbers_apart_and_can_be_scored(
    endpoint, hub, started, tmp_path
):
    names = ("f", "mu", "x")
    parameters = ",".join(f'{{name="{name}", low=5.0, high=8.0, easy=5.0}}' for name in names)
    started(small_config(f"curriculum.parameters=[{parameters}]", "curriculum.gate.enabled=false"))
    command = ["curriculum", "query", "--connect", endpoint, "--cell", "0", "--count", "3", "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    for task in json.loads(result.stdout)["tasks"]:
        assert task["task"].keys() == set(names)
        assert all(5 <= value <= 8 for value in task["task"].values())
        assert task["q"] is None
        assert 0 <= task["f"] <= 1
    file = tmp_path / "tasks.json"
    file.write_text(result.stdout)
    scored = CliRunner().invoke(app, ["curriculum", "score", str(file), "--connect", endpoint, "--json"])
    assert scored.exit_code == 0, scored.output
    assert len(json.loads(scored.stdout)["f"]) == 3
