"""The algorithms on made-up tasks whose true success is known."""

import numpy as np
import pytest

from common.config import Config, resolve
from curriculum.synthetic_world import PARAMETERS, SyntheticWorld, difficulty

OPEN = "curriculum.gate.enabled=false"
STILL = {"skill": 0.3, "growth": 0.0}
"""A learner that stays as it is, for whom one task in seven is likely to succeed."""


def settings(variant: str, *overrides: str) -> Config:
    return resolve("fast", variant=variant, overrides=(OPEN, *overrides))


def taught(world: SyntheticWorld, tasks: int) -> SyntheticWorld:
    for _ in range(tasks):
        world.step()
    return world


def proposed(world: SyntheticWorld, tasks: int) -> dict[str, list[float]]:
    """True success of what is proposed, by category; f_pi goes on learning."""
    found: dict[str, list[float]] = {}
    for _ in range(tasks):
        pick = world.step()
        found.setdefault(pick.category, []).append(world.probability(pick.entry))
    return found


def test_difficulty_grows_with_everything_but_lateral_offset_counts_most_when_near():
    middle = np.full(4, 0.5)
    for index in range(len(PARAMETERS)):
        less, more = middle.copy(), middle.copy()
        less[index], more[index] = 0.2, 0.8
        assert difficulty(less[None]) < difficulty(more[None])
    near, far = np.array([[0.0, 0.5, 1.0, 0.5]]), np.array([[1.0, 0.5, 1.0, 0.5]])
    straight = np.array([0.0, 0.0, -1.0, 0.0])
    assert difficulty(near) - difficulty(near + straight) > difficulty(far) - difficulty(far + straight)


def test_learner_learns_most_from_tasks_of_middling_difficulty_and_nothing_from_others():
    gains = []
    for skill in (-1.0, 0.45, 2.0):
        world = SyntheticWorld(settings("rnd"), seed=1, skill=skill)
        taught(world, 100)
        gains.append(world.skill - skill)
    assert gains[0] < 1e-6 < 0.02 < gains[1]
    assert gains[2] < 1e-6


def test_same_seed_same_lesson():
    ends = [taught(SyntheticWorld(settings("navacl-q"), seed=seed), 60).skill for seed in (1, 1, 2)]
    assert ends[0] == ends[1] != ends[2]


def assert_above(higher: list[float], lower: list[float]) -> None:
    """Means that are four standard errors apart."""
    a, b = np.array(higher), np.array(lower)
    assert min(len(a), len(b)) >= 30
    assert a.mean() - b.mean() > 4 * np.hypot(a.std() / len(a) ** 0.5, b.std() / len(b) ** 0.5)


def test_easy_tasks_succeed_more_often_than_frontier_and_those_more_than_uniform():
    world = taught(SyntheticWorld(settings("navacl-q"), seed=3, **STILL), 400)
    found = proposed(world, 250)
    uniform = [world.probability(world.new()) for _ in range(1000)]
    assert_above(found["easy"], found["frontier"])
    assert_above(found["frontier"], uniform)


@pytest.mark.slow
def test_frontier_to_the_letter_lies_at_the_mean_and_so_among_hopeless_tasks_when_few_succeed():
    """Why NavACL-Q+ has it at 0.5: where success is rare, most tasks near the mean of f_pi are hopeless."""
    fast = ("curriculum.fit_steps=8", "curriculum.learning_rate=4e-3")
    world = taught(SyntheticWorld(settings("navacl-q-letter", *fast), seed=3, **STILL), 400)
    found = proposed(world, 600)
    uniform = [world.probability(world.new()) for _ in range(1000)]
    assert_above(found["easy"], found["frontier"])
    assert_above(found["easy"], uniform)
    assert_above(uniform, found["frontier"])


def excess(worlds: list[SyntheticWorld]) -> float:
    """By how much the Brier score of 400 predictions each exceeds the best, as a share of it.

    Of proposed tasks, before their outcomes; p (1 - p) is what nobody can predict away.
    """
    picks = [(world.step(), world) for world in worlds for _ in range(400)]
    f, p = np.array([(pick.f, world.probability(pick.entry)) for pick, world in picks]).T
    return float(np.mean((f - p) ** 2) / np.mean(p * (1 - p)))


@pytest.mark.parametrize(
    "seeds", [range(11, 15), pytest.param(range(11, 31), marks=pytest.mark.slow)], ids=["four", "twenty"]
)
def test_brier_score_is_within_a_tenth_of_the_best_after_800_outcomes(seeds):
    """The settings were chosen on seeds 40 to 47; without them it is about a tenth, by seed more or less."""
    config = settings("navacl-q", "curriculum.calibrate=true", "curriculum.average=0.99")
    assert excess([taught(SyntheticWorld(config, seed=seed, **STILL), 800) for seed in seeds]) < 0.1


@pytest.mark.slow
def test_curriculum_teaches_in_a_third_of_the_tasks_that_uniform_ones_take():
    least = 0.9
    ours = SyntheticWorld(settings("navacl-q"), seed=1).tasks_until(least, 3000)
    assert ours is not None
    uniform = SyntheticWorld(settings("rnd"), seed=1)
    assert uniform.tasks_until(least, 3 * ours) is None


def test_tasks_until_counts_what_was_needed():
    world = SyntheticWorld(settings("schedule"), seed=1)
    needed = world.tasks_until(0.5, 5000)
    assert needed == world.tasks > 0
    assert world.success >= 0.5
    assert SyntheticWorld(settings("schedule"), seed=1).tasks_until(0.5, needed - 11) is None
