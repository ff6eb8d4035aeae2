"""An actor process: what it offers the curriculum."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from actor.service import RANDOM_TASKS, ActorService
from common.bus import Member
from curriculum.service import CurriculumService
from learner.checkpoint import RunDirectory
from learner.service import LearnerService
from tests.helpers import small_config, wait_until

CONFIG = small_config(
    "actor.worlds=1",
    "replay.capacity=1000",
    "world.max_episode_steps=2",
    "curriculum.gate.enabled=false",
    "curriculum.random_limit=1.0",
    "curriculum.random_steps=1e-6",  # random tasks from the first step on
    "curriculum.narrowed_candidates=1.0",
)


@pytest.fixture
def driver(hub, client, tmp_path: Path, one_thread) -> Iterator[ActorService]:
    """An actor with a learner and a curriculum."""
    learner = LearnerService(hub, RunDirectory(tmp_path / "run", CONFIG))
    curriculum = CurriculumService(client, "run", CONFIG, learner.contract.digest, None)
    driver = ActorService(
        client, learner.contract, CONFIG, Member("actor", "local", "a"), tmp_path / "spool", [0]
    )
    yield driver
    driver.close()
    curriculum.close()
    learner.close()


def narrowed(driver: ActorService) -> int:
    """Of twenty candidates."""
    driver._candidates = []
    for _ in range(20):
        driver._look(0)
    return sum(candidate.task.start != CONFIG.world.start for candidate in driver._candidates)


def test_candidates_are_narrowed_the_less_the_more_random_tasks_succeed(driver):
    assert narrowed(driver) == 20
    driver._random_successes.extend([True, False] * (RANDOM_TASKS // 2))
    assert 3 <= narrowed(driver) <= 17
    driver._random_successes.extend([True] * RANDOM_TASKS)
    assert narrowed(driver) == 0
    settings = CONFIG.curriculum.model_copy(update={"narrowed_fades": False})
    driver.config = CONFIG.model_copy(update={"curriculum": settings})
    assert narrowed(driver) == 20


def test_only_random_tasks_count_for_that(driver):
    driver._ask(0)

    def categories() -> dict[str, int]:
        driver._start_answered()
        for finished in driver._rollout.step(driver._actor):
            driver._ship(finished)
        return driver._categories

    wait_until(lambda: categories()["random"] >= 4, 30, "random tasks")
    others = sum(categories().values()) - categories()["random"]
    assert others >= 1, "the first was asked for before its first step"
    assert 3 <= len(driver._random_successes) <= categories()["random"]
    assert not any(driver._random_successes), "nobody docks in two steps"
