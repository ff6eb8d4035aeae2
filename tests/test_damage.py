"""Disks that fill up or cannot be written, files that are damaged, numbers that are none."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from common.bus import BUSY, Keys
from common.config import parse, resolve
from common.contract import fetch_contract
from common.messages import Episode, Receipt
from learner.checkpoint import RunDirectory
from tests.crew import RESUMED, Crew, assert_nothing_is_lost_and_nothing_there_twice, ids, losses_of
from tests.helpers import STORED, deliver, free_endpoint, reason, tiny_episode, wait_until


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
    command = [*disk.inside, sys.executable, "-m", "deploy.cli", "learner", "--run", str(run)]
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
            wait_until(lambda: feeder.feed() and crew.figure("updates") > 20, 30, "updates")
            checkpoints = disk.outside / "run" / "checkpoints"
            wait_until(lambda: any(int(p.name[6:]) for p in checkpoints.glob("0*[0-9]")), 20, "a checkpoint")
            newest = sorted(checkpoints.glob("0*[0-9]"))[-1].name
            disk.fill()
            assert reason(feeder.deliver(feeder.episode(feeder.sent), feeder.sent)) == BUSY
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
        self._session, self._channel, self.sent = session, Keys(contract.run).trajectory, 0

    def episode(self, seed: int, steps: int = 20) -> Episode:
        return tiny_episode(self.config, steps, seed, digest=self.digest)

    def deliver(self, episode: Episode, seq: int) -> Receipt:
        receipt = deliver(self._session, self._channel, episode, seq, address="local/feeder")
        self.sent += receipt == STORED
        return receipt

    def feed(self) -> bool:
        """The next episode, which must be taken."""
        assert self.deliver(self.episode(self.sent), self.sent) == STORED
        return True


def checkpointed(crew: Crew) -> tuple[list[Path], int]:
    """Whole checkpoints, oldest first, of a learner that was fed and stopped; how many episodes it got."""
    crew.start_learner()
    with crew.listening() as session:
        feeder = Feeder(session)

        def kept() -> list[Path]:
            return sorted((crew.run / "checkpoints").glob("0*[0-9]"))

        def fed() -> list[Path]:
            """Checkpoints with updates, while episodes allow for more updates."""
            feeder.feed()
            return [path for path in kept() if not path.name.endswith("-000000000")]

        wait_until(lambda: len(fed()) >= 2, 60, "two checkpoints")
        updates = crew.figure("updates")
        wait_until(lambda: fed() and crew.figure("updates") > updates, 60, "more updates")
        assert crew.figure("duplicates") == 0
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
        assert feeder.deliver(feeder.episode(0), count - 1) == STORED
        wait_until(lambda: crew.figure("duplicates") == 1, 20, "the count of duplicates")
        for seq in range(count, count + 10):
            assert feeder.deliver(feeder.episode(seq), seq) == STORED
        wait_until(lambda: crew.figure("updates") > updates, 60, "more updates")
        assert crew.figure("duplicates") == 1
    assert crew.stop("learner") == 0


@pytest.mark.timeout(120)
def test_episode_with_numbers_that_are_none_is_refused_and_changes_nothing(crew):
    crew.start_learner()
    with crew.listening() as session:
        feeder = Feeder(session)
        for _ in range(10):
            feeder.feed()
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
                found = reason(feeder.deliver(good.model_copy(update={name: column}), 10))
                assert re.search(rf"{name}.*NaN or infinity", found)
                refused += 1
        assert segment.stat().st_size == size
        wait_until(lambda: crew.figure("refused") == refused, 10, "the count of refusals")
        assert (crew.figure("episodes"), crew.figure("env_steps"), crew.figure("replay")) == (10, 200, 200)
        # nor is its number used up
        assert feeder.deliver(feeder.episode(10), 10) == STORED
        wait_until(lambda: crew.figure("episodes") == 11, 20, "the good one")
        assert crew.figure("duplicates") == 0
        assert feeder.deliver(feeder.episode(10), 10) == STORED
        wait_until(lambda: crew.figure("duplicates") == 1, 20, "the count of duplicates")
        assert crew.figure("episodes") == 11
        for seq in range(11, 20):
            assert feeder.deliver(feeder.episode(seq), seq) == STORED
        updates = crew.figure("updates")
        wait_until(lambda: crew.figure("updates") > updates, 20, "updates")
        assert np.isfinite(losses_of(crew.reports[crew.running["learner"].pid])).all()
    assert crew.stop("learner") == 0
    assert ids(crew.log()) == [("local/feeder", "b1", seq) for seq in range(20)]
