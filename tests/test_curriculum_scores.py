"""Scores and snapshots over the bus and by the command, and a curriculum that is killed."""

import json
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import safetensors.numpy
import zenoh

from common.bus import Keys, Member, ask, ask_bytes
from common.config import Config
from common.delivery import Sender, Spool
from common.errors import RefusedError
from common.link import make_link, open_client
from common.messages import (
    SCHEMA_VERSION,
    Candidates,
    M,
    Message,
    Nothing,
    Outcome,
    Proposal,
    Proposals,
    Scored,
    ScoreQuery,
    Scores,
    Snapshot,
    TaskQuery,
)
from common.tasks import Task
from curriculum.service import DATABASE, CurriculumService
from deploy.cli.main import run
from tests.crew import Processes
from tests.helpers import STORED, deliver, small_config, wait_until
from tests.test_curriculum_database import boxed, make_candidate

pytestmark = pytest.mark.usefixtures("one_thread")
OPEN = small_config("curriculum.gate.enabled=false", "curriculum.batch_size=4")
BOX = boxed("curriculum.batch_size=4")
KEYS = Keys("run-1")
ROW = {
    "distance": 2.5,
    "agent_clearance": 1.5,
    "goal_clearance": 2.0,
    "relative_angle": 0.3,
    "lateral_offset": 0.4,
    "approach_angle": 0.1,
}


@pytest.fixture
def started(hub: zenoh.Session) -> Iterator[Callable[..., CurriculumService]]:
    """Starts a curriculum on the hub: no learner, no actor."""
    services: list[CurriculumService] = []

    def start(config: Config = OPEN, folder: Path | None = None) -> CurriculumService:
        services.append(CurriculumService(hub, "run-1", config, None, folder))
        return services[-1]

    yield start
    for service in services:
        with suppress(zenoh.ZError):
            service.close()


def query(client: zenoh.Session, cell: int = 0, count: int = 1) -> list[Proposal]:
    return ask(client, KEYS.task, TaskQuery(cell=cell, t=0, count=count), Proposals).tasks


def score(client: zenoh.Session, *tasks: Scored) -> Scores:
    return ask(client, KEYS.score, ScoreQuery(tasks=list(tasks)), Scores)


def snapshot(client: zenoh.Session) -> Snapshot:
    return ask(client, KEYS.snapshot, Nothing(), Snapshot)


def packed(kind: str, **fields: object) -> bytes:
    """A message that need not be a valid one."""
    return bytes(msgpack.packb([SCHEMA_VERSION, kind, fields]))


def teach(client: zenoh.Session, outcomes: int) -> None:
    """Outcomes of tasks of the docking world, most of which succeed."""
    for seed in range(outcomes):
        task = Task(cell=seed % 9, seed=seed, start=OPEN.world.start)
        outcome = Outcome(proposal=None, task=task, success=seed % 3 > 0)
        assert deliver(client, KEYS.result, outcome, seed) == STORED


def f_pi(file: bytes, rows: list[dict[str, float]], q: list[float | None]) -> np.ndarray:
    """Predictions (N,) computed from nothing but the bytes of a snapshot's file."""
    (size,) = struct.unpack("<Q", file[:8])
    about = json.loads(json.loads(file[8 : 8 + size])["__metadata__"]["f_pi"])
    columns = [scaled(about, name, rows, q) for name in about["inputs"]]
    x, tensors = np.stack(columns, axis=1), safetensors.numpy.load(file)
    weights = sorted(name for name in tensors if name.endswith("weight"))
    assert len(weights) == 3
    for index, name in enumerate(weights):
        x = x @ tensors[name].T.astype(float) + tensors[name.replace("weight", "bias")]
        x = np.maximum(x, 0) if index < 2 else x
    return 1 / (1 + np.exp(-x[:, 0]))


def scaled(
    about: dict[str, Any], name: str, rows: list[dict[str, float]], q: list[float | None]
) -> np.ndarray:
    """An input of f_pi, (N,)."""
    if name != "q":
        centre, half = about["scales"][name]
        return (np.array([row[name] for row in rows]) - centre) / half
    if "q_range" not in about:
        return np.zeros(len(rows))
    low, high = about["q_range"]
    known = np.array([about["q_mean"] if value is None else value for value in q])
    return np.clip((known - (low + high) / 2) / ((high - low) / 2), -1.5, 1.5)


# Scores


def test_scores_of_tasks_are_f_pi_of_the_snapshots_file(client, started):
    started()
    teach(client, 40)
    tasks = [Task(cell=cell, seed=seed, start=OPEN.world.start) for cell in (0, 4, 8) for seed in range(4)]
    answer = score(client, *(Scored(task=task) for task in tasks))
    expected = f_pi(snapshot(client).network, answer.properties, [None] * 12)
    assert answer.f == pytest.approx(expected.tolist(), abs=1e-5)
    assert np.ptp(answer.f) > 0.01
    assert answer.outcomes == 40
    assert answer.properties[0].keys() == ROW.keys()


def test_scores_of_properties_and_q_are_f_pi_of_the_snapshots_file(client, started):
    network = started().curriculum.algorithm.network
    rng = np.random.default_rng(0)
    for _ in range(60):  # of a learner's critic, of which there is none here
        row, q = ROW | {"distance": rng.uniform(1, 5)}, rng.uniform(-2, 1)
        network.add(row, q, bool(q + rng.normal() > 0))
    rows = [ROW | {"distance": d} for d in (1.0, 2.0, 4.5, 4.5, 4.5)]
    values = [-1.0, 0.5, None, -40.0, 40.0]
    answer = score(client, *(Scored(properties=r, q=q) for r, q in zip(rows, values, strict=True)))
    assert answer.f == pytest.approx(f_pi(snapshot(client).network, rows, values).tolist(), abs=1e-5)
    assert answer.f[3] < answer.f[2] < answer.f[4]
    assert answer.properties == rows


@pytest.mark.parametrize(
    "inputs", [["distance", "relative_angle"], ["q"], ["q", "distance"]], ids=["navacl", "q-only", "q first"]
)
def test_file_tells_the_inputs_in_their_order(client, started, inputs):
    config = small_config("curriculum.gate.enabled=false", f"curriculum.inputs={inputs}")
    network = started(config).curriculum.algorithm.network
    rng = np.random.default_rng(0)
    for _ in range(64):
        q = rng.uniform(-1, 1)
        network.add(ROW | {"distance": rng.uniform(1, 5)}, q, q > 0)
    rows, values = [ROW | {"distance": d} for d in (1.0, 4.0)], [-0.5, 0.9]
    answer = score(client, *(Scored(properties=r, q=q) for r, q in zip(rows, values, strict=True)))
    assert answer.f == pytest.approx(f_pi(snapshot(client).network, rows, values).tolist(), abs=1e-5)


def test_calibrated_scores_are_told_by_the_file_too(client, started):
    calibrated = boxed("curriculum.batch_size=4", "curriculum.calibrate=true")
    started(calibrated)
    for seq, proposal in enumerate(query(client, 0, 30)):
        outcome = Outcome(proposal=proposal.id, task=proposal.task, success=proposal.task["x"] < 2)
        assert deliver(client, KEYS.result, outcome, seq) == STORED
    rows = [{"x": 1.0}, {"x": 7.0}]
    answer, file = score(client, *(Scored(properties=row) for row in rows)), snapshot(client).network
    (size,) = struct.unpack("<Q", file[:8])
    about = json.loads(json.loads(file[8 : 8 + size])["__metadata__"]["f_pi"])
    raw = f_pi(file, rows, [None, None])
    a, b = about["calibration"]
    expected = 1 / (1 + np.exp(-(a * np.log(raw / (1 - raw)) + b)))
    assert answer.f == pytest.approx(expected.tolist(), abs=1e-5)


def test_boxes_of_numbers_are_scored_by_task_and_by_properties(client, started):
    started(BOX)
    answer = score(client, Scored(task={"x": 3.0}), Scored(properties={"x": 3.0}), Scored(task={"x": 8.0}))
    assert answer.f[0] == answer.f[1] != answer.f[2]
    expected = f_pi(snapshot(client).network, answer.properties, [None] * 3)
    assert answer.f == pytest.approx(expected.tolist(), abs=1e-5)


def test_most_tasks_that_fit_are_scored(client, started):
    started()
    answer = score(client, *(Scored(properties=ROW | {"distance": 1 + i / 250}) for i in range(1000)))
    assert len(answer.f) == 1000
    assert all(0 <= f <= 1 for f in answer.f)


def test_score_changes_nothing(client, started):
    curriculum = started().curriculum
    before = curriculum.rng.bit_generator.state, snapshot(client)
    first = score(client, Scored(task=Task(cell=0, seed=1, start=OPEN.world.start)))
    assert score(client, Scored(task=Task(cell=0, seed=1, start=OPEN.world.start))) == first
    assert (curriculum.rng.bit_generator.state, snapshot(client)) == before


TASK = Task(cell=0, seed=1, start=OPEN.world.start)
WITHOUT = {name: value for name, value in ROW.items() if name != "goal_clearance"}


@pytest.mark.parametrize(
    ("tasks", "words"),
    [
        ([Scored(properties=WITHOUT)], r"tasks\.0\.properties\.goal_clearance: missing"),
        ([Scored(properties=ROW), Scored(properties={})], r"tasks\.1\.properties\.distance: missing"),
        ([Scored(properties=ROW | {"colour": 1.0})], r"tasks\.0\.properties\.colour: no property"),
        ([Scored(task=TASK), Scored(task=TASK, properties=ROW)], r"tasks\.1: either task or properties"),
        ([Scored(q=1.0)], r"tasks\.0: either task or properties"),
        ([Scored(task=TASK), Scored(task={"x": 1.0})], r"tasks\.1\.task: a task of the docking world"),
    ],
)
def test_score_of_what_does_not_fit_is_refused_naming_the_field(client, started, tasks, words):
    started()
    with pytest.raises(RefusedError, match=words):
        score(client, *tasks)
    assert len(score(client, Scored(properties=ROW)).f) == 1


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ([{"properties": ROW | {"distance": float("nan")}}], r"tasks\.0\.properties\.distance: .*finite"),
        ([{"properties": ROW, "q": float("inf")}], r"tasks\.0\.q: .*finite"),
        ([{"properties": ROW}, {"properties": ROW | {"distance": "far"}}], r"tasks\.1\.properties\.distance"),
        ([{"properties": ROW, "colour": 1}], r"tasks\.0\.colour"),
        ([{"task": {"x": float("nan")}}], r"tasks\.0\.task"),
        ([], r"tasks: .*at least 1"),
        ([{"properties": ROW}] * 1001, r"tasks: .*at most 1000"),
    ],
)
def test_score_query_that_is_none_is_refused_naming_the_field(client, started, fields, words):
    started()
    with pytest.raises(RefusedError, match=words):
        ask_bytes(client, KEYS.score, packed("ScoreQuery", tasks=fields))
    assert len(score(client, Scored(properties=ROW)).f) == 1


def test_algorithm_that_predicts_nothing_says_so(client, started):
    started(small_config("curriculum.algorithm='rnd'", "curriculum.gate.enabled=false"))
    with pytest.raises(RefusedError, match="rnd predicts nothing"):
        score(client, Scored(task=TASK))
    assert query(client)[0].category == "rnd"
    found = snapshot(client)
    assert (found.network, found.inputs, found.brier, found.reliability) == (b"", [], None, [])


# Snapshots and tasks


def test_snapshot_counts(client, started):
    started()
    candidates = [make_candidate(OPEN, seed, cell=2) for seed in range(3)]
    assert deliver(client, KEYS.candidates, Candidates(digest={}, candidates=candidates), 0) == STORED
    proposals = query(client, 2, 2) + query(client, 5, 3)
    for seq, proposal in enumerate([proposals[0], proposals[4]]):
        outcome = Outcome(proposal=proposal.id, task=proposal.task, success=True)
        assert deliver(client, KEYS.result, outcome, seq + 1) == STORED
    found = snapshot(client)
    assert (found.algorithm, found.outcomes, found.leases, found.gate_open) == ("navacl-q+", 2, 3, True)
    assert found.candidates == [0, 0, 2, 0, 0, 0, 0, 0, 0]
    assert sum(found.proposed.values()) == 5
    assert set(found.proposed) <= {"easy", "frontier", "random"}
    assert found.inputs == list(OPEN.curriculum.inputs)
    f = [proposals[0].f, proposals[4].f]
    assert found.brier == pytest.approx(sum((1 - value) ** 2 for value in f) / 2)
    assert sum(count for _, _, count in found.reliability) == 2


def test_snapshot_before_anything_has_happened(client, started):
    started()
    found = snapshot(client)
    assert (found.outcomes, found.leases, found.proposed, found.brier) == (0, 0, {}, None)
    assert np.isfinite(f_pi(found.network, [ROW], [None])).all()


def test_cell_that_the_environment_does_not_have_is_refused_and_the_service_goes_on(client, started):
    started(BOX)
    with pytest.raises(RefusedError, match="cell: 1 does not exist here; 0 to 0 do"):
        query(client, 1)
    with pytest.raises(RefusedError, match=r"TaskQuery\.cell: "):
        ask_bytes(client, KEYS.task, packed("TaskQuery", cell=9))
    (proposal,) = query(client, 0)
    assert proposal.task.keys() == {"x"}


# The command


def call(monkeypatch, capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `navaclq curriculum`, run in this process."""
    monkeypatch.setattr(sys, "argv", ["navaclq", "curriculum", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        run()
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out, captured.err


def test_command_scores_the_tasks_of_a_file(client, started, endpoint, monkeypatch, capsys, tmp_path):
    started()
    file = tmp_path / "tasks.json"
    file.write_text(json.dumps([TASK.model_dump(), {"properties": ROW, "q": 0.5}]))
    code, out, err = call(monkeypatch, capsys, "score", file, "--connect", endpoint, "--json")
    assert (code, err) == (0, "")
    expected = score(client, Scored(task=TASK), Scored(properties=ROW, q=0.5))
    assert json.loads(out) == expected.model_dump()
    code, out, _ = call(monkeypatch, capsys, "score", file, "--connect", endpoint)
    assert code == 0
    assert f"{expected.f[0]:.3f}" in out


@pytest.mark.parametrize("config", [OPEN, BOX], ids=["docking", "box"])
def test_command_scores_what_query_prints(client, started, endpoint, monkeypatch, capsys, tmp_path, config):
    started(config)
    asked = ("query", "--connect", endpoint, "--cell", "0", "--count", "3", "--json")
    _, printed, _ = call(monkeypatch, capsys, *asked)
    (tmp_path / "tasks.json").write_text(printed)
    command = ("score", tmp_path / "tasks.json", "--connect", endpoint, "--json")
    code, out, _ = call(monkeypatch, capsys, *command)
    assert code == 0
    tasks = json.loads(printed)["tasks"]
    found = json.loads(out)
    assert found["properties"] == [task["properties"] for task in tasks]
    assert found["f"] == pytest.approx([task["f"] for task in tasks], abs=1e-5)


def test_command_scores_boxes_of_numbers(client, started, endpoint, monkeypatch, capsys, tmp_path):
    started(BOX)
    (tmp_path / "tasks.json").write_text('[{"x": 2.5}, {"x": 7}]')
    command = ("score", tmp_path / "tasks.json", "--connect", endpoint, "--json")
    code, out, _ = call(monkeypatch, capsys, *command)
    assert code == 0
    assert json.loads(out)["properties"] == [{"x": 2.5}, {"x": 7.0}]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot read"),
        (b"{", "is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"", "is not JSON"),
        (b"3", "a list of tasks is expected"),
        (b"{}", "a list of tasks is expected"),
        (b'{"tasks": 3}', "a list of tasks is expected"),
        (b"[1, 2]", "a list of tasks is expected"),
        (b"[]", "tasks: "),
        (b'[{"properties": {"distance": NaN}}]', r"tasks.0.properties.distance: "),
        (b'[{"properties": 3}]', r"tasks.0.properties: "),
        (b'[{"cell": 77, "seed": 0, "start": {}}]', "tasks.0.task"),
        (b'[{"x": "far"}]', "tasks.0.task"),
        (b"[{}]", "tasks.0.task"),
        (json.dumps([{"x": 1.0}] * 1001).encode(), "tasks: "),
    ],
)
def test_file_that_is_no_list_of_tasks_gets_one_sentence(
    endpoint, monkeypatch, capsys, tmp_path, content, words
):
    file = tmp_path / "tasks.json"
    if content is not None:
        file.write_bytes(content)
    code, out, err = call(monkeypatch, capsys, "score", file, "--connect", endpoint, "--timeout", "0.1")
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    assert words in err
    assert str(file) in err


def test_folder_in_place_of_the_file_gets_one_sentence(endpoint, monkeypatch, capsys, tmp_path):
    code, _, err = call(monkeypatch, capsys, "score", tmp_path, "--connect", endpoint)
    assert code == 2
    assert "cannot read" in err


def test_command_tells_what_the_curriculum_refuses(client, started, endpoint, monkeypatch, capsys, tmp_path):
    started()
    (tmp_path / "tasks.json").write_text('[{"properties": {"distance": 1.0}}]')
    command = ("score", tmp_path / "tasks.json", "--connect", endpoint)
    code, out, err = call(monkeypatch, capsys, *command)
    assert (code, out) == (1, "")
    assert err.startswith("error: tasks.0.properties.agent_clearance: missing")
    assert len(err.strip().splitlines()) == 1


def test_command_prints_and_saves_the_snapshot(client, started, endpoint, monkeypatch, capsys, tmp_path):
    started()
    teach(client, 8)
    out_file = tmp_path / "f.safetensors"
    command = ("snapshot", "--connect", endpoint, "--json", "--out", out_file)
    code, out, err = call(monkeypatch, capsys, *command)
    assert (code, err) == (0, "")
    expected = snapshot(client)
    assert json.loads(out) == json.loads(expected.model_dump_json(exclude={"network"}))
    assert out_file.read_bytes() == expected.network
    code, out, _ = call(monkeypatch, capsys, "snapshot", "--connect", endpoint)
    assert code == 0
    assert "navacl-q+" in out


@pytest.mark.parametrize("out", ["missing/f.safetensors", "."])
def test_snapshot_that_cannot_be_saved_gets_one_sentence(
    started, endpoint, monkeypatch, capsys, tmp_path, out
):
    started()
    command = ("snapshot", "--connect", endpoint, "--json", "--out", tmp_path / out)
    code, printed, err = call(monkeypatch, capsys, *command)
    assert (code, printed) == (2, "")
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    assert str(tmp_path) in err


def test_snapshot_without_f_pi_is_not_saved(started, endpoint, monkeypatch, capsys, tmp_path):
    started(small_config("curriculum.algorithm='sfl'"))
    command = ("snapshot", "--connect", endpoint, "--json", "--out", tmp_path / "f.safetensors")
    code, out, err = call(monkeypatch, capsys, *command)
    assert (code, out, err) == (2, "", "error: sfl has no f_pi that --out could save\n")
    assert list(tmp_path.iterdir()) == []


def test_serve_refuses_a_file_as_run_directory(endpoint, monkeypatch, capsys, tmp_path):
    (tmp_path / "run").write_text("")
    code, _, err = call(monkeypatch, capsys, "serve", "--run", tmp_path / "run", "--listen", endpoint)
    assert code == 2
    assert len(err.strip().splitlines()) == 1


# Killed


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    found = Processes(tmp_path)
    yield found
    found.close()


NUMBERS = 'curriculum.parameters=[{name="x", low=0.0, high=8.0, easy=0.0}]'
SETTINGS = ("--preset", "smoke", "--set", NUMBERS, "--set", "curriculum.gate.enabled=false")
TASKS = 150
"""In each life of the curriculum."""


def asked(session: zenoh.Session, kind: type[M], question: Message, key: str) -> M:
    """The answer of a curriculum that may still be starting."""
    return ask(session, key, question, kind, timeout=5, patience=120)


def test_killed_curriculum_has_every_acknowledged_outcome_once(processes, endpoint, tmp_path):
    keys, spool = Keys("run"), Spool(tmp_path / "spool", 2.0**20)
    command = ("curriculum", "serve", "--run", tmp_path / "run", "--listen", endpoint)
    reported: dict[str, bool] = {}
    processes.start("life 0", *command, *SETTINGS)  # which are kept
    with open_client(make_link(endpoint), patience=120) as session:
        sender = Sender(session, spool, Member("actor", "local", "a1"), "b1", timeout=2.0)
        for life in range(3):
            tasks = asked(session, Proposals, TaskQuery(cell=0, count=TASKS), keys.task).tasks
            for index, proposal in enumerate(tasks):
                if life < 2 and index == TASKS - 20:  # in the middle: the last ones find nobody there
                    wait_until(lambda reported=reported: sender.sent > len(reported) - TASKS / 2)
                    processes.running[f"life {life}"].kill()
                    processes.running[f"life {life}"].wait(15)
                reported[proposal.id] = index % 3 == 0
                outcome = Outcome(proposal=proposal.id, task=proposal.task, success=reported[proposal.id])
                sender.put(keys.result, outcome)
            if life < 2:
                assert len(spool) >= 20
                processes.start(f"life {life + 1}", *command)
        wait_until(lambda: sender.sent == 3 * TASKS, 30, "all outcomes acknowledged")
        found = asked(session, Snapshot, Nothing(), keys.snapshot)
        assert sender.close(patience=5.0) == 0
    assert processes.stop("life 2") == 0
    assert len(reported) == found.outcomes == 3 * TASKS
    assert found.leases == 0
    assert sum(sender.refused.values()) == 0
    with sqlite3.connect(tmp_path / "run" / DATABASE) as database:
        rows = database.execute("SELECT proposal, success, category FROM outcomes").fetchall()
    database.close()
    assert len(rows) == 3 * TASKS
    assert {name: bool(success) for name, success, _ in rows} == reported
    assert "unserved" not in {category for _, _, category in rows}
