"""Processes of navaclq started by hand, which can be killed; what a whole system of them says and leaves."""

import re
import shutil
import signal
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zenoh

from common.access import LOCAL
from common.bus import Keys, Member, Subscription
from common.link import make_link, open_client
from common.members import Members
from common.messages import Stat, Version
from learner.log import EpisodeLog, Record
from tests.helpers import free_endpoint, wait_until

SMOKE = ["--preset", "smoke", "--set", "actor.worlds=2"]
CAPACITY = 100_000
"""Transitions in the replay, more than any of these runs makes: all that is in the log must be in it."""
SETTINGS = (*SMOKE, "--set", f"replay.capacity={CAPACITY}", "--set", "learner.checkpoint_seconds=0.5")
RESUMED = re.compile(
    r"resumed with (\d+) episodes \((\d+) steps\), (\d+) transitions in the replay, (\d+) up"
)
Id = tuple[str, str, int]
"""Address of the actor, boot and number of an episode."""


class Processes:
    """Commands of navaclq in the background, their output in files, ended with the test."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.running: dict[str, subprocess.Popen] = {}

    def start(self, name: str, *arguments, inside: Iterable[str] = ()) -> subprocess.Popen:
        """`inside` is what to put before the command, to run it in another namespace."""
        with (self.folder / f"{name}.txt").open("ab") as output:
            self.running[name] = subprocess.Popen(
                [*inside, sys.executable, "-m", "deploy.cli", *map(str, arguments)],
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        return self.running[name]

    def words(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text()

    def stop(self, name: str, timeout: float = 15.0) -> int:
        self.running[name].send_signal(signal.SIGTERM)
        return self.running[name].wait(timeout)

    def close(self) -> None:
        for process in self.running.values():
            if process.poll() is None:
                process.kill()
            process.wait()


class Crew(Processes):
    """Learner, curriculum and two actors of one run, started by hand, with what they say on the bus."""

    def __init__(self, folder: Path, run: Path | None = None) -> None:
        super().__init__(folder)
        self.run, self.spool, self.endpoint = run or folder / "run", folder / "spool", free_endpoint()
        self.settings: tuple[str, ...] = ()
        self.inside: list[str] = []
        """Of the learner."""
        self.reports: dict[int, list[dict]] = defaultdict(list)
        """Figures of each life of the learner, by process id."""
        self.versions: list[Version] = []
        self.made: Counter[str] = Counter()
        """Episodes that were made in the actors' former lives, as last told."""

    def start_learner(self) -> int:
        """Starts it, or starts it again with the same command; its process id."""
        command = ("learner", "--run", self.run, "--listen", self.endpoint, *SETTINGS, *self.settings)
        return self.start("learner", *command, inside=self.inside).pid

    def start_other(self, name: str) -> None:
        join = ("--connect", self.endpoint)
        if name == "curriculum":
            self.start(name, "curriculum", "serve", "--run", self.folder / "run", *join)
        else:
            self.start(name, "actor", "--name", name, "--spool", self.spool, *join)

    @contextmanager
    def listening(self) -> Iterator[zenoh.Session]:
        """Hears all that is said, over every life of the hub."""
        keys = Keys("run")
        with open_client(make_link(self.endpoint), patience=60) as session:
            self.monitor = Members(session, keys)
            self._heard = (
                Subscription(session, keys.version, Version, self.versions.append),
                Subscription(
                    session,
                    keys.stat(Member("learner", "*", "*")),
                    Stat,
                    lambda stat: self.reports[stat.pid].append(stat.values),
                ),
            )
            yield session

    def figure(self, name: str) -> float:
        """Newest figure of the learner that runs now; 0 before it has told."""
        reports = self.reports[self.running["learner"].pid]
        return reports[-1].get(name, 0) if reports else 0

    def of_actors(self, figure: str) -> list:
        return [values.get(figure, 0) for _, values in sorted(self.monitor.of("actor").items())]

    def wait_for_training(self, timeout: float = 60.0) -> None:
        """Until this life of the learner makes updates, from episodes that were driven with its weights."""
        known = "charts/staleness"
        wait_until(lambda: self.figure(known), timeout, "episodes driven with the new weights")
        updates = self.figure("updates")
        wait_until(lambda: self.figure("updates") > updates, timeout, "updates")

    def kill(self, name: str) -> None:
        """SIGKILL, after which nothing of it moves any more."""
        self.running[name].kill()
        self.running[name].wait(15)
        if name in "ab":
            self.made[name] += _made(self.monitor.of("actor").get(name, {}))
            self.monitor.stats.pop(Member("actor", LOCAL, name), None)

    def log(self) -> list[Record]:
        """What is in the log now, read from a copy."""
        copy = self.folder / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.run / "log", copy)
        return list(EpisodeLog(copy, CAPACITY).restore())

    def waiting(self) -> set[Id]:
        """Episodes in the spools of the actors, from all their lives."""
        files = self.spool.glob("*/*/learner/*/*.msg")
        return {("/".join(file.parts[-5:-3]), file.parts[-2], int(file.stem)) for file in files}

    def newest_checkpoint(self) -> Path | None:
        """Of those that are whole."""
        found = sorted(p for p in (self.run / "checkpoints").glob("*") if p.suffix != ".part")
        return found[-1] if found else None


def address(name: str) -> str:
    """Under which an actor of that name delivers."""
    return f"{LOCAL}/{name}"


def _made(figures: dict) -> int:
    """Episodes that an actor has made, by its own figures."""
    return int(sum(value for key, value in figures.items() if key.startswith("ending_")))


def ids(records: list[Record]) -> list[Id]:
    return [(r.origin.actor, r.origin.boot, r.origin.seq) for r in records]


def assert_nothing_is_lost_and_nothing_there_twice(crew: Crew) -> list[Record]:
    """For the end, when all processes have stopped. An actor numbers its episodes from 0 without gaps."""
    records, waiting = crew.log(), crew.waiting()
    found = ids(records)
    assert len(found) == len(set(found)), "an episode counts twice"
    numbers: dict[tuple[str, str], set[int]] = defaultdict(set)
    for actor, boot, seq in {*found, *waiting}:
        numbers[actor, boot].add(seq)
    for life, those in numbers.items():
        assert those == set(range(len(those))), f"{life} lost {set(range(max(those))) - those}"
    # nor are the last ones of a life missing, of which the gaps above know nothing
    for name in "ab":
        told = crew.made[name] + _made(crew.monitor.of("actor").get(name, {}))
        assert told <= sum(len(those) for (actor, _), those in numbers.items() if actor == address(name))
        assert told > 0
    steps = np.cumsum([r.length for r in records])
    assert [r.env_steps for r in records] == list(steps)
    assert [r.episodes for r in records] == list(range(1, len(records) + 1))
    return records


def losses_of(reports: list[dict]) -> list[float]:
    return [values["losses/qf_loss"] for values in reports if "losses/qf_loss" in values]
