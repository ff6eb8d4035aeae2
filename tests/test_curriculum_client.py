"""docs/curriculum-protocol.md: it names every field, its examples are messages, and what it says is so."""

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from common import messages
from common.bus import Keys, ask, ask_bytes
from common.config import Config, resolve
from common.errors import RefusedError
from common.messages import (
    Message,
    Nothing,
    Outcome,
    Proposal,
    Proposals,
    Receipt,
    Scored,
    ScoreQuery,
    Scores,
    Snapshot,
    TaskQuery,
    decode,
    encode,
)
from curriculum.service import CurriculumService
from tests.helpers import STORED, deliver, deliver_all, parcel, reason, wait_until

ROOT = Path(__file__).parents[1]
CLIENT = ROOT / "examples" / "curriculum_client.py"
TOML = ROOT / "examples" / "gymnasium_curriculum.toml"
TEXT = (ROOT / "docs" / "curriculum-protocol.md").read_text("utf-8")
SECTIONS = {part.partition("\n")[0]: part for part in re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]}
DESCRIBED = (TaskQuery, Proposals, Proposal, Outcome, Receipt, ScoreQuery, Scored, Scores, Nothing, Snapshot)
KEYS = Keys("standalone")
TASK = {"distance": 1.5, "gap": 0.3, "wind": 0.1}
OUTCOME = Outcome(proposal=None, task=TASK, success=True)


@pytest.fixture
def started(hub: zenoh.Session) -> Iterator[Callable[..., CurriculumService]]:
    """Starts a curriculum for the example's parameters on the hub, in place of the one before."""
    services: list[CurriculumService] = []

    def start(
        *settings: str, digest: dict[str, str] | None = None, folder: Path | None = None
    ) -> CurriculumService:
        for service in services:
            service.close()
            service._token.undeclare()
        services.clear()
        config: Config = resolve(file=TOML, overrides=settings)
        services.append(CurriculumService(hub, "standalone", config, digest, folder))
        return services[-1]

    yield start
    for service in services:
        service.close()


def run_client(endpoint: str, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(CLIENT), endpoint, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd="/", env={**os.environ})


def question(name: str, fields: dict, version: int = 1) -> bytes:
    return msgpack.packb([version, name, fields])


def query(client: zenoh.Session, count: int = 1) -> list[Proposal]:
    return ask(client, KEYS.task, TaskQuery(cell=0, count=count), Proposals).tasks


# The script


def test_client_imports_nothing_of_this_project():
    tree = ast.walk(ast.parse(CLIENT.read_text("utf-8")))
    imported = {alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names}
    assert imported == {"json", "sys", "zlib", "msgpack", "zenoh"}
    assert "ImportFrom" not in ast.dump(ast.parse(CLIENT.read_text("utf-8")))


def test_client_gets_tasks_scores_them_and_reports(endpoint, hub, started):
    service = started()
    for times in (1, 2):  # a second life is another sender
        done = run_client(endpoint)
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        tasks = [Proposal.model_validate(task) for task in told["tasks"]]
        scores = Scores.model_validate(told["scores"])
        assert len(tasks) == len(scores.f) == 2
        assert scores.properties == [task.properties for task in tasks]
        assert scores.outcomes == times - 1
        assert told["receipt"] == {"answers": [""]}
        assert service.curriculum.outcomes == times
        assert service.curriculum.database.count_leases() == times
    recorded = [outcome.result for outcome in service.curriculum.database.outcomes()]
    assert recorded[-1].entry.task == tasks[0].task
    assert [(result.category, result.success) for result in recorded] == [("gate", True)] * 2


def test_client_says_why_it_is_refused_or_that_nobody_answers(endpoint, hub, started):
    done = run_client(endpoint)
    assert (done.returncode, done.stderr) == (1, "nobody answers navaclq/standalone/curriculum/task\n")
    started("curriculum.algorithm=rnd", "curriculum.gate.enabled=false")
    done = run_client(endpoint)
    assert (done.returncode, done.stderr) == (1, "refused: rnd predicts nothing\n")
    done = run_client(endpoint, "another")
    assert (done.returncode, done.stderr) == (1, "nobody answers navaclq/another/curriculum/task\n")


# The document


@pytest.mark.parametrize("kind", DESCRIBED, ids=lambda kind: kind.__name__)
def test_every_field_has_its_row_and_every_row_its_field(kind):
    section = SECTIONS[kind.__name__].partition("**Delivery.**")[0]
    rows = re.findall(r"^\| `(\w+)` \|", section, flags=re.MULTILINE)
    assert rows == list(kind.model_fields)


@pytest.mark.parametrize("kind", DESCRIBED, ids=lambda kind: kind.__name__)
def test_defaults_are_those_of_the_fields(kind):
    section = SECTIONS[kind.__name__].partition("**Delivery.**")[0]
    fields = kind.model_fields.items()
    expected = {name: field.default for name, field in fields if not field.is_required()}
    found = {}
    if "| default |" in section:
        for name, default in re.findall(r"^\| `(\w+)` \| [^|]* \| ([^|]*?) ?\|", section, flags=re.MULTILINE):
            if default:
                found[name] = {"nil": None, "{}": {}, "0": 0, "1": 1}[default]
    assert found == expected


def test_categories_and_algorithms_are_named():
    for name in ("easy", "frontier", "random", "gate", "rnd", "schedule", "sfl"):
        assert f"`{name}`" in SECTIONS["Proposal"]
    for name in ("navacl-q", "navacl-q+", "rnd", "schedule", "sfl"):
        assert f"`{name}`" in SECTIONS["Snapshot"]


def test_examples_are_messages():
    found = [json.loads(text) for text in re.findall(r"^```json\n(.+?)\n```", TEXT, re.MULTILINE | re.DOTALL)]
    assert [name for _, name, _ in found] == ["TaskQuery", "Outcome", "ScoreQuery"]
    for example in found:
        kind: type[Message] = getattr(messages, example[1])
        assert encode(decode(kind, msgpack.packb(example)))


# What it says


def test_a_question_may_leave_out_defaults_and_the_run(client, started):
    started()
    payload = question("TaskQuery", {"cell": 0})
    for key in (KEYS.task, Keys("*").task):
        assert len(decode(Proposals, ask_bytes(client, key, payload)).tasks) == 1
    payload, key = encode(OUTCOME), f"{Keys('*').result}/local/a1"
    attachment = msgpack.packb([["local/a1", "b", 0, len(payload), 0]])
    with pytest.raises(RefusedError, match="under another's name"):
        ask_bytes(client, key, payload, attachment)


@pytest.mark.parametrize(
    ("key", "payload", "words"),
    [
        (KEYS.task, question("TaskQuery", {"cell": 0}, version=2), "schema version: '2'"),
        (KEYS.task, question("Query", {"cell": 0}), "message of another type: 'Query'"),
        (KEYS.task, question("TaskQuery", {"cell": 0, "x": 1}), r"TaskQuery\.x: Extra inputs"),
        (KEYS.task, question("TaskQuery", {"cell": 1}), "cell: 1 does not exist here"),
        (
            KEYS.task,
            question("TaskQuery", {"cell": 0, "count": 1001}),
            re.escape("TaskQuery.count: Input should be less than or equal to 1000"),
        ),
        (KEYS.task, b"x" * (2**20 + 1), "too large: 1048577 bytes; at most 1048576"),
        (KEYS.snapshot, b"", "not msgpack"),
        (KEYS.score, question("ScoreQuery", {"tasks": []}), r"ScoreQuery\.tasks"),
        (KEYS.score, question("ScoreQuery", {"tasks": [{}]}), "either task or properties"),
        (KEYS.score, question("ScoreQuery", {"tasks": [{"task": TASK | {"gap": 9}}]}), "gap is 9; it lies"),
        (
            KEYS.score,
            question("ScoreQuery", {"tasks": [{"properties": {"gap": 1}}]}),
            "distance: missing; needed are distance, gap, wind",
        ),
        (f"{KEYS.result}/local/a1", encode(OUTCOME), "header: expected"),
    ],
)
def test_refusals_are_sentences(client, started, key, payload, words):
    started()
    with pytest.raises(RefusedError, match=words):
        ask_bytes(client, key, payload)
    assert len(query(client)) == 1


def test_properties_are_not_held_to_ranges_and_integers_stand_for_floats(client, started):
    started()
    scored = question("ScoreQuery", {"tasks": [{"properties": {"distance": 30, "gap": 9, "wind": 0}}]})
    answer = decode(Scores, ask_bytes(client, KEYS.score, scored))
    assert answer.properties == [{"distance": 30.0, "gap": 9.0, "wind": 0.0}]
    assert 0 <= answer.f[0] <= 1


def test_outcomes_count_once_by_number_and_by_proposal(client, started):
    service = started()
    (proposal,) = query(client)
    told = Outcome(proposal=proposal.id, task=proposal.task, success=True)
    for seq in (0, 0, 1):
        assert deliver(client, KEYS.result, told, seq) == STORED
    assert service.curriculum.outcomes == 1
    for seq in (2, 3):
        assert deliver(client, KEYS.result, OUTCOME, seq) == STORED
    assert service.curriculum.outcomes == 3
    wrong = OUTCOME.model_copy(update={"task": {"gap": 1.0}})
    assert reason(deliver(client, KEYS.result, wrong, 4)).startswith("task: ")
    assert "jumps too far ahead" in reason(deliver(client, KEYS.result, OUTCOME, 20_000))
    assert deliver(client, KEYS.result, OUTCOME, 4) == STORED, "a refusal uses no number up"
    assert service.curriculum.outcomes == 4


def test_64_outcomes_go_together_and_not_one_more(client, started):
    service = started()
    parcels = [parcel(OUTCOME, seq) for seq in range(65)]
    with pytest.raises(RefusedError, match="header: 65 messages"):
        deliver_all(client, KEYS.result, parcels)
    assert deliver_all(client, KEYS.result, parcels[:64]).answers == [""] * 64
    assert service.curriculum.outcomes == 64


def test_curriculum_goes_by_its_own_record_of_a_proposal(client, started):
    service = started()
    (proposal,) = query(client)
    unknown = Outcome(proposal="unknown", task=TASK | {"gap": 99.0}, success=False)
    assert reason(deliver(client, KEYS.result, unknown, 0)).startswith("task: gap is 99;")
    told = Outcome(proposal=proposal.id, task=TASK, success=False)
    assert deliver(client, KEYS.result, told, 0) == STORED
    (outcome,) = service.curriculum.database.outcomes()
    assert outcome.result.entry.task == proposal.task


def test_a_second_outcome_of_a_proposal_is_acknowledged_whatever_it_says_of_the_task(client, started):
    service = started()
    (proposal,) = query(client)
    dummy = Outcome(proposal=proposal.id, task=TASK | {"gap": 99.0}, success=False)
    told = deliver_all(client, KEYS.result, [parcel(dummy, seq) for seq in range(2)])
    assert told.answers == ["", ""]
    assert deliver(client, KEYS.result, dummy, 2) == STORED
    assert service.curriculum.outcomes == 1


def test_a_lease_that_ran_out_counts_as_proposed_for_as_long_again(client, started, tmp_path):
    first = started("curriculum.lease=0.001", folder=tmp_path)
    proposals = query(client, count=2)
    wait_until(lambda: first.curriculum.database.count_leases() == 0, what="the end of the leases")
    for seq, proposal in enumerate(proposals):
        told = Outcome(proposal=proposal.id, task=proposal.task, success=True)
        assert deliver(client, KEYS.result, told, seq) == STORED
        if seq == 0:
            second = started("curriculum.lease=0.001", folder=tmp_path)
    categories = [outcome.result.category for outcome in second.curriculum.database.outcomes()]
    assert categories == ["gate", "unserved"]
    again = Outcome(proposal=proposals[0].id, task=proposals[0].task, success=True)
    assert deliver(client, KEYS.result, again, 0, boot="b2") == STORED
    assert second.curriculum.outcomes == 2, "told before the restart"


def test_only_the_curriculum_of_a_run_looks_at_the_digest(client, started):
    service = started(digest={"protocol": "2", "reward": "0123"})
    assert "contract differs in 'protocol'" in reason(deliver(client, KEYS.result, OUTCOME, 0))
    ours = OUTCOME.model_copy(update={"digest": {"protocol": "2", "reward": "4567"}})
    words = "contract differs in 'reward': this run has 0123, got 4567"
    assert reason(deliver(client, KEYS.result, ours, 0)) == words
    ours = OUTCOME.model_copy(update={"digest": {"protocol": "2", "reward": "0123"}})
    assert deliver(client, KEYS.result, ours, 0) == STORED
    assert service.curriculum.outcomes == 1


def test_snapshot_tells_of_leases_and_categories(client, started):
    started()
    query(client, count=3)
    told = ask(client, KEYS.snapshot, Nothing(), Snapshot)
    assert (told.candidates, told.leases, told.proposed) == ([0], 3, {"gate": 3})
    assert (told.inputs, told.gate_open, told.brier) == (["distance", "gap", "wind"], False, None)
    assert told.network[8:].startswith(b"{")
