"""Everything goes wrong at once, and nothing that was acknowledged is lost."""

import random
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

from common.bus import Keys, ask
from common.errors import NoAnswerError, RefusedError
from common.link import make_link, open_client
from common.members import Members
from common.messages import ContractReply, Nothing
from learner.log import EpisodeLog
from tests.crew import SMOKE, Processes
from tests.helpers import PATIENCE, free_endpoint, wait_until
from tests.wire import Wire

ACTORS = ("a", "b", "c", "d")
CAPACITY = 2**20
SETTINGS = (
    *SMOKE,
    *("--set", f"replay.capacity={CAPACITY}"),
    *("--set", "replay.samples_per_insert=1"),
    *("--set", "learner.checkpoint_seconds=1"),
    *("--set", "world.lidar.beams=2"),
)
QUICK = 2.0
"""Seconds within which a server that is up answers whatever else goes on."""


class Probe(NamedTuple):
    """A question, and whether it was answered."""

    began: float
    until: float
    answered: bool


class Prober:
    """Asks the learner for its contract, on a connection that nobody cuts, and times the answers."""

    def __init__(self, session: zenoh.Session) -> None:
        self.probes: list[Probe] = []
        self._session, self._stop = session, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            began = time.monotonic()
            try:
                ask(self._session, Keys("run").contract, Nothing(), ContractReply, timeout=10.0)
                answered = True
            except (NoAnswerError, RefusedError):
                answered = False
            self.probes.append(Probe(began, time.monotonic(), answered))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


class Chaos(Processes):
    """A learner, a curriculum and simulated actors, each of which may be killed, frozen or cut off."""

    def __init__(self, folder: Path, seed: int) -> None:
        super().__init__(folder)
        self.dice = random.Random(seed)
        self.endpoint = free_endpoint()
        self.wires = {name: Wire(int(self.endpoint.rpartition(":")[2])) for name in ACTORS}
        self.done: dict[str, int] = defaultdict(int)
        self.away: list[tuple[float, float]] = []
        """From when to when the learner was dead or frozen, its start not included."""

    def launch(self, name: str) -> None:
        if name == "learner":
            self.start(name, "learner", "--run", self.folder / "run", "--listen", self.endpoint, *SETTINGS)
        elif name == "curriculum":
            run = self.folder / "run"
            self.start(name, "curriculum", "serve", "--run", run, "--connect", self.endpoint)
        else:
            spool, journal = self.folder / "spool" / name, self.folder / f"{name}.journal"
            arguments = (self.wires[name].endpoint, name, str(spool), str(journal))
            with (self.folder / f"{name}.txt").open("ab") as output:
                self.running[name] = subprocess.Popen(
                    [sys.executable, "-m", "tests.sim_actor", *arguments],
                    stdout=output,
                    stderr=output,
                    cwd=Path(__file__).parents[1],
                )

    def kill(self, name: str) -> None:
        began = time.monotonic()
        self.running[name].kill()
        self.running[name].wait()
        time.sleep(self.dice.uniform(0.0, 1.0))
        self.launch(name)
        self._was_away(name, began)

    def freeze(self, name: str) -> None:
        began = time.monotonic()
        self.running[name].send_signal(signal.SIGSTOP)
        time.sleep(self.dice.uniform(0.2, 5.0))  # beyond the lease, too
        self.running[name].send_signal(signal.SIGCONT)
        self._was_away(name, began)

    def cut(self, name: str, stall: bool) -> None:
        self.wires[name].cut(stall)
        time.sleep(self.dice.uniform(0.2, 5.0))
        self.wires[name].mend()

    def all_run(self) -> bool:
        """True; fails with its last words when one has ended by itself."""
        for name, process in self.running.items():
            assert process.poll() is None, f"{name} ended: {self.words(name)[-2000:]}"
        return True

    def strike(self) -> None:
        """Does something bad to somebody."""
        victim = self.dice.choice(("learner", "curriculum", *ACTORS))
        kinds = ["kill", "freeze"] + ["cut", "stall"] * (victim in ACTORS)
        kind = self.dice.choice(kinds)
        self.done[f"{kind} {victim if victim not in ACTORS else 'actor'}"] += 1
        if kind == "kill":
            self.kill(victim)
        elif kind == "freeze":
            self.freeze(victim)
        else:
            self.cut(victim, kind == "stall")

    def _was_away(self, name: str, began: float) -> None:
        if name == "learner":
            self.away.append((began, time.monotonic()))

    def close(self) -> None:
        for process in self.running.values():
            process.send_signal(signal.SIGCONT)
        super().close()
        for wire in self.wires.values():
            wire.close()


@pytest.fixture
def chaos(tmp_path, request):
    found = Chaos(tmp_path, request.param)
    yield found
    found.close()


def delivered(members: Members) -> dict[str, tuple[int, int] | int]:
    """Of each actor its process and how much of what that sent was acknowledged; 0 for nothing."""
    stats = {member.name: stat for member, stat in list(members.stats.items()) if member.role == "actor"}
    return {
        name: (stats[name].pid, stats[name].values["acknowledged"])
        if name in stats and stats[name].values["acknowledged"]
        else 0
        for name in ACTORS
    }


def journal_of(file: Path) -> tuple[dict[tuple[str, int], int], set[tuple[str, int]]]:
    """Checksums of what an actor made, by boot and number, and which of it had reached its spool."""
    made: dict[tuple[str, int], int] = {}
    kept: set[tuple[str, int]] = set()
    for line in file.read_text().splitlines():
        match line.split():
            case ["made", boot, seq, crc]:
                made[boot, int(seq)] = int(crc)
            case ["kept", boot, seq]:
                kept.add((boot, int(seq)))
    return made, kept


def unleash(chaos: Chaos, seconds: float) -> None:
    """Strikes at random for so long, then lets everything come to rest and counts."""
    for name in ("learner", "curriculum", *ACTORS):
        chaos.launch(name)
    with open_client(make_link(chaos.endpoint)) as session:
        prober, members = Prober(session), Members(session, Keys("run"))
        try:
            wait_until(
                lambda: chaos.all_run() and all(delivered(members).values()), 60, "the first episodes of all"
            )
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                time.sleep(chaos.dice.uniform(0.0, 2.0))
                chaos.strike()
            assert any(v["full"] for v in members.of("actor").values()), "no spool was ever full"
            before = delivered(members)
            wait_until(
                lambda: all(now not in (0, before[n]) for n, now in delivered(members).items()),
                90,
                "each actor to deliver once more",
            )
        finally:
            prober.close()
    for name in (*ACTORS, "curriculum", "learner"):
        assert chaos.stop(name) == 0, chaos.words(name)

    records = list(EpisodeLog(chaos.folder / "run" / "log", CAPACITY).restore())
    stored = {(r.origin.actor, r.origin.boot, r.origin.seq): zlib.crc32(r.payload) for r in records}
    assert len(stored) == len(records), "an episode is stored twice"
    acknowledged = 0
    sent: dict[tuple[str, str, int], int] = {}
    for name in ACTORS:
        made, kept = journal_of(chaos.folder / f"{name}.journal")
        spool = chaos.folder / "spool" / name / "learner"
        waiting = {(file.parent.name, int(file.stem)) for file in spool.glob("*/*.msg")}
        done = kept - waiting
        acknowledged += len(done)
        sent |= {(f"local/{name}", boot, seq): crc for (boot, seq), crc in made.items()}
        missing = {(boot, seq) for boot, seq in done if (f"local/{name}", boot, seq) not in stored}
        assert not missing, f"{name}: {len(missing)} acknowledged episodes are not stored"
        assert not list(spool.rglob("*.bad"))
        assert "refused for good" not in chaos.words(name), chaos.words(name)
    assert stored.items() <= sent.items(), "something is stored that nobody sent"
    assert acknowledged > 100
    for name in ("learner", "curriculum", *ACTORS):
        assert "Traceback" not in chaos.words(name), chaos.words(name)

    # a question counts when the learner was up all the while: away, it is until its first answer again
    answered = [probe for probe in prober.probes if probe.answered]
    away = [(0.0, answered[0].until)]
    away += [(gone, min(p.until for p in answered if p.began > back)) for gone, back in chaos.away]
    counted = [p for p in prober.probes if not any(p.began < back and p.until > gone for gone, back in away)]
    worst = max(probe.until - probe.began for probe in counted)
    print(
        dict(chaos.done), f"{len(stored)} stored, {acknowledged} acknowledged, slowest answer {worst:.2f} s"
    )
    assert all(probe.answered for probe in counted)
    assert worst < QUICK * PATIENCE


@pytest.mark.timeout(480)
@pytest.mark.parametrize("chaos", [1], indirect=True)
def test_a_minute_of_kills_freezes_and_cuts_loses_nothing_that_was_acknowledged(chaos):
    unleash(chaos, 60.0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("chaos", [2], indirect=True)
def test_ten_minutes_of_kills_freezes_and_cuts_lose_nothing_that_was_acknowledged(chaos):
    unleash(chaos, 600.0)
