"""The examples run as their docstrings say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_another_librarys_sac_trains_on_the_environment():
    done = subprocess.run(
        [sys.executable, EXAMPLES / "stable_baselines3_sac.py", "--steps", "2000", "--seed", "1"],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},  # threads that wait for each other take ten times as long
    )
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    found = re.fullmatch(r"10 episodes: mean reward (-?\d+\.\d\d), success rate ([01]\.\d\d)", last)
    assert found, last
    assert -26 < float(found[1]) < 10  # 100 slow steps and a collision at worst; a docking brings 10
