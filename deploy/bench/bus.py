"""`bench bus`: acknowledged, logged delivery against what carries it, and a learner under load.

A receiver in a process of its own takes episodes as the learner does: decoded, checked, appended to the log,
committed, and only then acknowledged. The same bytes go there as bare queries with an empty reply, which are
the limit, as puts that nobody acknowledges, and through ZeroMQ. All take turns in every round.
"""

from __future__ import annotations

import json
import math
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import zenoh
from isal.isal_zlib import crc32

from common.access import LOCAL
from common.bus import Member, ask_bytes, ask_later
from common.config import Config, override
from common.contract import digest
from common.delivery import Parcel, Sender, Spool, pack_bundle
from common.errors import NoAnswerError, RefusedError, RunError
from common.link import make_link, open_client
from common.messages import Episode, Origin, Receipt, decode, encode
from common.observation import Columns, ObservationLayout
from deploy.bench.bus_peers import CONFIG, DURABILITIES, EPISODE, RUN, channel, make_take
from deploy.bench.processes import PATIENCE, running_learner
from deploy.bench.replay import synthetic_episode
from deploy.bench.report import Report
from deploy.launcher import free_port
from learner.learner import Learner
from learner.log import EpisodeLog

SIZES = {"64k": 64 * 1024, "512k": 512 * 1024, "2m": 2048 * 1024}
VOLUME = 8 * 2**20
"""Bytes that are timed together, in at least LEAST messages."""
LEAST = 16
IN_FLIGHT = 4
SMALL, SMALL_COUNT = 4 * 1024, 1000
"""The messages that show what bundles are good for."""
MOST_LOST = 10
"""Measurements that are repeated before the benchmark gives up."""
RECOVERY = 2.0
"""Seconds in which a lost connection is renewed, with all that the other side declares."""
MEMBER = Member("actor", LOCAL, "bench")
WINDOW = 1.5
"""Seconds of load in a round."""
FASTEST = 1500
"""Episodes per second for which the log of the loaded learner has room; with more, a round is shorter."""
PROCESSES = 4
"""Of the actors that only send."""
UNLIMITED = (
    "replay.samples_per_insert=1e-6",
    "replay.error_buffer=100",
    "replay.hold_actors=false",
    "learner.threads=1",
)
"""No updates, which would take the time of the ingest, and nothing that holds actors back."""
INGESTED = 200
"""Episodes that are taken in without the bus together."""
Answer = Callable[[bytes | Exception], None]


def bench_bus(
    config: Config, rounds: int, actors: int, seconds: float, progress: Callable[[int, str], None]
) -> Report:
    """Compares for `rounds` rounds, then loads a learner with so many actors for `seconds`, unless 0."""
    report = Report("bus")
    with tempfile.TemporaryDirectory() as folder:
        _compare(report, _roomy(config), rounds, Path(folder), progress)
    if actors:
        with tempfile.TemporaryDirectory() as folder:
            _load(report, config, actors, seconds, Path(folder), lambda note: progress(rounds, note))
    else:
        report.skipped.append("load: ask for it with --load ACTORS")
    return report


def _roomy(config: Config) -> Config:
    """Takes the largest episode, and logs a few of its segments."""
    steps = SIZES["2m"] // _row_bytes(config)
    room = (f"world.max_episode_steps={steps}", f"replay.capacity={40 * steps}")
    return override(config.model_dump(mode="json"), room)


def _row_bytes(config: Config) -> int:
    return Columns.empty(1, ObservationLayout.of(config)).nbytes


def _episode(config: Config, size: int, ours: dict[str, str]) -> Episode:
    """The longest one whose message has no more than `size` bytes."""
    rng = np.random.default_rng(config.seed)

    def make(steps: int) -> Episode:
        return synthetic_episode(config, steps, rng).model_copy(update={"digest": ours})

    return make(1 + (size - len(encode(make(1)))) // _row_bytes(config))


def _compare(
    report: Report, config: Config, rounds: int, folder: Path, progress: Callable[[int, str], None]
) -> None:
    (folder / CONFIG).write_text(config.to_toml(), "utf-8")
    endpoint, agreed = f"tcp/127.0.0.1:{free_port()}", digest(config, b"")
    episodes = {name: _episode(config, size, agreed) for name, size in SIZES.items()}
    small = encode(_episode(config, SMALL, agreed))
    times: dict[tuple[str, str], list[float]] = {}
    used: dict[tuple[str, str], list[float]] = {}
    with ExitStack() as stack:
        receiver = stack.enter_context(_peer(folder, "receive", endpoint))
        port = receiver.hear()["zmq"]
        session = stack.enter_context(open_client(make_link(endpoint), patience=PATIENCE))
        ways = _Ways(session, folder / "spool")
        ways.wait()
        sends: dict[str, Callable[[Episode, bytes, int], None]] = {
            "acked_process": partial(ways.acknowledged, "process"),
            "acked_host": partial(ways.acknowledged, "host"),
            "spooled": ways.spooled,
            "bare_query": ways.query,
            "put": ways.put,
        }
        try:
            sends["zmq"] = stack.enter_context(_zmq(port))
        except ImportError as error:
            report.skipped.append(f"zmq: {error}; pip install 'navaclq[bench]'")
        for i in range(rounds + 1):  # the first warms up
            measured: dict[tuple[str, str], tuple[float, float]] = {}
            for size, episode in episodes.items():
                payload = encode(episode)
                n = max(LEAST, VOLUME // len(payload))
                for name, send in sends.items():
                    taken, cpu = ways.time(partial(send, episode, payload, n))
                    measured[name, size] = taken / n, cpu / n
            for name, drain in (("bundled", _bundled), ("single", _single)):
                boot = f"{name}-{i}"
                spool = _filled(folder / boot, boot, small)
                taken, cpu = ways.time(partial(drain, session, spool, boot))
                measured[name, "4k"] = taken / SMALL_COUNT, cpu / SMALL_COUNT
            if i:
                for key, (seconds, cpu_seconds) in measured.items():
                    times.setdefault(key, []).append(seconds)
                    used.setdefault(key, []).append(cpu_seconds)
                progress(i, "")
        ways.close()
    if ways.lost:
        report.skipped.append(f"{ways.lost} measurements that lost the connection, and were repeated")
    lengths = {size: len(encode(episode)) for size, episode in episodes.items()} | {"4k": len(small)}
    for (name, size), seconds_each in times.items():
        rate = 1 / median(seconds_each)
        report.add(f"{name}_{size}", rate, "episodes/s")
        report.add(f"{name}_{size}_volume", rate * lengths[size] / 1e6, "MB/s")
        report.add(f"{name}_{size}_cpu", 1e3 * median(used[name, size]), "ms")
    for size in SIZES:
        for durability in DURABILITIES:
            ours, limit = (f"acked_{durability}", size), ("bare_query", size)
            report.compare(f"acked_{durability}_over_bare_query_{size}", times[limit], times[ours])
            report.compare(f"acked_{durability}_over_bare_query_{size}_cpu", used[limit], used[ours])
        acked = times["acked_process", size]
        report.compare(f"acked_over_put_{size}", times["put", size], acked)
        if "zmq" in sends:
            report.compare(f"acked_over_zmq_{size}", times["zmq", size], acked)
        report.compare(f"spooled_over_acked_{size}", acked, times["spooled", size])
    report.compare("bundled_over_single_4k", times["single", "4k"], times["bundled", "4k"])


def _time(work: Callable[[], None]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


class _Ways:
    """The ways from one session to the receiver: each sends an episode n times, until all have arrived."""

    def __init__(self, session: zenoh.Session, folder: Path) -> None:
        self._session, self._puts = session, 0
        self._numbers = {durability: count() for durability in DURABILITIES}
        self.lost = 0
        """Times that the connection was."""
        spool = Spool(folder, float("inf"))
        self._sender = Sender(session, spool, MEMBER, "spooled", PATIENCE, IN_FLIGHT)

    def wait(self) -> None:
        """Until this session knows all that the receiver has declared, `count` as the last of it."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                self._puts, _ = self._ask()
                return
            except NoAnswerError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)

    def _ask(self) -> tuple[int, float]:
        """Puts that have come, and seconds of CPU that the receiver has used."""
        puts, cpu = json.loads(ask_bytes(self._session, channel("count"), b""))
        return puts, cpu

    def time(self, work: Callable[[], None]) -> tuple[float, float]:
        """Seconds that it takes, and seconds of CPU that both ends use for it.

        Again when the connection is lost, as on a host that starves them.
        """
        while True:
            try:
                before = self._ask()[1] + time.process_time()
                taken = _time(work)
                return taken, self._ask()[1] + time.process_time() - before
            except NoAnswerError:
                self.lost += 1
                if self.lost > MOST_LOST:
                    raise
                time.sleep(RECOVERY)
                self.wait()

    def acknowledged(self, durability: str, episode: Episode, payload: bytes, n: int) -> None:
        """As a Sender does, but from memory."""
        crc, key = crc32(payload), f"{channel(durability)}/{MEMBER.address}"

        def send(answer: Answer) -> None:
            origin = Origin(actor=MEMBER.address, boot="memory", seq=next(self._numbers[durability]))
            body, header = pack_bundle([Parcel(origin, crc, payload)])
            ask_later(self._session, key, body, answer, PATIENCE, header)

        for receipt in _keep_in_flight(send, n):
            _check(receipt)

    def spooled(self, episode: Episode, payload: bytes, n: int) -> None:
        """The whole way of an episode from its maker, over a spool on disk."""
        goal = self._sender.sent + n
        for _ in range(n):
            self._sender.put(channel("process"), episode)
        deadline = time.monotonic() + PATIENCE
        while self._sender.sent < goal:
            if self._sender.refused or time.monotonic() > deadline:
                raise RefusedError(self._sender.last_refusal or self._sender.trouble)
            time.sleep(0.0005)

    def query(self, episode: Episode, payload: bytes, n: int) -> None:
        """Bare queries."""
        key = channel("query")
        _keep_in_flight(lambda answer: ask_later(self._session, key, payload, answer, PATIENCE), n)

    def put(self, episode: Episode, payload: bytes, n: int) -> None:
        """Puts that wait for room, and one question in the end whether all have come."""
        for _ in range(n):
            self._session.put(channel("put"), payload, congestion_control=zenoh.CongestionControl.BLOCK)
        self._puts += n
        deadline = time.monotonic() + PATIENCE
        while self._ask()[0] != self._puts:
            if time.monotonic() > deadline:
                raise NoAnswerError("puts were lost")

    def close(self) -> None:
        """Ends the sender's thread."""
        self._sender.close(patience=0.0)


def _keep_in_flight(send: Callable[[Answer], None], n: int) -> list[bytes]:
    """Calls `send` n times with IN_FLIGHT answers outstanding at most; all answers."""
    room, answers = threading.Semaphore(IN_FLIGHT), list[bytes | Exception]()

    def hear(answer: bytes | Exception) -> None:
        answers.append(answer)
        room.release()

    for _ in range(n):
        room.acquire()
        send(hear)
    for _ in range(IN_FLIGHT):
        room.acquire()
    return [_success(answer) for answer in answers]


def _success(answer: bytes | Exception) -> bytes:
    if isinstance(answer, Exception):
        raise answer
    return answer


def _check(receipt: bytes) -> None:
    for reason in filter(None, decode(Receipt, receipt).answers):
        raise RefusedError(reason)


@contextmanager
def _zmq(port: int) -> Iterator[Callable[[Episode, bytes, int], None]]:
    """The same over ZeroMQ, which acknowledges what it has received."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.linger = 0
        dealer.rcvtimeo = int(1000 * PATIENCE)
        dealer.connect(f"tcp://127.0.0.1:{port}")

        def send(episode: Episode, payload: bytes, n: int) -> None:
            for i in range(n):
                if i >= IN_FLIGHT:
                    dealer.recv()
                dealer.send_multipart([b"header", payload], copy=False)
            for _ in range(min(n, IN_FLIGHT)):
                dealer.recv()

        yield send


def _filled(folder: Path, boot: str, payload: bytes) -> Spool:
    spool = Spool(folder, float("inf"))
    for number in range(SMALL_COUNT):
        spool.put(Origin(actor=MEMBER.address, boot=boot, seq=number), channel("process"), payload)
    return spool


def _bundled(session: zenoh.Session, spool: Spool, boot: str) -> None:
    """Empties a spool as Sender does."""
    sender = Sender(session, spool, MEMBER, boot, PATIENCE, IN_FLIGHT)
    deadline = time.monotonic() + PATIENCE
    while len(spool):
        if sender.refused or time.monotonic() > deadline:
            raise RefusedError(sender.last_refusal or sender.trouble)
        time.sleep(0.0005)
    sender.close(patience=0.0)


def _single(session: zenoh.Session, spool: Spool, boot: str) -> None:
    """Empties a spool as Sender would if each message went alone."""
    flying: set[Path] = set()
    answers: queue.SimpleQueue[tuple[Path, bytes | Exception]] = queue.SimpleQueue()

    def hear(path: Path, answer: bytes | Exception) -> None:
        answers.put((path, answer))

    def land() -> None:
        path, answer = answers.get(timeout=PATIENCE)
        _check(_success(answer))
        spool.remove(path)
        flying.remove(path)

    while len(spool):
        key, bundle = spool.bundle(flying)
        for path, parcel in bundle.items():
            if len(flying) == IN_FLIGHT:
                land()
            flying.add(path)
            body, header = pack_bundle([parcel])
            ask_later(session, f"{key}/{MEMBER.address}", body, partial(hear, path), PATIENCE, header)
        if not bundle:
            land()


def _load(
    report: Report, config: Config, actors: int, seconds: float, folder: Path, note: Callable[[str], None]
) -> None:
    """One real learner, and actors that do nothing but send; the limit takes turns with them."""
    rounds, quota = max(1, round(seconds / WINDOW)), math.ceil(FASTEST * WINDOW / actors)
    length = _episode(config, SIZES["64k"], {}).length
    room = f"replay.capacity={(rounds + 1) * actors * quota * length}"
    config = override(config.model_dump(mode="json"), (*UNLIMITED, room))
    (folder / CONFIG).write_text(config.to_toml(), "utf-8")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    limits, loads, limits_cpu, loads_cpu = (list[float]() for _ in range(4))
    with ExitStack() as stack:
        note("the learner starts")
        process, contract = stack.enter_context(running_learner(folder / RUN, folder / CONFIG, endpoint))
        ours = contract.digest
        payload = encode(_episode(config, SIZES["64k"], ours))
        (folder / EPISODE).write_bytes(payload)
        ingest = _ingest(config, ours, payload, folder / "limit")
        note("actors start")
        peers = [stack.enter_context(_peer(folder, "act", endpoint, *share)) for share in _shares(actors)]
        for peer in peers:
            peer.hear()
        before = _resident(process)
        for i in range(rounds + 1):  # the first warms up
            (limit, limit_cpu), used = ingest(), _cpu_seconds(process)
            for peer in peers:
                peer.tell([WINDOW, quota if i else 1])
            told = [peer.hear() for peer in peers]
            if i:
                sent = sum(words["sent"] for words in told)
                limits.append(limit)
                limits_cpu.append(limit_cpu)
                loads.append(max(words["seconds"] for words in told) / sent)
                loads_cpu.append((_cpu_seconds(process) - used) / sent)
            note(f"{actors} actors, {i} of {rounds}")
        after = _resident(process)
        ends = [peer.finish() for peer in peers]
    made = {address: number for end in ends for address, number in end["made"].items()}
    stored = Counter(
        (record.origin.actor, record.origin.seq)
        for record in EpisodeLog(folder / RUN / "log", config.replay.capacity).restore()
    )
    expected = {(address, seq) for address, number in made.items() for seq in range(number)}
    waited = np.percentile([value for end in ends for value in end["latencies"]], (50, 99))
    report.add(f"load_{actors}_actors", 1 / median(loads), "episodes/s")
    report.add(f"load_{actors}_actors_volume", len(payload) / 1e6 / median(loads), "MB/s")
    report.add("load_acknowledged_p50", float(waited[0]), "ms")
    report.add("load_acknowledged_p99", float(waited[1]), "ms")
    report.add("load_learner_cores", median(a / b for a, b in zip(loads_cpu, loads, strict=True)), "cores")
    report.add("load_learner_rss", after, "MB")
    report.add("load_learner_rss_before", before, "MB")
    report.add("load_sent", len(expected), "episodes")
    report.add("load_lost", len(expected - stored.keys()), "episodes")
    report.add("load_stored_twice", stored.total() - len(stored), "episodes")
    report.add("load_refused", sum(end["refused"] for end in ends), "episodes")
    report.add("ingest_limit", 1 / median(limits), "episodes/s")
    report.compare("load_over_ingest_limit", limits, loads)
    report.compare("load_over_ingest_limit_cpu", limits_cpu, loads_cpu)


def _ingest(
    config: Config, ours: dict[str, str], payload: bytes, folder: Path
) -> Callable[[], tuple[float, float]]:
    """Measures what an episode costs a learner besides the bus: seconds, and seconds of CPU."""
    learner, log = Learner(config), EpisodeLog(folder, config.replay.capacity)
    take, numbers, crc = make_take(config, ours, log), count(), crc32(payload)

    def work() -> None:
        for _ in range(INGESTED):
            origin = Origin(actor=MEMBER.address, boot="limit", seq=next(numbers))
            episode = take(Parcel(origin, crc, payload))
            log.commit()
            learner.insert(episode, log.env_steps - episode.length)

    def measure() -> tuple[float, float]:
        before = time.process_time()
        taken = _time(work)
        return taken / INGESTED, (time.process_time() - before) / INGESTED

    return measure


def _shares(actors: int) -> list[tuple[int, int]]:
    """First number and count of the actors of each process."""
    edges = np.linspace(0, actors, min(actors, PROCESSES) + 1).astype(int).tolist()
    return [(first, last - first) for first, last in pairwise(edges)]


def _resident(process: int) -> float:
    """Memory of a process, MB."""
    status = Path(f"/proc/{process}/status").read_text("ascii")
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def _cpu_seconds(process: int) -> float:
    """That a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class _Peer:
    """A process of bus_peers, spoken to in lines of JSON."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def tell(self, words: Any) -> None:
        """Sends it a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()

    def hear(self) -> dict[str, Any]:
        """Waits for its next line."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RunError(f"a process of the benchmark ended with {self._process.wait()}; it told why above")
        words: dict[str, Any] = json.loads(line)
        return words

    def finish(self) -> dict[str, Any]:
        """Ends its work; its last line."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        return self.hear()


@contextmanager
def _peer(folder: Path, job: str, endpoint: str, *numbers: int) -> Iterator[_Peer]:
    command = [sys.executable, "-m", "deploy.bench.bus_peers", job, str(folder), endpoint]
    process = subprocess.Popen(
        [*command, *map(str, numbers)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    with process:  # which closes its stdin, and waits
        try:
            yield _Peer(process)
        except BaseException:
            process.kill()
            raise
