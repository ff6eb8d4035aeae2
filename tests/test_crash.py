"""What goes wrong on real machines: processes that are killed, disks that fill up, files that are damaged."""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from common.bus import Keys, RefusedError, Subscription, ask_bytes, open_client
from common.config import parse, resolve
from common.contract import fetch_contract
from common.delivery import Sender, Spool, pack_header
from common.messages import Acknowledgement, Episode, Origin, Stat, Version, decode, encode
from deploy.screen import Monitor
from learner.checkpoint import RunDirectory
from learner.log import EpisodeLog, Record
from tests.helpers import free_endpoint, tiny_episode, wait_until
from tests.test_system import SMOKE, Processes

CAPACITY = 100_000
"""Transitions in the replay, more than any of these runs makes: all that is in the log must be in it."""
SETTINGS = (*SMOKE, "--set", f"replay.capacity={CAPACITY}", "--set", "learner.checkpoint_seconds=0.5")
RESUMED = re.compile(
    r"resumed with (\d+) episodes \((\d+) steps\), (\d+) transitions in the replay, (\d+) up"
)
Id = tuple[str, str, int]
"""Actor, boot and number of an episode."""


class Crew(Processes):
    """Learner, curriculum and two actors of one run, started by hand, with what they say on the bus."""

    def __init__(self, folder: Path, run: Path | None = None) -> None:
        super().__init__(folder)
        self.run, self.spool, self.endpoint = run or folder / "run", folder / "spool", free_endpoint()
        self.settings: tuple[str, ...] = ()
        self.inside: list[str] = []
        """What to put before the learner's command, to run it in another namespace."""
        self.reports: dict[int, list[dict]] = defaultdict(list)
        """Figures of each life of the learner, by process id."""
        self.versions: list[Version] = []
        self.made: Counter[str] = Counter()
        """Episodes that were made in the actors' former lives, as last told."""

    def start_learner(self) -> int:
        """Starts it, or starts it again with the same command; its process id."""
        command = ["learner", "--run", str(self.run), "--listen", self.endpoint, *SETTINGS, *self.settings]
        with (self.folder / "learner.txt").open("ab") as output:
            self.running["learner"] = subprocess.Popen(
                [*self.inside, sys.executable, "-m", "deploy.cli.main", *command],
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        return self.running["learner"].pid

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
        with open_client(self.endpoint, patience=60) as session:
            self.monitor = Monitor(session, keys)
            self._heard = (
                Subscription(session, keys.version, Version, self.versions.append),
                Subscription(
                    session,
                    keys.stat("learner", "*"),
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
            self.monitor.stats.pop(("actor", name), None)

    def log(self) -> list[Record]:
        """What is in the log now, read from a copy."""
        copy = self.folder / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.run / "log", copy)
        return list(EpisodeLog(copy, CAPACITY).restore())

    def waiting(self) -> set[Id]:
        """Episodes in the spools of the actors, from all their lives."""
        files = self.spool.glob("*/learner/*/*.msg")
        return {(file.parts[-4], file.parts[-2], int(file.stem)) for file in files}

    def newest_checkpoint(self) -> Path | None:
        """Of those that are whole."""
        found = sorted(p for p in (self.run / "checkpoints").glob("*") if p.suffix != ".part")
        return found[-1] if found else None


@pytest.fixture
def crew(tmp_path: Path) -> Iterator[Crew]:
    found = Crew(tmp_path)
    yield found
    found.close()


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
        assert told <= sum(len(those) for (actor, _), those in numbers.items() if actor == name)
        assert told > 0
    steps = np.cumsum([r.length for r in records])
    assert [r.env_steps for r in records] == list(steps)
    assert [r.episodes for r in records] == list(range(1, len(records) + 1))
    return records


def losses_of(reports: list[dict]) -> list[float]:
    return [values["losses/qf_loss"] for values in reports if "losses/qf_loss" in values]


def kill_the_learner_and_look(crew: Crew, moment: float) -> None:
    """SIGKILL after so many seconds; then the same command must find all that was acknowledged."""
    time.sleep(moment)
    crew.kill("learner")
    before = losses_of([report for life in crew.reports.values() for report in life])[-8:]
    acknowledged = sum(crew.of_actors("acknowledged"))
    epoch = max(version.epoch for version in crew.versions)
    records, newest = crew.log(), crew.newest_checkpoint()
    assert len(set(ids(records))) == len(records) >= acknowledged
    said = len(RESUMED.findall(crew.words("learner")))

    new = crew.start_learner()
    crew.wait_for_training()
    episodes, steps, transitions, updates = map(int, RESUMED.findall(crew.words("learner"))[said])
    assert episodes == len(records)
    assert steps == transitions == sum(r.length for r in records)
    assert newest is not None
    assert updates == int(newest.name.partition("-")[2]) > 0
    # weights: the new life's are newer than all before, and the actors drive with them
    assert max(version.epoch for version in crew.versions) > epoch
    wait_until(
        lambda: (
            set(crew.of_actors("weights"))
            <= {v.counter for v in list(crew.versions) if v.epoch > epoch and v.counter >= updates}
        ),
        20,
        "the new weights at both actors",
    )
    # The reported loss is a mean of the last 200 updates, on prioritised batches of 16 from a replay that
    # grows: from one report to the next it moves by a factor of up to three. Ten on both sides leaves room
    # for that, and for a mean of 20. Critics that do not fit their targets or moments, rewards that are read
    # wrongly or weights of zero leave it; whether weights are the saved ones, the counts above say better.
    wait_until(lambda: crew.figure("updates") >= updates + 20, 20, "twenty updates")
    first = next(losses_of([r])[0] for r in crew.reports[new] if r["updates"] >= updates + 20)
    assert min(before) / 10 <= first <= 10 * max(before), f"{first} after {before}"


def learner_is_killed(crew: Crew, times: int, seed: int) -> None:
    dice = random.Random(seed)
    # the actors stop when so much waits, and leave the learner the processors for its start
    crew.settings = ("--set", "actor.spool_megabytes=0.2")
    crew.start_learner()
    for name in ("curriculum", "a", "b"):
        crew.start_other(name)
    with crew.listening():
        wait_until(lambda: crew.figure("updates") > 400, 90, "losses that have settled")
        for _ in range(times):
            kill_the_learner_and_look(crew, dice.uniform(0.5, 4.0))
        wait_until(lambda: max(crew.of_actors("spool")) <= 2, 30, "delivery of what had waited")
        for name in "ab":
            assert crew.stop(name) == 0, crew.words(name)
        wait_until(lambda: crew.figure("replay") == crew.figure("env_steps"), 10, "all in the replay")
        assert crew.figure("refused") == 0
        told = sum(crew.of_actors("acknowledged"))
        for name in ("curriculum", "learner"):
            assert crew.stop(name) == 0, crew.words(name)
        records = assert_nothing_is_lost_and_nothing_there_twice(crew)
        assert len(records) >= told > 0
        assert json.loads((crew.run / "summary.json").read_text())["episodes"] == len(records)
        assert crew.figure("replay") <= sum(r.length for r in records)
    in_order = zip(crew.versions, crew.versions[1:], strict=False)
    assert not any(later < earlier for earlier, later in in_order), "weights ran backwards"
    driven = {decode(Episode, r.payload).first_version.epoch for r in records}
    assert driven >= set(range(1, times + 2)), "episodes were driven with the weights of every life"
    assert "Traceback" not in crew.words("learner")
    assert not list(crew.run.rglob("*.part"))


@pytest.mark.timeout(480)
def test_learner_that_is_killed_three_times_loses_nothing_and_learns_on(crew):
    learner_is_killed(crew, 3, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_learner_that_is_killed_twenty_times_loses_nothing_and_learns_on(crew):
    learner_is_killed(crew, 20, seed=2)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_whoever_is_killed_whenever_in_the_end_everything_is_acknowledged(crew):
    dice = random.Random(3)
    others = ("curriculum", "a", "b")
    crew.start_learner()
    for name in others:
        crew.start_other(name)
    with crew.listening() as session:
        wait_until(lambda: crew.figure("updates") > 20, 90, "training")
        for victim in dice.sample((*others, "learner") * 4, 16):
            time.sleep(dice.uniform(0.1, 4.0))  # also while it or another one is still starting
            crew.kill(victim)
            if victim == "learner":
                crew.start_learner()
            else:
                crew.start_other(victim)
        crew.wait_for_training()
        for name in "ab":
            wait_until(lambda n=name: crew.monitor.of("actor").get(n, {}).get("acknowledged", 0), 60, name)
        wait_until(lambda: max(crew.of_actors("spool")) <= 2, 60, "delivery of what had waited")
        wait_until(lambda: crew.monitor.curriculum.get("outcomes", 0) > 0, 30, "outcomes at the curriculum")
        for name in "ab":
            assert crew.stop(name) == 0, crew.words(name)
        # what an actor had no time for any more goes out in its next life; here one without worlds
        left = [
            Spool(folder, 1e9)
            for name in "ab"
            for folder in sorted((crew.spool / name).iterdir())
            if folder.is_dir()
        ]
        assert len(left) == 4
        for spool in left:
            assert Sender(session, spool, spool.folder.parent.name, "last").close(patience=20) == 0
        assert list(crew.spool.rglob("*.msg")) == list(crew.spool.rglob("*.bad")) == []
        for name in ("curriculum", "learner"):
            assert crew.stop(name) == 0, crew.words(name)
        records = assert_nothing_is_lost_and_nothing_there_twice(crew)
        assert crew.monitor.curriculum["refused"] == 0
    boots = {(actor, boot) for actor, boot, _ in ids(records)}
    assert len(boots) >= 4, "episodes of several lives of both actors"
    for name in ("learner", *others):
        assert "Traceback" not in crew.words(name), crew.words(name)


class Disk:
    """A small file system, seen only from within its namespace; `outside` is the way in for a test."""

    def __init__(self, folder: Path, megabytes: int) -> None:
        folder.mkdir()
        script = 'mount -t tmpfs -o size="$1"m tmpfs "$2" && echo up && exec sleep 900'
        try:
            self._holder = subprocess.Popen(
                ["unshare", "--map-root-user", "--mount", "sh", "-c", script, "sh", str(megabytes), folder],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        except FileNotFoundError:
            pytest.skip("there is no command unshare to make a file system of its own with")
        assert self._holder.stdout is not None and self._holder.stderr is not None
        if self._holder.stdout.readline() != "up\n":
            pytest.skip(f"no small file system can be had here: {self._holder.stderr.read().strip()}")
        self.folder = folder
        self.outside = Path(f"/proc/{self._holder.pid}/root{folder}")
        target = ["--target", str(self._holder.pid)]
        self.inside = ["nsenter", *target, "--user", "--mount", "--preserve-credentials", "--wd"]

    def make_read_only(self) -> None:
        subprocess.run([*self.inside, "mount", "-o", "remount,ro", self.folder], check=True)

    def fill(self) -> None:
        """To the last byte."""
        with (self.outside / "filler").open("ab", buffering=0) as file:
            for size in (2**20, 2**12, 1):
                while True:
                    try:
                        if file.write(bytes(size)) != size:
                            break
                    except OSError:
                        break
        assert shutil.disk_usage(self.outside).free == 0

    def make_room(self) -> None:
        (self.outside / "filler").unlink()

    def close(self) -> None:
        self._holder.kill()
        self._holder.communicate()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    found = Disk(tmp_path / "disk", 48)
    yield found
    found.close()


COMPLAINT = re.compile(r"^(\S+ \S+) ERROR .*cannot write .*$", re.MULTILINE)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_disk_that_fills_up_holds_the_actors_back_and_loses_nothing(tmp_path, disk):
    crew = Crew(tmp_path, run=disk.outside / "run")
    crew.run = disk.folder / "run"  # as the learner in its namespace knows it
    crew.inside = disk.inside
    # so many samples are owed that learning goes on without new episodes
    crew.settings = ("--set", "replay.error_buffer=1e9", "--set", "learner.snapshot_steps=1000000")
    try:
        crew.start_learner()
        wait_until((disk.outside / "run" / "run.json").exists, 60, "the run")
        (tmp_path / "run").mkdir()  # the curriculum's part of it, on a disk with room
        for name in ("config.toml", "run.json", "encoder.safetensors"):
            shutil.copy(disk.outside / "run" / name, tmp_path / "run")
        for name in ("curriculum", "a", "b"):
            crew.start_other(name)
        with crew.listening():
            disk_fills_up(crew, disk)
    finally:
        crew.close()


def disk_fills_up(crew: Crew, disk: Disk) -> None:
    crew.wait_for_training(90)
    checkpoints = disk.outside / "run" / "checkpoints"
    wait_until(lambda: list(checkpoints.glob("0*[0-9]")), 10, "a checkpoint")

    disk.fill()
    filled = time.monotonic()
    wait_until(lambda: COMPLAINT.search(crew.words("learner")), 15, "a complaint")
    # it goes on training, and the actors stop driving instead of filling their own disks
    updates = crew.figure("updates")
    wait_until(lambda: crew.figure("updates") > updates + 50, 20, "training with a full disk")
    wait_until(lambda: min(crew.of_actors("waiting_s")) > 0, 20, "actors that wait")
    driven, heard = crew.of_actors("env_steps"), len(crew.reports[crew.running["learner"].pid])
    wait_until(lambda: len(crew.reports[crew.running["learner"].pid]) >= heard + 3, 20, "three seconds")
    assert crew.of_actors("env_steps") == driven
    assert max(crew.of_actors("spool")) < 20
    wait_until(lambda: crew.figure("failed_writes") >= 12, 30, "many failures")
    seconds = time.monotonic() - filled
    assert crew.running["learner"].poll() is None
    words = crew.words("learner")
    complaints = [found[0] for found in COMPLAINT.finditer(words)]
    assert 1 <= len(complaints) <= 1 + seconds / 4
    for complaint in complaints:
        assert str(disk.folder / "run") in complaint
        assert "No space left on device" in complaint
    assert "Traceback" not in words

    # with room again all goes on, and what was held back arrives
    sent = crew.of_actors("acknowledged")
    episodes = crew.figure("episodes")
    whole = {path.name for path in checkpoints.glob("0*[0-9]")}
    disk.make_room()
    wait_until(lambda: crew.figure("episodes") > episodes + 10, 20, "delivery with room again")
    wait_until(
        lambda: all(now > then for now, then in zip(crew.of_actors("acknowledged"), sent, strict=True)),
        20,
        "delivery by both",
    )
    wait_until(lambda: {path.name for path in checkpoints.glob("0*[0-9]")} - whole, 20, "a new checkpoint")

    # killed while the disk is full: the last good checkpoint and all episodes are found again
    disk.fill()
    failed = crew.figure("failed_writes")
    wait_until(lambda: crew.figure("failed_writes") > failed + 3, 20, "failures again")
    crew.kill("learner")
    newest = sorted(path.name for path in checkpoints.glob("0*[0-9]"))[-1]
    said = len(crew.words("learner"))
    crew.start_learner()
    assert crew.running["learner"].wait(120) == 2, "it cannot even count its start"
    assert_one_sentence(crew.words("learner")[said:], str(disk.folder / "run"), "No space left on device")
    disk.make_room()
    crew.start_learner()
    crew.wait_for_training()
    assert int(RESUMED.findall(crew.words("learner"))[-1][3]) == int(newest.partition("-")[2]) > 0
    wait_until(lambda: max(crew.of_actors("spool")) <= 2, 30, "delivery of what had waited")
    for name in ("a", "b", "curriculum", "learner"):
        assert crew.stop(name) == 0, crew.words(name)
    crew.run = disk.outside / "run"
    records = assert_nothing_is_lost_and_nothing_there_twice(crew)
    assert len(records) >= sum(crew.of_actors("acknowledged"))
    assert "Traceback" not in crew.words("learner")


def assert_one_sentence(words: str, *parts: str) -> None:
    """What a command says that refuses: one line after the usual ones of its log, and no traceback."""
    lines = [line for line in words.splitlines() if not re.match(r"\d{4}-\d\d-\d\d .* INFO ", line)]
    assert len(lines) == 1, words
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0]


@pytest.mark.parametrize(
    ("reason", "existing"),
    [
        pytest.param("Read-only file system", False, id="read-only, new run"),
        pytest.param("Read-only file system", True, id="read-only, existing run", marks=pytest.mark.slow),
        pytest.param("No space left on device", False, id="full, new run", marks=pytest.mark.slow),
        pytest.param("No space left on device", True, id="full, existing run", marks=pytest.mark.slow),
    ],
)
def test_run_directory_that_cannot_be_written_is_named_in_one_sentence(disk, reason, existing):
    run = disk.folder / "run"
    command = [*disk.inside, sys.executable, "-m", "deploy.cli.main", "learner", "--run", str(run)]
    if existing:
        RunDirectory(disk.outside / "run", resolve("smoke"))
    else:
        command += ["--preset", "smoke"]
    if reason.startswith("Read"):
        disk.make_read_only()
    else:
        disk.fill()
    before = {path: path.stat().st_size for path in sorted((disk.outside / "run").glob("*.*"))}
    done = subprocess.run(
        [*command, "--listen", free_endpoint()], capture_output=True, text=True, timeout=120
    )
    assert_one_sentence(done.stderr, str(run), reason)
    assert done.returncode == 2
    assert (
        before.items() <= {path: path.stat().st_size for path in (disk.outside / "run").glob("*.*")}.items()
    )


@pytest.mark.slow
def test_learner_that_is_stopped_with_a_full_disk_says_so_and_resumes_from_what_was_whole(tmp_path, disk):
    crew = Crew(tmp_path, run=disk.folder / "run")
    crew.inside, crew.settings = disk.inside, ("--set", "learner.checkpoint_seconds=2")
    try:
        crew.start_learner()
        with crew.listening() as session:
            feeder = Feeder(session)
            wait_until(
                lambda: (
                    feeder.deliver(feeder.episode(feeder.sent), feeder.sent) and crew.figure("updates") > 20
                ),
                30,
                "updates",
            )
            checkpoints = disk.outside / "run" / "checkpoints"
            wait_until(lambda: any(int(p.name[6:]) for p in checkpoints.glob("0*[0-9]")), 20, "a checkpoint")
            newest = sorted(checkpoints.glob("0*[0-9]"))[-1].name
            disk.fill()
            with pytest.raises(RefusedError, match=r"^BUSY$"):
                feeder.deliver(feeder.episode(feeder.sent), feeder.sent)
        assert crew.stop("learner") == 1
        words = crew.words("learner")
        assert "Traceback" not in words
        last = words.splitlines()[-1]
        assert last.startswith("error: ") and str(crew.run) in last and "No space left on device" in last
        disk.make_room()
        said = len(words)
        crew.start_learner()
        found = wait_until(lambda: RESUMED.findall(crew.words("learner")[said:]), 60, "resuming")
        episodes, _, _, updates = map(int, found[0])
        assert episodes == feeder.sent
        assert updates >= int(newest[6:]) > 0
        assert crew.stop("learner") == 0
    finally:
        crew.close()


class Feeder:
    """Delivers random episodes to a learner in place of an actor."""

    def __init__(self, session: zenoh.Session) -> None:
        contract = fetch_contract(session, patience=30)
        self.config, self.digest = parse(contract.config), contract.digest
        self._session, self._key, self.sent = session, Keys(contract.run).trajectory, 0

    def episode(self, seed: int, steps: int = 20) -> Episode:
        return tiny_episode(self.config, steps, seed, digest=self.digest)

    def deliver(self, episode: Episode, seq: int) -> Acknowledgement:
        payload = encode(episode)
        header = pack_header(Origin(actor="feeder", boot="b1", seq=seq), payload)
        answer = decode(Acknowledgement, ask_bytes(self._session, self._key, payload, header))
        self.sent += 1
        return answer


def checkpointed(crew: Crew) -> tuple[list[Path], int]:
    """Whole checkpoints, oldest first, of a learner that was fed and stopped; how many episodes it got."""
    crew.start_learner()
    with crew.listening() as session:
        feeder = Feeder(session)

        def kept() -> list[Path]:
            return sorted((crew.run / "checkpoints").glob("0*[0-9]"))

        def fed() -> list[Path]:
            """Checkpoints with updates, while episodes allow for more updates."""
            assert not feeder.deliver(feeder.episode(feeder.sent), feeder.sent).duplicate
            return [path for path in kept() if not path.name.endswith("-000000000")]

        wait_until(lambda: len(fed()) >= 2, 60, "two checkpoints")
        updates = crew.figure("updates")
        wait_until(lambda: fed() and crew.figure("updates") > updates, 60, "more updates")
    assert crew.stop("learner") == 0
    return kept(), feeder.sent


@pytest.mark.parametrize(
    "file",
    [
        "networks",
        pytest.param("optimizers", marks=pytest.mark.slow),
        pytest.param("priorities", marks=pytest.mark.slow),
    ],
)
def test_checkpoint_cut_in_half_is_named_and_the_one_before_it_resumed(crew, file):
    (*_, before, newest), count = checkpointed(crew)
    cut = newest / f"{file}.safetensors"
    os.truncate(cut, cut.stat().st_size // 2)
    said = len(crew.words("learner"))
    crew.start_learner()
    assert crew.running["learner"].wait(120) == 2
    assert_one_sentence(crew.words("learner")[said:], str(newest))

    shutil.rmtree(newest)
    crew.start_learner()
    episodes, steps, transitions, updates = map(
        int, wait_until(lambda: RESUMED.findall(crew.words("learner")[said:]), 60, "resuming")[0]
    )
    assert (episodes, steps, transitions) == (count, 20 * count, 20 * count)
    assert updates == int(before.name.partition("-")[2]) > 0
    assert updates < int(newest.name.partition("-")[2])
    with crew.listening() as session:
        feeder = Feeder(session)
        assert feeder.deliver(feeder.episode(0), count - 1).duplicate
        for seq in range(count, count + 10):
            feeder.deliver(feeder.episode(seq), seq)
        wait_until(lambda: crew.figure("updates") > updates, 60, "more updates")
    assert crew.stop("learner") == 0


@pytest.mark.timeout(120)
def test_episode_with_numbers_that_are_none_is_refused_and_changes_nothing(crew):
    crew.start_learner()
    with crew.listening() as session:
        feeder = Feeder(session)
        for seq in range(10):
            feeder.deliver(feeder.episode(seq), seq)
        wait_until(lambda: crew.figure("episodes") == 10, 20, "ten episodes")
        segment = crew.run / "log" / "00000001.log"
        size = segment.stat().st_size
        refused = 0
        for name in ("reward", "visual", "lidar", "action"):
            for bad in (np.nan, np.inf, -np.inf):
                good = feeder.episode(10)
                column = getattr(good, name).copy()
                assert column.dtype.kind == "f", "codes of the frozen encoder"
                column.flat[column.size // 2] = bad
                with pytest.raises(RefusedError, match=rf"{name}.*NaN or infinity"):
                    feeder.deliver(good.model_copy(update={name: column}), 10)
                refused += 1
        assert segment.stat().st_size == size
        wait_until(lambda: crew.figure("refused") == refused, 10, "the count of refusals")
        assert (crew.figure("episodes"), crew.figure("env_steps"), crew.figure("replay")) == (10, 200, 200)
        # nor is its number used up
        assert not feeder.deliver(feeder.episode(10), 10).duplicate
        assert feeder.deliver(feeder.episode(10), 10).duplicate
        for seq in range(11, 20):
            feeder.deliver(feeder.episode(seq), seq)
        updates = crew.figure("updates")
        wait_until(lambda: crew.figure("updates") > updates, 20, "updates")
        assert np.isfinite(losses_of(crew.reports[crew.running["learner"].pid])).all()
    assert crew.stop("learner") == 0
    assert ids(crew.log()) == [("feeder", "b1", seq) for seq in range(20)]
