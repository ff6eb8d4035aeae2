import gc
import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import zenoh

from common import bus
from common.access import Credentials
from common.bus import (
    BUSY,
    EVERYBODY,
    GROUP,
    INBOX_BYTES,
    INTERNAL_ERROR,
    LOGGED,
    Keys,
    Member,
    QueryServer,
    Subscription,
    announce,
    ask,
    ask_bytes,
    ask_later,
    list_members,
    publish,
    serve,
    watch_members,
)
from common.delivery import BUNDLE_BYTES
from common.errors import NoAnswerError, RefusedError, UsageError
from common.link import LARGEST_MESSAGE, make_link, open_client, open_hub, open_router
from common.messages import (
    MEGABYTE,
    PROTOCOL,
    Message,
    MessageError,
    Nothing,
    Stat,
    TaskQuery,
    Version,
    encode,
)
from tests.helpers import free_endpoint, wait_until

KEYS = Keys("run-1")
A = Member("actor", "local", "a")
ECHO_HUB = """
import sys, time
from common.bus import QueryServer
from common.link import make_link, open_hub
with open_hub(make_link(sys.argv[1])) as hub:
    server = QueryServer(hub, "navaclq/run-1/echo", lambda payload, *_: payload)
    print("up", flush=True)
    time.sleep(60)
"""


class Gate:
    """A handler that stands still until it is opened."""

    def __init__(self) -> None:
        self.entered, self.opened = threading.Event(), threading.Event()

    def __call__(self, payload: bytes, *_: object) -> bytes:
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
    assert KEYS.live(A, "7f") == "navaclq/run-1/live/actor/local/a/7f"
    assert KEYS.stat(A) == "navaclq/run-1/stat/actor/local/a"
    assert KEYS.live(EVERYBODY, "*") == "navaclq/run-1/live/*/*/*/*"
    assert KEYS.stat(EVERYBODY) == "navaclq/run-1/stat/*/*/*"
    assert len({KEYS.weights("policy"), KEYS.weights("critic"), KEYS.version}) == 3
    plain = [v for v in vars(KEYS).values() if isinstance(v, str)]
    assert len(plain) == len(set(plain)) >= 6
    assert all(v == KEYS.root or v.startswith("navaclq/run-1/") for v in plain)


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tcp/localhost:1", "tcp/[::1]:65535", "tcp/127.9.9.9:80"]
)
def test_loopback_endpoints_are_taken(endpoint):
    link = make_link(endpoint)
    assert (link.endpoints, link.credentials, link.group, str(link)) == ((endpoint,), None, "local", endpoint)


def test_a_link_may_name_several_hubs_in_order_each_of_which_must_be_allowed():
    link = make_link("tcp/127.0.0.1:7447, tcp/[::1]:7448")
    assert link.endpoints == ("tcp/127.0.0.1:7447", "tcp/[::1]:7448")
    assert str(link) == "tcp/127.0.0.1:7447, tcp/[::1]:7448"
    assert make_link(" tcp/127.0.0.1:7447\n").endpoints == ("tcp/127.0.0.1:7447",), "as a file gives it"
    with pytest.raises(UsageError, match="plain TCP to host-b is readable"):
        make_link("tcp/127.0.0.1:7447,tcp/host-b:7447")
    for text in ("tcp/127.0.0.1:7447,", ",tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447,,tcp/127.0.0.1:7448"):
        with pytest.raises(UsageError, match="'' is no endpoint"):
            make_link(text)


def test_tls_needs_credentials_and_credentials_need_tls(tmp_path):
    with pytest.raises(UsageError, match="tls/host-b:7447 needs --certs"):
        make_link("tls/host-b:7447")
    credentials = Credentials(tmp_path, "actor-host-b", ())
    link = make_link("tls/host-b:7447,tls/[fe80::1]:7448", credentials)
    assert (link.endpoints, link.group) == (("tls/host-b:7447", "tls/[fe80::1]:7448"), "actor-host-b")
    for text in ("tcp/127.0.0.1:7447", "tls/host-b:7447,tcp/127.0.0.1:7447"):
        for insecure in (False, True):
            with pytest.raises(UsageError, match="--certs is for tls/HOST:PORT"):
                make_link(text, credentials, insecure)


@pytest.mark.parametrize(
    ("member", "address", "label", "called"),
    [
        (Member("actor", "local", "a"), "local/a", "a", "actor a"),
        (Member("actor", "host-b", "a"), "host-b/a", "host-b/a", "actor host-b/a"),
        (Member("learner", "local", "learner"), "local/learner", "learner", "learner"),
        (Member("learner", "learner", "learner"), "learner/learner", "learner", "learner"),
        (
            Member("curriculum", "curriculum", "curriculum"),
            "curriculum/curriculum",
            "curriculum",
            "curriculum",
        ),
    ],
)
def test_a_member_is_called_by_as_much_as_tells_it_apart(member, address, label, called):
    assert (member.address, member.label, str(member)) == (address, label, called)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "tcp/learner.example.org:7447", "tcp/[::]:7447"]
)
def test_plain_tcp_beyond_loopback_needs_insecure(endpoint):
    with pytest.raises(UsageError, match="--insecure"):
        make_link(endpoint)
    assert make_link(endpoint, insecure=True).endpoints == (endpoint,)


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
        "tcp/127.0.0.1\n:7447",
        "tcp/127.0.0.1:7447\n0",
        "tcp/127.0.0.1:7447#x=1",
        "tcp/a b:7447",
        "tcp/127.0.0.1:-1",
    ],
)
@pytest.mark.parametrize("insecure", [False, True])
def test_malformed_endpoint_is_a_usage_error_with_an_example(endpoint, insecure):
    said = "is no endpoint; write tcp/HOST:PORT or tls/HOST:PORT, for example tcp/127.0.0.1:7447"
    with pytest.raises(UsageError, match=said):
        make_link(endpoint, insecure=insecure)


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
    with open_client(make_link(endpoint)) as other:
        server = serve(other, KEYS.contract, Nothing, lambda _: Version(epoch=2))
        found = wait_until(lambda: answered(client, KEYS.contract, Nothing(), Version))
        assert found == Version(epoch=2)
        server.close()


def test_newcomer_finds_the_contract_without_knowing_the_run(hub, client):
    server = serve(hub, KEYS.contract, Nothing, lambda _: Version(epoch=5))
    assert ask(client, Keys("*").contract, Nothing(), Version) == Version(epoch=5)
    server.close()


def test_payload_and_attachment_arrive_to_the_byte(hub, client):
    server = QueryServer(
        hub, KEYS.trajectory, lambda payload, attachment, _: attachment + payload, max_bytes=4 * MEGABYTE
    )
    blob = bytes(range(256)) * 8192
    assert ask_bytes(client, KEYS.trajectory, blob, b"\x00head") == b"\x00head" + blob
    assert ask_bytes(client, KEYS.trajectory, b"") == b""
    server.close()


def test_a_server_of_a_wildcard_answers_every_key_that_it_covers(hub, client):
    server = QueryServer(hub, f"{KEYS.trajectory}/**", lambda payload, *_: payload)
    for name in ("local/a", "host-1/b"):
        assert ask_bytes(client, f"{KEYS.trajectory}/{name}", name.encode()) == name.encode()
    server.close()


def test_one_thread_answers_in_the_order_of_arrival(hub, client):
    seen: list[bytes] = []
    threads: set[int] = set()

    def handler(payload: bytes, *_: object) -> bytes:
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
    def handler(payload: bytes, *_: object) -> bytes:
        raise MessageError(f"contract differs in {payload.decode()}")

    server = QueryServer(hub, KEYS.trajectory, handler)
    with pytest.raises(RefusedError, match=r"^contract differs in 'reward'$"):
        ask_bytes(client, KEYS.trajectory, b"'reward'")
    assert server.refused == {"contract differs in 'reward'": 1}
    server.close()


def test_refusals_leave_nothing_behind_for_the_garbage_collector(hub, client):
    """It would come late: of 100,000 refusals in a large process 80 MB were left."""

    def handler(*_: object) -> bytes:
        raise MessageError("no")

    server = QueryServer(hub, KEYS.trajectory, handler)
    heard: list[bytes | Exception] = []
    gc.collect()
    gc.disable()
    try:
        for i in range(100):
            ask_later(client, KEYS.trajectory, b"1", heard.append, 10.0)
            wait_until(lambda i=i: len(heard) == i + 1)
        assert [str(refusal) for refusal in heard] == ["no"] * 100
        heard.clear()
        assert gc.collect() < 100
    finally:
        gc.enable()
    server.close()


def test_a_failing_handler_answers_internal_error_and_goes_on(hub, client, caplog):
    def handler(payload: bytes, *_: object) -> bytes:
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
        ask(client, KEYS.contract, Nothing(), Nothing, timeout=30.0)
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

    def _handle(self, payload: bytes, *_: object) -> bytes:
        if payload == b"refuse":
            raise MessageError("reason: refuse")
        self.handling(payload)
        self.handled.append(payload)
        return payload

    def _commit(self) -> None:
        self.commits.append(len(self.handled))
        self.committing(b"")
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
    other = QueryServer(hub, KEYS.contract, lambda payload, *_: payload)
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

    def handler(payload: bytes, *_: object) -> bytes:
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


def test_malformed_messages_are_counted_by_reason_and_each_reason_is_logged_once(hub, client, caplog):
    server = serve(hub, KEYS.task, TaskQuery, lambda _: Nothing())
    for _ in range(40):
        with pytest.raises(RefusedError, match="not msgpack"):
            ask_bytes(client, KEYS.task, b"\xc1junk")
    with pytest.raises(RefusedError, match=r"TaskQuery\.cell: Field required"):
        ask_bytes(client, KEYS.task, b"\x93\x01\xa9TaskQuery\x80")
    assert server.refused == {"not msgpack": 40, "TaskQuery.cell": 1}
    first, second = refusals_in(caplog)
    assert first.startswith("refused a message on navaclq/run-1/curriculum/task: not msgpack: ")
    assert second == "refused a message on navaclq/run-1/curriculum/task: TaskQuery.cell: Field required"
    assert ask(client, KEYS.task, TaskQuery(cell=0), Nothing) == Nothing()
    server.close()


def refusals_in(caplog) -> list[str]:
    """What was logged of refusals."""
    return [record.message for record in caplog.records if "refused a message" in record.message]


def test_a_refusal_is_logged_once_for_each_sender_and_reason(hub, client, caplog):
    def handler(payload: bytes, *_: object) -> bytes:
        raise MessageError(f"{payload.decode()}: and more")

    server = QueryServer(hub, f"{KEYS.trajectory}/*/*", handler)
    for _ in range(3):
        for sender in ("local/a", "local/b"):
            for reason in (b"digest", b"layout"):
                with pytest.raises(RefusedError):
                    ask_bytes(client, f"{KEYS.trajectory}/{sender}", reason)
    assert server.refused == {"digest": 6, "layout": 6}
    assert refusals_in(caplog) == [
        f"refused a message on {KEYS.trajectory}/{sender}: {reason}: and more"
        for sender in ("local/a", "local/b")
        for reason in ("digest", "layout")
    ]
    server.close()


def test_refusals_that_are_logged_are_bounded_however_many_names_a_sender_takes(hub, client, caplog):
    server = QueryServer(hub, f"{KEYS.trajectory}/*/*", lambda *_: b"")
    with caplog.at_level(logging.WARNING):
        for i in range(LOGGED + 50):
            server.note_refusal(f"{KEYS.trajectory}/local/{i}", "digest: differs")
    assert len(refusals_in(caplog)) == LOGGED
    assert server.refused == {"digest": LOGGED + 50}, "but all are counted"
    server.close()


def test_a_query_that_is_too_large_is_refused_before_the_handler(hub, client):
    handled: list[int] = []

    def handler(payload: bytes, attachment: bytes, _: str) -> bytes:
        handled.append(len(payload) + len(attachment))
        return b"ok"

    server = QueryServer(hub, KEYS.trajectory, handler, max_bytes=1000)
    for payload, attachment in ((1001, 0), (0, 1001), (600, 401), (MEGABYTE, 5)):
        with pytest.raises(RefusedError) as refusal:
            ask_bytes(client, KEYS.trajectory, bytes(payload), bytes(attachment))
        size = payload + attachment
        assert str(refusal.value) == f"too large: {size} bytes; at most 1000 are taken here"
    assert handled == []
    for payload, attachment in ((1000, 0), (0, 1000), (600, 400)):
        assert ask_bytes(client, KEYS.trajectory, bytes(payload), bytes(attachment)) == b"ok"
    assert handled == [1000, 1000, 1000]
    assert server.refused == {"too large": 4}
    server.close()


def test_a_question_is_taken_up_to_the_size_of_its_type(hub, client):
    asked: list[TaskQuery] = []

    class Long(TaskQuery):
        max_bytes = 2 * MEGABYTE

    servers = [
        serve(hub, KEYS.task, TaskQuery, lambda query: (asked.append(query), Nothing())[1]),
        serve(hub, KEYS.contract, Long, lambda query: (asked.append(query), Nothing())[1]),
    ]
    with pytest.raises(RefusedError, match=f"too large: {MEGABYTE + 1} bytes; at most {MEGABYTE} are taken"):
        ask_bytes(client, KEYS.task, bytes(MEGABYTE + 1))
    with pytest.raises(RefusedError, match=r"not msgpack|a message is"):
        ask_bytes(client, KEYS.contract, bytes(MEGABYTE + 1))
    assert asked == []
    for server in servers:
        server.close()


def test_a_server_whose_inbox_holds_enough_bytes_is_busy_until_they_are_answered(hub, client, monkeypatch):
    monkeypatch.setattr(bus, "INBOX_BYTES", 10_000)
    gate = Gate()
    server = QueryServer(hub, KEYS.trajectory, gate, capacity=256)
    # two that wait do not fill it, and the third may go beyond what is left
    taken = [in_thread(lambda: ask_bytes(client, KEYS.trajectory, bytes(3000), timeout=30.0))]
    assert gate.entered.wait(10)
    for waiting in (1, 2):
        taken.append(in_thread(lambda: ask_bytes(client, KEYS.trajectory, bytes(3000), timeout=30.0)))
        wait_until(lambda n=waiting: len(server) == n)
    taken.append(in_thread(lambda: ask_bytes(client, KEYS.trajectory, b"", bytes(5000), timeout=30.0)))
    wait_until(lambda: len(server) == 3)
    for payload, attachment in ((b"x", b""), (b"", b"x"), (bytes(3000), b"")):
        with pytest.raises(RefusedError, match=f"^{BUSY}$"):
            ask_bytes(client, KEYS.trajectory, payload, attachment)
    assert [result for _, result in taken] == [[], [], [], []]
    gate.opened.set()
    assert results(taken) == [bytes(3000), bytes(3000), bytes(3000), b""]
    # all of it is given back, a hundred times over
    for _ in range(100):
        assert ask_bytes(client, KEYS.trajectory, bytes(9000)) == bytes(9000)
    assert server._waiting_bytes == 0
    assert server.refused == {}, "who comes again is not refused"
    server.close()


def test_bytes_of_queries_that_were_refused_or_found_no_room_are_given_back(hub, client, monkeypatch):
    monkeypatch.setattr(bus, "INBOX_BYTES", 10_000)

    def handler(payload: bytes, *_: object) -> bytes:
        if payload.startswith(b"fail"):
            raise OSError("no space left on device")
        raise MessageError("no")

    server = QueryServer(hub, KEYS.trajectory, handler, max_bytes=20_000)
    for payload in (b"fail" + bytes(9000), bytes(9000), bytes(20_001)) * 5:
        with pytest.raises(RefusedError, match=f"^(no|{INTERNAL_ERROR}|too large.*)$"):
            ask_bytes(client, KEYS.trajectory, payload)
    assert server._waiting_bytes == 0
    server.close()
    gate = Gate()
    server = QueryServer(hub, KEYS.trajectory, gate, capacity=1)
    taken = [in_thread(lambda: ask_bytes(client, KEYS.trajectory, bytes(1000), timeout=30.0))]
    assert gate.entered.wait(10)
    taken.append(in_thread(lambda: ask_bytes(client, KEYS.trajectory, bytes(1000), timeout=30.0)))
    wait_until(lambda: len(server) == 1)
    for _ in range(20):
        with pytest.raises(RefusedError, match=f"^{BUSY}$"):  # for want of a place, not of bytes
            ask_bytes(client, KEYS.trajectory, bytes(1000))
    assert server._waiting_bytes == 2000
    gate.opened.set()
    assert results(taken) == [bytes(1000)] * 2
    wait_until(lambda: server._waiting_bytes == 0)
    server.close()


def test_the_largest_messages_fit_into_an_inbox_and_through_the_transport():
    largest = max(kind.max_bytes for kind in Message.__subclasses__())
    assert largest <= INBOX_BYTES
    assert largest + BUNDLE_BYTES < LARGEST_MESSAGE


def test_the_handler_learns_on_which_key_it_was_asked(hub, client):
    server = QueryServer(hub, f"{KEYS.trajectory}/*/*", lambda payload, _, key: key.encode())
    for name in ("local/a", "host-1/b"):
        key = f"{KEYS.trajectory}/{name}"
        assert ask_bytes(client, key, b"") == key.encode()
    server.close()


def test_kinds_of_refusal_that_are_counted_are_bounded(hub, client):
    def handler(payload: bytes, *_: object) -> bytes:
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
        ask(client, KEYS.contract, Nothing(), Nothing)
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
        (lambda payload, *_: payload + b"!", b"what?!"),
        (lambda *_: b"", b""),
        (lambda *_: (_ for _ in ()).throw(MessageError("no")), RefusedError("no")),
        (lambda *_: (_ for _ in ()).throw(MessageError(BUSY)), RefusedError(BUSY)),
        (None, NoAnswerError(f"nobody serves {KEYS.task}")),
    ],
    ids=["answer", "empty answer", "refused", "busy", "nobody"],
)
@pytest.mark.parametrize("urgent", [False, True], ids=["at leisure", "urgent"])
def test_ask_later_calls_back_exactly_once_with_the_bytes_or_what_went_wrong(
    hub, client, handler, expected, urgent
):
    server = QueryServer(hub, KEYS.task, handler) if handler else None
    calls: list[bytes | Exception] = []
    ask_later(client, KEYS.task, b"what?", calls.append, timeout=5.0, urgent=urgent)
    wait_until(lambda: calls)
    with pytest.raises(NoAnswerError):  # a round trip later
        ask_bytes(client, KEYS.version, b"")
    assert list(map(repr, calls)) == [repr(expected)]
    if server:
        server.close()


def test_ask_later_passes_payload_and_attachment_on_to_the_byte(hub, client):
    server = QueryServer(hub, f"{KEYS.trajectory}/*/*", lambda *asked: b"|".join(map(bytes_of, asked)))
    calls: list[bytes | Exception] = []
    ask_later(
        client, f"{KEYS.trajectory}/local/a", b"\x00pay", calls.append, timeout=5.0, attachment=b"head\xff"
    )
    wait_until(lambda: calls)
    assert calls == [b"\x00pay|head\xff|navaclq/run-1/trajectory/local/a"]
    server.close()


def bytes_of(value: bytes | str) -> bytes:
    return value if isinstance(value, bytes) else value.encode()


def test_ask_later_calls_back_once_with_no_answer_after_its_timeout(hub, client):
    gate, calls = Gate(), []
    server = QueryServer(hub, KEYS.task, gate)
    ask_later(client, KEYS.task, b"", calls.append, timeout=0.3)
    assert gate.entered.wait(10)
    assert calls == []
    wait_until(lambda: calls)
    gate.opened.set()
    with pytest.raises(MessageError):  # the server is free again, so its late reply is out
        ask(client, KEYS.task, Nothing(), Version)
    assert list(map(repr, calls)) == [repr(NoAnswerError("timeout"))]
    server.close()


def stat_of(member: Member, **values: float | int | str) -> Stat:
    """What a process of that name tells."""
    return Stat(
        **member._asdict(), host="h", pid=1, since=1.7e9, code="1.0+abc", protocol=PROTOCOL, values=values
    )


def test_published_figures_reach_subscribers_and_malformed_ones_are_ignored(hub, client, caplog):
    got: list[Stat] = []
    subscriber = Subscription(hub, KEYS.stat(EVERYBODY), Stat, got.append)
    stat = stat_of(A, steps=3, rate=0.5, state="ok")

    def arrived() -> list[Stat]:
        client.put(KEYS.stat(A), b"junk")
        publish(client, KEYS.stat(A), stat)
        return got

    wait_until(arrived)
    assert set(map(repr, got)) == {repr(stat)}
    assert "ignored a message on navaclq/run-1/stat/actor/local/a: not msgpack" in caplog.text
    assert subscriber.ignored >= 1


def test_a_publication_that_is_too_large_is_ignored_unread(hub, client, caplog):
    got: list[Version] = []
    subscriber = Subscription(hub, KEYS.version, Version, got.append)

    def ignored() -> int:
        client.put(KEYS.version, bytes(MEGABYTE + 1))
        return subscriber.ignored

    wait_until(ignored)
    assert "ignored a message on navaclq/run-1/weights/version: too large: 1048577 bytes" in caplog.text
    client.put(KEYS.version, encode(Version(epoch=3)))
    wait_until(lambda: got == [Version(epoch=3)])


def members(session: zenoh.Session, keys: Keys = KEYS) -> set[str]:
    """Keys of the liveliness tokens that the hub knows now."""
    replies = session.liveliness().get(keys.live(EVERYBODY, "*"))
    return {str(reply.ok.key_expr) for reply in replies if reply.ok}


def test_members_are_seen_joining_and_leaving_and_those_there_before(endpoint, hub, client):
    events: list[tuple[Member, bool]] = []
    lives: dict[Member, set[str]] = {}

    def hear(member: Member, life: str, alive: bool) -> None:
        events.append((member, alive))
        lives.setdefault(member, set()).add(life)

    early, late, kept = (
        Member("learner", "learner", "learner"),
        Member("actor", "local", "late"),
        Member("actor", "host-b", "kept"),
    )
    tokens = [announce(client, KEYS, early)]
    wait_until(lambda: members(hub))
    watch = watch_members(hub, KEYS, hear)
    wait_until(lambda: events == [(early, True)])
    with open_client(make_link(endpoint)) as other:
        token = announce(other, KEYS, late)
        wait_until(lambda: (late, True) in events)
        token.undeclare()
        wait_until(lambda: (late, False) in events)
        tokens.append(announce(other, KEYS, kept))
        wait_until(lambda: (kept, True) in events)
    wait_until(lambda: (kept, False) in events)
    assert len(events) == 5
    assert (early, False) not in events
    assert [len(lives[member]) for member in (early, late, kept)] == [1, 1, 1], "one life each, told twice"
    del tokens, watch


def test_a_killed_member_is_seen_leaving(endpoint, hub):
    victim = Member("actor", "local", "victim")
    events: list[tuple[Member, str, bool]] = []
    watch = watch_members(hub, KEYS, lambda *event: events.append(event))
    script = (
        "import sys, time; from common.bus import Keys, Member, announce\n"
        "from common.link import make_link, open_client\n"
        "with open_client(make_link(sys.argv[1])) as session:\n"
        "    token = announce(session, Keys('run-1'), Member('actor', 'local', 'victim')); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", script, endpoint], cwd=Path(__file__).parents[1])
    wait_until(lambda: events, 20)
    ((member, life, alive),) = events
    assert (member, alive) == (victim, True)
    process.kill()
    process.wait()
    wait_until(lambda: events[1:] == [(victim, life, False)])
    del watch


def test_a_name_in_use_is_refused_until_its_owner_leaves(endpoint, hub, client):
    a1 = Member("actor", "local", "a1")
    with open_client(make_link(endpoint)) as other:
        token = announce(other, KEYS, a1)
        (held,) = members(hub)
        with pytest.raises(UsageError) as refusal:
            announce(client, KEYS, a1)
        assert str(refusal.value) == "a actor named 'a1' is already connected; choose another --name"
        wait_until(lambda: members(hub) == {held})  # who was refused leaves nothing behind
        namesakes = [
            announce(client, KEYS, Member("curriculum", "local", "a1")),
            announce(client, KEYS, Member("actor", "host-b", "a1")),
            announce(client, Keys("run-2"), a1),
        ]
        del token
    free = wait_until(lambda: try_announce(client, a1))
    del free, namesakes


def test_a_name_is_also_taken_by_a_namesake_on_the_same_session(hub):
    a1 = Member("actor", "local", "a1")
    token = announce(hub, KEYS, a1)
    assert try_announce(hub, a1) is None
    token.undeclare()
    assert try_announce(hub, a1)


def try_announce(session: zenoh.Session, member: Member, keys: Keys = KEYS) -> zenoh.LivelinessToken | None:
    try:
        return announce(session, keys, member)
    except UsageError:
        return None


def announced_at_once(sessions: list[zenoh.Session], rounds: int) -> list[int]:
    """In how many of the rounds, a name each, nobody, one or several of the sessions got the name."""
    counts = [0] * (len(sessions) + 1)
    for i in range(rounds):
        start = threading.Barrier(len(sessions))

        def announce_one(session: zenoh.Session, start=start, name=f"twin-{i}") -> object | None:
            start.wait(10)
            return try_announce(session, Member("actor", "local", name))

        tried = [in_thread(lambda s=session: announce_one(s)) for session in sessions]
        tokens = [token for token in results(tried) if token is not None]
        assert not any(isinstance(token, Exception) for token in tokens)
        counts[len(tokens)] += 1
        for token in tokens:
            token.undeclare()
    return counts


def test_of_two_that_announce_one_name_at_the_same_moment_never_both_are_accepted(endpoint, hub, client):
    with open_client(make_link(endpoint)) as other:
        neither, one, both = announced_at_once([client, other], 60)
        assert both == 0
        assert neither + one == 60
        # nor does it help to be the hub itself, which hears the others at once
        neither, one, both = announced_at_once([hub, client], 60)
        assert both == 0
        assert neither + one == 60


def test_a_name_is_taken_also_by_a_member_behind_another_router(endpoint, hub):
    a1, ways = Member("actor", "local", "a1"), [make_link(free_endpoint()) for _ in range(2)]
    with (
        open_router(ways[0], make_link(endpoint)),
        open_router(ways[1], make_link(endpoint)),
        open_client(ways[0]) as one,
        open_client(ways[1]) as other,
    ):
        token = announce(one, KEYS, a1)
        wait_until(lambda: list_members(other, KEYS) == {a1})
        assert try_announce(other, a1) is None
        token.undeclare()
        assert wait_until(lambda: try_announce(other, a1))


def test_questions_deliveries_and_figures_pass_through_a_router(endpoint, hub):
    way, got = make_link(free_endpoint()), []
    server = QueryServer(hub, f"{KEYS.trajectory}/*/*", lambda payload, *_: payload)
    subscriber = Subscription(hub, KEYS.stat(EVERYBODY), Stat, got.append)
    with open_router(way, make_link(endpoint)), open_client(way) as behind:
        wait_until(lambda: answered_bytes(behind, f"{KEYS.trajectory}/local/a", b"x") == b"x")
        token = announce(behind, KEYS, A)
        wait_until(lambda: list_members(hub, KEYS) == {A})
        wait_until(lambda: (publish(behind, KEYS.stat(A), stat_of(A, steps=1)), got)[1])
        token.undeclare()
        wait_until(lambda: not list_members(hub, KEYS))
    server.close()
    del subscriber


def answered_bytes(session: zenoh.Session, key: str, payload: bytes) -> bytes | None:
    """The answer, or None while the declaration has not arrived."""
    try:
        return ask_bytes(session, key, payload)
    except NoAnswerError:
        return None


def test_members_are_listed_as_far_as_is_asked_for(endpoint, hub, client):
    assert list_members(hub, KEYS) == set()
    found = [A, Member("actor", "host-b", "a"), Member("learner", "local", "learner")]
    with open_client(make_link(endpoint)) as other:
        tokens = [announce(other, KEYS, member) for member in found]
        for session in (hub, client):
            wait_until(lambda s=session: list_members(s, KEYS) == set(found))
        assert list_members(client, KEYS, Member("actor", "*", "*")) == set(found[:2])
        assert list_members(client, KEYS, Member("*", "local", "*")) == {found[0], found[2]}
        assert list_members(client, KEYS, A) == {A}
        assert list_members(client, Keys("run-2")) == set()
        assert list_members(client, Keys("*")) == set(found)
        tokens.clear()
    wait_until(lambda: list_members(client, KEYS) == set())


def test_two_that_hindered_each_other_leave_the_name_free(endpoint, hub, client):
    with open_client(make_link(endpoint)) as other:
        announced_at_once([client, other], 10)
        wait_until(lambda: not members(hub), what="no name held")
        for i in range(10):
            assert try_announce(client, Member("actor", "local", f"twin-{i}"))


def test_an_address_in_use_is_a_usage_error(endpoint, hub):
    with pytest.raises(UsageError, match=f"cannot listen on {endpoint}"), open_hub(make_link(endpoint)):
        pass


def test_client_waits_for_a_hub_that_starts_later_and_says_so(endpoint):
    waits: list[float] = []
    answers: list[bytes] = []

    def join() -> None:
        with open_client(make_link(endpoint), waits.append, patience=30.0) as session:
            answers.append(wait_until(lambda: echo(session)))

    thread, result = in_thread(join)
    wait_until(lambda: len(waits) >= 2)
    assert answers == []
    with open_hub(make_link(endpoint)) as hub:
        server = QueryServer(hub, "navaclq/run-1/echo", lambda payload, *_: payload)
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
        open_client(make_link(endpoint), patience=0.1),
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
        with open_client(make_link(endpoint), patience=10.0) as client:
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
