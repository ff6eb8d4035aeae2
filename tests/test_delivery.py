import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import msgpack
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from common.bus import BUSY, INTERNAL_ERROR, QueryServer, open_client, open_hub
from common.delivery import DuplicateFilter, Sender, Spool, pack_header, unpack_header
from common.messages import Acknowledgement, MessageError, Origin, TaskQuery, decode, encode
from tests.helpers import wait_until

KEY = "navaclq/run-1/trajectory"
MEGABYTE = 2.0**20


def origin(seq: int, boot: str = "b1", actor: str = "a1") -> Origin:
    return Origin(actor=actor, boot=boot, seq=seq)


def drain(spool: Spool) -> list[bytes]:
    """Payloads in the order in which the spool gives them."""
    payloads = []
    while (head := spool.first()) is not None:
        payloads.append(head[3])
        spool.remove(head[0])
    return payloads


class Receiver:
    """Stores what is new and answers after it; `silent` first attempts of each message get no reply."""

    def __init__(self, session: zenoh.Session, silent: int = 0) -> None:
        self.stored: list[tuple[Origin, bytes]] = []
        self.attempts: Counter[Origin] = Counter()
        self.duplicates = 0
        self._seen, self._silent = DuplicateFilter(), silent
        self._queryable = session.declare_queryable(KEY, self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        with query:
            payload = query.payload.to_bytes()
            source = unpack_header(query.attachment.to_bytes(), payload)
            self.attempts[(source.actor, source.boot, source.seq)] += 1
            duplicate = self._seen.seen(source)
            if duplicate:
                self.duplicates += 1
            else:
                self._seen.add(source)
                self.stored.append((source, payload))
            if self.attempts[(source.actor, source.boot, source.seq)] > self._silent:
                query.reply(KEY, encode(Acknowledgement(duplicate=duplicate)))


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "spool", MEGABYTE)


def test_header_gives_the_origin_of_its_payload():
    for payload in (b"", b"abc", bytes(10_000)):
        assert unpack_header(pack_header(origin(7), payload), payload) == origin(7)


def test_damaged_payload_is_noticed():
    header = pack_header(origin(0), b"payload")
    for damaged in (b"", b"paylode", b"payload\x00", b"Payload"):
        with pytest.raises(MessageError, match="payload damaged"):
            unpack_header(header, damaged)


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"junk",
        msgpack.packb(3),
        msgpack.packb(["a", "b", 0]),
        msgpack.packb(["a", "b", 0, 0, 0]),
        msgpack.packb(["a/b", "b", 0, 0]),
        msgpack.packb(["a", "**", 0, 0]),
        msgpack.packb(["a", "b", -1, 0]),
        msgpack.packb(["a", "b", None, 0]),
        msgpack.packb([["a"], "b", 0, 0]),
        msgpack.packb({"actor": "a", "boot": "b", "seq": 0, "crc": 0}),
    ],
)
def test_malformed_header_is_refused(header):
    with pytest.raises(MessageError, match=r"header: expected \[actor, boot, seq, crc32\]"):
        unpack_header(header, b"")


@pytest.mark.parametrize("crc", [None, "0", 1, -1, 2**40, [0]])
def test_wrong_checksum_of_any_type_is_refused(crc):
    with pytest.raises(MessageError, match="payload damaged"):
        unpack_header(msgpack.packb(["a", "b", 0, crc]), b"payload")


@given(st.binary(max_size=60))
def test_random_header_is_refused_with_a_message_error(header):
    with pytest.raises(MessageError):
        unpack_header(header, b"payload")


def test_spool_gives_back_in_order_what_was_put(spool):
    for i in range(12):
        spool.put(origin(i), KEY, b"message %d" % i)
    assert len(spool) == 12
    path, key, header, payload = spool.first()
    assert (key, payload) == (KEY, b"message 0")
    assert unpack_header(header, payload) == origin(0)
    assert spool.first()[0] == path, "looking does not take it out"
    assert drain(spool) == [b"message %d" % i for i in range(12)]
    assert len(spool) == 0
    assert list(spool.folder.glob("*/*")) == []


def test_spool_survives_its_process_with_order_and_origins(tmp_path):
    first = Spool(tmp_path, MEGABYTE)
    for i in (0, 1, 9, 10, 11, 100):
        first.put(origin(i), KEY, b"old %d" % i)
    second = Spool(tmp_path, MEGABYTE)
    second.put(origin(0, "b2"), "other/key", b"new 0")
    third = Spool(tmp_path, MEGABYTE)
    assert len(third) == 7
    _, _, header, payload = third.first()
    assert unpack_header(header, payload) == origin(0, "b1")
    assert drain(third) == [b"old 0", b"old 1", b"old 9", b"old 10", b"old 11", b"old 100", b"new 0"]
    assert len(Spool(tmp_path, MEGABYTE)) == 0


def test_spool_removes_files_torn_by_a_crash(tmp_path):
    spool = Spool(tmp_path, MEGABYTE)
    spool.put(origin(0), KEY, b"whole")
    torn = tmp_path / "b1" / "000000000001.part"
    torn.write_bytes(b"half of a rec")
    again = Spool(tmp_path, MEGABYTE)
    assert not torn.exists()
    assert drain(again) == [b"whole"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda record: b"",
        lambda record: record[:-3],
        lambda record: record[:-1] + bytes([record[-1] ^ 1]),
        lambda record: bytes(len(record)),
        lambda record: b"\x00",
        lambda record: b"\xc0",
        lambda record: msgpack.packb([KEY, "header", "payload"]),
        lambda record: msgpack.packb([KEY, pack_header(origin(0), b"x"), "x"]),
        lambda record: msgpack.packb({"key": 1, "header": 2, "payload": 3}),
    ],
    ids=["empty", "torn", "flipped", "zeros", "zero", "nil", "text", "text payload", "map"],
)
def test_damaged_file_is_set_aside_and_those_behind_it_are_sent(tmp_path, damage, caplog):
    spool = Spool(tmp_path, MEGABYTE)
    for i in range(3):
        spool.put(origin(i), KEY, b"message %d" % i)
    victim = tmp_path / "b1" / "000000000000.msg"
    victim.write_bytes(damage(victim.read_bytes()))
    again = Spool(tmp_path, MEGABYTE)
    assert drain(again) == [b"message 1", b"message 2"]
    assert len(again) == 0
    assert victim.with_suffix(".bad").exists()
    assert "is unreadable" in caplog.text
    assert len(Spool(tmp_path, MEGABYTE)) == 0, "not tried again"


def test_vanished_file_is_passed_over_and_frees_its_space(tmp_path):
    spool = Spool(tmp_path, 1000)
    for i in range(2):
        spool.put(origin(i), KEY, bytes(600))
    assert spool.full
    (tmp_path / "b1" / "000000000000.msg").unlink()
    assert drain(spool) == [bytes(600)]
    assert not spool.full


def test_spool_is_full_from_its_limit_on_and_free_again_below_it(tmp_path):
    spool = Spool(tmp_path, 3000)
    assert not spool.full
    for i in range(2):
        spool.put(origin(i), KEY, bytes(1000))
        assert not spool.full
    spool.put(origin(2), KEY, bytes(1000))
    assert spool.full
    assert Spool(tmp_path, 3000).full, "counted again at the next start"
    spool.remove(spool.first()[0])
    assert not spool.full


def test_two_incarnations_do_not_overwrite_each_other(tmp_path):
    spool = Spool(tmp_path, MEGABYTE)
    spool.put(origin(0, "b1"), KEY, b"first")
    spool.put(origin(0, "b2"), KEY, b"second")
    assert drain(spool) == [b"first", b"second"]


def test_acknowledged_messages_leave_the_spool_in_order(hub, client, spool):
    receiver = Receiver(hub)
    sender = Sender(client, spool, "a1", "b1")
    for i in range(30):
        sender.put(KEY, TaskQuery(cell=0, t=i))
    assert sender.close(patience=10) == 0
    assert [decode(TaskQuery, payload).t for _, payload in receiver.stored] == list(range(30))
    assert [source for source, _ in receiver.stored] == [origin(i) for i in range(30)]
    assert sender.sent == 30
    assert receiver.duplicates == 0


def test_message_whose_acknowledgement_is_lost_comes_again_with_its_id_and_is_stored_once(hub, client, spool):
    receiver = Receiver(hub, silent=2)
    sender = Sender(client, spool, "a1", "b1", timeout=2.0)
    for i in range(4):
        sender.put(KEY, TaskQuery(cell=0, t=i))
    assert sender.close(patience=20) == 0
    assert [source.seq for source, _ in receiver.stored] == [0, 1, 2, 3]
    assert set(receiver.attempts.values()) == {3}
    assert receiver.duplicates == 8
    assert sender.sent == 4


def test_messages_wait_for_a_receiver_that_appears_later(hub, client, spool):
    sender = Sender(client, spool, "a1", "b1", timeout=2.0)
    for i in range(3):
        sender.put(KEY, TaskQuery(cell=0, t=i))
    wait_until(lambda: sender.waiting_since is not None)
    assert (len(spool), sender.sent) == (3, 0)
    receiver = Receiver(hub)
    wait_until(lambda: sender.sent == 3)
    wait_until(lambda: sender.waiting_since is None)
    assert sender.close(patience=5) == 0
    assert [source.seq for source, _ in receiver.stored] == [0, 1, 2]


def test_undelivered_messages_of_a_dead_sender_go_out_under_their_first_id(hub, client, tmp_path):
    first = Sender(client, Spool(tmp_path, MEGABYTE), "a1", "b1", timeout=1.0)
    first.put(KEY, TaskQuery(cell=1, t=1))
    first.put(KEY, TaskQuery(cell=1, t=2))
    assert first.close(patience=0) == 2
    receiver = Receiver(hub)
    second = Sender(client, Spool(tmp_path, MEGABYTE), "a1", "b2", timeout=2.0)
    second.put(KEY, TaskQuery(cell=1, t=3))
    assert second.close(patience=10) == 0
    assert [source for source, _ in receiver.stored] == [origin(0, "b1"), origin(1, "b1"), origin(0, "b2")]
    assert [decode(TaskQuery, payload).t for _, payload in receiver.stored] == [1, 2, 3]


def test_busy_receiver_is_asked_again_until_it_has_room(hub, client, spool):
    entered, opened = threading.Event(), threading.Event()

    def handler(payload: bytes, header: bytes) -> bytes:
        entered.set()
        assert opened.wait(20)
        return encode(Acknowledgement())

    server = QueryServer(hub, KEY, handler, capacity=1)
    rivals = [Sender(client, Spool(spool.folder / str(i), MEGABYTE), f"r{i}", "b1") for i in range(3)]
    for rival in rivals:
        rival.put(KEY, TaskQuery(cell=0))
    assert entered.wait(10)
    # one is being handled, one waits behind it, and there is no room for the third
    wait_until(lambda: [rival.held_back for rival in rivals].count(True) == 1)
    assert [rival.sent for rival in rivals] == [0, 0, 0]
    opened.set()
    assert [rival.close(patience=15) for rival in rivals] == [0, 0, 0]
    assert [rival.sent for rival in rivals] == [1, 1, 1]
    assert [rival.refused for rival in rivals] == [{}, {}, {}]
    assert [rival.held_back for rival in rivals] == [False, False, False]
    server.close()


class Answers:
    """A receiver that answers as `mood` says, None being an acknowledgement, and counts what it was asked."""

    def __init__(self, session: zenoh.Session) -> None:
        self.mood: Exception | None = None
        self.asked: list[int] = []
        self.server = QueryServer(session, KEY, self._answer)

    def _answer(self, payload: bytes, header: bytes) -> bytes:
        self.asked.append(unpack_header(header, payload).seq)
        if self.mood is not None:
            raise self.mood
        return encode(Acknowledgement())


def test_sender_is_held_back_while_the_receiver_is_busy_until_the_next_acknowledgement(hub, client, spool):
    answers = Answers(hub)
    sender = Sender(client, spool, "a1", "b1")
    assert not sender.held_back
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.sent == 1)
    assert not sender.held_back
    answers.mood = MessageError(BUSY)
    sender.put(KEY, TaskQuery(cell=0))
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.held_back)
    while len(answers.asked) < 4:  # asked again, with a pause between, it stays held back
        assert sender.held_back
        time.sleep(0.001)
    assert (sender.sent, len(spool), sender.refused) == (1, 2, {})
    answers.mood = None
    wait_until(lambda: sender.sent == 3)
    wait_until(lambda: not sender.held_back)
    assert answers.asked[0] == 0
    assert answers.asked[1:] == [1] * (len(answers.asked) - 2) + [2]
    assert sender.close(patience=5) == 0
    answers.server.close()


@pytest.mark.parametrize(
    ("mood", "final"),
    [
        (MessageError("contract differs in 'reward'"), True),
        (MessageError("BUSY bee"), True),
        (MessageError("busy"), True),
        (OSError("no space left on device"), False),
        (MessageError(INTERNAL_ERROR), False),
    ],
    ids=["refused", "busy in a reason", "lower case", "error within", "internal error"],
)
def test_other_errors_do_not_hold_the_sender_back(hub, client, spool, mood, final):
    answers = Answers(hub)
    answers.mood = mood
    sender = Sender(client, spool, "a1", "b1")
    sender.put(KEY, TaskQuery(cell=0))
    while len(answers.asked) < 2:
        assert not sender.held_back
        if final and sender.refused:
            break
        time.sleep(0.001)
    assert not sender.held_back
    assert (sum(sender.refused.values()), len(spool)) == ((1, 0) if final else (0, 1))
    answers.mood = None
    assert sender.close(patience=10) == 0
    answers.server.close()


def test_sender_that_finds_nobody_is_not_held_back(hub, client, spool):
    sender = Sender(client, spool, "a1", "b1", timeout=2.0)
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.waiting_since is not None)
    assert not sender.held_back
    sender.close(patience=0)


def test_receiver_that_leaves_no_longer_holds_the_sender_back(hub, client, spool):
    answers = Answers(hub)
    answers.mood = MessageError(BUSY)
    sender = Sender(client, spool, "a1", "b1", timeout=2.0)
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.held_back)
    answers.server.close()
    # what it makes meanwhile waits in the spool, as it does whenever nobody is there
    wait_until(lambda: not sender.held_back)
    assert len(spool) == 1
    again = Answers(hub)
    assert sender.close(patience=10) == 0
    again.server.close()


def test_final_refusal_behind_busy_ends_the_holding_back(hub, client, spool):
    answers = Answers(hub)
    answers.mood = MessageError(BUSY)
    sender = Sender(client, spool, "a1", "b1")
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.held_back)
    answers.mood = MessageError("contract differs in 'reward'")
    wait_until(lambda: sender.refused)
    wait_until(lambda: not sender.held_back)
    assert sender.close(patience=5) == 0
    answers.server.close()


def test_refused_message_is_dropped_counted_and_does_not_hold_up_the_next(hub, client, spool):
    stored = []

    def handler(payload: bytes, header: bytes) -> bytes:
        query = decode(TaskQuery, payload)
        if query.cell == 0:
            raise MessageError("contract differs in 'reward': this run has 1, got 2")
        stored.append(query.t)
        return encode(Acknowledgement())

    server = QueryServer(hub, KEY, handler)
    sender = Sender(client, spool, "a1", "b1")
    for i in range(4):
        sender.put(KEY, TaskQuery(cell=i % 2, t=i))
    assert sender.close(patience=10) == 0
    assert stored == [1, 3]
    assert sender.refused == {"contract differs in 'reward'": 2}
    assert sender.last_refusal == "contract differs in 'reward': this run has 1, got 2"
    assert sender.sent == 2
    server.close()


def test_message_that_meets_an_error_within_the_receiver_is_not_lost(hub, client, spool):
    attempts = []

    def handler(payload: bytes, header: bytes) -> bytes:
        attempts.append(unpack_header(header, payload).seq)
        if len(attempts) < 3:
            raise OSError("no space left on device")
        return encode(Acknowledgement())

    server = QueryServer(hub, KEY, handler)
    sender = Sender(client, spool, "a1", "b1")
    sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=10) == 0
    assert attempts == [0, 0, 0]
    assert (sender.sent, sender.refused) == (1, {})
    server.close()


def test_message_too_large_to_send_is_refused_to_the_caller_and_uses_no_number(hub, client, spool):
    receiver = Receiver(hub)
    sender = Sender(client, spool, "a1", "b1")

    class Small(TaskQuery):
        max_bytes = 1

    with pytest.raises(MessageError, match="at most 1 are allowed"):
        sender.put(KEY, Small(cell=0))
    sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=10) == 0
    assert [source.seq for source, _ in receiver.stored] == [0]


def test_messages_put_from_several_threads_all_get_their_own_number(hub, client, spool):
    receiver = Receiver(hub)
    sender = Sender(client, spool, "a1", "b1")

    def put(first: int) -> None:
        for t in range(first, first + 25):
            sender.put(KEY, TaskQuery(cell=0, t=t))

    threads = [threading.Thread(target=put, args=(100 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sender.close(patience=15) == 0
    assert [source.seq for source, _ in receiver.stored] == list(range(100))
    assert len({payload for _, payload in receiver.stored}) == 100


def test_every_message_is_stored_once_though_the_receiver_is_killed_again_and_again(endpoint, tmp_path):
    file = tmp_path / "stored.txt"

    def start() -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.receiver", endpoint, KEY, str(file)],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[1],
        )
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        return process

    def stored() -> int:
        return file.read_bytes().count(b"\n") if file.exists() else 0

    process = start()
    try:
        with open_client(endpoint, patience=10) as session:
            sender = Sender(session, Spool(tmp_path / "spool", MEGABYTE), "a1", "b1", timeout=2.0)
            total = 0
            for _ in range(3):
                before = stored()
                for _ in range(200):
                    sender.put(KEY, TaskQuery(cell=0, t=total))
                    total += 1
                wait_until(lambda least=before + 20: stored() > least, 20)
                process.kill()
                process.wait()
                process = start()
            assert sender.close(patience=20) == 0
    finally:
        process.kill()
        process.wait()
    lines = [line.split(" ") for line in file.read_text().splitlines()]
    assert [int(seq) for _, _, seq, _ in lines] == list(range(600))
    assert [decode(TaskQuery, bytes.fromhex(data)).t for *_, data in lines] == list(range(600))


def test_closing_without_a_hub_keeps_everything_on_disk(endpoint, tmp_path):
    with open_hub(endpoint), open_client(endpoint, patience=10) as session:
        sender = Sender(session, Spool(tmp_path, MEGABYTE), "a1", "b1", timeout=1.0)
        for i in range(3):
            sender.put(KEY, TaskQuery(cell=0, t=i))
        assert sender.close(patience=0.1) == 3
    assert len(drain(Spool(tmp_path, MEGABYTE))) == 3


origins = st.builds(
    Origin, actor=st.sampled_from(["a1", "a2"]), boot=st.sampled_from(["b1", "b2"]), seq=st.integers(0, 30)
)


@given(st.lists(origins, max_size=60), st.integers(0, 60))
def test_duplicate_filter_agrees_with_a_set_and_survives_its_state(arrivals, saved_at):
    seen, reference = DuplicateFilter(), set()
    for i, source in enumerate(arrivals):
        if i == saved_at:
            restored = DuplicateFilter()
            restored.restore(msgpack.unpackb(msgpack.packb(seen.state())))
            seen = restored
        key = (source.actor, source.boot, source.seq)
        assert seen.seen(source) == (key in reference)
        seen.add(source)
        reference.add(key)
        assert seen.seen(source)
    for actor in ("a1", "a2"):
        for boot in ("b1", "b2"):
            for seq in range(33):
                assert seen.seen(origin(seq, boot, actor)) == ((actor, boot, seq) in reference)


def test_duplicate_filter_keeps_a_mark_and_the_gaps_below_it():
    seen = DuplicateFilter()
    for seq in (0, 1, 5, 3):
        seen.add(origin(seq))
    assert seen.state() == [["a1", "b1", 6, [2, 4]]]
    for seq in (2, 4):
        seen.add(origin(seq))
    assert seen.state() == [["a1", "b1", 6, []]]


def test_same_number_of_another_incarnation_or_actor_is_no_duplicate():
    seen = DuplicateFilter()
    seen.add(origin(0))
    assert seen.seen(origin(0))
    assert not seen.seen(origin(0, boot="b2"))
    assert not seen.seen(origin(0, actor="a2"))


def test_number_far_ahead_is_refused_and_changes_nothing():
    seen = DuplicateFilter()
    seen.add(origin(4))
    before = seen.state()
    with pytest.raises(MessageError, match="seq 200000 jumps too far ahead of 5"):
        seen.seen(origin(200_000))
    assert seen.state() == before
    assert not seen.seen(origin(10_005))
    seen.add(origin(10_005))
    assert seen.seen(origin(10_005))


def test_incarnation_heard_for_the_first_time_may_begin_anywhere():
    seen = DuplicateFilter()
    assert not seen.seen(origin(5_000_000))
    seen.add(origin(5_000_000))
    assert seen.seen(origin(5_000_000))
    assert not seen.seen(origin(4_999_999))  # may still arrive, late
    assert not seen.seen(origin(5_000_001))


def test_restored_filter_does_not_share_its_state():
    seen, restored = DuplicateFilter(), DuplicateFilter()
    seen.add(origin(3))
    restored.restore(seen.state())
    seen.add(origin(1))
    assert not restored.seen(origin(1))
