import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import ReplayConfig, resolve
from common.errors import UsageError
from learner.replay.limiter import RateLimiter


def make(batch_size: int = 10, max_steps: int = 20, **settings: Any) -> RateLimiter:
    """Two samples per transition after the first 50, give or take 100."""
    usual = {"warmup_steps": 50, "samples_per_insert": 2.0, "error_buffer": 100.0, "hold_actors": True}
    return RateLimiter(ReplayConfig(**(usual | settings)), batch_size, max_steps)


def drain(limiter: RateLimiter) -> int:
    """Samples as often as it may; how often that was."""
    batches = 0
    while limiter.may_sample():
        limiter.sample()
        batches += 1
    return batches


def warm(**settings: Any) -> RateLimiter:
    """A limiter at the end of its warm-up."""
    limiter = make(**settings)
    limiter.insert(50)
    return limiter


def test_nothing_is_sampled_during_the_warm_up():
    limiter = make()
    for transitions in (20, 20, 9):
        assert not limiter.may_sample()
        limiter.insert(transitions)
    assert not limiter.may_sample()
    limiter.insert(1)
    assert limiter.may_sample()


def test_transitions_of_the_warm_up_are_worth_nothing():
    limiter = make()
    for transitions in (20, 20, 10):
        limiter.insert(transitions)
        assert limiter.balance == 0
    assert limiter.inserted == 50


@pytest.mark.parametrize(("before", "worth"), [(0, 0), (30, 0), (31, 2), (45, 30), (49, 38), (50, 40)])
def test_of_an_episode_across_the_end_of_the_warm_up_only_what_lies_beyond_it_counts(before, worth):
    limiter = make()
    limiter.insert(before)
    limiter.insert(20)
    assert limiter.balance == worth


def test_sampling_runs_ahead_to_the_lower_edge_of_the_band_and_waits_there():
    limiter = warm()
    assert drain(limiter) == 10
    assert limiter.balance == -100
    limiter.insert(4)
    assert not limiter.may_sample()
    limiter.insert(1)
    assert drain(limiter) == 1
    limiter.insert(20)
    assert drain(limiter) == 4


def test_batch_that_would_cross_the_lower_edge_waits():
    limiter = warm(batch_size=30)
    assert drain(limiter) == 3
    assert limiter.balance == -90
    limiter.insert(9)
    assert not limiter.may_sample()
    limiter.insert(1)
    assert limiter.may_sample()


def test_inserting_waits_at_the_upper_edge_if_actors_are_held():
    limiter = warm()
    assert limiter.may_insert(50)
    assert not limiter.may_insert(51)
    limiter.insert(40)
    assert limiter.may_insert(10)
    assert not limiter.may_insert(11)
    limiter.insert(10)
    assert limiter.balance == 100
    assert not limiter.may_insert(1)
    limiter.sample()
    assert limiter.may_insert(5)
    assert not limiter.may_insert(6)


def test_asking_changes_nothing():
    limiter = warm()
    limiter.insert(20)
    for _ in range(5):
        assert limiter.may_insert(20)
        assert limiter.may_sample()
    assert (limiter.balance, limiter.inserted) == (40, 70)


def test_inserting_never_waits_if_actors_are_not_held_and_what_exceeds_the_band_is_forgotten():
    limiter = warm(hold_actors=False)
    for _ in range(100):
        assert limiter.may_insert(20)
        limiter.insert(20)
    assert limiter.balance == 100
    assert limiter.inserted == 2050
    assert drain(limiter) == 20, "from one edge of the band to the other, however much came"
    assert limiter.balance == -100
    limiter.insert(20)
    assert drain(limiter) == 4


def test_what_is_forgotten_is_the_excess_only():
    limiter = warm(hold_actors=False)
    limiter.insert(45)
    assert limiter.balance == 90
    limiter.insert(20)
    assert limiter.balance == 100
    limiter.sample()
    limiter.insert(2)
    assert limiter.balance == 94


@pytest.mark.parametrize("hold", [True, False])
@pytest.mark.parametrize(
    ("batch_size", "max_steps", "per_insert", "least"),
    [(10, 20, 2.0, "25"), (128, 100, 64.0, "3264"), (64, 100, 16.0, "832"), (1, 1, 0.5, "0.75")],
)
def test_band_in_which_neither_side_could_go_on_is_refused_naming_the_least_possible_one(
    batch_size, max_steps, per_insert, least, hold
):
    make(batch_size, max_steps, samples_per_insert=per_insert, error_buffer=float(least), hold_actors=hold)
    narrow = float(least) - 0.25
    said = (
        f"replay.error_buffer = {narrow:g} is too narrow for episodes of {max_steps} steps and batches of "
        f"{batch_size}; it must be at least {least}"
    )
    with pytest.raises(UsageError, match=f"^{re.escape(said)}$"):
        make(batch_size, max_steps, samples_per_insert=per_insert, error_buffer=narrow, hold_actors=hold)


@pytest.mark.parametrize("variant", ["navacl-q", "rnd", "e2e"])
@pytest.mark.parametrize("preset", ["paper", "fast", "smoke"])
def test_every_preset_has_a_possible_band(preset, variant):
    config = resolve(preset, variant=variant)
    limiter = RateLimiter(config.replay, config.sac.batch_size, config.world.max_episode_steps)
    limiter.insert(config.replay.warmup_steps)
    assert limiter.may_sample()
    assert limiter.may_insert(config.world.max_episode_steps)


@st.composite
def limiters(draw: st.DrawFn, hold: bool | None = None) -> tuple[RateLimiter, ReplayConfig, int, int]:
    """Any legal limiter, often one with the narrowest band, its settings, batch size and longest episode."""
    batch_size, max_steps = draw(st.integers(1, 300)), draw(st.integers(1, 120))
    per_insert = draw(st.one_of(st.floats(0.01, 100), st.integers(1, 64).map(float)))
    least = (per_insert * max_steps + batch_size) / 2
    config = ReplayConfig(
        samples_per_insert=per_insert,
        error_buffer=least * draw(st.one_of(st.just(1.0), st.floats(1, 10))),
        warmup_steps=draw(st.integers(1, 500)),
        hold_actors=draw(st.booleans()) if hold is None else hold,
    )
    return RateLimiter(config, batch_size, max_steps), config, batch_size, max_steps


def turns(max_steps: int) -> st.SearchStrategy[list[tuple[int, int]]]:
    """In turns: the length of an episode that comes, and how many batches the learner has time for."""
    return st.lists(st.tuples(st.integers(1, max_steps), st.integers(0, 40)), min_size=1, max_size=60)


@given(limiters(hold=True), st.data())
def test_samples_per_transition_stay_within_the_band_if_actors_are_held(made, data):
    limiter, config, batch_size, max_steps = made
    limiter.insert(config.warmup_steps)
    inserted = batches = 0
    for length, times in data.draw(turns(max_steps)):
        if limiter.may_insert(length):
            limiter.insert(length)
            inserted += length
        for _ in range(times):
            if limiter.may_sample():
                limiter.sample()
                batches += 1
        owed = config.samples_per_insert * inserted - batch_size * batches
        assert limiter.balance == pytest.approx(owed, abs=1e-6)
        assert abs(owed) <= config.error_buffer * (1 + 1e-9)


@given(limiters(), st.lists(st.integers(1, 120), min_size=20, max_size=60))
def test_long_run_has_the_ratio_asked_for_to_within_the_band_of_a_learner_that_keeps_up(made, lengths):
    limiter, config, batch_size, max_steps = made
    limiter.insert(config.warmup_steps)
    inserted, batches = 0, drain(limiter)
    for length in lengths:
        steps = min(length, max_steps)
        assert limiter.may_insert(steps)
        limiter.insert(steps)
        inserted += steps
        batches += drain(limiter)
    ahead = batch_size * batches - config.samples_per_insert * inserted
    assert ahead <= config.error_buffer * (1 + 1e-9)
    assert ahead > (config.error_buffer - batch_size) * (1 - 1e-9) - 1e-6, "it takes all that it may"


@given(limiters(hold=False), st.data())
def test_learner_never_samples_more_than_asked_for_whatever_is_forgotten(made, data):
    limiter, config, batch_size, max_steps = made
    limiter.insert(config.warmup_steps)
    inserted = batches = 0
    for length, times in data.draw(turns(max_steps)):
        assert limiter.may_insert(length)
        limiter.insert(length)
        inserted += length
        for _ in range(times):
            if limiter.may_sample():
                limiter.sample()
                batches += 1
        assert abs(limiter.balance) <= config.error_buffer * (1 + 1e-9)
        ahead = batch_size * batches - config.samples_per_insert * inserted
        assert ahead <= config.error_buffer * (1 + 1e-9)


def check_somebody_can_go_on(limiter: RateLimiter, max_steps: int, moves: list[tuple[int, int]]) -> None:
    """Actors and learner take turns as in `moves`; never must both of them wait, whatever waits to come."""
    for length, times in moves:
        for steps in (1, length, max_steps):
            assert limiter.may_sample() or limiter.may_insert(steps), (limiter.balance, limiter.inserted)
        if limiter.may_insert(length):
            limiter.insert(length)
        for _ in range(times):
            for steps in (1, length, max_steps):
                assert limiter.may_sample() or limiter.may_insert(steps), (limiter.balance, limiter.inserted)
            if limiter.may_sample():
                limiter.sample()


@given(limiters(hold=True), st.data())
def test_never_do_both_sides_wait_after_the_warm_up(made, data):
    limiter, config, _, max_steps = made
    limiter.insert(config.warmup_steps)
    check_somebody_can_go_on(limiter, max_steps, data.draw(turns(max_steps)))


@given(limiters(hold=True), st.data())
def test_never_do_both_sides_wait_across_the_end_of_the_warm_up(made, data):
    limiter, config, _, max_steps = made
    limiter.insert(data.draw(st.integers(0, config.warmup_steps)))
    check_somebody_can_go_on(limiter, max_steps, data.draw(turns(max_steps)))


def test_episode_that_ends_the_warm_up_comes_in_however_narrow_the_band():
    limiter = make(samples_per_insert=8.0, batch_size=16, error_buffer=88.0)
    limiter.insert(49)
    assert not limiter.may_sample()
    assert limiter.may_insert(20), "or nobody could ever go on"
