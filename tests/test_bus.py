import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import zenoh

from common.bus import (
    BUSY,
    GROUP,
    INTERNAL_ERROR,
    Keys,
    NoAnswerError,
    QueryServer,
    RefusedError,
    Subscription,
    announce,
    ask,
    ask_bytes,
    ask_later,
    check_endpoint,
    open_client,
    open_hub,
    publish,
    serve,
    watch_members,
)
from common.errors import UsageError
from common.messages import Acknowledgement, MessageError, Nothing, Stat, TaskQuery, Version
from tests.helpers import wait_until

KEYS = Keys("run-1")
ECHO_HUB = """
import sys, time
from common.bus import QueryServer, open_hub
with open_hub(sys.argv[1]) as hub:
    server = QueryServer(hub, "navaclq/run-1/echo", lambda payload, attachment: payload)
    print("up", flush=True)
    time.sleep(60)
"""


class Gate:
    """A handler that stands still until it is opened."""

    def __init__(self) -> None:
        self.entered, self.opened = threading.Event(), threading.Event()

    def __call__(self, payload: bytes, attachment: bytes) -> bytes:
        self.entered.set()
        assert self.opened.wait(20)
        return payload


def in_thread(action) -> tuple[threading.Thread, list]:
    """Runs `action` in a thread; the list gets its result or its exception."""
    result: list = []

    def run() -> None:
        try:
            result.append(action())
        except Exception as error:
            result.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, result


def test_keys_of_two_runs_never_meet():
    assert KEYS.contract == "navaclq/run-1/contract"
    assert KEYS.live("actor", "a") == "navaclq/run-1/live/actor/a"
    assert KEYS.stat("actor", "a") == "navaclq/run-1/stat/actor/a"
    assert len({KEYS.weights("policy"), KEYS.weights("critic"), KEYS.version}) == 3
    plain = [v for v in vars(KEYS).values() if isinstance(v, str)]
    assert len(plain) == len(set(plain)) >= 6
    assert all(v == KEYS.root or v.startswith("navaclq/run-1/") for v in plain)


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tcp/localhost:1", "tcp/[::1]:65535", "tcp/127.9.9.9:80"]
)
def test_loopback_endpoints_are_taken(endpoint):
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "tcp/learner.example.org:7447", "tcp/[::]:7447"]
)
def test_plain_tcp_beyond_loopback_needs_insecure(endpoint):
    with pytest.raises(UsageError, match="--insecure"):
        check_endpoint(endpoint)
    assert check_endpoint(endpoint, insecure=True) == endpoint


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        "127.0.0.1:7447",
        "tcp/127.0.0.1",
        "tcp/:7447",
        "tcp/127.0.0.1:0",
        "tcp/127.0.0.1:65536",
        "udp/127.0.0.1:7447",
        "tcp/127.0.0.1:7447\n",
        "tcp/127.0.0.1:7447#x=1",
        "tcp/a b:7447",
        "tcp/127.0.0.1:-1",
    ],
)
@pytest.mark.parametrize("insecure", [False, True])
def test_malformed_endpoint_is_a_usage_error_with_an_example(endpoint, insecure):
    with pytest.raises(UsageError, match=r"is no endpoint; write tcp/HOST:PORT, for example"):
        check_endpoint(endpoint, insecure)


def test_a_question_gets_its_answer_in_both_directions(hub, client):
    asked = []

    def handler(query: TaskQuery) -> Version:
        asked.append(query)
        return Version(epoch=query.cell, counter=query.t)

    for server_side, asker in ((hub, client), (client, hub)):
        key = f"{KEYS.task}/{id(asker)}"
        server = serve(server_side, key, TaskQuery, handler)
        found = wait_until(lambda k=key, s=asker: answered(s, k, TaskQuery(cell=3, t=41), Version))
        assert found == Version(epoch=3, counter=41)
        assert asked[-1] == TaskQuery(cell=3, t=41)
        server.close()


def answered(session: zenoh.Session, key: str, question, kind):
    """The answer, or None while the declaration has not arrived."""
    try:
        return ask(session, key, question, kind)
    except NoAnswerError:
        return None


def test_two_clients_reach_each_other_through_the_hub(endpoint, hub, client):
    with open_client(endpoint) as other:
        server = serve(other, KEYS.contract, Nothing, lambda _: Acknowledgement(duplicate=True))
        found = wait_until(lambda: answered(client, KEYS.contract, Nothing(), Acknowledgement))
        assert found == Acknowledgement(duplicate=True)
        server.close()


def test_newcomer_finds_the_contract_without_knowing_the_run(hub, client):
    server = serve(hub, KEYS.contract, Nothing, lambda _: Version(epoch=5))
    assert ask(client, Keys("*").contract, Nothing(), Version) == Version(epoch=5)
    server.close()


def test_payload_and_attachment_arrive_to_the_byte(hub, client):
    server = QueryServer(hub, KEYS.trajectory, lambda payload, attachment: attachment + payload)
    blob = bytes(range(256)) * 8192
    assert ask_bytes(client, KEYS.trajectory, blob, b"\x00head") == b"\x00head" + blob
    assert ask_bytes(client, KEYS.trajectory, b"") == b""
    server.close()


def test_a_server_of_a_wildcard_answers_every_key_that_it_covers(hub, client):
    server = QueryServer(hub, f"{KEYS.trajectory}/**", lambda payload, _: payload)
    for name in ("local/a", "host-1/b"):
        assert ask_bytes(client, f"{KEYS.trajectory}/{name}", name.encode()) == name.encode()
    server.close()


def test_one_thread_answers_in_the_order_of_arrival(hub, client):
    seen: list[bytes] = []
    threads: set[int] = set()

    def handler(payload: bytes, _: bytes) -> bytes:
        seen.append(payload)
        threads.add(threading.get_ident())
        return payload

    server = QueryServer(hub, KEYS.trajectory, handler)
    for i in range(50):
        assert ask_bytes(client, KEYS.trajectory, b"%d" % i) == b"%d" % i
    assert seen == [b"%d" % i for i in range(50)]
    assert len(threads) == 1
    server.close()


def test_reason_of_a_refusal_reaches_the_asker(hub, client):
    def handler(payload: bytes, _: bytes) -> bytes:
        raise MessageError(f"contract differs in {payload.decode()}")

    server = QueryServer(hub, KEYS.trajectory, handler)
    with pytest.raises(RefusedError, match=r"^contract differs in 'reward'$"):
        ask_bytes(client, KEYS.trajectory, b"'reward'")
    assert server.refused == {"contract differs in 'reward'": 1}
    server.close()


def test_a_failing_handler_answers_internal_error_and_goes_on(hub, client, caplog):
    def handler(payload: bytes, _: bytes) -> bytes:
        return b"%d" % (1 // int(payload))

    server = QueryServer(hub, KEYS.trajectory, handler)
    with pytest.raises(RefusedError, match=f"^{INTERNAL_ERROR}$"):
        ask_bytes(client, KEYS.trajectory, b"0")
    assert ask_bytes(client, KEYS.trajectory, b"1") == b"1"
    assert server.refused == {INTERNAL_ERROR: 1}
    assert "ZeroDivisionError" in caplog.text, "the cause stays on this side"
    server.close()


def test_an_answer_that_cannot_be_sent_does_not_end_the_server(hub, client, caplog):
    answers = iter([7, b"bytes"])
    server = QueryServer(hub, KEYS.trajectory, lambda *_: next(answers))
    with pytest.raises(RefusedError, match=INTERNAL_ERROR):
        ask_bytes(client, KEYS.trajectory, b"")
    assert ask_bytes(client, KEYS.trajectory, b"") == b"bytes"
    assert "TypeError" in caplog.text
    server.close()


def test_nobody_serving_is_known_at_once(hub, client):
    began = time.monotonic()
    with pytest.raises(NoAnswerError, match="nobody serves navaclq/run-1/contract"):
        ask(client, KEYS.contract, Nothing(), Acknowledgement, timeout=30.0)
    assert time.monotonic() - began < 10


def test_a_closed_server_no_longer_answers(hub, client):
    server = serve(hub, KEYS.contract, Nothing, lambda _: Nothing())
    assert ask(client, KEYS.contract, Nothing(), Nothing) == Nothing()
    server.close()
    with pytest.raises(NoAnswerError):
        ask(client, KEYS.contract, Nothing(), Nothing, timeout=5.0)


def test_a_slow_answer_is_no_answer(hub, client):
    gate = Gate()
    server = QueryServer(hub, KEYS.trajectory, gate)
    with pytest.raises(NoAnswerError, match="timeout"):
        ask_bytes(client, KEYS.trajectory, b"", timeout=0.3)
    gate.opened.set()
    assert ask_bytes(client, KEYS.trajectory, b"again") == b"again"
    server.close()


def test_a_stalled_handler_does_not_delay_other_servers_of_the_process(hub, client):
    gates = [Gate(), Gate(), Gate()]
    stalled = [QueryServer(hub, f"{KEYS.trajectory}/{i}", gate) for i, gate in enumerate(gates)]
    threads = [
        in_thread(lambda i=i: ask_bytes(client, f"{KEYS.trajectory}/{i}", b"late", timeout=30.0))
        for i in range(3)
    ]
    assert all(gate.entered.wait(10) for gate in gates)
    other = serve(hub, KEYS.contract, Nothing, lambda _: Version(epoch=1))
    for _ in range(20):
        assert ask(client, KEYS.contract, Nothing(), Version, timeout=5.0) == Version(epoch=1)
    assert [result for _, result in threads] == [[], [], []]
    for gate in gates:
        gate.opened.set()
    for thread, result in threads:
        thread.join(10)
        assert result == [b"late"]
    for server in (*stalled, other):
        server.close()


def test_a_full_inbox_refuses_with_busy_at_once_and_keeps_what_it_took(hub, client):
    gate = Gate()
    server = QueryServer(hub, KEYS.trajectory, gate, capacity=1)
    first, first_result = in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"1", timeout=30.0))
    assert gate.entered.wait(10)
    others = [in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"2", timeout=30.0)) for _ in range(3)]
    wait_until(lambda: sum(bool(result) for _, result in others) == 2)
    assert sorted(str(result[0]) for _, result in others if result) == [BUSY, BUSY]
    assert all(isinstance(result[0], RefusedError) for _, result in others if result)
    assert first_result == []
    gate.opened.set()
    for thread in (first, *(thread for thread, _ in others)):
        thread.join(10)
    assert first_result == [b"1"]
    assert [result[0] for _, result in others if not isinstance(result[0], RefusedError)] == [b"2"]
    assert server.refused == {}, "who comes again is not refused"
    server.close()


def test_closing_behind_a_stuck_handler_and_a_full_inbox_returns(hub, client):
    gate = Gate()
    server = QueryServer(hub, KEYS.trajectory, gate, capacity=1)
    threads = [in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"", timeout=30.0))]
    assert gate.entered.wait(10)
    threads += [in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"", timeout=30.0)) for _ in range(2)]
    wait_until(lambda: any(result for _, result in threads))
    closing, done = in_thread(server.close)
    closing.join(8)
    assert done == [None]
    gate.opened.set()
    for thread, _ in threads:
        thread.join(10)
        assert not thread.is_alive()


class Committed:
    """A server with `commit`: what it handled, what had been handled at each commit, and two gates."""

    def __init__(self, session: zenoh.Session, capacity: int = 256) -> None:
        self.handled: list[bytes] = []
        self.commits: list[int] = []
        self.failing = False
        self.handling, self.committing = Gate(), Gate()
        self.committing.opened.set()
        self.server = QueryServer(session, KEYS.trajectory, self._handle, capacity, self._commit)

    def _handle(self, payload: bytes, attachment: bytes) -> bytes:
        if payload == b"refuse":
            raise MessageError("reason: refuse")
        self.handling(payload, attachment)
        self.handled.append(payload)
        return payload

    def _commit(self) -> None:
        self.commits.append(len(self.handled))
        self.committing(b"", b"")
        if self.failing:
            raise OSError("Input/output error")

    def queue(self, client: zenoh.Session, count: int) -> list[tuple[threading.Thread, list]]:
        """Asks so many times from threads of their own, until all are in the server's queue."""
        waiting = self.server._inbox.qsize()
        asked = [
            in_thread(lambda i=i: ask_bytes(client, KEYS.trajectory, b"%d" % i, timeout=30.0))
            for i in range(count)
        ]
        wait_until(lambda: self.server._inbox.qsize() == waiting + count)
        return asked

    def stand_still(self, client: zenoh.Session) -> tuple[threading.Thread, list]:
        """Asks once, and returns when that keeps the server busy."""
        asked = in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"first", timeout=30.0))
        assert self.handling.entered.wait(10)
        return asked


def results(asked: list[tuple[threading.Thread, list]]) -> list:
    """What each of the threads got, once all have ended."""
    for thread, _ in asked:
        thread.join(15)
        assert not thread.is_alive()
    return [result[0] for _, result in asked]


def test_queries_that_wait_together_are_answered_after_one_commit(hub, client):
    committed = Committed(hub)
    first = committed.stand_still(client)
    others = committed.queue(client, 20)
    committed.handling.opened.set()
    assert results([first]) == [b"first"]
    assert results(others) == [b"%d" % i for i in range(20)]
    assert committed.commits == [1, 21], "one for the first, which was alone, and one for all that waited"
    committed.server.close()


def test_more_queries_than_a_group_take_more_commits_in_the_order_of_arrival(hub, client):
    committed = Committed(hub)
    first = committed.stand_still(client)
    others = committed.queue(client, GROUP + 6)
    committed.handling.opened.set()
    assert sorted(results([first, *others])) == sorted([b"first", *(b"%d" % i for i in range(GROUP + 6))])
    assert committed.commits == [1, 1 + GROUP, 7 + GROUP]
    committed.server.close()


def test_no_reply_leaves_before_the_commit_has_returned(hub, client):
    committed = Committed(hub)
    committed.committing.opened.clear()
    committed.handling.opened.set()
    first = in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"first", timeout=30.0))
    assert committed.committing.entered.wait(10)
    others = committed.queue(client, 5)
    # a round trip on another key, so that a reply which had left would be here
    other = QueryServer(hub, KEYS.contract, lambda payload, _: payload)
    for _ in range(20):
        assert ask_bytes(client, KEYS.contract, b"ping") == b"ping"
    assert committed.handled == [b"first"]
    assert [result for _, result in (first, *others)] == [[]] * 6
    committed.committing.opened.set()
    assert results([first, *others]) == [b"first", *(b"%d" % i for i in range(5))]
    assert committed.commits == [1, 6]
    committed.server.close()
    other.close()


def test_each_of_a_group_gets_its_own_answer_the_refused_one_too(hub, client):
    committed = Committed(hub)
    first = committed.stand_still(client)
    asked = [in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"refuse", timeout=30.0))]
    wait_until(lambda: committed.server._inbox.qsize() == 1)
    asked += committed.queue(client, 3)
    committed.handling.opened.set()
    refused, *answers = results(asked)
    assert isinstance(refused, RefusedError) and str(refused) == "reason: refuse"
    assert answers == [b"0", b"1", b"2"]
    assert results([first]) == [b"first"]
    assert committed.commits == [1, 4]
    assert committed.server.refused == {"reason": 1}
    committed.server.close()


def test_when_the_commit_fails_all_that_waited_for_it_are_told_and_the_server_lives_on(hub, client, caplog):
    committed = Committed(hub)
    first = committed.stand_still(client)
    others = committed.queue(client, 7)
    committed.failing = True
    committed.handling.opened.set()
    for found in results([first, *others]):
        assert isinstance(found, RefusedError)
        assert str(found) == INTERNAL_ERROR
    assert committed.commits == [1, 8]
    assert "Input/output error" in caplog.text, "the cause stays on this side"
    committed.failing = False
    assert ask_bytes(client, KEYS.trajectory, b"again") == b"again"
    assert committed.server.refused == {INTERNAL_ERROR: 8}
    committed.server.close()


def test_closing_answers_what_waits_for_a_commit_and_ends_the_thread(hub, client):
    committed = Committed(hub)
    first = committed.stand_still(client)
    others = committed.queue(client, 5)
    closing, done = in_thread(committed.server.close)
    wait_until(lambda: committed.server._inbox.qsize() == 6, what="the end in the queue, behind the others")
    committed.handling.opened.set()
    closing.join(10)
    assert done == [None]
    wait_until(lambda: not committed.server._thread.is_alive(), what="the thread's end")
    assert results([first, *others]) == [b"first", *(b"%d" % i for i in range(5))]
    assert committed.commits == [1, 6]
    with pytest.raises(NoAnswerError):
        ask_bytes(client, KEYS.trajectory, b"late", timeout=5.0)


def test_closing_during_a_commit_that_stands_still_returns(hub, client):
    committed = Committed(hub)
    committed.committing.opened.clear()
    committed.handling.opened.set()
    first = in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"first", timeout=30.0))
    assert committed.committing.entered.wait(10)
    closing, done = in_thread(committed.server.close)
    closing.join(8)
    assert done == [None]
    committed.committing.opened.set()
    assert results([first]) == [b"first"]
    wait_until(lambda: not committed.server._thread.is_alive(), what="the thread's end")


def test_busy_is_no_refusal_that_counts_or_is_logged_from_a_handler_either(hub, client, caplog):
    answers = iter([BUSY, BUSY, "contract differs", None])

    def handler(payload: bytes, _: bytes) -> bytes:
        if (reason := next(answers)) is not None:
            raise MessageError(reason)
        return payload

    server = QueryServer(hub, KEYS.trajectory, handler)
    for reason in (BUSY, BUSY, "contract differs"):
        with pytest.raises(RefusedError, match=f"^{reason}$"):
            ask_bytes(client, KEYS.trajectory, b"x")
    assert ask_bytes(client, KEYS.trajectory, b"x") == b"x"
    assert server.refused == {"contract differs": 1}
    assert BUSY not in caplog.text
    assert "contract differs" in caplog.text
    server.close()


def test_malformed_messages_are_counted_by_reason_and_logged_at_most_once_a_second(hub, client, caplog):
    server = serve(hub, KEYS.task, TaskQuery, lambda _: Nothing())
    began = time.monotonic()
    for _ in range(40):
        with pytest.raises(RefusedError, match="not msgpack"):
            ask_bytes(client, KEYS.task, b"\xc1junk")
    with pytest.raises(RefusedError, match=r"TaskQuery\.cell: Field required"):
        ask_bytes(client, KEYS.task, b"\x93\x01\xa9TaskQuery\x80")
    seconds = time.monotonic() - began
    assert server.refused == {"not msgpack": 40, "TaskQuery.cell": 1}
    logged = [record for record in caplog.records if "refused a message" in record.message]
    assert 1 <= len(logged) <= 1 + seconds
    assert "navaclq/run-1/curriculum/task: not msgpack" in logged[0].message
    assert ask(client, KEYS.task, TaskQuery(cell=0), Nothing) == Nothing()
    server.close()


def test_kinds_of_refusal_that_are_counted_are_bounded(hub, client):
    def handler(payload: bytes, _: bytes) -> bytes:
        raise MessageError(f"reason {payload.decode()}")

    server = QueryServer(hub, KEYS.trajectory, handler)
    for i in range(130):
        with pytest.raises(RefusedError):
            ask_bytes(client, KEYS.trajectory, b"%d" % i)
    assert len(server.refused) <= 101
    assert sum(server.refused.values()) == 130
    server.close()


def test_a_malformed_answer_is_a_message_error(hub, client):
    server = QueryServer(hub, KEYS.contract, lambda *_: b"junk")
    with pytest.raises(MessageError, match="not msgpack"):
        ask(client, KEYS.contract, Nothing(), Acknowledgement)
    server.close()


def test_a_reason_that_is_no_text_is_still_a_refusal(hub, client):
    def receive(query: zenoh.Query) -> None:
        with query:
            query.reply_err(b"\xff\xfe broken")

    queryable = hub.declare_queryable(KEYS.contract, receive)
    with pytest.raises(RefusedError, match="broken"):
        ask_bytes(client, KEYS.contract, b"")
    queryable.undeclare()


@pytest.mark.parametrize(
    ("handler", "expected"),
    [
        (lambda *_: b"\x93\x01\xa7Version\x82\xa5epoch\x07\xa7counter\x09", Version(epoch=7, counter=9)),
        (lambda *_: b"junk", None),
        (lambda *_: (_ for _ in ()).throw(MessageError("no")), None),
        (None, None),
    ],
    ids=["answer", "malformed", "refused", "nobody"],
)
def test_ask_later_calls_back_exactly_once(hub, client, handler, expected):
    server = QueryServer(hub, KEYS.task, handler) if handler else None
    calls: list[Version | None] = []
    ask_later(client, KEYS.task, TaskQuery(cell=1), Version, calls.append, timeout=5.0)
    wait_until(lambda: calls)
    with pytest.raises(NoAnswerError):  # a round trip later
        ask_bytes(client, KEYS.version, b"")
    assert calls == [expected]
    if server:
        server.close()


def test_ask_later_calls_back_once_with_none_after_its_timeout(hub, client):
    gate, calls = Gate(), []
    server = QueryServer(hub, KEYS.task, gate)
    ask_later(client, KEYS.task, TaskQuery(cell=1), Version, calls.append, timeout=0.3)
    assert gate.entered.wait(10)
    assert calls == []
    wait_until(lambda: calls)
    gate.opened.set()
    with pytest.raises(MessageError):  # the server is free again, so its late reply is out
        ask(client, KEYS.task, Nothing(), Version)
    assert calls == [None]
    server.close()


def test_published_figures_reach_subscribers_and_malformed_ones_are_ignored(hub, client, caplog):
    got: list[Stat] = []
    subscriber = Subscription(hub, KEYS.stat("*", "*"), Stat, got.append)
    stat = Stat(role="actor", id="a", host="h", pid=1, values={"steps": 3, "rate": 0.5, "state": "ok"})

    def arrived() -> list[Stat]:
        client.put(KEYS.stat("actor", "a"), b"junk")
        publish(client, KEYS.stat("actor", "a"), stat)
        return got

    wait_until(arrived)
    assert set(map(repr, got)) == {repr(stat)}
    assert "ignored a message on navaclq/run-1/stat/actor/a: not msgpack" in caplog.text
    assert subscriber.ignored >= 1


def test_members_are_seen_joining_and_leaving_and_those_there_before(endpoint, hub, client):
    events: list[tuple[str, str, bool]] = []
    early = announce(client, KEYS, "learner", "early")
    wait_until(lambda: any(r.ok for r in hub.liveliness().get(KEYS.live("learner", "early"))))
    watch = watch_members(hub, KEYS, lambda *event: events.append(event))
    wait_until(lambda: events == [("learner", "early", True)])
    with open_client(endpoint) as other:
        late = announce(other, KEYS, "actor", "late")
        wait_until(lambda: ("actor", "late", True) in events)
        late.undeclare()
        wait_until(lambda: ("actor", "late", False) in events)
        kept = announce(other, KEYS, "actor", "kept")
        wait_until(lambda: ("actor", "kept", True) in events)
    wait_until(lambda: ("actor", "kept", False) in events)
    assert len(events) == 5
    assert ("learner", "early", False) not in events
    del early, kept, watch


def test_a_killed_member_is_seen_leaving(endpoint, hub):
    events: list[tuple[str, str, bool]] = []
    watch = watch_members(hub, KEYS, lambda *event: events.append(event))
    script = (
        "import sys, time; from common.bus import Keys, announce, open_client\n"
        "with open_client(sys.argv[1]) as session:\n"
        "    token = announce(session, Keys('run-1'), 'actor', 'victim'); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, endpoint], cwd=Path(__file__).parents[1])
    wait_until(lambda: events == [("actor", "victim", True)], 20)
    process.kill()
    process.wait()
    wait_until(lambda: events[1:] == [("actor", "victim", False)])
    del watch


def test_a_name_in_use_is_refused_until_its_owner_leaves(endpoint, hub, client):
    with open_client(endpoint) as other:
        token = announce(other, KEYS, "actor", "a1")

        def refused() -> bool:
            try:
                announce(client, KEYS, "actor", "a1")
            except UsageError as error:
                assert str(error) == "a actor named 'a1' is already connected; choose another --name"
                return True
            return False

        wait_until(refused)
        namesake = announce(client, KEYS, "curriculum", "a1")
        del token
    free = wait_until(lambda: try_announce(client, "a1"))
    del free, namesake


def try_announce(session: zenoh.Session, name: str) -> object | None:
    try:
        return announce(session, KEYS, "actor", name)
    except UsageError:
        return None


def test_an_address_in_use_is_a_usage_error(endpoint, hub):
    with pytest.raises(UsageError, match=f"cannot listen on {endpoint}"), open_hub(endpoint):
        pass


def test_client_waits_for_a_hub_that_starts_later_and_says_so(endpoint):
    waits: list[float] = []
    answers: list[bytes] = []

    def join() -> None:
        with open_client(endpoint, waits.append, patience=30.0) as session:
            answers.append(wait_until(lambda: echo(session)))

    thread, result = in_thread(join)
    wait_until(lambda: len(waits) >= 2)
    assert answers == []
    with open_hub(endpoint) as hub:
        server = QueryServer(hub, "navaclq/run-1/echo", lambda payload, _: payload)
        thread.join(20)
        server.close()
    assert answers == [b"echo"]
    assert result == [None]
    assert waits == sorted(waits)


def echo(session: zenoh.Session) -> bytes | None:
    try:
        return ask_bytes(session, "navaclq/run-1/echo", b"echo", timeout=2.0)
    except NoAnswerError:
        return None


def test_client_gives_up_when_its_patience_ends(endpoint):
    with (
        pytest.raises(NoAnswerError, match=f"no hub answers at {endpoint}"),
        open_client(endpoint, patience=0.1),
    ):
        pass


def test_client_finds_a_hub_again_that_was_killed_and_restarted(endpoint):
    def start() -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", ECHO_HUB, endpoint], stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
        )
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        return process

    process = start()
    try:
        with open_client(endpoint, patience=10.0) as client:
            assert wait_until(lambda: echo(client)) == b"echo"
            process.kill()
            process.wait()
            wait_until(lambda: echo(client) is None)
            process = start()
            assert wait_until(lambda: echo(client), 20) == b"echo"
    finally:
        process.kill()
        process.wait()


def test_refusals_are_logged_below_the_level_of_errors(hub, client, caplog):
    server = serve(hub, KEYS.task, TaskQuery, lambda _: Nothing())
    with pytest.raises(RefusedError):
        ask_bytes(client, KEYS.task, b"junk")
    server.close()
    assert {record.levelno for record in caplog.records if record.name == "common.bus"} == {logging.WARNING}
