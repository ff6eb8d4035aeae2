import importlib.util
import os
import re
import shutil
import socket
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from common.bus import EVERYBODY, Keys, Member, Subscription
from common.messages import PROTOCOL, Stat
from common.telemetry import Quantiles, Reporter
from common.version import PACKAGES, code_version
from tests.helpers import wait_until


def test_figures_are_due_at_once_and_then_not_again_within_the_second(hub, client):
    got: list[Stat] = []
    keys = Keys("run-1")
    subscriber = Subscription(hub, keys.stat(EVERYBODY), Stat, got.append)
    reporter = Reporter(client, keys, Member("learner", "local", "main"))
    assert reporter.due
    reporter.report({"updates": 0})
    assert not reporter.due

    def arrived() -> list[Stat]:
        reporter.report({"updates": 12, "rate": 3.5})
        return [stat for stat in got if stat.values.get("updates") == 12]

    stat = wait_until(arrived)[0]
    assert (stat.role, stat.group, stat.name) == ("learner", "local", "main")
    assert stat.values == {"updates": 12, "rate": 3.5}
    del subscriber


def test_a_process_tells_with_its_figures_where_it_runs_since_when_and_with_which_code(hub, client):
    got: list[Stat] = []
    keys, began = Keys("run-1"), time.time()
    subscriber = Subscription(hub, keys.stat(EVERYBODY), Stat, got.append)
    reporter = Reporter(client, keys, Member("actor", "host-b", "a"))
    made = time.time()
    time.sleep(0.05)
    first = wait_until(lambda: (reporter.report({}), got)[1])[0]
    assert (first.host, first.pid, first.protocol) == (socket.gethostname(), os.getpid(), PROTOCOL)
    assert first.code == code_version()
    assert began <= first.since <= made
    reporter.report({"steps": 1})
    wait_until(lambda: got[-1].values)
    assert got[-1] == first.model_copy(update={"values": {"steps": 1}}), "the rest stays as it was"
    del subscriber


def test_quantiles_are_those_of_the_last_500_values():
    quantiles, rng = Quantiles(), np.random.default_rng(0)
    assert quantiles.figures("x", "ms") == {}
    quantiles.add(3.14159)
    assert quantiles.figures("x", "ms") == {"x_p50_ms": 3.14, "x_p99_ms": 3.14}
    values = rng.exponential(10, 1700)
    for count, value in enumerate(values, 1):
        quantiles.add(value)
        if count in (10, 499, 500, 501, 1700):
            # the value 3.14 is still among the last 500 at 10 and 499
            last = np.array([3.14159, *values[:count]])[-500:]
            found = quantiles.figures("episode", "s")
            assert found.keys() == {"episode_p50_s", "episode_p99_s"}
            assert found["episode_p50_s"] == pytest.approx(np.median(last), abs=0.0051)
            assert found["episode_p99_s"] == pytest.approx(np.quantile(last, 0.99), abs=0.0051)
            assert all(type(value) is float for value in found.values()), "as a Stat takes them"


def test_one_slow_value_in_a_hundred_does_not_move_the_median_and_two_move_the_99th_percentile():
    quantiles = Quantiles()
    for i in range(100):
        quantiles.add(1000.0 if i in (20, 70) else 1.0)
    figures = quantiles.figures("x", "ms")
    assert figures["x_p50_ms"] == 1.0
    assert figures["x_p99_ms"] > 900


def copied(folder: Path) -> Path:
    """The packages' source, without what running it leaves behind."""
    root = Path(__file__).parents[1]
    for package in PACKAGES:
        shutil.copytree(root / package, folder / package, ignore=lambda *_: {"__pycache__"})
    return folder


def version_in(folder: Path) -> str:
    """What the code in this folder says of itself."""
    spec = importlib.util.spec_from_file_location("version_there", folder / "common" / "version.py")
    assert spec is not None and spec.loader is not None
    there = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(there)
    found: str = there.code_version()
    return found


def test_version_is_that_of_the_package_with_a_hash_of_the_source():
    found = code_version()
    assert re.fullmatch(r"[0-9a-z.+]+\+[0-9a-f]{8}", found)
    assert found.startswith(f"{version('navaclq')}+")
    assert len(found) <= 64, "as a Stat takes it"


def test_hosts_with_the_same_source_say_the_same_version_and_one_line_makes_another(tmp_path):
    here, there = copied(tmp_path / "here"), copied(tmp_path / "there")
    same = version_in(here)
    assert version_in(there) == same == code_version()
    (there / "common" / "__pycache__").mkdir()
    (there / "common" / "__pycache__" / "bus.cpython-311.pyc").write_bytes(b"left behind")
    (there / "common" / "notes.txt").write_text("not code")
    assert version_in(there) == same
    found = {same}
    for package in PACKAGES:
        file = sorted((there / package).rglob("*.py"))[-1]
        file.write_text(file.read_text() + "\n# one line\n")
        found.add(version_in(there))
    (there / "actor" / "rollout.py").rename(there / "actor" / "rollouts.py")
    found.add(version_in(there))
    assert len(found) == len(PACKAGES) + 2
    assert {words.rpartition("+")[0] for words in found} == {same.rpartition("+")[0]}
