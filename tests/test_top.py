"""`navaclq top`: what is wrong in words, the picture of a run, and both of systems on a real bus."""

import io
import json
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from common.access import Credentials
from common.bus import Keys, Member, announce, list_members
from common.link import Link, make_link, open_client, open_hub
from common.members import Members
from common.messages import PROTOCOL, Stat
from common.telemetry import Reporter
from common.version import code_version
from deploy import certs, screen
from deploy.cli import doctor, options, top
from deploy.launcher import free_port
from deploy.screen import Census, Screen, line, picture
from deploy.troubles import Process, find_troubles, number, plain, span
from tests.helpers import small_config, wait_until
from tests.test_cli import call

HERE = Path(__file__).parents[1]
CODE, OTHER = "0.1.0+3fa9c1d2", "0.1.0+00000000"
LEARNER = {
    "env_steps": 1234567,
    "episodes": 15321,
    "updates": 104321,
    "steps_per_s": 412.3,
    "updates_per_s": 71.2,
    "replay": 500000,
    "failed_writes": 0,
    "elapsed_s": 3723.4,
    "refused": 4,
    "inbox": 3,
    "weights": "2.104321",
    "publish_s": 2.0,
    "charts/success_100": 0.41,
    "charts/success_random": 0.22,
    "charts/staleness": 142.2,
    "losses/alpha": 0.031,
    "losses/qf_values": -3.2,
    "endings/success": 0.39,
    "endings/dolly_contact": 0.12,
    "endings/other_contact": 0.31,
    "endings/timeout": 0.18,
    "tasks/easy": 0.6,
    "tasks/random": 0.4,
}
CURRICULUM = {"gate_open": 1, "gate_success": 0.62, "weights": "2.104000", "refused": 0, "inbox": 1}
ACTOR = {
    "steps_per_s": 41.3,
    "spool": 2,
    "spool_full": 0,
    "refused": 0,
    "refusal": "",
    "weights": "2.104300",
    "waiting_s": 0.0,
    "trouble": "",
    "reports": 1,
    "reports_refused": 0,
    "reports_waiting_s": 0.0,
    **{f"{name}_p{p}_ms": p / 4 for name in screen.CHANNELS for p in (50, 99)},
}
GONE = {"alive": False}


@pytest.fixture(autouse=True)
def signals_stay_as_they_are(monkeypatch):
    monkeypatch.setattr(top, "exit_on_signals", lambda: None)


def process(
    role, name=None, figures=None, *, alive=True, silent=0.4, told=True, code=CODE, protocol=2, host="hub"
):
    member = Member(role, "local", name or role)
    stat = Stat(
        **member._asdict(), host=host, pid=7, since=time.time() - 300, code=code, protocol=protocol,
        values=figures or {},
    )  # fmt: skip
    return Process(member, alive, silent, stat if told else None)


def learner(figures=None, **more):
    return process("learner", figures=LEARNER | (figures or {}), **more)


def curriculum(**more):
    return process("curriculum", figures=CURRICULUM, **more)


def actor(name="a-0", figures=None, **more):
    return process("actor", name, ACTOR | (figures or {}), **more)


def actors(count, figures=None, **more):
    return [actor(f"a-{i}", figures, **more) for i in range(count)]


def drawn(processes, width=120, **more):
    """The picture as text, and its lines."""
    console = Console(width=width, height=more.get("height", 100), file=io.StringIO(), color_system=None)
    console.print(picture(processes, "a title", console, **more))
    text = console.file.getvalue()
    return text, text.splitlines()


CASES = {
    "all is well": ([learner(), curriculum(), *actors(3)], []),
    "a hub without members": ([], ["nobody is connected: neither learner, curriculum nor actors"]),
    "everybody left": (
        [learner(**GONE, silent=9), actor(**GONE, silent=12)],
        ["nobody is connected since 9 s: neither learner, curriculum nor actors"],
    ),
    "a curriculum that stands alone": ([curriculum()], []),
    "no learner": ([curriculum(), *actors(2)], ["no learner: 2 actors wait"]),
    "the learner left": (
        [learner(**GONE, silent=31), curriculum(), actor(figures={"waiting_s": 29.0})],
        ["no learner since 31 s: 1 actor waits"],
    ),
    "no curriculum": ([learner(), actor()], ["curriculum is not there: actors drive random tasks"]),
    "the curriculum left": (
        [learner(), curriculum(**GONE, silent=200), actor()],
        ["curriculum is not there since 3 min: actors drive random tasks"],
    ),
    "no actors": ([learner(), curriculum()], ["no actors: the learner waits for episodes"]),
    "a learner alone": (
        [learner()],
        ["curriculum is not there", "no actors: the learner waits for episodes"],
    ),
    "pre-training needs actors only": ([process("actor", "a", {"frames": 12, "frames_per_s": 3.0})], []),
    "an actor waits": (
        [learner(), curriculum(), actor("b-3", {"waiting_s": 14.2, "trouble": "timeout"})],
        ["actor b-3 waits for the learner since 14 s"],
    ),
    "an actor waits a moment": ([learner(), curriculum(), actor(figures={"waiting_s": 4.9})], []),
    "many wait": (
        [learner(), curriculum(), *actors(12, {"waiting_s": 14.2})],
        ["12 actors wait for the learner since 14 s or less: a-0, a-1, a-2 and 9 more"],
    ),
    "held back for the balance": (
        [learner(), curriculum(), actor(figures={"waiting_s": 59.0, "trouble": "BUSY"})],
        [],
    ),
    "held back for too long": (
        [learner(), curriculum(), actor(figures={"waiting_s": 61.0, "trouble": "BUSY"})],
        ["actor a-0 is told by the learner to wait since 61 s"],
    ),
    "the curriculum takes nothing": (
        [learner(), curriculum(), actor(figures={"reports_waiting_s": 8.0})],
        ["actor a-0 waits for the curriculum since 8 s"],
    ),
    "an actor hangs": (
        [learner(), curriculum(), actor(silent=6.2, figures={"waiting_s": 9.0})],
        ["actor a-0 says nothing since 6 s"],
    ),
    "the learner hangs": (
        [learner(silent=8), curriculum(), actor(figures={"waiting_s": 6.0})],
        ["learner says nothing since 8 s", "actor a-0 waits for the learner since 6 s"],
    ),
    "an actor starts": ([learner(), curriculum(), actor(), actor("b", told=False, silent=2)], []),
    "an actor starts for long": (
        [learner(), curriculum(), actor(), actor("b", told=False, silent=4)],
        ["actor b is connected but has told nothing for 4 s: it starts, or hangs"],
    ),
    "an actor left": (
        [learner(), curriculum(), actor(), actor("b", **GONE, silent=75)],
        ["actor b is gone since 75 s"],
    ),
    "a full spool": (
        [learner(), curriculum(), actor(figures={"spool_full": 1})],
        ["actor a-0's spool is full: the simulation is paused"],
    ),
    "a refusal": (
        [learner(), curriculum(), actor("a-1", {"refused": 3, "refusal": "contract differs in 'reward': x"})],
        ["actor a-1: refused: contract differs in 'reward': x"],
    ),
    "refusals for one reason": (
        [learner(), curriculum(), *actors(5, {"reports_refused": 1, "refusal": "contract differs"})],
        ["5 actors: refused: contract differs: a-0, a-1, a-2 and 2 more"],
    ),
    "a refusal without a reason": (
        [learner(), curriculum(), actor(figures={"refused": 1})],
        ["actor a-0: refused: for a reason it does not tell"],
    ),
    "a full disk": (
        [learner({"failed_writes": 3, "failed_s": 2.0}), curriculum(), actor()],
        ["learner: cannot write to its disk (3 failed writes)"],
    ),
    "one failed write": (
        [learner({"failed_writes": 1}), curriculum(), actor()],
        ["learner: cannot write to its disk (1 failed write)"],
    ),
    "a disk that was full": ([learner({"failed_writes": 3, "failed_s": 400.0}), curriculum(), actor()], []),
    "other code": (
        [learner(), curriculum(code=OTHER), *actors(1)],
        [f"curriculum runs other code than the learner ({OTHER}, the learner {CODE})"],
    ),
    "another protocol": (
        [learner(), curriculum(), *actors(5, protocol=1)],
        ["5 processes run other code than the learner (protocol 1, the learner 2): a-0, a-1, a-2 and 2 more"],
    ),
    "weights of minutes ago": (
        [learner(), curriculum(), actor(figures={"weights": "2.90000"})],
        ["actor a-0 drives with old weights (2.90000; the learner has 2.104321)"],
    ),
    "weights of a moment ago": ([learner(), curriculum(), actor(figures={"weights": "2.103500"})], []),
    "weights published seldom": (
        [learner({"publish_s": 120.0}), curriculum(), actor(figures={"weights": "2.90000"})],
        [],
    ),
    "weights of the learner's former life": (
        [learner(), curriculum(), actor(figures={"weights": "1.104400"})],
        ["actor a-0 drives with old weights (1.104400; the learner has 2.104321)"],
    ),
    "weights newer than those told last": (
        [learner(), curriculum(), actor(figures={"weights": "2.104500"})],
        [],
    ),
    "the worst comes first": (
        [
            learner({"failed_writes": 2, "failed_s": 1.0}),
            actor("a", {"weights": "1.1"}),
            actor("b", {"spool_full": 1}),
            actor("c", silent=6),
        ],
        [
            "curriculum is not there: actors drive random tasks",
            "learner: cannot write to its disk (2 failed writes)",
            "actor c says nothing since 6 s",
            "actor b's spool is full: the simulation is paused",
            "actor a drives with old weights (1.1; the learner has 2.104321)",
        ],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said_in_words(case):
    processes, expected = CASES[case]
    assert find_troubles(processes) == expected


def test_times_are_told_in_units_that_suit_them():
    given_and_said = {
        -3: "0 s", 0.4: "0 s", 119: "119 s", 121: "2 min", 7300: "2 h", 86400: "24 h", 4e5: "5 days"
    }  # fmt: skip
    assert {seconds: span(seconds) for seconds in given_and_said} == given_and_said


def test_text_from_the_bus_cannot_move_the_cursor():
    assert plain("\x1b[2Jgone\r\n\x9b1m[bold]") == "?[2Jgone???1m[bold]"
    assert len(plain("x" * 5000)) == 160


def test_a_figure_that_is_no_finite_number_counts_as_none():
    values = {"a": 2, "b": "3", "c": float("nan"), "d": float("inf"), "e": 10**400, "f": [], "g": -1.5}
    assert [number(values, key) for key in "abcdefgx"] == [2, 0, 0, 0, 0, 0, -1.5, 0]


ODD = st.one_of(
    st.integers(),
    st.integers(min_value=10**300, max_value=10**310),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=40),
    st.sampled_from(["", "1.2", "2.x", ".", "BUSY", "\x1b[31m", "[bold]", "[/]", "9" * 39, "1.²"]),
)
KEYS = st.sampled_from([*LEARNER, *CURRICULUM, *ACTOR, "failed_s", "frames"]) | st.text(max_size=20)
NAMES = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)


@st.composite
def odd_processes(draw):
    role = draw(st.sampled_from(["learner", "curriculum", "actor"]) | NAMES)
    member = Member(role, draw(st.just("local") | NAMES), draw(NAMES))
    stat = Stat(
        **member._asdict(),
        host=draw(st.text(max_size=128)),
        pid=draw(st.integers(0, 2**64 - 1)),
        since=draw(st.floats(allow_nan=False, allow_infinity=False)),
        code=draw(st.text(max_size=64)),
        protocol=draw(st.integers(0, 2**64 - 1)),
        values=draw(st.dictionaries(KEYS, ODD, max_size=12)),
    )
    silent = draw(st.floats(0, 1e6))
    return Process(member, draw(st.booleans()), silent, stat if draw(st.booleans()) else None)


@settings(max_examples=50)
@given(st.lists(odd_processes(), max_size=6), st.sampled_from([20, 80, 160]))
def test_no_figure_however_odd_ends_the_screen(processes, width):
    assert all(isinstance(sentence, str) for sentence in find_troubles(processes))
    text, _ = drawn(processes, width, height=24, supervised=[("x", True, 3)], events=["\x1b[1m e"])
    assert all(c.isprintable() for c in text.replace("\n", ""))
    assert "\n" not in line(processes)
    described = json.loads(json.dumps(top.describe(processes, "run"), allow_nan=False))
    assert len(described["processes"]) == len(processes)


TROUBLED = [
    learner({"failed_writes": 3, "failed_s": 9.0}),
    curriculum(**GONE, silent=31),
    *(actor(f"a-{i}", host="host-a") for i in range(4)),
    *(actor(f"b-{i}", host="host-b.example.org") for i in range(2)),
    actor("b-2", {"waiting_s": 14.2}, host="host-b.example.org"),
    actor("b-10", host="host-b.example.org", code=OTHER),
    actor("c-0", {"spool_full": 1, "spool": 240}, host="host-c"),
    actor("c-1", {"refused": 2, "refusal": "contract differs in 'reward': 1 here"}, host="host-c"),
    actor("c-2", {"weights": "2.9"}, host="host-c"),
    actor("c-3", host="host-c", silent=6.0),
]


@pytest.mark.parametrize("width", [80, 120, 160])
def test_the_picture_shows_every_process_by_host_and_what_is_wrong(width):
    text, lines = drawn(TROUBLED, width)
    assert {len(row) for row in lines} == {width}
    start = next(i for i, row in enumerate(lines) if re.match(r"│ host +process +state", row)) + 1
    rows = [row.strip("│ ") for row in lines[start : start + len(TROUBLED)]]
    pattern = r"(?:actor \S+|learner|curriculum)(?= +(?:alive|gone|waiting|silent|paused))"
    assert [re.search(pattern, row)[0] for row in rows] == [str(p.member) for p in TROUBLED]
    assert [row.split()[0].rstrip("…") for row in rows if row.startswith("h")] == [
        "hub",
        "host-a",
        "host-b.exam" if width == 80 else "host-b.example.org",
        "host-c",
    ]
    words = " ".join(text.replace("│", " ").split())
    for sentence in find_troubles(TROUBLED):
        assert sentence in words
    for state in (
        "gone 31 s", "waiting 14 s", "alive, other code", "paused, spool full", "alive, 2 refused",
        "alive, old weights", "silent 6 s",
    ):  # fmt: skip
        assert state in text
    for figure in (
        "1234567 (412.3/s)", "104321 (71.2/s)", "41%", "22%", "open, success 62%", "62:03", "142.20 updates",
        "2.104321", "success 39%  dolly_contact 12%", "12.5", "24.8",
    ):  # fmt: skip
        assert figure in text
    assert (CODE in text) and ("24.8 " * 4 in re.sub(" +", " ", text)) == (width == 160)


def test_figures_of_a_process_that_is_gone_do_not_count():
    text, _ = drawn([learner(), curriculum(), actor(figures={"spool": 77}, **GONE, silent=5)])
    assert "77" not in text


def test_where_there_is_no_room_the_actors_that_are_well_share_a_row():
    crowd = [learner(), curriculum(), *(actor(f"a-{i}", host="far") for i in range(60)), actor("b", silent=7)]
    text, lines = drawn(crowd, 80, height=24)
    assert len(lines) <= 24
    assert re.search(r"60 actors +alive +2478 ", text)
    assert re.search(r"actor b +silent 7 s", text)
    assert "latency" not in text
    text, lines = drawn(crowd, 80)
    assert "actor a-59 " in text
    assert "latency" in text


def test_a_picture_of_a_supervised_run_tells_restarts_and_children_that_never_came():
    supervised = [("learner", True, 0), ("curriculum", True, 2), ("local-0", False, 1), ("local-1", True, 0)]
    text, _ = drawn([learner(), curriculum()], 80, supervised=supervised, events=["12:00:01 something"])
    assert re.search(r"curriculum +alive .* 2 +│", text)
    assert re.search(r"local-0 +down +1 +│", text)
    assert re.search(r"local-1 +starting +0 +│", text)
    assert "12:00:01 something" in text


def test_a_line_ends_with_the_first_trouble():
    well = line([learner(), curriculum(), actor()])
    assert well.startswith("62:03  steps 1234567 (412.3/s)  updates 104321 (71.2/s)")
    assert well.endswith("gate open, success 62%  processes 3")
    assert line([learner(), actor()]).endswith("  WRONG: curriculum is not there: actors drive random tasks")
    assert line([learner()]).endswith("  WRONG: curriculum is not there (and 1 more)")
    assert line([curriculum()]) == "waiting for the learner"


def fake_members(*processes, now=None):
    """Members that have heard of these processes."""
    now = now or time.monotonic()
    return SimpleNamespace(
        alive={p.member for p in processes if p.alive},
        stats={p.member: p.stat for p in processes if p.stat},
        heard={p.member: now - p.silent for p in processes if p.stat},
    )


def test_those_that_left_are_remembered_for_a_while():
    members = fake_members(learner(), actor("a-10", **GONE, silent=299), actor("a-9", **GONE, silent=301))
    assert [(str(p.member), p.alive) for p in Census(members).take()] == [
        ("actor a-10", False),
        ("learner", True),
    ]


def test_one_that_never_spoke_is_silent_since_it_was_first_seen():
    members = fake_members(actor("a-10", told=False), actor("a-9", silent=50))
    census = Census(members)
    assert [p.silent for p in census.take()] == pytest.approx([0, 0], abs=0.3)  # both were not seen before
    census._seen = {member: seen - 9 for member, seen in census._seen.items()}
    nine, ten = census.take()
    assert (nine.member.name, ten.member.name) == ("a-9", "a-10")
    assert (nine.silent, ten.silent) == pytest.approx((9, 9), abs=0.3)
    assert ten.stat is None


def test_a_terminal_gets_pictures_and_anything_else_lines(monkeypatch):
    monkeypatch.setattr(screen, "DRAW_SECONDS", 0.0)
    monkeypatch.setattr(screen, "LINE_SECONDS", 0.0)
    members = fake_members(learner(), actor())
    for terminal in (True, False):
        console = Console(
            file=io.StringIO(), force_terminal=terminal, width=100, height=50, color_system=None
        )
        shown = Screen(members, console, "title", lambda: [("learner", True, 4)])
        shown.say("an event with [brackets]")
        shown.update()
        shown.close()
        text = console.file.getvalue()
        assert "an event with [brackets]" in text
        assert ("╭" in text) == ("restarts" in text) == terminal
        assert "curriculum is not there: actors drive random tasks" in text


@pytest.fixture
def people(hub, client):
    """Announces and reports for made-up members, in the run `x`."""
    tokens = []

    def come(role, name, session=client, **figures):
        member = Member(role, "local", name)
        tokens.append(announce(session, Keys("x"), member))
        reporter = Reporter(session, Keys("x"), member)
        if figures:
            reporter.report(figures)
        return reporter

    yield come
    for token in tokens:
        token.undeclare()


class Talkers:
    """Reports of several processes, again and again while it is entered."""

    def __init__(self, *reporters):
        self._reporters, self._over = reporters, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        while not self._over.wait(0.1):
            for reporter, figures in self._reporters:
                reporter.report(figures)

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()


def test_json_describes_every_process_and_ends(monkeypatch, capsys, people, endpoint):
    talk = Talkers(
        (people("learner", "learner"), LEARNER),
        (people("actor", "a"), ACTOR | {"spool_full": 1}),
    )
    people("actor", "dumb")
    monkeypatch.setattr(top, "PATIENCE", 1.5)
    with talk:
        code, out, err = call(monkeypatch, capsys, "top", "--json", "--connect", endpoint)
    assert (code, err) == (0, "")
    assert len(out.splitlines()) == 1
    found = json.loads(out)
    assert set(found) == {"run", "processes", "troubles"}
    assert found["run"] is None
    keys = {*Stat.model_fields, "alive", "silent_s"}
    assert all(set(p) == keys for p in found["processes"])
    a, dumb, learner = found["processes"]
    assert (a["role"], a["group"], a["name"], a["alive"]) == ("actor", "local", "a", True)
    assert (a["code"], a["protocol"]) == (code_version(), PROTOCOL)
    assert a["values"] == ACTOR | {"spool_full": 1}
    assert abs(time.time() - a["since"]) < 60
    assert 0 <= a["silent_s"] < 5
    assert (dumb["name"], dumb["alive"], dumb["host"], dumb["since"], dumb["values"]) == (
        "dumb", True, None, None, {}
    )  # fmt: skip
    assert learner["values"] == LEARNER
    assert found["troubles"][0] == "curriculum is not there: actors drive random tasks"
    assert "actor a's spool is full: the simulation is paused" in found["troubles"]


def test_without_a_terminal_one_picture_is_printed_when_all_have_spoken(
    monkeypatch, capsys, people, endpoint
):
    monkeypatch.setattr(top, "PATIENCE", 60.0)  # it does not take that long
    with Talkers((people("curriculum", "curriculum"), CURRICULUM), (people("actor", "a"), ACTOR)):
        began = time.monotonic()
        code, out, _ = call(monkeypatch, capsys, "top", "--connect", endpoint)
    assert code == 0
    assert time.monotonic() - began < 30
    assert "no learner: 1 actor waits" in out
    assert f"navaclq top: no run at {endpoint}" in out
    assert re.search(r"actor a +alive", out)


def test_without_a_hub_it_says_so(monkeypatch, capsys, endpoint):
    monkeypatch.setattr(top, "PATIENCE", 0.1)
    code, out, err = call(monkeypatch, capsys, "top", "--once", "--connect", endpoint)
    assert (code, out, err) == (1, "", f"error: no hub answers at {endpoint}\n")


def test_figures_that_the_screen_reads_are_those_that_the_services_tell(hub, client, tmp_path, one_thread):
    from actor.service import ActorService
    from curriculum.service import CurriculumService
    from learner.checkpoint import RunDirectory
    from learner.service import LearnerService

    config = small_config("actor.worlds=1", "replay.capacity=1000")
    members = Members(hub, Keys("*"))
    learner = LearnerService(hub, RunDirectory(tmp_path / "run", config))
    curriculum = CurriculumService(client, "run", config, learner.contract.digest, None)
    member = Member("actor", "local", "a")
    driver = ActorService(client, learner.contract, config, member, tmp_path / "spool", [0])
    try:
        wait_until(lambda: len(members.alive) == 3, 10, "three members")
        learner._failed_writes = 1
        learner._complained = time.monotonic() - 3
        learner._report(1.0, 2.0)
        curriculum._report()
        driver._report()
        wait_until(lambda: len(members.stats) == 3, 10, "their figures")
        told = {p.role: p.values for p in Census(members).take()}
        assert set(told["actor"]) >= {key for key in ACTOR if not key.endswith("_ms")}
        assert set(told["curriculum"]) >= set(CURRICULUM)
        assert set(told["learner"]) >= {key for key in LEARNER if "/" not in key} | {"failed_s"}
        for values in told.values():
            assert re.fullmatch(r"\d+\.\d+", values["weights"])
        assert 3 <= told["learner"]["failed_s"] < 30
        assert find_troubles(Census(members).take()) == [
            "learner: cannot write to its disk (1 failed write)",
            "actor a drives with old weights (0.0; the learner has 1.0)",
        ]
        found = top._Run(client)
        assert wait_until(lambda: found.ask() or found.name, 10, "the run's name") == "run"
    finally:
        driver.close()
        curriculum.close()
        learner.close()


def test_members_are_listed_with_a_query(people, client):
    for role, name in (("actor", "a"), ("actor", "b"), ("learner", "learner")):
        people(role, name)
    a, b = (Member("actor", "local", name) for name in "ab")
    assert list_members(client, Keys("*")) == {a, b, Member("learner", "local", "learner")}
    assert list_members(client, Keys("x"), Member("actor", "*", "*")) == {a, b}
    assert list_members(client, Keys("y")) == set()


def test_a_probe_finds_its_member_or_fails_with_one_sentence(monkeypatch, capsys, people, endpoint):
    people("actor", "a-0")
    monkeypatch.setenv("NAVACLQ_CONNECT", endpoint)
    for wanted in ("actor", "actor/a-0"):
        code, out, err = call(monkeypatch, capsys, "doctor", "--only-hub", "--member", wanted, "--json")
        assert (code, err) == (0, "")
        assert json.loads(out) == {
            "hub": {"endpoint": endpoint, "answers": True, "members": ["actor a-0"]},
        }
    code, out, err = call(monkeypatch, capsys, "doctor", "--only-hub", "--member", "actor/a")
    assert code == 1
    assert err == f"error: no actor/a is connected to the hub at {endpoint}\n"
    code, _, err = call(monkeypatch, capsys, "doctor", "--only-hub", "--member", "actor/*")
    assert code == 2
    assert "must be ROLE or ROLE/NAME" in err


def test_a_probe_of_a_silent_hub_fails(monkeypatch, capsys, endpoint):
    code, out, _ = call(monkeypatch, capsys, "doctor", "--only-hub", "--json", "--connect", endpoint)
    assert code == 1
    assert json.loads(out)["hub"]["answers"] is False
    assert call(monkeypatch, capsys, "doctor", "--only-hub", "--connect", endpoint, "--member", "x")[0] == 1


def test_a_probe_does_not_load_what_computes(people, endpoint):
    people("actor", "a-0")
    code = (
        "import sys; from deploy.cli.main import app\n"
        "assert not app(standalone_mode=False)\n"
        "assert not {'torch', 'pybullet', 'onnxruntime', 'PIL'} & set(sys.modules), 'slow'"
    )
    for more in ([], ["--member", "actor/a-0"]):
        command = [sys.executable, "-c", code, "doctor", "--only-hub", "--connect", endpoint, *more]
        subprocess.run(command, check=True, cwd=HERE)


def test_processes_see_with_their_certificates_what_their_probes_ask(monkeypatch, capsys, tmp_path):
    certs.create(tmp_path / "ca", ["actor-b"])
    endpoint = f"tls/127.0.0.1:{free_port()}"

    def link(name) -> Link:
        return options.make_link(endpoint, tmp_path / "ca" / name, False)

    with open_hub(link("learner")) as hub, open_client(link("actor-b"), patience=20.0) as b:
        tokens = [
            announce(session, Keys("x"), Member(*member))
            for session, member in (
                (hub, ("learner", "learner", "learner")),
                (b, ("actor", "actor-b", "b-0")),
            )
        ]

        def probe(name, wanted) -> int:
            arguments = ("doctor", "--only-hub", "--connect", endpoint, "--member", wanted, "--certs")
            return call(monkeypatch, capsys, *arguments, tmp_path / "ca" / name)[0]

        for name in ("actor-b", "operator"):
            assert probe(name, "actor/b-0") == 0
            assert probe(name, "actor") == 0
            assert probe(name, "actor/b-1") == 1
        assert probe("operator", "learner") == 0
        monkeypatch.setattr(top, "PATIENCE", 1.0)
        arguments = ("top", "--json", "--connect", endpoint, "--certs", tmp_path / "ca" / "operator")
        code, out, _ = call(monkeypatch, capsys, *arguments)
        assert code == 0
        assert {p["name"] for p in json.loads(out)["processes"]} == {"learner", "b-0"}
        del tokens


def test_a_probe_asks_for_its_own_group_only():
    own = Link(("tls/h:1",), Credentials(Path(), "actor-b", ()))
    operator = Link(("tls/h:1",), Credentials(Path(), "operator", ()))
    assert doctor._parse_member("actor/b-0", own) == Member("actor", "actor-b", "b-0")
    assert doctor._parse_member("actor", operator) == Member("actor", "*", "*")
    assert doctor._parse_member("learner", make_link("tcp/127.0.0.1:1")) == Member("learner", "*", "*")
