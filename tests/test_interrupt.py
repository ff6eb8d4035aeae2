"""Ctrl-C in every command, at every stage of its start too: it ends soon, and leaves no process behind."""

import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.crew import SMOKE
from tests.helpers import PATIENCE, free_endpoint, heed_ctrl_c

SOON = 5.0
"""Seconds until everything has ended."""
MARK = "NAVACLQ_TEST_MARK"
COMMANDS = {
    "learner": ("learner", "--run", "{run}", "--listen", "{hub}", *SMOKE),
    "actor that waits": ("actor", "--connect", "{hub}"),
    "two actors that wait": ("actor", "--connect", "{hub}", "--count", "2"),
    "curriculum that waits": ("curriculum", "serve", "--connect", "{hub}"),
    "curriculum alone": ("curriculum", "serve", "--listen", "{hub}", "--preset", "smoke"),
    "curriculum query": ("curriculum", "query", "--connect", "{hub}", "--cell", "0", "--timeout", "60"),
    "router": ("router", "--listen", "{hub}"),
    "router that waits": ("router", "--listen", "{own}", "--connect", "{hub}"),
    "top that waits": ("top", "--connect", "{hub}"),
    "train": ("train", "--run", "{run}", *SMOKE),
    "pretrain": ("pretrain", "--run", "{run}", "--preset", "smoke"),
    "evaluate": ("evaluate", "shipped", "--suite", "train", "--work", "{run}.db"),
    "world check": ("world", "check", "--tasks", "10000"),
    "bench sim": ("bench", "sim", "--rounds", "50"),
    "bench learner": ("bench", "learner"),
    "bench curriculum": ("bench", "curriculum"),
    "doctor": ("doctor", "--connect", "{hub}"),
}


def marked(mark: str) -> list[str]:
    """Command lines of the processes that were started, directly or not, with this mark."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdecimal() and f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:  # it has ended meanwhile, or is being started
            continue
    return [command for command in found if command]


@pytest.fixture
def mark() -> Iterator[str]:
    """Processes with it are ended after the test, whatever happened."""
    own = uuid.uuid4().hex
    yield own
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdecimal() and own.encode() in (folder / "environ").read_bytes():
                os.kill(int(folder.name), signal.SIGKILL)
        except OSError:
            continue


def interrupt(name: str, moment: float, folder: Path, mark: str, number: int = signal.SIGINT) -> None:
    """Ctrl-C, or another signal, so many seconds after the start."""
    words = {"run": folder / uuid.uuid4().hex, "hub": free_endpoint(), "own": free_endpoint()}
    output = folder / "output.txt"
    with output.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "deploy.cli", *(part.format(**words) for part in COMMANDS[name])],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
            preexec_fn=heed_ctrl_c,
            env={**os.environ, MARK: mark, "HOME": str(folder)},
        )
    time.sleep(moment)
    early, began = process.poll(), time.monotonic()
    if early is None:
        os.killpg(process.pid, number)  # as a terminal does: to all that have not left its group
        time.sleep(0.5)
        if b"Exception ignored" in output.read_bytes():
            # the interpreter loses it in its own imports, before any of our lines runs; people press it again
            os.killpg(process.pid, number)
    try:
        process.wait(began + SOON * PATIENCE - time.monotonic())
    except subprocess.TimeoutExpired:
        pytest.fail(
            f"{name} still runs {SOON * PATIENCE} s after Ctrl-C at {moment:.2f} s: {output.read_text()}"
        )
    while left := marked(mark):  # a helper of multiprocessing ends just after those that it serves
        late = time.monotonic() - began > SOON * PATIENCE
        assert not late, f"{name} left processes behind after Ctrl-C at {moment:.2f} s: {left}"
        time.sleep(0.05)
    text = output.read_text()
    if early is None and "Traceback" in text:
        # the interpreter itself may be interrupted before any of our lines run
        assert "KeyboardInterrupt" in text and "deploy/cli" not in text, text


@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_ends_a_command_and_all_its_processes(name, tmp_path, mark):
    dice = random.Random(name)
    for moment in (dice.uniform(0.0, 0.8), dice.uniform(0.8, 5.0)):
        interrupt(name, moment, tmp_path, mark)


def test_sigterm_ends_a_benchmark_and_all_its_processes(tmp_path, mark):
    for moment in (2.0, 4.0, 6.0):  # within these its learner is started, and waited for
        interrupt("bench curriculum", moment, tmp_path, mark, signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_at_every_moment_of_the_start_ends_a_command_and_all_its_processes(name, tmp_path, mark):
    for moment in (*(0.1 * i for i in range(15)), 2.0, 3.0, 4.0, 6.0, 8.0, 12.0):
        interrupt(name, moment, tmp_path, mark)
