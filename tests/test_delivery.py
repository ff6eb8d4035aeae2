import logging
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import msgpack
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from common import bus
from common.bus import BUSY, INTERNAL_ERROR, Member, QueryServer, ask_bytes
from common.delivery import (
    BUNDLE_BYTES,
    DAMAGED,
    DuplicateFilter,
    Parcel,
    Receiver,
    Sender,
    Spool,
    pack_bundle,
    unpack_bundle,
)
from common.errors import RefusedError
from common.link import make_link, open_client, open_hub
from common.messages import BUNDLE, Frames, MessageError, Origin, Receipt, TaskQuery, decode, encode
from tests.helpers import PATIENCE, STORED, deliver, deliver_all, parcel, reason, wait_until

KEY = "navaclq/run-1/trajectory"
OTHER = "navaclq/run-1/frames"
A1 = Member("actor", "local", "a1")
MEGABYTE = 2.0**20


def origin(seq: int, boot: str = "b1", actor: str = "local/a1") -> Origin:
    return Origin(actor=actor, boot=boot, seq=seq)


def drain(spool: Spool) -> list[bytes]:
    """Payloads in the order in which the spool gives them."""
    payloads = []
    while len(spool):
        _, found = spool.bundle(set())
        payloads += [parcel.payload for parcel in found.values()]
        for path in found:
            spool.remove(path)
    return payloads


def fill(spool: Spool, count: int, first: int = 0) -> None:
    """Puts questions with t = `first` and so on, under those numbers."""
    for t in range(first, first + count):
        spool.put(origin(t), KEY, encode(TaskQuery(cell=0, t=t)))


class Store:
    """Stores what is new and answers after it; `silent` first attempts of each message get no reply."""

    def __init__(self, session: zenoh.Session, silent: int = 0) -> None:
        self.stored: list[tuple[Origin, bytes]] = []
        self.attempts: Counter[tuple[str, str, int]] = Counter()
        self.deliveries: list[int] = []
        """How many messages each held."""
        self.duplicates = 0
        self._seen, self._silent = DuplicateFilter(), silent
        self._queryable = session.declare_queryable(f"{KEY}/*/*", self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        with query:
            parcels = unpack_bundle(query.payload.to_bytes(), query.attachment.to_bytes())
            self.deliveries.append(len(parcels))
            for source, crc, payload in parcels:
                assert crc == zlib.crc32(payload)
                self.attempts[(source.actor, source.boot, source.seq)] += 1
                if self._seen.seen(source):
                    self.duplicates += 1
                else:
                    self._seen.add(source)
                    self.stored.append((source, payload))
            if all(
                self.attempts[(p.origin.actor, p.origin.boot, p.origin.seq)] > self._silent for p in parcels
            ):
                query.reply(query.key_expr, encode(Receipt(answers=[""] * len(parcels))))


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "spool", MEGABYTE)


def test_one_message_is_sent_as_it_is_beside_its_header():
    for payload in (b"", b"abc", bytes(10_000)):
        (one,) = parcels = [parcel(payload, 7)]
        sent, attachment = pack_bundle(parcels)
        assert sent == payload
        assert unpack_bundle(sent, attachment) == [one]
        assert one == Parcel(origin(7), zlib.crc32(payload), payload)


@given(st.lists(st.tuples(st.binary(max_size=40), st.integers(0, 2**40)), min_size=1, max_size=BUNDLE))
def test_a_bundle_gives_back_its_messages_with_their_origins(contents):
    parcels = [parcel(payload, seq, boot=f"b{seq % 3}") for payload, seq in contents]
    assert unpack_bundle(*pack_bundle(parcels)) == parcels


HEADER = ["a", "b", 0, 7, 0]


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"junk",
        msgpack.packb(3),
        msgpack.packb(None),
        msgpack.packb(HEADER),
        msgpack.packb([HEADER[:-1]]),
        msgpack.packb([[*HEADER, 0]]),
        msgpack.packb([["a/b/c", "b", 0, 7, 0]]),
        msgpack.packb([["a", "**", 0, 7, 0]]),
        msgpack.packb([["*/*", "b", 0, 7, 0]]),
        msgpack.packb([["a", "b", -1, 7, 0]]),
        msgpack.packb([["a", "b", None, 7, 0]]),
        msgpack.packb([[["a"], "b", 0, 7, 0]]),
        msgpack.packb([["a", "b", 0, "7", 0]]),
        msgpack.packb([["a", "b", 0, 7.0, 0]]),
        msgpack.packb([["a", "b", 0, True, 0]]),
        msgpack.packb([["a", "b", 0, -7, 0]]),
        msgpack.packb([["a", "b", 0, 14, 0], ["a", "b", 0, -7, 0]]),
        msgpack.packb([["a", "b", 0, 7, None]]),
        msgpack.packb([["a", "b", 0, 7, "0"]]),
        msgpack.packb([["a", "b", 0, 7, [0]]]),
        msgpack.packb([HEADER, 3]),
        msgpack.packb({"actor": "a", "boot": "b", "seq": 0, "size": 7, "crc": 0}),
        msgpack.packb([{"actor": "a", "boot": "b", "seq": 0, "size": 7, "crc": 0}]),
        b"\xdd\xff\xff\xff\xff",
        b"\x91" * 5000,
    ],
)
def test_malformed_header_is_refused(header):
    with pytest.raises(
        MessageError, match=r"header: expected \[actor, boot, seq, size, crc32\] of each message"
    ):
        unpack_bundle(b"payload", header)


@pytest.mark.parametrize(
    "sizes", [[], [0], [6], [8], [3, 3], [3, 5], [7, 7], [2**62], [7, 2**62], [7] + [0] * BUNDLE]
)
def test_header_that_does_not_fit_its_payload_is_refused(sizes):
    header = msgpack.packb([["a", "b", seq, size, 0] for seq, size in enumerate(sizes)])
    with pytest.raises(MessageError, match=rf"header: {len(sizes)} messages of \d+ bytes, got 7"):
        unpack_bundle(b"payload", header)


def test_header_of_many_more_messages_than_go_together_costs_the_receiver_nothing():
    header = msgpack.packb([["a", "b", 0, 0, 0]] * 300_000)
    began = time.process_time()
    with pytest.raises(MessageError, match=r"^header: "):
        unpack_bundle(b"", header)
    assert time.process_time() - began < 0.4


@given(st.binary(max_size=60))
def test_random_header_is_refused_with_a_message_error(header):
    with pytest.raises(MessageError):
        unpack_bundle(b"payload", header)


def test_spool_gives_back_in_order_what_was_put(spool):
    for i in range(12):
        spool.put(origin(i), KEY, b"message %d" % i)
    assert len(spool) == 12
    channel, found = spool.bundle(set())
    assert channel == KEY
    assert list(found.values()) == [parcel(b"message %d" % i, i) for i in range(12)]
    assert spool.bundle(set()) == (channel, found), "looking does not take them out"
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
    _, found = third.bundle(set())
    assert [(p.origin.boot, p.origin.seq) for p in found.values()] == [
        ("b1", i) for i in (0, 1, 9, 10, 11, 100)
    ]
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
        lambda record: msgpack.packb([KEY, "local/a1", "b1", 0, zlib.crc32(b"x"), "x"]),
        lambda record: msgpack.packb([KEY, "local/a1", "b1", -1, zlib.crc32(b"x"), b"x"]),
        lambda record: msgpack.packb([KEY, "*/*", "b1", 0, zlib.crc32(b"x"), b"x"]),
        lambda record: msgpack.packb({"channel": 1, "actor": 2, "boot": 3, "seq": 4, "crc": 5, "payload": 6}),
        lambda record: msgpack.packb([KEY, msgpack.packb([A1, "b1", 0, zlib.crc32(b"x")]), b"x"]),
    ],
    ids=[
        *("empty", "torn", "flipped", "zeros", "zero", "nil", "text", "text payload", "impossible number"),
        *("impossible name", "map", "of the last version"),
    ],
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
    spool.remove(next(iter(spool.bundle(set())[1])))
    assert not spool.full


def test_two_incarnations_do_not_overwrite_each_other(tmp_path):
    spool = Spool(tmp_path, MEGABYTE)
    spool.put(origin(0, "b1"), KEY, b"first")
    spool.put(origin(0, "b2"), KEY, b"second")
    assert drain(spool) == [b"first", b"second"]


def bundles(spool: Spool) -> list[list[int]]:
    """Numbers of the messages in each delivery, until the spool is empty."""
    found = []
    while len(spool):
        _, bundle = spool.bundle(set())
        found.append([parcel.origin.seq for parcel in bundle.values()])
        for path in bundle:
            spool.remove(path)
    return found


def test_small_messages_go_together_as_many_as_a_delivery_may_hold(spool):
    fill(spool, 2 * BUNDLE + 3)
    assert bundles(spool) == [
        [*range(BUNDLE)],
        [*range(BUNDLE, 2 * BUNDLE)],
        [*range(2 * BUNDLE, 2 * BUNDLE + 3)],
    ]


def test_messages_go_together_until_they_are_large_enough(tmp_path):
    spool = Spool(tmp_path, 1e9)
    for i in range(9):
        spool.put(origin(i), KEY, bytes(BUNDLE_BYTES // 4 - 100))
    assert bundles(spool) == [[0, 1, 2, 3], [4, 5, 6, 7], [8]]


def test_a_large_message_goes_alone_and_those_around_it_without_it(tmp_path):
    spool = Spool(tmp_path, 1e9)
    for i, size in enumerate((1, 1, BUNDLE_BYTES, 1, 2**23, 2**23, 1, 1)):
        spool.put(origin(i), KEY, bytes(size))
    assert bundles(spool) == [[0, 1], [2], [3], [4], [5], [6, 7]]


def test_messages_for_another_channel_go_apart_and_the_order_stays(spool):
    channels = [KEY, KEY, OTHER, KEY, OTHER, OTHER]
    for i, channel in enumerate(channels):
        spool.put(origin(i), channel, b"message")
    found = []
    while len(spool):
        channel, bundle = spool.bundle(set())
        found.append((channel, [parcel.origin.seq for parcel in bundle.values()]))
        for path in bundle:
            spool.remove(path)
    assert found == [(KEY, [0, 1]), (OTHER, [2]), (KEY, [3]), (OTHER, [4, 5])]


def test_messages_that_are_on_their_way_are_passed_over(spool):
    fill(spool, 5)
    _, bundle = spool.bundle(set())
    paths = list(bundle)
    assert list(spool.bundle({paths[0], paths[3]})[1]) == [paths[1], paths[2], paths[4]]
    assert spool.bundle(set(paths)) == ("", {})
    assert Spool(spool.folder / "empty", MEGABYTE).bundle(set()) == ("", {})
    assert len(spool) == 5


def test_unreadable_message_among_others_is_set_aside_and_the_rest_goes_together(spool):
    fill(spool, 6)
    for seq in (0, 3):
        (spool.folder / "b1" / f"{seq:012d}.msg").write_bytes(b"damaged")
    _, bundle = spool.bundle(set())
    assert [parcel.origin.seq for parcel in bundle.values()] == [1, 2, 4, 5]
    assert len(spool) == 4
    assert len(list(spool.folder.glob("b1/*.bad"))) == 2


@given(
    st.lists(
        st.tuples(st.sampled_from([KEY, OTHER]), st.sampled_from([0, 1, 9000, 70_000, BUNDLE_BYTES])),
        max_size=90,
    )
)
def test_bundles_hold_every_message_once_in_order_and_none_could_hold_more(tmp_path_factory, messages):
    spool = Spool(tmp_path_factory.mktemp("spool"), 1e9)
    for seq, (channel, size) in enumerate(messages):
        spool.put(origin(seq), channel, bytes(size))
    sizes = {int(path.stem): path.stat().st_size for path in spool.folder.glob("*/*.msg")}
    following = 0
    while len(spool):
        channel, bundle = spool.bundle(set())
        found = [parcel.origin.seq for parcel in bundle.values()]
        assert found == [*range(following, following + len(found))]
        assert {messages[seq][0] for seq in found} == {channel}
        size, following = sum(sizes[seq] for seq in found), following + len(found)
        assert len(found) == 1 or (len(found) <= BUNDLE and size <= BUNDLE_BYTES)
        assert (
            following == len(messages)
            or messages[following][0] != channel
            or len(found) == BUNDLE
            or size + sizes[following] > BUNDLE_BYTES
        )
        for path in bundle:
            spool.remove(path)
    assert following == len(messages)


def test_acknowledged_messages_leave_the_spool_in_order(hub, client, spool):
    store = Store(hub)
    sender = Sender(client, spool, A1, "b1")
    for i in range(30):
        sender.put(KEY, TaskQuery(cell=0, t=i))
    assert sender.close(patience=10) == 0
    assert [decode(TaskQuery, payload).t for _, payload in store.stored] == list(range(30))
    assert [source for source, _ in store.stored] == [origin(i) for i in range(30)]
    assert sender.sent == 30
    assert store.duplicates == 0


def test_messages_that_wait_together_are_sent_in_one_query(hub, client, spool):
    fill(spool, 2 * BUNDLE + 3)
    store = Store(hub)
    sender = Sender(client, spool, A1, "b2")
    assert sender.close(patience=10) == 0
    assert store.deliveries == [BUNDLE, BUNDLE, 3]
    assert [source.seq for source, _ in store.stored] == [*range(2 * BUNDLE + 3)]
    assert (sender.sent, store.duplicates) == (2 * BUNDLE + 3, 0)


def test_message_whose_acknowledgement_is_lost_comes_again_with_its_id_and_is_stored_once(hub, client, spool):
    store = Store(hub, silent=2)
    fill(spool, 4)  # these go together, through every attempt
    sender = Sender(client, spool, A1, "b2", timeout=2.0)
    assert sender.close(patience=20) == 0
    assert [source for source, _ in store.stored] == [origin(i) for i in range(4)]
    assert set(store.attempts.values()) == {3}
    assert store.duplicates == 8
    assert sender.sent == 4


def test_messages_one_by_one_whose_acknowledgements_are_lost_are_stored_once(hub, client, spool):
    store = Store(hub, silent=2)
    sender = Sender(client, spool, A1, "b1", timeout=0.5)
    for i in range(4):
        sender.put(KEY, TaskQuery(cell=0, t=i))
        time.sleep(0.05)
    assert sender.close(patience=30) == 0
    assert sorted(source.seq for source, _ in store.stored) == [0, 1, 2, 3]
    assert min(store.attempts.values()) >= 3
    assert store.duplicates == store.attempts.total() - 4
    assert sender.sent == 4


def test_messages_wait_for_a_receiver_that_appears_later(hub, client, spool):
    sender = Sender(client, spool, A1, "b1", timeout=2.0)
    for i in range(3):
        sender.put(KEY, TaskQuery(cell=0, t=i))
    wait_until(lambda: sender.waiting_since is not None)
    assert (len(spool), sender.sent) == (3, 0)
    store = Store(hub)
    wait_until(lambda: sender.sent == 3)
    wait_until(lambda: sender.waiting_since is None)
    assert sender.close(patience=5) == 0
    assert [source.seq for source, _ in store.stored] == [0, 1, 2]


def test_undelivered_messages_of_a_dead_sender_go_out_under_their_first_id(hub, client, tmp_path):
    first = Sender(client, Spool(tmp_path, MEGABYTE), A1, "b1", timeout=1.0)
    first.put(KEY, TaskQuery(cell=1, t=1))
    first.put(KEY, TaskQuery(cell=1, t=2))
    assert first.close(patience=0) == 2
    store = Store(hub)
    second = Sender(client, Spool(tmp_path, MEGABYTE), A1, "b2", timeout=2.0)
    second.put(KEY, TaskQuery(cell=1, t=3))
    assert second.close(patience=10) == 0
    assert [source for source, _ in store.stored] == [origin(0, "b1"), origin(1, "b1"), origin(0, "b2")]
    assert [decode(TaskQuery, payload).t for _, payload in store.stored] == [1, 2, 3]


def test_busy_receiver_is_asked_again_until_it_has_room(hub, client, spool):
    entered, opened = threading.Event(), threading.Event()

    def handler(*_: object) -> bytes:
        entered.set()
        assert opened.wait(20 * PATIENCE)
        return encode(STORED)

    server = QueryServer(hub, f"{KEY}/*/*", handler, capacity=1)
    rivals = [
        Sender(client, Spool(spool.folder / str(i), MEGABYTE), Member("actor", "local", f"r{i}"), "b1")
        for i in range(3)
    ]
    rivals[0].put(KEY, TaskQuery(cell=0))
    assert entered.wait(10 * PATIENCE)
    rivals[1].put(KEY, TaskQuery(cell=0))
    wait_until(lambda: len(server) == 1)
    rivals[2].put(KEY, TaskQuery(cell=0))
    # one is being handled, one waits behind it, and there is no room for the third
    wait_until(lambda: rivals[2].held_back)
    assert [rival.trouble for rival in rivals] == ["", "", BUSY]
    assert [rival.held_back for rival in rivals] == [False, False, True]
    assert [rival.sent for rival in rivals] == [0, 0, 0]
    opened.set()
    assert [rival.close(patience=15) for rival in rivals] == [0, 0, 0]
    assert [rival.sent for rival in rivals] == [1, 1, 1]
    assert [rival.refused for rival in rivals] == [{}, {}, {}]
    assert [rival.held_back for rival in rivals] == [False, False, False]
    assert [rival.trouble for rival in rivals] == ["", "", ""]
    server.close()


class Answers:
    """A receiver that answers as `mood` says, None being an acknowledgement, and counts what it was asked."""

    def __init__(self, session: zenoh.Session, max_bytes: int = 2**20) -> None:
        self.mood: Exception | Callable[[Origin], Exception | None] | None = None
        self.asked: list[int] = []
        self.stored: list[int] = []
        self._seen = DuplicateFilter()
        self.server = Receiver(session, KEY, self._take, self._seen.seen, max_bytes)

    def _take(self, parcel: Parcel) -> None:
        source = parcel.origin
        self.asked.append(source.seq)
        mood = self.mood(source) if callable(self.mood) else self.mood
        if mood is not None:
            raise mood
        self._seen.add(source)
        self.stored.append(source.seq)


def test_sender_is_held_back_while_the_receiver_is_busy_until_the_next_acknowledgement(hub, client, spool):
    answers = Answers(hub)
    sender = Sender(client, spool, A1, "b1")
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
    assert set(answers.asked[1:]) == {1, 2}
    assert sorted(answers.stored) == [0, 1, 2], "asked again and again, and stored once"
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
    sender = Sender(client, spool, A1, "b1")
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
    sender = Sender(client, spool, A1, "b1", timeout=2.0)
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.waiting_since is not None)
    assert not sender.held_back
    sender.close(patience=0)


def test_receiver_that_leaves_no_longer_holds_the_sender_back(hub, client, spool):
    answers = Answers(hub)
    answers.mood = MessageError(BUSY)
    sender = Sender(client, spool, A1, "b1", timeout=2.0)
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
    sender = Sender(client, spool, A1, "b1")
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: sender.held_back)
    answers.mood = MessageError("contract differs in 'reward'")
    wait_until(lambda: sender.refused)
    wait_until(lambda: not sender.held_back)
    assert sender.close(patience=5) == 0
    answers.server.close()


def test_refused_message_is_dropped_counted_and_does_not_hold_up_the_next(hub, client, spool):
    stored = []

    def take(parcel: Parcel) -> None:
        query = decode(TaskQuery, parcel.payload)
        if query.cell == 0:
            raise MessageError("contract differs in 'reward': this run has 1, got 2")
        stored.append(query.t)

    server = Receiver(hub, KEY, take, lambda source: False, 2**20)
    sender = Sender(client, spool, A1, "b1")
    for i in range(4):
        sender.put(KEY, TaskQuery(cell=i % 2, t=i))
    assert sender.close(patience=10) == 0
    assert stored == [1, 3]
    assert sender.refused == {"contract differs in 'reward'": 2}
    assert sender.last_refusal == "contract differs in 'reward': this run has 1, got 2"
    assert sender.sent == 2
    assert server.refused == {"contract differs in 'reward'": 2}
    server.close()


def test_message_that_meets_an_error_within_the_receiver_is_not_lost(hub, client, spool):
    answers = Answers(hub)
    answers.mood = lambda _: OSError("no space left on device") if len(answers.asked) < 3 else None
    sender = Sender(client, spool, A1, "b1")
    sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=10) == 0
    assert answers.asked == [0, 0, 0]
    assert answers.stored == [0]
    assert (sender.sent, sender.refused) == (1, {})
    assert answers.server.refused == {INTERNAL_ERROR: 2}
    answers.server.close()


def test_each_message_of_a_delivery_gets_its_own_answer_and_the_right_ones_leave_the_spool(
    hub, client, spool
):
    moods = {
        0: MessageError("digest: differs"),
        2: MessageError(BUSY),
        3: OSError("disk"),
        5: MessageError("no"),
    }
    answers = Answers(hub)
    answers.mood = lambda source: moods.get(source.seq)
    fill(spool, 6)
    sender = Sender(client, spool, A1, "b2", in_flight=1)
    wait_until(lambda: len(spool) == 2)
    waiting = [parcel.origin.seq for parcel in spool.bundle(set())[1].values()]
    assert waiting == [2, 3]
    assert answers.stored == [1, 4]
    assert answers.asked[:6] == [0, 1, 2, 3, 4, 5]
    assert sender.refused == {"digest": 1, "no": 1}
    assert sender.last_refusal == "no"
    assert sender.sent == 2
    wait_until(lambda: answers.asked.count(3) >= 2)
    assert set(answers.asked[6:]) == {2, 3}, "the others do not come again"
    moods.clear()
    assert sender.close(patience=10) == 0
    assert sorted(answers.stored) == [1, 2, 3, 4]
    assert (sender.sent, sender.refused, sender.trouble) == (4, {"digest": 1, "no": 1}, "")
    answers.server.close()


def test_answers_of_a_delivery_are_those_of_its_messages_in_order(hub, client):
    moods = {1: MessageError("digest: differs"), 2: MessageError(BUSY), 3: OSError("disk")}
    answers = Answers(hub)
    answers.mood = lambda source: moods.get(source.seq)
    receipt = deliver_all(client, KEY, [parcel(b"x", seq) for seq in range(5)])
    assert receipt.answers == ["", "digest: differs", BUSY, INTERNAL_ERROR, ""]
    moods.clear()
    receipt = deliver_all(client, KEY, [parcel(b"x", seq) for seq in (4, 3, 2, 0, 5)])
    assert receipt.answers == [""] * 5
    assert answers.stored == [0, 4, 3, 2, 5]
    assert answers.server.duplicates == 2
    assert answers.server.refused == {"digest": 1, INTERNAL_ERROR: 1}, "who comes again is not refused"
    answers.server.close()


@pytest.mark.parametrize(
    "receipt",
    [
        encode(Receipt(answers=[])),
        encode(Receipt(answers=["", ""])),
        encode(Receipt(answers=[""] * 4)),
        encode(TaskQuery(cell=0)),
        b"",
        b"garbage",
        msgpack.packb([1, "Receipt", {"answers": ["", "", None]}]),
        msgpack.packb([1, "Receipt", {"answers": "yes"}]),
        msgpack.packb([2, "Receipt", {"answers": ["", "", ""]}]),
        MessageError("header: expected something else"),
        MessageError("under another's name: local/a1"),
        MessageError("too large: 9 bytes"),
        OSError("disk"),
    ],
    ids=[
        *(
            "none",
            "too few",
            "too many",
            "no receipt",
            "empty",
            "garbage",
            "an answer that is none",
            "no list",
        ),
        *("another schema", "bad header", "another's name", "too large", "error within"),
    ],
)
def test_without_a_receipt_that_makes_sense_everything_comes_again(hub, client, spool, receipt):
    asked: list[int] = []

    def handler(payload: bytes, attachment: bytes, _: str) -> bytes:
        asked.append(len(unpack_bundle(payload, attachment)))
        if len(asked) == 3:
            return encode(Receipt(answers=[""] * 3))
        if isinstance(receipt, Exception):
            raise receipt
        return receipt

    fill(spool, 3)
    server = QueryServer(hub, f"{KEY}/*/*", handler)
    sender = Sender(client, spool, A1, "b2")
    wait_until(lambda: sender.trouble)
    assert not sender.held_back
    assert sender.waiting_since is not None
    assert sender.close(patience=10) == 0
    assert asked == [3, 3, 3]
    assert (sender.sent, sender.refused, sender.trouble) == (3, {}, "")
    server.close()


class Held:
    """Takes deliveries without answering them, until a test does."""

    def __init__(self, session: zenoh.Session) -> None:
        self.flying: dict[int, zenoh.Query] = {}
        """By the number of their first message."""
        self._queryable = session.declare_queryable(f"{KEY}/*/*", self._receive)

    def _receive(self, query: zenoh.Query) -> None:
        parcels = unpack_bundle(query.payload.to_bytes(), query.attachment.to_bytes())
        assert len(parcels) == 1
        self.flying[parcels[0].origin.seq] = query

    def answer(self, seq: int, said: str = "") -> None:
        with self.flying.pop(seq) as query:
            query.reply(query.key_expr, encode(Receipt(answers=[said])))
        del query


@pytest.mark.parametrize("most", [1, 2, 5])
def test_so_many_deliveries_are_on_their_way_at_a_time_and_the_next_leaves_when_one_is_answered(
    hub, client, tmp_path, most
):
    spool = Spool(tmp_path / "large", 1e9)
    for seq in range(7):
        spool.put(origin(seq), KEY, bytes(BUNDLE_BYTES))
    held = Held(hub)
    sender = Sender(client, spool, A1, "b2", timeout=60.0, in_flight=most)
    wait_until(lambda: len(held.flying) == most)
    time.sleep(0.3)
    assert sorted(held.flying) == [*range(most)]
    # the newest first: each is settled by its own answer, and the next one takes its place
    for following in range(most, 7):
        held.answer(max(held.flying))
        wait_until(lambda n=following: n in held.flying)
        assert len(held.flying) == most
    assert sender.sent == 7 - most
    assert len(spool) == most
    for seq in sorted(held.flying):
        held.answer(seq)
    assert sender.close(patience=10) == 0
    assert sender.sent == 7


def test_what_is_put_meanwhile_leaves_though_another_delivery_is_not_answered(hub, client, spool):
    held = Held(hub)
    sender = Sender(client, spool, A1, "b1", timeout=60.0)
    sender.put(KEY, TaskQuery(cell=0))
    wait_until(lambda: 0 in held.flying)
    sender.put(KEY, TaskQuery(cell=1))
    wait_until(lambda: 1 in held.flying)
    held.answer(1)
    wait_until(lambda: sender.sent == 1)
    assert [path.stem for path in spool.folder.glob("*/*.msg")] == ["000000000000"]
    sender.put(KEY, TaskQuery(cell=2))
    wait_until(lambda: 2 in held.flying)
    held.answer(0)
    held.answer(2)
    assert sender.close(patience=10) == 0


def test_of_two_on_their_way_the_refused_one_goes_and_the_one_that_is_to_wait_comes_again(hub, client, spool):
    held = Held(hub)
    sender = Sender(client, spool, A1, "b1", timeout=60.0)
    for seq in range(2):
        sender.put(KEY, TaskQuery(cell=0))
        wait_until(lambda s=seq: s in held.flying)
    held.answer(0, BUSY)
    wait_until(lambda: sender.held_back)
    held.answer(1, "digest: differs")
    wait_until(lambda: sender.refused == {"digest": 1})
    wait_until(lambda: 0 in held.flying)
    assert len(spool) == 1
    held.answer(0)
    assert sender.close(patience=10) == 0
    assert (sender.sent, sender.refused) == (1, {"digest": 1})


def test_damaged_message_of_a_delivery_is_not_taken_and_its_number_stays_free(hub, client):
    answers = Answers(hub)
    whole = [parcel(b"message %d" % seq, seq) for seq in range(3)]
    damaged = [whole[0], whole[1]._replace(payload=b"massage 1"), whole[2]]
    assert deliver_all(client, KEY, damaged).answers == ["", DAMAGED, ""]
    assert answers.stored == [0, 2]
    for crc in (0, 1, -1, 2**40):
        assert deliver_all(client, KEY, [whole[1]._replace(crc=crc)]).answers == [DAMAGED]
    assert answers.asked == [0, 2]
    assert deliver_all(client, KEY, whole).answers == ["", "", ""]
    assert answers.stored == [0, 2, 1]
    assert (answers.server.duplicates, answers.server.refused) == (2, {"payload damaged": 5})
    answers.server.close()


def test_message_that_is_damaged_on_its_way_comes_again(hub, client, spool):
    taken: dict[int, bytes] = {}
    seen = DuplicateFilter()

    def take(parcel: Parcel) -> None:
        taken[parcel.origin.seq] = parcel.payload
        seen.add(parcel.origin)

    def damage(payload: bytes, attachment: bytes, key: str) -> bytes:
        """Hands the first two deliveries on with a byte flipped."""
        passed.append(len(payload))
        if len(passed) <= 2:
            flipped = bytearray(payload)
            flipped[len(payload) // 2] ^= 1
            payload = bytes(flipped)
        return ask_bytes(hub, key.replace(KEY, OTHER), payload, attachment)

    passed: list[int] = []
    receiver = Receiver(hub, OTHER, take, seen.seen, 2**20)
    way = QueryServer(hub, f"{KEY}/*/*", damage)
    fill(spool, 5)
    sender = Sender(client, spool, A1, "b2")
    assert sender.close(patience=10) == 0
    assert taken == {t: encode(TaskQuery(cell=0, t=t)) for t in range(5)}
    assert len(passed) == 3
    assert passed[1] < passed[0], "only what was damaged came again"
    assert (sender.sent, sender.refused) == (5, {})
    assert receiver.refused == {"payload damaged": 2}
    receiver.close()
    way.close()


def test_who_delivers_under_anothers_name_is_refused_and_nothing_is_taken(hub, client, caplog):
    answers = Answers(hub)
    own, others = parcel(b"x", 0), parcel(b"x", 0, address="local/a2")
    for address, parcels in (
        ("local/a1", [others]),
        ("local/a1", [own, others]),
        ("local/a1", [others, own]),
        ("host-b/a1", [own]),
        ("local/a1", [parcel(b"x", 0, address="a1")]),
        ("*/*", [own]),
        ("local/*", [own]),
        ("**", [own]),
    ):
        with pytest.raises(RefusedError, match=r"^under another's name: (local/)?a[12]$"):
            deliver_all(client, KEY, parcels, address)
    assert answers.asked == []
    assert answers.server.refused == {"under another's name": 8}
    assert deliver_all(client, KEY, [own]) == deliver_all(client, KEY, [others], "local/a2") == STORED
    assert answers.stored == [0, 0]
    answers.server.close()


def test_delivery_that_is_too_large_is_refused_before_anything_is_taken(hub, client, spool):
    answers = Answers(hub, max_bytes=1000)
    most = 1000 + BUNDLE_BYTES
    with pytest.raises(RefusedError, match=rf"^too large: \d+ bytes; at most {most} are taken here$"):
        deliver(client, KEY, bytes(most), 0)
    with pytest.raises(RefusedError, match=r"^too large"):
        ask_bytes(client, f"{KEY}/local/a1", b"", bytes(most + 1))
    assert answers.asked == []
    assert answers.server.refused == {"too large": 2}
    # the largest message, and the largest delivery of small ones, fit
    assert deliver(client, KEY, bytes(1000), 0) == STORED
    for seq in range(1, BUNDLE + 1):
        spool.put(origin(seq), KEY, bytes(BUNDLE_BYTES // BUNDLE - 60))
    small = [*spool.bundle(set())[1].values()]
    assert deliver_all(client, KEY, small).answers == [""] * len(small)
    assert len(small) > BUNDLE * 0.9
    answers.server.close()


def test_largest_message_of_all_fits_into_a_delivery(hub, client):
    answers = Answers(hub, max_bytes=Frames.max_bytes)
    assert deliver(client, KEY, bytes(Frames.max_bytes), 0) == STORED
    assert answers.stored == [0]
    answers.server.close()


def test_refusals_of_messages_are_logged_once_for_each_sender_and_kind(hub, client, caplog):
    answers = Answers(hub)
    answers.mood = lambda source: MessageError(
        f"{'digest' if source.seq % 2 else 'layout'}: seq {source.seq}"
    )
    for address in ("local/a1", "host-b/a1"):
        for first in range(0, 12, 4):
            parcels = [parcel(b"x", seq, address=address) for seq in range(first, first + 4)]
            assert all(deliver_all(client, KEY, parcels, address).answers)
    assert answers.server.refused == {"digest": 12, "layout": 12}
    logged = [record for record in caplog.records if "refused a message" in record.message]
    assert [record.message for record in logged] == [
        f"refused a message on {KEY}/{address}: {kind}"
        for address in ("local/a1", "host-b/a1")
        for kind in ("layout: seq 0", "digest: seq 1")
    ]
    assert {record.levelno for record in logged} == {logging.WARNING}
    answers.server.close()


def test_delivery_is_acknowledged_after_the_commit_and_comes_again_when_that_fails(hub, client, spool):
    events: list[str] = []
    seen = DuplicateFilter()

    def take(parcel: Parcel) -> None:
        events.append(f"take {parcel.origin.seq}")
        seen.add(parcel.origin)

    def commit() -> None:
        events.append("commit")
        if events.count("commit") == 1:
            raise OSError("Input/output error")

    server = Receiver(hub, KEY, take, seen.seen, 2**20, commit=commit)
    fill(spool, 3)
    sender = Sender(client, spool, A1, "b2")
    wait_until(lambda: sender.trouble)
    assert (sender.sent, len(spool)) == (0, 3)
    assert sender.close(patience=10) == 0
    assert events == ["take 0", "take 1", "take 2", "commit", "commit"]
    assert (sender.sent, server.duplicates) == (3, 3)
    assert "Input/output error" not in sender.last_refusal
    server.close()


def test_receiver_whose_inbox_is_full_of_bytes_holds_senders_back_until_it_has_worked_it_off(
    hub, client, tmp_path, monkeypatch
):
    monkeypatch.setattr(bus, "INBOX_BYTES", BUNDLE_BYTES)
    opened, answers = threading.Event(), Answers(hub)

    def stand_still(_: Origin) -> None:
        assert opened.wait(20)

    answers.mood = stand_still
    spool = Spool(tmp_path, 1e9)
    for seq in range(6):
        spool.put(origin(seq), KEY, bytes(BUNDLE_BYTES))
    sender = Sender(client, spool, A1, "b2", in_flight=3)
    wait_until(lambda: sender.held_back)
    assert (sender.sent, len(spool)) == (0, 6)
    opened.set()
    assert sender.close(patience=20) == 0
    assert sorted(answers.stored) == [*range(6)]
    assert (sender.sent, sender.refused, answers.server.refused) == (6, {}, {})
    assert answers.server._waiting_bytes == 0
    answers.server.close()


def test_message_whose_file_cannot_be_removed_at_once_is_not_lost_and_not_stored_twice(hub, client, tmp_path):
    class Sticky(Spool):
        failures = 2

        def remove(self, path: Path) -> None:
            if self.failures:
                self.failures -= 1
                raise OSError(5, "Input/output error", str(path))
            super().remove(path)

    answers, spool = Answers(hub), Sticky(tmp_path, MEGABYTE)
    sender = Sender(client, spool, A1, "b1")
    sender.put(KEY, TaskQuery(cell=0))
    sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=15) == 0
    assert answers.stored == [0, 1]
    assert sender.sent == 2
    answers.server.close()


def test_time_until_the_receipt_is_measured(hub, client, spool):
    answers = Answers(hub)
    answers.mood = lambda _: time.sleep(0.05)  # None after it
    sender = Sender(client, spool, A1, "b1")
    assert sender.latency.figures("episode", "ms") == {}
    for _ in range(3):
        sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=10) == 0
    figures = sender.latency.figures("episode", "ms")
    assert figures.keys() == {"episode_p50_ms", "episode_p99_ms"}
    assert 50 <= figures["episode_p50_ms"] <= figures["episode_p99_ms"] < 10_000
    answers.server.close()


def test_one_message_is_answered_with_its_reason(hub, client):
    answers = Answers(hub)
    answers.mood = MessageError("digest: " + "x" * 1000)
    assert reason(deliver(client, KEY, b"x", 0)) == "digest: " + "x" * 392
    answers.server.close()


def test_message_too_large_to_send_is_refused_to_the_caller_and_uses_no_number(hub, client, spool):
    store = Store(hub)
    sender = Sender(client, spool, A1, "b1")

    class Small(TaskQuery):
        max_bytes = 1

    with pytest.raises(MessageError, match="at most 1 are allowed"):
        sender.put(KEY, Small(cell=0))
    sender.put(KEY, TaskQuery(cell=0))
    assert sender.close(patience=10) == 0
    assert [source.seq for source, _ in store.stored] == [0]


def test_messages_put_from_several_threads_all_get_their_own_number(hub, client, spool):
    store = Store(hub)
    sender = Sender(client, spool, A1, "b1")

    def put(first: int) -> None:
        for t in range(first, first + 25):
            sender.put(KEY, TaskQuery(cell=0, t=t))

    threads = [threading.Thread(target=put, args=(100 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sender.close(patience=15) == 0
    assert [source.seq for source, _ in store.stored] == list(range(100))
    assert len({payload for _, payload in store.stored}) == 100


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
        with open_client(make_link(endpoint), patience=10) as session:
            sender = Sender(session, Spool(tmp_path / "spool", MEGABYTE), A1, "b1", timeout=2.0)
            total = 0
            cut_off = []
            for _ in range(3):
                before = stored()
                for _ in range(200):
                    sender.put(KEY, TaskQuery(cell=0, t=total))
                    total += 1
                wait_until(lambda least=before + 20: stored() > least, 20)
                process.kill()
                process.wait()
                cut_off.append(stored() - sender.sent)
                process = start()
            assert sender.close(patience=20) == 0
            assert sender.sent == 600
    finally:
        process.kill()
        process.wait()
    assert max(cut_off) > 0, "some were stored and not acknowledged when it was killed"
    lines = [line.split(" ") for line in file.read_text().splitlines()]
    assert sorted(int(seq) for _, _, seq, _ in lines) == list(range(600))
    assert all(decode(TaskQuery, bytes.fromhex(data)).t == int(seq) for _, _, seq, data in lines)
    assert {(actor, boot) for actor, boot, *_ in lines} == {("local/a1", "b1")}


def test_closing_without_a_hub_keeps_everything_on_disk(endpoint, tmp_path):
    with open_hub(make_link(endpoint)), open_client(make_link(endpoint), patience=10) as session:
        sender = Sender(session, Spool(tmp_path, MEGABYTE), A1, "b1", timeout=1.0)
        for i in range(3):
            sender.put(KEY, TaskQuery(cell=0, t=i))
        assert sender.close(patience=0.1) == 3
    assert len(drain(Spool(tmp_path, MEGABYTE))) == 3


origins = st.builds(
    Origin,
    actor=st.sampled_from(["local/a1", "local/a2"]),
    boot=st.sampled_from(["b1", "b2"]),
    seq=st.integers(0, 30),
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
    for actor in ("local/a1", "local/a2"):
        for boot in ("b1", "b2"):
            for seq in range(33):
                assert seen.seen(origin(seq, boot, actor)) == ((actor, boot, seq) in reference)


def test_duplicate_filter_keeps_a_mark_and_the_gaps_below_it():
    seen = DuplicateFilter()
    for seq in (0, 1, 5, 3):
        seen.add(origin(seq))
    assert seen.state() == [["local/a1", "b1", 6, [2, 4]]]
    for seq in (2, 4):
        seen.add(origin(seq))
    assert seen.state() == [["local/a1", "b1", 6, []]]


def test_same_number_of_another_incarnation_or_actor_is_no_duplicate():
    seen = DuplicateFilter()
    seen.add(origin(0))
    assert seen.seen(origin(0))
    assert not seen.seen(origin(0, boot="b2"))
    assert not seen.seen(origin(0, actor="local/a2"))


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
