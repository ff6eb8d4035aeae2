import signal
import subprocess
import sys
from pathlib import Path

import pytest

from common.bus import Keys, Subscription
from common.messages import Stat
from common.telemetry import Reporter
from tests.helpers import wait_until

SCRIPT = """
import sys, time
from common.bus import open_hub
from common.telemetry import exit_on_signals
exit_on_signals()
try:
    with open_hub(sys.argv[1]):
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
    rest, _ = process.communicate(timeout=20)
    assert rest == b"closed\n"
    assert process.returncode == 0


def test_figures_are_due_at_once_and_then_not_again_within_the_second(hub, client):
    got: list[Stat] = []
    keys = Keys("run-1")
    subscriber = Subscription(hub, keys.stat("*", "*"), Stat, got.append)
    reporter = Reporter(client, keys, "learner", "main")
    assert reporter.due
    reporter.report({"updates": 0})
    assert not reporter.due

    def arrived() -> list[Stat]:
        reporter.report({"updates": 12, "rate": 3.5})
        return [stat for stat in got if stat.values.get("updates") == 12]

    stat = wait_until(arrived)[0]
    assert (stat.role, stat.id, stat.values) == ("learner", "main", {"updates": 12, "rate": 3.5})
    del subscriber
