"""Somebody else's environments under a real curriculum, also while it is away, and the example's gain."""

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import zenoh

from common.bus import QueryServer
from common.config import resolve
from common.errors import NoAnswerError, UsageError
from common.link import make_link
from curriculum.gymnasium_wrapper import CurriculumWrapper
from curriculum.service import CurriculumService
from curriculum.task_space import AnyTask
from tests.crew import Processes
from tests.helpers import wait_until

EXAMPLES = Path(__file__).parents[1] / "examples"
TOML = EXAMPLES / "gymnasium_curriculum.toml"
OWN = {"distance": -1.0}


class Walk(gymnasium.Env):
    """Three steps of reward 1, at whose end it succeeded if the last action was 1; action 2 falls at once."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self) -> None:
        self.driven: list[dict[str, float]] = []
        self.closed = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        self.driven.append(options or OWN)
        return self._see(), {"own": 1}

    def step(self, action):
        self.left -= 1
        fell = bool(action == 2)
        return self._see(), 1.0, fell, self.left == 0, {"is_success": bool(action == 1)}

    def _see(self):
        return np.array([self.left], np.float32)

    def close(self):
        self.closed = True


@pytest.fixture
def started(hub: zenoh.Session) -> Iterator[Callable[..., CurriculumService]]:
    """Starts a curriculum for the example's parameters on the hub."""
    services: list[CurriculumService] = []

    def start(*settings: str) -> CurriculumService:
        config = resolve(file=TOML, overrides=settings)
        services.append(CurriculumService(hub, "standalone", config, None, None))
        return services[-1]

    yield start
    for service in services:
        service.close()


@pytest.fixture
def wrap(client: zenoh.Session, tmp_path: Path) -> Iterator[Callable[..., CurriculumWrapper]]:
    """Wraps a Walk, in a session that all share."""
    made: list[CurriculumWrapper] = []
    names = count()

    def make(curriculum: str | None = None, **settings) -> CurriculumWrapper:
        name = settings.pop("name", f"env-{next(names)}")
        made.append(CurriculumWrapper(Walk(), curriculum or client, tmp_path / "spool", name, **settings))
        return made[-1]

    yield make
    for env in made:
        env.close()


def drive(env: gymnasium.Env, *actions: int) -> dict:
    """An episode, or the beginning of one; returns what reset told."""
    _, told = env.reset()
    for action in actions:
        env.step(action)
    return told["curriculum"]


def outcomes(service: CurriculumService) -> list[tuple[AnyTask, bool]]:
    """Task and success of those on record."""
    return [(o.result.entry.task, o.result.success) for o in service.curriculum.database.outcomes()]


def delivered(env: CurriculumWrapper, number: int) -> None:
    wait_until(lambda: env.reports.sent == number, what=f"{number} outcomes acknowledged")


def test_task_goes_to_the_environment_and_its_outcome_back(started, wrap):
    service, env = started(), wrap()
    told = drive(env, 0, 0, 1)
    assert told.keys() == {"id", "category", "why", "f", "task"}
    assert told["category"] == "gate" and "favourable starts" in told["why"] and math.isnan(told["f"])
    assert env.unwrapped.driven == [told["task"]]
    assert told["task"].keys() == {"distance", "gap", "wind"}
    delivered(env, 1)
    assert outcomes(service) == [(told["task"], True)]
    failed = drive(env, 0, 0, 0)
    delivered(env, 2)
    assert outcomes(service)[1:] == [(failed["task"], False)]
    assert service.curriculum.database.count_leases() == 0
    assert (env.unserved, env.dropped, env.steps) == (0, 0, 6)


def test_prediction_is_told_as_soon_as_there_is_one(started, wrap):
    started("curriculum.gate.enabled=false")
    told = drive(wrap())
    assert told["category"] in ("easy", "frontier", "random")
    assert 0 <= told["f"] <= 1
    assert told["why"]


def test_options_of_the_caller_go_along_but_do_not_change_the_task(started, wrap):
    started()
    env = wrap()
    _, told = env.reset(options={"colour": 3, "gap": -5.0})
    assert env.unwrapped.driven == [{"colour": 3, **told["curriculum"]["task"]}]
    assert told["own"] == 1
    assert told["curriculum"]["task"]["gap"] > 0


def test_seed_goes_to_the_environment(started, wrap):
    started()
    env = wrap()
    env.reset(seed=7)
    first = env.unwrapped.np_random.random()
    env.reset(seed=7)
    assert env.unwrapped.np_random.random() == first


def test_an_end_is_reported_once_and_an_abandoned_episode_never(started, wrap):
    service, env = started(), wrap()
    drive(env, 0, 0)
    told = drive(env, 2)
    for _ in range(3):  # beyond the end
        env.step(1)
    drive(env, 0)
    last = drive(env, 0, 0, 1)
    delivered(env, 2)
    env.close()
    assert outcomes(service) == [(told["task"], False), (last["task"], True)]
    assert service.curriculum.outcomes == 2
    assert service.curriculum.database.count_leases() == 2


def test_success_may_be_a_function_of_the_episode(started, wrap):
    service, seen = started(), []

    def judge(info, terminated, total):
        seen.append((info["is_success"], terminated, total))
        return total > 2

    env = wrap(success=judge)
    drive(env, 1, 1, 0)
    drive(env, 0, 2)
    delivered(env, 2)
    assert seen == [(False, False, 3.0), (False, True, 2.0)]
    assert [success for _, success in outcomes(service)] == [True, False]


def test_environment_that_does_not_say_whether_it_succeeded_is_named(started, wrap, monkeypatch):
    started()
    env = wrap()
    env.reset()
    monkeypatch.setattr(
        Walk, "step", lambda self, action: (np.zeros(1, np.float32), 0.0, True, False, {"other": 1})
    )
    with pytest.raises(UsageError, match="info has no is_success"):
        env.step(0)


def test_without_a_curriculum_the_environment_resets_by_itself(wrap):
    env = wrap()
    for times in (1, 2):
        told = drive(env, 0, 0, 1)
        assert (told["id"], told["category"], told["task"]) == ("", "unserved", {})
        assert "nobody serves" in told["why"]
        assert env.unserved == times
    assert env.unwrapped.driven == [OWN, OWN]
    env.reset(options={"colour": 3})
    assert env.unwrapped.driven[-1] == {"colour": 3}
    assert len(env.reports.spool) == env.reports.sent == 0


def test_curriculum_that_does_not_answer_in_time_is_passed_over(hub, started, wrap):
    env, gate = wrap(timeout=0.2), []

    def hold(*_):
        gate.append(wait_until(lambda: released))
        return b""

    released: list[bool] = []
    silent = QueryServer(hub, "navaclq/standalone/curriculum/task", hold)
    told = drive(env)
    assert (told["category"], told["why"]) == ("unserved", "timeout")
    assert not gate, "it had not answered yet"
    released.append(True)
    wait_until(lambda: gate, what="the end of the silence")
    silent.close()
    started()
    assert drive(env)["category"] == "gate"
    assert env.unserved == 1


def test_curriculum_of_the_docking_world_has_nothing_for_others(started, wrap):
    started("curriculum.parameters=[]")
    env = wrap()
    told = drive(env, 0, 0, 1)
    assert told["category"] == "unserved"
    assert "curriculum.parameters" in told["why"]
    assert len(env.reports.spool) == 0


def test_outcomes_wait_for_a_curriculum_that_is_away(endpoint, tmp_path):
    """A service in a process of its own is killed, and comes back with what it knew."""
    processes = Processes(tmp_path)
    serve = ["curriculum", "serve", "--config", TOML, "--listen", endpoint, "--run", tmp_path / "run"]
    env = None
    try:
        processes.start("first", *serve)
        env = CurriculumWrapper(Walk(), endpoint, tmp_path / "spool", "env-0", run="run", patience=60.0)
        wait_until(lambda: drive(env)["category"] == "gate", timeout=30, what="a first task")
        unserved = env.unserved
        processes.running["first"].kill()
        processes.running["first"].wait()
        for action in (0, 0, 1):
            env.step(action)
        wait_until(lambda: drive(env, 0, 0, 1)["category"] == "unserved", what="its absence")
        assert env.unserved == unserved + 1
        waiting = len(env.reports.spool)
        assert waiting >= 1 and env.reports.sent == 0
        processes.start("second", *serve)
        delivered(env, waiting)
        assert len(env.reports.spool) == 0
        wait_until(lambda: drive(env)["category"] == "gate", timeout=30, what="tasks again")
        assert "1 of the last 1 did" in drive(env)["why"]
    finally:
        if env is not None:
            env.close()
        processes.close()


def test_close_delivers_what_waits_and_the_next_life_what_was_left(started, wrap, monkeypatch):
    monkeypatch.setattr("curriculum.gymnasium_wrapper.CLOSE_SECONDS", 0.1)
    service, env = started(), wrap(name="env")
    drive(env)
    for server in service._servers:
        server.close()
    for action in (0, 0, 1):
        env.step(action)
    env.close()
    assert env.unwrapped.closed
    assert len(env.reports.spool) == 1
    service._token.undeclare()
    fresh = started()
    monkeypatch.setattr("curriculum.gymnasium_wrapper.CLOSE_SECONDS", 20.0)
    second = wrap(name="env")
    drive(second, 0, 0, 0)
    second.close()
    assert second.reports.sent == 2
    assert [success for _, success in outcomes(fresh)] == [True, False]


def test_full_spool_drops_and_counts(started, wrap, monkeypatch):
    monkeypatch.setattr("curriculum.gymnasium_wrapper.SPOOL_BYTES", 0)
    service, env = started(), wrap()
    drive(env, 0, 0, 1)
    assert env.dropped == 1
    assert service.curriculum.outcomes == 0


def test_environments_of_a_vector_share_a_session(started, wrap):
    service = started()
    vector = gymnasium.vector.SyncVectorEnv([wrap, lambda: wrap(run="another"), wrap])
    _, told = vector.reset()
    said = told["curriculum"]
    assert list(said["category"]) == ["gate", "unserved", "gate"]
    assert list(said["task"]["_gap"]) == [True, False, True]
    assert said["f"].shape == (3,)
    for _ in range(7):  # the fourth and the eighth step would be resets
        vector.step(np.array([1, 1, 0]))
    wait_until(lambda: service.curriculum.outcomes == 4, what="two episodes of each that has a curriculum")
    assert sorted(success for _, success in outcomes(service)) == [False, False, True, True]
    vector.close()


def test_wrong_endpoint_and_name_are_said_at_once(endpoint, tmp_path):
    with pytest.raises(UsageError, match="no endpoint"):
        CurriculumWrapper(Walk(), "localhost", tmp_path, "env")
    with pytest.raises(UsageError, match="name 'a/b'"):
        CurriculumWrapper(Walk(), endpoint, tmp_path, "a/b")
    with pytest.raises(NoAnswerError, match="no hub answers"):
        CurriculumWrapper(Walk(), make_link(endpoint), tmp_path, "env", patience=0.0)


@pytest.mark.slow
def test_example_learns_faster_with_the_curriculum_than_from_uniform_tasks():
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / "gymnasium_curriculum.py"), "--seed", "1"],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("240 outcomes acknowledged, 0 resets unserved") == 2
    rows = re.findall(r"^ +(\d+)  (\d\.\d\d) +(\d\.\d\d)$", done.stdout, flags=re.MULTILINE)
    assert [int(row[0]) for row in rows] == [0, 60, 120, 180, 240]
    rnd, navacl = (np.mean([float(row[i]) for row in rows]) for i in (1, 2))
    assert navacl > rnd + 0.15, done.stdout
