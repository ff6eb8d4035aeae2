import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from common.signals import LEAVE, signals_held
from tests.helpers import PATIENCE, heed_ctrl_c

SCRIPT = """
import sys, time
from common.link import make_link, open_hub
from common.signals import exit_on_signals
exit_on_signals()
try:
    with open_hub(make_link(sys.argv[1])):
        print("up", flush=True)
        while True:  # a signal just before a long sleep would not end it
            time.sleep(0.05)
finally:
    print("closed", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_process_cleanly_with_its_session_closed(endpoint, number):
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, endpoint], stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"up\n"
    process.send_signal(number)
    rest, _ = process.communicate(timeout=20 * PATIENCE)
    assert rest == b"closed\n"
    assert process.returncode == 0


IN_A_CALLBACK = """
import signal, time, weakref
from common.signals import exit_on_signals
class Gone: pass
exit_on_signals()
gone = Gone()
callback = weakref.ref(gone, lambda _: signal.raise_signal(signal.SIGINT))
try:
    del gone
    print("ignored", flush=True)
    for _ in range(600):
        time.sleep(0.05)
finally:
    print("closed", flush=True)
"""


BEFORE = """
from common.signals import give_again
give_again(KeyboardInterrupt, signal.SIGINT)
"""


def test_a_signal_that_comes_where_python_ignores_exceptions_is_not_lost():
    """As in an import's callbacks, for the first seconds of every command."""

    def run(script):
        command, folder = [sys.executable, "-c", script], Path(__file__).parents[1]
        found = subprocess.run(command, capture_output=True, cwd=folder, timeout=25 * PATIENCE)
        return found.returncode, found.stdout, found.stderr

    assert run(IN_A_CALLBACK) == (0, b"ignored\nclosed\n", b"")
    code, out, err = run(IN_A_CALLBACK.replace("exit_on_signals()", BEFORE))
    assert (code, out) == (-signal.SIGINT, b"ignored\nclosed\n")
    assert err.endswith(b"KeyboardInterrupt\n")


SLEEPS = """
import signal, threading, time
from common.signals import stop_on_signals
stop = stop_on_signals()
began = time.monotonic()
assert not stop.wait(0.2) and not stop.is_set()
assert time.monotonic() - began >= 0.2
threading.Timer(0.2, signal.raise_signal, [signal.SIGTERM]).start()
print(stop.wait(), stop.is_set(), stop.wait(1000))
"""


def test_a_loop_that_sleeps_is_told_of_a_signal():
    command, folder = [sys.executable, "-c", SLEEPS], Path(__file__).parents[1]
    found = subprocess.run(command, capture_output=True, cwd=folder, timeout=25 * PATIENCE)
    assert (found.returncode, found.stdout, found.stderr) == (0, b"True True True\n", b"")


STARTS = """
import signal, subprocess, sys
from common.signals import exit_on_signals, signals_held
exit_on_signals()
children = []
try:
    with signals_held():
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        signal.raise_signal(int(sys.argv[1]))  # between the child's birth and the note of it
        children.append(child)
    print("not reached", flush=True)
finally:
    for child in children:
        child.kill()
        print("ended", child.wait(), flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_waits_until_a_child_that_is_being_started_is_known_to_its_parent(number):
    command, folder = [sys.executable, "-c", STARTS, str(int(number))], Path(__file__).parents[1]
    found = subprocess.run(command, capture_output=True, cwd=folder, timeout=25 * PATIENCE)
    assert (found.returncode, found.stdout, found.stderr) == (0, b"ended -9\n", b"")


def test_a_signal_that_was_ignored_stays_ignored_and_the_others_keep_their_handlers():
    def handler(number, frame):
        heard.append(number)

    heard: list[int] = []
    before = {number: signal.getsignal(number) for number in LEAVE}
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, handler)
        with signals_held():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            assert not heard
        assert heard == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        for number, old in before.items():
            signal.signal(number, old)


WORKERS = """
import multiprocessing, os, signal, sys, time
from common.signals import workers_start

def work(pipe):
    pipe.send(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    time.sleep(60)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    worker = context.Process(target=work, args=(theirs,), daemon=True)
    try:
        with workers_start():
            worker.start()
            theirs.close()
            os.killpg(0, signal.SIGINT)  # as a terminal does, while the worker still loads Python
    except KeyboardInterrupt:
        print("interrupted", signal.pthread_sigmask(signal.SIG_BLOCK, ()), ours.recv(), flush=True)
        worker.terminate()
        worker.join()
        print(worker.exitcode, flush=True)
"""


def test_ctrl_c_is_for_the_parent_alone_from_a_workers_first_moment_on(tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(WORKERS)
    found = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        timeout=25 * PATIENCE,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    blocked = {signal.SIGINT}
    assert (found.stdout, found.stderr) == (f"interrupted set() {blocked}\n{-signal.SIGTERM}\n", "")
