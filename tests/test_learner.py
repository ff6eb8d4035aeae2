import json
import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.config import Config
from common.errors import RunError
from common.messages import Episode
from common.observation import Observation
from learner.learner import Learner
from learner.replay.buffer import PRIORITY_FLOOR, Batch
from learner.sac import Losses
from tests.helpers import small_config, tiny_episode

LIMITS = (
    "replay.capacity=80",
    "replay.warmup_steps=40",
    "replay.samples_per_insert=8",
    "replay.error_buffer=88",
    "sac.batch_size=16",
)
"""Half an update per transition; a band of 11 updates; episodes have up to 20 steps."""

pytestmark = pytest.mark.usefixtures("one_thread")


def settings(*overrides: str) -> Config:
    return small_config(*LIMITS, *overrides)


def episodes_of(config: Config, lengths: Iterable[int]) -> list[tuple[Episode, int]]:
    """Episodes of these lengths with the run's step at which each begins."""
    found, step = [], 0
    for i, length in enumerate(lengths):
        ending = "success" if i % 3 == 0 else "timeout"
        found.append((tiny_episode(config, length, seed=i, ending=ending), step))
        step += length
    return found


def updates_of(learner: Learner, env_steps: int = 0) -> list[Losses]:
    """All updates that are allowed now."""
    losses = []
    while (figures := learner.update(env_steps)) is not None:
        losses.append(figures)
        assert len(losses) < 1000, "there is no end to it"
    return losses


def frozen_save(learner: Learner) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
    """What `save` gives, as it comes back from files."""
    tensors, state = learner.save()
    copies = {group: {key: value.clone() for key, value in part.items()} for group, part in tensors.items()}
    return copies, json.loads(json.dumps(state))


def resumed(
    config: Config, episodes: list[tuple[Episode, int]], saved: tuple[dict[str, Any], dict[str, Any]]
) -> Learner:
    """A fresh learner, refilled and loaded as after a restart."""
    learner = Learner(config)
    for episode, first in episodes:
        learner.insert(episode, first, restored=True)
    learner.load(*saved)
    return learner


def check_same(ours: Learner, theirs: Learner) -> None:
    (tensors, state), (others, other) = ours.save(), theirs.save()
    assert state == other
    assert tensors.keys() == others.keys()
    for group, part in tensors.items():
        assert part.keys() == others[group].keys()
        for key, value in part.items():
            assert torch.equal(value, others[group][key]), f"{group}: {key}"


def test_updates_begin_after_the_warm_up_and_never_leave_the_band():
    config = settings()
    learner = Learner(config)
    episodes = episodes_of(config, [20, 19, 1, 20, 2, 1, 1])
    found = []
    for episode, first in episodes:
        learner.insert(episode, first)
        found.append(len(updates_of(learner)))
    # at 40 steps a band's half of 88 samples, then 8 samples per step
    assert found == [0, 0, 5, 10, 1, 1, 0]
    assert learner.sac.updates == sum(found)
    assert learner.limiter.balance == 8 * (64 - 40) - 16 * sum(found)


def test_update_that_is_not_allowed_draws_nothing():
    config = settings()
    learner = Learner(config)
    learner.insert(*episodes_of(config, [20])[0])
    before = frozen_save(learner)
    assert learner.update(0) is None
    assert learner.save()[1] == before[1]
    assert learner.sac.updates == 0


def test_long_run_makes_half_an_update_per_transition():
    config = settings()
    learner = Learner(config)
    for episode, first in episodes_of(config, np.random.default_rng(0).integers(1, 21, 30).tolist()):
        learner.insert(episode, first)
        updates_of(learner)
    beyond = learner.limiter.inserted - 40
    assert beyond > 200
    assert learner.sac.updates == math.floor((8 * beyond + 88) / 16)


def test_learner_that_lags_behind_makes_no_more_updates_than_a_band():
    config = settings()
    learner = Learner(config)
    for episode, first in episodes_of(config, [20] * 12):
        learner.insert(episode, first)
    assert len(updates_of(learner)) == 2 * 88 // 16


def test_priorities_of_what_was_sampled_are_the_td_errors_and_no_others_change(monkeypatch):
    config = settings("replay.priority_exponent=0.6")
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        learner.insert(episode, first)
    seen: list[tuple[Batch, NDArray[np.float64]]] = []
    original = learner.sac.update

    def watched(batch: Batch, others: Observation | None) -> tuple[Losses, NDArray[np.float64]]:
        losses, errors = original(batch, others)
        seen.append((batch, errors))
        return losses, errors

    monkeypatch.setattr(learner.sac, "update", watched)
    for _ in range(3):
        before = dict(zip(*(part.tolist() for part in learner.replay.priorities()), strict=True))
        learner.update(0)
        batch, errors = seen[-1]
        priorities = ((np.abs(errors) + PRIORITY_FLOOR) ** 0.6).tolist()
        expected = before | dict(zip(batch.steps.tolist(), priorities, strict=True))
        found = dict(zip(*(part.tolist() for part in learner.replay.priorities()), strict=True))
        assert found == pytest.approx(expected, rel=1e-5)
        assert found != before


def test_importance_exponent_goes_from_its_first_to_its_last_value_and_stays_there(monkeypatch):
    config = settings(
        "replay.importance_start=0.4",
        "replay.importance_end=0.6",
        "replay.importance_steps=1000",
        "replay.draw_ahead=1",
    )
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        learner.insert(episode, first)
    asked = watch_draws(monkeypatch, learner)
    for env_steps in (0, 250, 999, 1000, 10**9):
        assert learner.update(env_steps) is not None
    assert {given[:4] for given in asked} == {(1, 16, config.sac.n_step, config.sac.gamma)}
    assert [given[4] for given in asked] == pytest.approx([0.4, 0.45, 0.5998, 0.6, 0.6])


def watch_draws(monkeypatch, learner: Learner) -> list[tuple[int, int, int, float, float]]:
    """What the learner asks its replay for, from now on."""
    asked: list[tuple[int, int, int, float, float]] = []
    original = learner.replay.sample_many
    monkeypatch.setattr(
        learner.replay, "sample_many", lambda *given: (asked.append(given), original(*given))[1]
    )
    return asked


def test_batches_are_drawn_some_at_one_go_and_none_is_kept_in_a_checkpoint(monkeypatch):
    learner = Learner(settings("replay.draw_ahead=3", "replay.error_buffer=200"))
    for episode, first in episodes_of(learner.config, [20, 20]):
        learner.insert(episode, first)
    asked = watch_draws(monkeypatch, learner)
    for draws in (1, 1, 1, 2, 2):
        assert learner.update(0) is not None
        assert [given[0] for given in asked] == [3] * draws
    learner.save()
    assert learner.update(0) is not None
    assert len(asked) == 3


def test_batches_drawn_at_one_go_are_each_stratified_and_normalised_by_themselves():
    learner, errors = unequal()
    total = sum((error + 1e-6) ** 0.6 for error in errors.values())
    ends = dict(zip(errors, np.cumsum([(e + 1e-6) ** 0.6 for e in errors.values()]) / total, strict=True))
    seen = []
    for _ in range(100):
        batches = learner.replay.sample_many(4, 8, 1, 0.9, 0.5)
        assert len(batches) == 4
        for batch in batches:
            assert len(batch.steps) == len(batch.reward) == len(batch.next_observation.lidar) == 8
            assert batch.weight.max() == 1.0
            expected = np.array([(errors[step] + 1e-6) ** -0.3 for step in batch.steps.tolist()])
            np.testing.assert_allclose(batch.weight, expected / expected.max(), rtol=1e-5)
            assert batch.observation.lidar[:, 0].tolist() == batch.steps.tolist()
            # of eight equal shares of all that can be drawn, each gave one
            for share, step in enumerate(batch.steps.tolist()):
                power = (errors[step] + 1e-6) ** 0.6 / total
                assert ends[step] > share / 8 - 1e-9
                assert ends[step] - power < (share + 1) / 8 + 1e-9
        seen.append([batch.steps.tolist() for batch in batches])
    assert all(a != b for a, b, *_ in seen)


@pytest.mark.parametrize(("kind", "due"), [("critic", []), ("uniform", [0, 3, 6])])
def test_policy_learns_from_a_uniform_batch_if_asked_for_and_only_when_it_is_due(monkeypatch, kind, due):
    config = settings(f"sac.actor_batch={kind}", "sac.policy_delay=3", "replay.error_buffer=200")
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        learner.insert(episode, first)
    given, drawn = [], []
    update, draw = learner.sac.update, learner.replay.sample_uniformly
    monkeypatch.setattr(
        learner.sac, "update", lambda batch, others: (given.append(others), update(batch, others))[1]
    )
    monkeypatch.setattr(
        learner.replay, "sample_uniformly", lambda size: (drawn.append(draw(size)), drawn[-1])[1]
    )
    for _ in range(8):
        learner.update(0)
    assert [i for i, others in enumerate(given) if others is not None] == due
    assert [id(others) for others in given if others is not None] == [id(part) for part in drawn]
    assert all(len(others.lidar) == 16 for others in drawn)


CASES: dict[str, tuple[str, ...]] = {
    "critic's batch": (),
    "uniform batch": ("sac.actor_batch=uniform",),
    "normalised, Huber": ("network.normalize=true", "sac.critic_loss=huber"),
    "hard target": ("sac.target=hard", "sac.target_interval=3", "network.layer_norm=false"),
    "end to end": ("encoder.end_to_end=true", "encoder.channels=[2, 2, 2, 2]"),
}


@pytest.mark.parametrize("case", CASES)
def test_resumed_learner_goes_on_to_the_bit_as_the_one_that_was_not_stopped(case):
    config = settings(*CASES[case])
    lengths = [20, 7, 20, 1, 13, 20, 20, 5, 18]  # more than the ring holds
    episodes = episodes_of(config, lengths)
    before, after = episodes[:6], episodes[6:]
    original = Learner(config)
    for episode, first in before:
        original.insert(episode, first)
        updates_of(original, first)
    saved = frozen_save(original)
    assert original.sac.updates > 20
    assert original.replay.transitions < sum(lengths[:6]), "something was to be dropped"
    copy = resumed(config, before, saved)
    check_same(original, copy)
    for episode, first in after:
        original.insert(episode, first)
        copy.insert(episode, first)
        ours, theirs = updates_of(original, first), updates_of(copy, first)
        assert ours
        np.testing.assert_array_equal(ours, theirs)
        check_same(original, copy)


def test_state_is_loaded_from_the_save_and_not_from_the_configuration():
    config = settings("network.normalize=true")
    episodes = episodes_of(config, [20, 20, 20])
    original = Learner(config)
    for episode, first in episodes:
        original.insert(episode, first)
    updates_of(original)
    copy = resumed(config.model_copy(update={"seed": 77}), episodes, frozen_save(original))
    check_same(original, copy)
    original.limiter.balance = copy.limiter.balance = 50.0
    np.testing.assert_array_equal(updates_of(original), updates_of(copy))


@pytest.mark.parametrize("made", [0, 1, 7, 11])
@pytest.mark.parametrize("unsaved", [0, 3])
def test_resumed_learner_neither_bursts_nor_stalls(made, unsaved):
    """`unsaved` episodes came after the checkpoint; their updates are lost, not made up for."""
    config = settings()
    episodes = episodes_of(config, [20, 20, 20, 20, 20, 20])
    original = Learner(config)
    kept = episodes[: 6 - unsaved]
    for episode, first in kept:
        original.insert(episode, first)
    allowed = math.floor((original.limiter.balance + 88) / 16)
    for _ in range(made):
        assert original.update(0) is not None
    copy = resumed(config, episodes, frozen_save(original))
    assert copy.limiter.balance == original.limiter.balance
    assert len(updates_of(copy)) == len(updates_of(original)) == allowed - made
    assert copy.sac.updates == original.sac.updates == allowed


def test_restored_episodes_are_worth_no_updates_but_count_for_the_warm_up():
    config = settings()
    episodes = episodes_of(config, [20] * 10)
    learner = Learner(config)
    learner.insert(*episodes[0], restored=True)
    assert learner.update(0) is None
    for episode, first in episodes[1:8]:
        learner.insert(episode, first, restored=True)
    assert (learner.limiter.inserted, learner.limiter.balance) == (160, 0.0)
    assert len(updates_of(learner)) == 5, "as much as any run may run ahead"
    learner.insert(*episodes[8])
    assert len(updates_of(learner)) == 10


def test_run_that_was_stopped_in_its_warm_up_goes_on_with_it():
    config = settings()
    episodes = episodes_of(config, [20, 19, 1, 20])
    original = Learner(config)
    for episode, first in episodes[:2]:
        original.insert(episode, first)
    copy = resumed(config, episodes[:2], frozen_save(original))
    for learner in (original, copy):
        found = []
        for episode, first in episodes[2:]:
            found.append(len(updates_of(learner)))
            learner.insert(episode, first)
        assert [*found, len(updates_of(learner))] == [0, 5, 10]
    check_same(original, copy)


def test_resumed_learner_needs_only_the_episodes_that_its_ring_holds():
    config = settings()
    episodes = episodes_of(config, [20] * 9)
    original = Learner(config)
    for episode, first in episodes:
        original.insert(episode, first)
        updates_of(original)
    kept = len(original.replay._episodes)
    assert kept == 4
    copy = resumed(config, episodes[-kept:], frozen_save(original))
    ours, theirs = (
        dict(zip(*(part.tolist() for part in learner.replay.priorities()), strict=True))
        for learner in (original, copy)
    )
    assert ours == theirs
    assert len(set(ours.values())) > 40
    assert len(updates_of(copy)) == len(updates_of(original)) == 0
    more = episodes_of(config, [20] * 10)[-1]
    for learner in (original, copy):
        learner.insert(*more)
        assert len(updates_of(learner)) == 10


def test_save_is_not_changed_by_what_comes_later_where_it_is_a_copy():
    config = settings()
    original = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        original.insert(episode, first)
    tensors, state = original.save()
    before = {key: value.clone() for key, value in tensors["priorities"].items()}, json.dumps(state)
    updates_of(original)
    assert all(torch.equal(value, before[0][key]) for key, value in tensors["priorities"].items())
    assert json.dumps(state) == before[1]


@pytest.mark.parametrize("group", ["networks", "optimizers", "priorities"])
def test_save_that_lacks_something_is_refused(group):
    config = settings()
    episodes = episodes_of(config, [20, 20])
    original = Learner(config)
    for episode, first in episodes:
        original.insert(episode, first)
    updates_of(original)
    tensors, state = frozen_save(original)
    with pytest.raises(KeyError, match=group):
        resumed(config, episodes, ({k: v for k, v in tensors.items() if k != group}, state))
    gone = {"networks": "log_alpha", "optimizers": "generator", "priorities": "steps"}[group]
    del tensors[group][gone]
    with pytest.raises(KeyError, match=gone):
        resumed(config, episodes, (tensors, state))


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_losses_that_are_no_numbers_end_the_run_and_leave_the_priorities(value):
    config = settings("replay.draw_ahead=1")
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        learner.insert(episode, first)
    assert learner.update(0) is not None
    before = learner.replay.priorities()
    learner.replay.columns.reward[:] = value
    with pytest.raises(RunError, match=r"the losses of update 2 are not finite .* is from before"):
        learner.update(0)
    for ours, theirs in zip(learner.replay.priorities(), before, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_learning_goes_on_while_the_policys_figures_are_unknown():
    config = settings("sac.policy_delay=4")
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 20]):
        learner.insert(episode, first)
    assert [math.isnan(losses.policy) for losses in updates_of(learner)] == [False, True, True, True, False]


def chi_square(counts: Counter[int], probability: dict[int, float]) -> float:
    """Pearson's statistic in standard deviations of a normal variable (Wilson and Hilferty 1931)."""
    total, freedom = sum(counts.values()), len(probability) - 1
    assert set(counts) <= set(probability)
    assert min(probability.values()) * total > 5
    expected = {key: share * total for key, share in probability.items()}
    statistic = sum((counts[key] - mean) ** 2 / mean for key, mean in expected.items())
    variance = 2 / (9 * freedom)
    return ((statistic / freedom) ** (1 / 3) - (1 - variance)) / math.sqrt(variance)


def unequal(*overrides: str) -> tuple[Learner, dict[int, float]]:
    """A learner whose ring has gone round, and the very unequal |TD errors| of its transitions, by step.

    The LiDAR shows each row's step, and 2000 in the last rows of the episodes, which are no transitions.
    """
    config = settings("replay.priority_exponent=0.6", *overrides)
    learner = Learner(config)
    for episode, first in episodes_of(config, [20, 7, 20, 1, 13, 20, 20, 5, 18]):
        steps = np.append(np.arange(first, first + episode.length), 2000)
        lidar = np.broadcast_to(steps[:, None], episode.lidar.shape).astype(np.float16)
        learner.insert(episode.model_copy(update={"lidar": lidar}), first)
    replay = learner.replay
    rows = np.flatnonzero(replay._step >= 0)
    steps = replay._step[rows]
    assert replay.transitions == len(rows) < replay._used < replay._size
    errors = 10.0 ** np.random.default_rng(5).uniform(-2, 1, len(rows))
    batch = replay.sample(len(rows), 1, 0.9, 0.4)._replace(rows=rows, steps=steps)
    replay.update_priorities(batch, errors * np.random.default_rng(6).choice([-1, 1], len(rows)))
    return learner, dict(zip(steps.tolist(), errors.tolist(), strict=True))


@pytest.mark.parametrize("batch", range(3))
def test_every_one_of_batches_drawn_at_one_go_draws_in_proportion_to_the_priorities(batch):
    learner, errors = unequal()
    powers = {step: (error + 1e-6) ** 0.6 for step, error in errors.items()}
    counts: Counter[int] = Counter()
    for _ in range(3000):
        counts.update(learner.replay.sample_many(3, 4, 1, 0.9, 0.4)[batch].steps.tolist())
    assert chi_square(counts, {step: power / sum(powers.values()) for step, power in powers.items()}) < 3.5


@pytest.mark.parametrize(("size", "times"), [(1, 12_000), (16, 1000)])
def test_transitions_are_sampled_in_proportion_to_their_priorities(size, times):
    learner, errors = unequal()
    powers = {step: (error + 1e-6) ** 0.6 for step, error in errors.items()}
    probability = {step: power / sum(powers.values()) for step, power in powers.items()}
    assert max(probability.values()) > 40 * min(probability.values())
    counts: Counter[int] = Counter()
    for _ in range(times):
        batch = learner.replay.sample(size, 1, 0.9, 0.4)
        counts.update(batch.steps.tolist())
        assert batch.observation.lidar[:, 0].tolist() == batch.steps.tolist()
    assert chi_square(counts, probability) < 3.5
    # what the test can tell: another exponent, and no priorities at all
    powers = {step: error**0.7 for step, error in errors.items()}
    assert chi_square(counts, {step: power / sum(powers.values()) for step, power in powers.items()}) > 5
    assert chi_square(counts, dict.fromkeys(errors, 1 / len(errors))) > 50


@pytest.mark.parametrize(("size", "times"), [(1, 12_000), (16, 1000), (5000, 3)])
def test_uniform_batches_have_all_transitions_equally_often_whatever_their_priorities(size, times):
    learner, errors = unequal()
    before = learner.replay.priorities()
    counts: Counter[int] = Counter()
    for _ in range(times):
        seen = learner.replay.sample_uniformly(size)
        assert len(seen.lidar) == len(seen.visual) == len(seen.history) == size
        counts.update(seen.lidar[:, 0].astype(int).tolist())
    share = dict.fromkeys(errors, 1 / len(errors))
    assert chi_square(counts, share) < 3.5
    # what the test can tell: every second transition a fifth less often
    tilted = {step: value * (1.0 if i % 2 else 0.8) for i, (step, value) in enumerate(share.items())}
    assert chi_square(counts, {step: value / sum(tilted.values()) for step, value in tilted.items()}) > 4
    for ours, theirs in zip(learner.replay.priorities(), before, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_uniform_batches_hold_whole_observations():
    learner, _ = unequal()
    seen = learner.replay.sample_uniformly(200)
    weighted = learner.replay.sample(2000, 1, 0.9, 0.4).observation
    known = {row.lidar[0]: row for row in (Observation(*parts) for parts in zip(*weighted, strict=True))}
    compared = 0
    for parts in zip(*seen, strict=True):
        row = Observation(*parts)
        if row.lidar[0] in known:
            compared += 1
            for ours, theirs in zip(row, known[row.lidar[0]], strict=True):
                np.testing.assert_array_equal(ours, theirs)
    assert compared > 150
