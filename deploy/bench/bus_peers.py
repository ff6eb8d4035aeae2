"""The other ends of `navaclq bench bus`, as commands: a receiver, and actors that only send.

Both speak lines of JSON on stdout, and end when their stdin does.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zenoh

from common.access import LOCAL
from common.bus import Keys, Member
from common.config import Config, parse
from common.contract import check_digest, digest
from common.delivery import Parcel, Receiver, Sender, Spool
from common.link import make_link, open_client, open_hub
from common.messages import Episode, decode
from common.observation import ObservationLayout
from common.telemetry import Quantiles
from deploy.bench.processes import PATIENCE
from deploy.launcher import free_port
from learner.log import EpisodeLog

CONFIG, EPISODE = "config.toml", "episode.msg"
DURABILITIES = ("process", "host")
RUN = "load"
"""Name of the run whose learner is loaded."""
SPOOLED = 4
"""Episodes that an actor may have waiting."""
Take = Callable[[Parcel], Episode]


def channel(name: str) -> str:
    """Key on which one kind of traffic runs, apart from the others."""
    return Keys(f"bench-{name}").trajectory


def make_take(config: Config, ours: dict[str, str], log: EpisodeLog) -> Take:
    """What a learner does with an episode before it acknowledges it, up to the limiter and its own queue."""
    layout, world = ObservationLayout.of(config), config.world

    def take(parcel: Parcel) -> Episode:
        episode = decode(Episode, parcel.payload)
        check_digest(ours, episode.digest)
        episode.check_layout(layout, world.max_episode_steps, world.reward.largest)
        log.append(parcel, episode.length)
        return episode

    return take


def receive(folder: Path, endpoint: str) -> None:
    """Takes everything that `bench bus` sends: into a log of either durability, and bare."""
    config = parse((folder / CONFIG).read_text("utf-8"))
    ours = digest(config, b"")
    with open_hub(make_link(endpoint)) as session, _zmq_router() as zmq_port:
        servers: list[Any] = []
        for durability in DURABILITIES:
            sync = durability == "host"
            log = EpisodeLog(folder / durability, config.replay.capacity, sync=sync)
            take: Callable[[Parcel], Any] = make_take(config, ours, log)
            commit = log.commit if sync else None
            servers.append(
                Receiver(session, channel(durability), take, log.seen.seen, Episode.max_bytes, commit=commit)
            )
        servers += _bare(session)
        _say({"zmq": zmq_port})
        sys.stdin.read()
        for server in servers[: len(DURABILITIES)]:
            server.close()


def _bare(session: zenoh.Session) -> list[Any]:
    """Answers queries with nothing, at once; counts puts, and tells how many when asked, and the CPU time."""
    count = 0

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(channel("query"), b"")

    def add(sample: zenoh.Sample) -> None:
        nonlocal count
        count += 1

    def tell(query: zenoh.Query) -> None:
        with query:
            query.reply(channel("count"), json.dumps([count, time.process_time()]).encode())

    return [
        session.declare_queryable(channel("query"), answer),
        session.declare_subscriber(channel("put"), add),
        session.declare_queryable(channel("count"), tell),
    ]


@contextmanager
def _zmq_router() -> Iterator[int]:
    """The port of a socket of ZeroMQ whose messages are acknowledged at once; 0 without ZeroMQ."""
    try:
        import zmq
    except ImportError:
        yield 0
        return
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    port, up = free_port(), threading.Event()

    def serve() -> None:
        router = context.socket(zmq.ROUTER)
        router.linger = 0
        router.bind(f"tcp://127.0.0.1:{port}")
        up.set()
        try:
            while True:
                sender, _, _ = router.recv_multipart(copy=False)
                router.send_multipart([sender, b""], copy=False)
        except zmq.ContextTerminated:
            router.close()

    thread = threading.Thread(target=serve, name="zmq", daemon=True)
    thread.start()
    up.wait(PATIENCE)
    yield port
    context.term()
    thread.join(PATIENCE)


class _Latencies(Quantiles):
    """All of them, not the last ones."""

    def __init__(self) -> None:
        self.all: list[float] = []

    def add(self, value: float) -> None:
        self.all.append(value)


def act(folder: Path, endpoint: str, first: int, count: int) -> None:
    """`count` actors, each with a session and a spool of its own, that send one episode again and again.

    A line [seconds, episodes] on stdin makes each of them send for so long, or so many, until all are there.
    """
    payload = (folder / EPISODE).read_bytes()
    episode = decode(Episode, payload)
    with ExitStack() as stack:
        senders: dict[str, Sender] = {}
        for number in range(first, first + count):
            session = stack.enter_context(open_client(make_link(endpoint), patience=PATIENCE))
            member = Member("actor", LOCAL, f"load-{number}")
            spool = Spool(folder / "spool" / member.name, SPOOLED * len(payload))
            senders[member.address] = Sender(session, spool, member, "load")
            senders[member.address].latency = _Latencies()
        made = dict.fromkeys(senders, 0)
        _say({"actors": count})
        for line in sys.stdin:
            seconds, episodes = json.loads(line)
            before, began = sum(made.values()), time.perf_counter()
            goals = {address: number + episodes for address, number in made.items()}
            while time.perf_counter() - began < seconds and made != goals:
                busy = False
                for address, sender in senders.items():
                    if made[address] < goals[address] and not (sender.spool.full or sender.held_back):
                        sender.put(Keys(RUN).trajectory, episode)
                        made[address] += 1
                        busy = True
                if not busy:
                    time.sleep(0.002)
            while any(len(sender.spool) for sender in senders.values()):
                if time.perf_counter() - began > seconds + PATIENCE:
                    break
                time.sleep(0.002)
            _say({"sent": sum(made.values()) - before, "seconds": time.perf_counter() - began})
        latencies: list[float] = []
        for sender in senders.values():
            sender.close(patience=0.0)
            assert isinstance(sender.latency, _Latencies)
            latencies += sender.latency.all
        refused = sum(sum(sender.refused.values()) for sender in senders.values())
        _say({"made": made, "refused": refused, "latencies": latencies})


def _say(words: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    job, where, hub, *numbers = sys.argv[1:]
    if job == "receive":
        receive(Path(where), hub)
    else:
        act(Path(where), hub, *map(int, numbers))
