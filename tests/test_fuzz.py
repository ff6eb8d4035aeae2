"""Messages that are none, on every channel: refused, counted, never stored, and nobody falls over."""

import copy
import queue
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pytest
import zenoh

from common.bus import BUSY, Keys, Member, QueryServer, Subscription, ask_later
from common.config import override
from common.errors import RefusedError
from common.members import Members
from common.messages import (
    PROTOCOL,
    Candidate,
    Candidates,
    Frames,
    Message,
    Nothing,
    Outcome,
    Receipt,
    Scored,
    ScoreQuery,
    Stat,
    TaskQuery,
    Version,
    decode,
    encode,
)
from curriculum.service import CurriculumService
from learner.checkpoint import RunDirectory
from learner.pretraining.frame_store import FrameStore
from learner.pretraining.receiver import FrameReceiver
from learner.service import LearnerService
from tests.helpers import small_config, tiny_episode, wait_until

pytestmark = pytest.mark.usefixtures("one_thread")
ADDRESS = "local/fuzz"
TIMEOUT = 10.0
"""Seconds; so long Zenoh keeps some 0.8 KB of a query, answered or not."""
IN_FLIGHT = 64
JUNK: tuple[Any, ...] = (
    *(None, True, -1, 2**31, 2**63, -(2**63), 1.5, float("nan"), float("inf")),
    *("", "junk", "\x00", "a/b", "**", "x" * 5000, b"", b"junk", bytes(5000)),
    *([], {}, [[]], [None] * 100, {"extra": 1}, ["float32", [2**30, 2**30], b""], ["object", [1], b"x"]),
)
"""What is put in place of a part of a message; none of it is right in any place that it is put."""


class Channel(NamedTuple):
    """Where mutated messages go, and what counts those that are refused there."""

    key: str
    message: Message
    refused: Callable[[], int]
    delivered: bool = False
    """Whether messages come as deliveries, with a header."""
    told: bool = False
    """Whether they are publications, which nobody answers."""


class Target(NamedTuple):
    """All services of a run, and of a pre-training, in this process."""

    channels: dict[str, Channel]
    stored: Callable[[], tuple[int, ...]]


@pytest.fixture
def target(tmp_path: Path, hub: zenoh.Session) -> Iterator[Target]:
    config = small_config("replay.hold_actors=false")
    learner = LearnerService(hub, RunDirectory(tmp_path / "run", config))
    digest = learner.contract.digest
    curriculum = CurriculumService(hub, "run", config, digest, tmp_path / "curriculum")
    drives = override(config.model_dump(mode="json"), ("pretraining.drive_steps=4",))
    store = FrameStore(tmp_path / "frames", drives)
    frames = FrameReceiver(hub, "eyes", store)
    versions: list[Version] = []
    heard = Subscription(hub, Keys("run").version, Version, versions.append)
    members = Members(hub, Keys("run"))

    episode = tiny_episode(config, 5, digest=digest)
    size, shots = config.world.camera.size, 3
    drive = Frames(
        digest=frames.contract.digest,
        task=episode.task,
        frame=np.zeros((shots, size, size, 3), np.uint8),
        mask=np.zeros((shots, size * size // 8), np.uint8),
        goal=np.zeros((shots, 3), np.float32),
    )
    outcome = Outcome(digest=digest, proposal="p", task=episode.task, success=True)
    row = Candidate(task=episode.task, visual=episode.visual[0], lidar=episode.lidar[0])
    stat = Stat(
        **Member("actor", "local", "fuzz")._asdict(),
        **{"host": "h", "pid": 1, "since": 0.0, "code": "c", "protocol": PROTOCOL, "values": {"x": 1.0}},
    )
    keys, eyes = Keys("run"), Keys("eyes")
    servers = {server._key: server for server in (*learner._servers, *curriculum._servers, *frames._servers)}

    def of(key: str, message: Message) -> Channel:
        delivered = f"{key}/*/*" in servers
        server: QueryServer = servers[f"{key}/*/*" if delivered else key]
        return Channel(
            f"{key}/{ADDRESS}" if delivered else key, message, lambda: sum(server.refused.values()), delivered
        )

    def told(key: str, message: Message, ear: Subscription) -> Channel:
        return Channel(key, message, lambda: ear.ignored, told=True)

    channels = {
        "trajectory": of(keys.trajectory, episode),
        "frames": of(eyes.frames, drive),
        "result": of(keys.result, outcome),
        "candidates": of(keys.candidates, Candidates(digest=digest, candidates=[row, row])),
        "task": of(keys.task, TaskQuery(cell=1)),
        "score": of(keys.score, ScoreQuery(tasks=[Scored(task=episode.task, q=0.5)])),
        "snapshot": of(keys.snapshot, Nothing()),
        "contract": of(keys.contract, Nothing()),
        "weights": of(keys.weights("policy"), Nothing()),
        "version": told(keys.version, Version(epoch=1, counter=1), heard),
        "stat": told(keys.stat(Member("actor", "local", "fuzz")), stat, members._subscriptions[0]),
    }
    known = learner._log, store, curriculum.curriculum

    def stored() -> tuple[int, ...]:
        log, drives_, state = known
        return (
            log.episodes,
            drives_.drives,
            state.outcomes,
            len(state),
            len(versions),
            len(members.stats),
        )

    yield Target(channels, stored)
    frames.close()
    curriculum.close()
    for server in learner._servers:
        server.close()
    learner.run_directory.release()
    store.close()


def places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every part of a decoded message."""
    yield path
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in children:
        yield from places(child, (*path, key))


def replaced(node: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at the end of the way."""
    if not path:
        return value
    found = copy.copy(node)
    found[path[0]] = replaced(node[path[0]], path[1:], value)
    return found


class Mutator:
    """Makes wrong messages from a right one: by construction, none of them can be taken for it."""

    def __init__(self, message: Message, dice: np.random.Generator) -> None:
        self._kind, self._data, self._dice = type(message), encode(message), dice
        self._tree = msgpack.unpackb(self._data)
        self._places = list(places(self._tree))

    def __call__(self) -> bytes:
        """One of many ways in which a message can be wrong."""
        while True:
            ways = (self._cut, self._noise, self._grown, self._part, self._part, self._part, self._flipped)
            data = ways[self._dice.integers(len(ways))]()
            if not self._is_right(data):
                return data

    def _is_right(self, data: bytes) -> bool:
        """Whether a change went to what a message may well be: a number in its place is another's."""
        try:
            decode(self._kind, data)
            return True
        except ValueError:
            return False

    def _cut(self) -> bytes:
        return self._data[: self._dice.integers(len(self._data))]

    def _noise(self) -> bytes:
        return self._dice.bytes(int(self._dice.integers(0, 200)))

    def _grown(self) -> bytes:
        return self._data + self._dice.bytes(int(self._dice.integers(1, 50)))

    def _part(self) -> bytes:
        path = self._places[self._dice.integers(len(self._places))]
        junk = JUNK[self._dice.integers(len(JUNK))]
        return bytes(msgpack.packb(replaced(self._tree, path, junk)))

    def _flipped(self) -> bytes:
        data = bytearray(self._data)
        for _ in range(self._dice.integers(1, 5)):
            data[self._dice.integers(len(data))] ^= 1 << int(self._dice.integers(8))
        return bytes(data)


def header_of(payload: bytes, seq: int, dice: np.random.Generator) -> tuple[bytes, bool]:
    """A delivery's header, one in four of them wrong; whether it is right."""
    right: list[Any] = [ADDRESS, "boot", seq, len(payload), zlib.crc32(payload)]
    if dice.random() < 0.75:
        return msgpack.packb([right]), True
    wrong: list[Any] = list(right)
    wrong[dice.integers(5)] = [JUNK[i] for i in range(len(JUNK))][dice.integers(len(JUNK))]
    choices = ([wrong], right, [right, right], [], [right[:4]], [[*right, 1]], None)
    picked = choices[dice.integers(len(choices))]
    whole = msgpack.packb(picked)
    return (whole, False) if dice.random() < 0.8 else (whole[: dice.integers(len(whole))], False)


def resident() -> int:
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def send_wrong(client: zenoh.Session, channel: Channel, count: int, seed: int) -> Counter[str]:
    """Sends so many wrong messages, several at a time; how they were answered."""
    dice = np.random.default_rng(seed)
    mutator = Mutator(channel.message, dice)
    answers: queue.SimpleQueue[bytes | Exception] = queue.SimpleQueue()
    found: Counter[str] = Counter()

    def settle() -> None:
        answer = answers.get(timeout=60)
        if isinstance(answer, RefusedError):
            found["busy" if str(answer) == BUSY else "refused"] += 1
        elif isinstance(answer, bytes) and channel.delivered and all(decode(Receipt, answer).answers):
            found["refused in the receipt"] += 1
        else:
            found[f"taken: {answer!r}"[:200]] += 1

    for i in range(count):
        payload = mutator()
        if channel.told:
            client.put(channel.key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
            continue
        header = header_of(payload, i, dice)[0] if channel.delivered else b""
        ask_later(client, channel.key, payload, answers.put, TIMEOUT, header)
        if i >= IN_FLIGHT:
            settle()
    if not channel.told:
        for _ in range(min(count, IN_FLIGHT)):
            settle()
    return found


def fuzz(client: zenoh.Session, target: Target, name: str, count: int) -> None:
    channel, before = target.channels[name], target.stored()
    first = count // 10  # what a first error brings into memory stays
    send_wrong(client, channel, first, seed=1)
    wait_until(lambda: channel.refused() >= first, 60, f"{first} messages to be counted")
    memory, refused = resident(), channel.refused()
    found = send_wrong(client, channel, count, seed=2)
    if not channel.told:
        assert found["refused"] + found["refused in the receipt"] == count, found
    wait_until(lambda: channel.refused() >= refused + count, 60, f"{count} messages to be counted")
    assert target.stored() == before
    grown = (resident() - memory) / 2**20
    print(f"{name}: {dict(found)}, {grown:.1f} MB more")
    assert grown < 30


CHANNELS = (
    "trajectory",
    "frames",
    "result",
    "candidates",
    "task",
    "score",
    "snapshot",
    "contract",
    "weights",
    "version",
    "stat",
)


@pytest.mark.parametrize("name", CHANNELS)
def test_wrong_messages_are_refused_and_counted_and_leave_no_trace(client, target, name):
    fuzz(client, target, name, 2_000)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", CHANNELS)
def test_a_hundred_thousand_wrong_messages_are_refused_and_leave_no_trace(client, target, name):
    fuzz(client, target, name, 100_000)


def test_a_right_message_is_taken_after_the_wrong_ones(client, target):
    for name in CHANNELS:
        channel = target.channels[name]
        send_wrong(client, channel, 100, seed=3)
        answers: queue.SimpleQueue[bytes | Exception] = queue.SimpleQueue()
        payload = encode(channel.message)
        if channel.told:
            client.put(channel.key, payload)
            continue
        header = msgpack.packb([[ADDRESS, name, 0, len(payload), zlib.crc32(payload)]])
        ask_later(client, channel.key, payload, partial(answers.put), 60.0, header)
        answer = answers.get(timeout=60)
        assert isinstance(answer, bytes), (name, answer)
        if channel.delivered:
            assert decode(Receipt, answer).answers == [""], name
    expected = (1, 1, 1, 2, 1, 1)
    wait_until(lambda: target.stored()[-2:] == expected[-2:], 20, "what was told to be heard")
    assert target.stored() == expected
