"""Who is seen to take part in a run, what is said of it, and how much is kept of what anybody tells."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from common import members as module
from common.bus import Keys, Member, announce, publish
from common.link import make_link, open_client
from common.members import MOST, Members
from common.messages import PROTOCOL, Stat
from common.telemetry import Reporter
from common.version import code_version
from tests.helpers import wait_until

KEYS = Keys("run-1")
LEARNER = Member("learner", "local", "learner")
CURRICULUM = Member("curriculum", "curriculum", "curriculum")
A, B = Member("actor", "local", "a"), Member("actor", "host-b", "a")


class Heard:
    """Members as the hub sees them, and what was said of them."""

    def __init__(self, session: zenoh.Session) -> None:
        self.said: list[str] = []
        self.members = Members(session, KEYS, self.said.append)


@pytest.fixture
def heard(hub: zenoh.Session) -> Heard:
    return Heard(hub)


@pytest.fixture
def other(endpoint: str, hub: zenoh.Session) -> Iterator[zenoh.Session]:
    """A second client of the hub."""
    with open_client(make_link(endpoint), patience=10.0) as session:
        yield session


def stat_of(member: Member, code: str | None = None, host: str = "far", **values: float | int | str) -> Stat:
    return Stat(
        **member._asdict(),
        host=host,
        pid=7,
        since=1.7e9,
        code=code_version() if code is None else code,
        protocol=PROTOCOL,
        values=values,
    )


def tell(session: zenoh.Session, heard: Heard, stat: Stat) -> None:
    """Publishes figures until they are here: publications promise nothing."""
    member = Member(stat.role, stat.group, stat.name)

    def here() -> bool:
        publish(session, KEYS.stat(member), stat)
        return member in heard.members.stats and heard.members.stats[member].values == stat.values

    wait_until(here, what=f"the figures of {member}")


def pass_on(session: zenoh.Session, heard: Heard) -> None:
    """Returns when all that was published before has come through."""
    marker = Member("marker", "local", f"m{time.monotonic_ns()}")
    tell(session, heard, stat_of(marker))


def test_processes_are_alive_from_their_announcement_until_they_leave(heard, client, other):
    assert heard.members.alive == set()
    tokens = [announce(client, KEYS, member) for member in (LEARNER, A)]
    tokens.append(announce(other, KEYS, B))
    wait_until(lambda: heard.members.alive == {LEARNER, A, B})
    tokens[1].undeclare()
    wait_until(lambda: heard.members.alive == {LEARNER, B})
    other.close()
    wait_until(lambda: heard.members.alive == {LEARNER})
    del tokens


def test_those_that_were_there_before_are_alive_too(hub, client):
    token = announce(client, KEYS, A)
    late = Heard(hub)
    wait_until(lambda: late.members.alive == {A})
    del token


def test_a_killed_process_is_missed(endpoint, heard):
    script = (
        "import sys, time; from common.bus import Keys, Member, announce\n"
        "from common.link import make_link, open_client\n"
        "with open_client(make_link(sys.argv[1])) as session:\n"
        "    token = announce(session, Keys('run-1'), Member('actor', 'local', 'a')); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, endpoint], cwd=Path(__file__).parents[1])
    wait_until(lambda: heard.members.alive == {A}, 20)
    process.kill()
    process.wait()
    wait_until(lambda: heard.members.alive == set())


def test_joining_is_said_once_the_process_has_told_what_it_is_and_leaving_after_it(heard, client):
    token = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive)
    assert heard.said == []
    for steps in (1, 2, 3):
        tell(client, heard, stat_of(A, steps=steps))
    assert heard.said == ["actor a joined from far (process 7)"]
    token.undeclare()
    wait_until(lambda: len(heard.said) == 2)
    assert heard.said[1] == "actor a left"
    again = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive)
    assert len(heard.said) == 2
    tell(client, heard, stat_of(A, steps=4))
    assert heard.said[2:] == ["actor a joined from far (process 7)"]
    del again


def test_whom_one_hears_of_is_called_by_its_label(heard, client):
    tokens = [announce(client, KEYS, member) for member in (LEARNER, CURRICULUM, A, B)]
    wait_until(lambda: len(heard.members.alive) == 4)
    for member in (LEARNER, CURRICULUM, A, B):
        tell(client, heard, stat_of(member))
    assert [words.partition(" joined")[0] for words in heard.said] == [
        "learner",
        "curriculum",
        "actor a",
        "actor host-b/a",
    ]
    del tokens


def test_another_code_is_said_when_joining(heard, client):
    token = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive)
    tell(client, heard, stat_of(A, code="0.9+0123abcd"))
    assert heard.said == [
        "actor a joined from far (process 7, code 0.9+0123abcd, which is not that of this host)"
    ]
    del token


def test_who_only_tells_figures_has_not_joined_and_is_not_alive(heard, client):
    tell(client, heard, stat_of(A, steps=3))
    assert heard.members.of("actor") == {"a": {"steps": 3}}
    assert heard.members.alive == set()
    assert heard.said == []


def test_who_left_without_having_told_anything_is_not_missed_aloud(heard, client):
    token = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive)
    token.undeclare()
    wait_until(lambda: not heard.members.alive)
    tell(client, heard, stat_of(A, steps=1))  # its last words, which came late
    assert heard.said == []


def test_a_process_that_is_back_before_its_former_life_was_missed_stays_alive_throughout(
    heard, client, other
):
    former = other.liveliness().declare_token(KEYS.live(A, "former"))
    wait_until(lambda: heard.members.alive == {A})
    tell(other, heard, stat_of(A))
    new = client.liveliness().declare_token(KEYS.live(A, "new"))
    # the former life is missed when its connection is: nobody leaves by that
    pass_on(client, heard)
    former.undeclare()
    pass_on(other, heard)
    tell(client, heard, stat_of(A, steps=1))
    assert heard.members.alive == {A}
    assert heard.said == ["actor a joined from far (process 7)"]
    new.undeclare()
    wait_until(lambda: not heard.members.alive)
    assert heard.said[1:] == ["actor a left"]


def test_newest_figures_are_found_by_role_and_label_and_stay_after_their_process(heard, client):
    members = heard.members
    assert members.learner == members.curriculum == members.of("actor") == {}
    token = announce(client, KEYS, LEARNER)
    tell(client, heard, stat_of(LEARNER, updates=1))
    tell(client, heard, stat_of(LEARNER, updates=2, rate=0.5))
    tell(client, heard, stat_of(CURRICULUM, gate_open=1))
    tell(client, heard, stat_of(A, steps=3))
    tell(client, heard, stat_of(B, steps=4))
    token.undeclare()
    wait_until(lambda: not members.alive)
    assert members.learner == {"updates": 2, "rate": 0.5}
    assert members.curriculum == {"gate_open": 1}
    assert members.of("actor") == {"a": {"steps": 3}, "host-b/a": {"steps": 4}}
    assert members.of("router") == {}


def test_when_figures_came_is_known(heard, client):
    before = time.monotonic()
    tell(client, heard, stat_of(A, steps=1))
    first = heard.members.heard[A]
    assert before <= first <= time.monotonic()
    tell(client, heard, stat_of(A, steps=2))
    assert heard.members.heard[A] > first


def test_a_reporter_is_heard_with_all_that_it_tells_of_its_process(heard, client):
    token = announce(client, KEYS, B)
    reporter = Reporter(client, KEYS, B)

    def told() -> Stat | None:
        reporter.report({"steps": 5})
        return heard.members.stats.get(B)

    stat = wait_until(told)
    assert (stat.role, stat.group, stat.name, stat.values) == ("actor", "host-b", "a", {"steps": 5})
    wait_until(lambda: (reporter.report({"steps": 6}), heard.said)[1])
    assert heard.said == [f"actor host-b/a joined from {stat.host} (process {stat.pid})"]
    del token


def test_other_runs_are_not_heard(heard, client):
    foreign = Keys("run-2")
    token = announce(client, foreign, A)
    for _ in range(5):
        publish(client, foreign.stat(A), stat_of(A))
    tell(client, heard, stat_of(B))
    assert heard.members.alive == set()
    assert set(heard.members.stats) == {B}
    del token


def test_figures_that_are_none_are_ignored(heard, client):
    for junk in (b"", b"junk", b"\xc1", bytes(Stat.max_bytes + 1)):
        client.put(KEYS.stat(A), junk)
    tell(client, heard, stat_of(B, steps=1))
    assert set(heard.members.stats) == {B}


def test_who_tells_figures_under_another_name_than_its_own_is_ignored(heard, client):
    """A hub lets a group of actors publish below `stat/actor/GROUP` only: what it says there is its own."""
    tell(client, heard, stat_of(LEARNER, updates=5))
    for forged in (stat_of(LEARNER, updates=0), stat_of(B, steps=0), stat_of(A._replace(name="b"))):
        for _ in range(3):
            publish(client, KEYS.stat(A), forged)
    pass_on(client, heard)
    assert heard.members.learner == {"updates": 5}
    assert {member for member in heard.members.stats if member.role != "marker"} == {LEARNER}


def names(count: int, first: int = 0) -> list[Member]:
    return [Member("actor", "local", f"n{i}") for i in range(first, first + count)]


def test_figures_of_so_many_names_are_kept_and_of_those_the_newest(heard, client, monkeypatch):
    monkeypatch.setattr(module, "MOST", 20)
    for member in names(20):
        tell(client, heard, stat_of(member, steps=1))
    for member in names(200, first=20):
        publish(client, KEYS.stat(member), stat_of(member, steps=1))
    tell(client, heard, stat_of(names(1)[0], steps=2))
    assert set(heard.members.stats) == set(heard.members.heard) == set(names(20))
    assert heard.members.of("actor")["n0"] == {"steps": 2}
    assert len(heard.members._lives) <= 20


def test_a_newcomer_is_heard_though_names_that_nobody_has_any_more_fill_the_memory(
    heard, client, monkeypatch
):
    monkeypatch.setattr(module, "MOST", 20)
    for member in names(20):
        tell(client, heard, stat_of(member, steps=1))
    assert len(heard.members.stats) == 20
    assert heard.members.alive == set()
    token = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive == {A})
    for steps in range(20):
        publish(client, KEYS.stat(A), stat_of(A, steps=steps))
        time.sleep(0.02)
    assert "a" in heard.members.of("actor")
    assert len(heard.members.stats) <= 20
    del token


def test_of_processes_that_left_nothing_piles_up(heard, client):
    for member in names(300):
        announce(client, KEYS, member).undeclare()
    token = announce(client, KEYS, A)
    wait_until(lambda: heard.members.alive == {A})
    assert len(heard.members._lives) < 50
    del token


def test_all_figures_that_are_kept_fit_into_memory():
    assert MOST * Stat.max_bytes <= 2**30
