from collections import Counter

import numpy as np
import pytest

from common.config import Config
from common.errors import UsageError
from common.messages import Ending, Episode
from common.observation import Columns, Observation, ObservationLayout
from learner.replay.buffer import Batch, Replay
from tests.helpers import small_config, tiny_episode

CONFIG = small_config("replay.capacity=40", "replay.priority_exponent=1.0")
LAYOUT = ObservationLayout.of(CONFIG)


def make_replay(*overrides: str, seed: int = 0) -> Replay:
    config = small_config("replay.capacity=40", "replay.priority_exponent=1.0", *overrides)
    steps = config.world.max_episode_steps
    return Replay(config.replay, ObservationLayout.of(config), steps, np.random.default_rng(seed))


def numbered(steps: int, first: int = 0, ending: Ending = "timeout", config: Config = CONFIG) -> Episode:
    """An episode that shows in each row its number first + t; the rewards are 1, 2, 3, ..."""
    episode = tiny_episode(config, steps, seed=first, ending=ending)
    numbers = np.arange(first, first + steps + 1)
    reward = np.arange(1, steps + 2, dtype=np.float32)
    action = np.stack([numbers + 1, -numbers - 1], axis=1).astype(np.float32) / 4096
    reward[-1], action[-1] = 0, 0
    visual = np.broadcast_to(numbers[:, None], episode.visual.shape).astype(np.float16)
    return episode.model_copy(update={"visual": visual, "action": action, "reward": reward})


def number_of(batch: Batch) -> list[int]:
    """Numbers of the sampled rows, read from their actions."""
    return np.rint(batch.action[:, 0] * 4096).astype(int).tolist()  # minus 1, so that no row is 0


def add(replay: Replay, episode: Episode) -> None:
    """Adds an episode that follows the newest one in the run."""
    replay.add(episode, int(replay._step.max()) + 1)


def draw(replay: Replay, size: int = 4096, n_step: int = 1, importance: float = 0.5) -> Batch:
    return replay.sample(size, n_step, 0.5, importance)


def once_each(replay: Replay, n_step: int = 1) -> Batch:
    """A sample in which every transition stands once, in order of its number."""
    batch = draw(replay, n_step=n_step)
    order, rows = np.unique(number_of(batch), return_index=True)
    assert len(order) == replay.transitions
    return Batch(
        *(
            Observation(*(part[rows] for part in field)) if isinstance(field, Observation) else field[rows]
            for field in batch
        )
    )


def shares(replay: Replay, size: int = 10_000) -> dict[int, float]:
    """Share of every transition, by number, in a large stratified sample: exact to 1 / size."""
    return {number: count / size for number, count in Counter(number_of(draw(replay, size))).items()}


def naive_observation(episode: Episode, t: int) -> Observation:
    """What an agent sees at t by table 1, row by row."""
    frames = [episode.visual[max(t - back, 0)] for back in (3, 2, 1, 0)]
    past = range(t - 4, t)
    actions = [episode.action[s] if s >= 0 else np.zeros(2) for s in past]
    rewards = [[episode.reward[s] if s >= 0 else 0.0] for s in past]
    return Observation(np.stack(frames), episode.lidar[t], np.concatenate([*actions, *rewards]))


def check_consistent(replay: Replay, kept: list[Episode]) -> None:
    """Every transition of `kept`, and nothing else, can be sampled, with the content of its episode."""
    weights = replay._tree.weights
    live = [row for first, length in replay._episodes for row in range(first, first + length)]
    assert len(set(live)) == len(live) == replay.transitions == sum(e.length for e in kept)
    assert np.flatnonzero(weights).tolist() == sorted(live)
    assert replay._tree.total == pytest.approx(weights[live].sum(), rel=1e-9)
    for episode, (first, length) in zip(kept, replay._episodes, strict=True):
        for column, part in zip(replay.columns.parts(), episode.columns().parts(), strict=True):
            np.testing.assert_array_equal(column[first : first + length + 1], part)


def test_probability_is_the_priority_to_the_power_c_and_weights_are_those_of_the_paper():
    replay = make_replay("replay.priority_exponent=0.5")
    add(replay, numbered(4))
    replay.update_priorities(once_each(replay), np.array([1.0, -4.0, 9.0, 16.0]))
    # p^c = 1, 2, 3, 4
    assert shares(replay) == pytest.approx({1: 0.1, 2: 0.2, 3: 0.3, 4: 0.4}, abs=2e-4)
    batch = draw(replay, importance=0.5)
    # (4 P)^-0.5 over its largest, that of P = 0.1
    expected = {1: 1.0, 2: 0.5**0.5, 3: (1 / 3) ** 0.5, 4: 0.5}
    assert batch.weight.dtype == np.float32
    np.testing.assert_allclose(batch.weight, [expected[n] for n in number_of(batch)], rtol=1e-5)
    assert (draw(replay, importance=0.0).weight == 1).all()


def test_importance_weights_are_relative_to_the_largest_of_the_batch():
    replay = make_replay()
    add(replay, numbered(2))
    replay.update_priorities(once_each(replay), np.array([1.0, 99.0]))
    for _ in range(20):
        batch = draw(replay, size=2, importance=1.0)
        assert batch.weight.max() == 1.0
        if number_of(batch) == [2, 2]:
            assert batch.weight.tolist() == [1.0, 1.0]
            return
    raise AssertionError("a batch of the second transition alone was to be expected")


def test_new_episode_gets_the_highest_current_priority():
    replay = make_replay()
    add(replay, numbered(3))
    assert shares(replay) == pytest.approx({1: 1 / 3, 2: 1 / 3, 3: 1 / 3}, abs=2e-4)
    replay.update_priorities(once_each(replay), np.array([0.9, 0.2, 0.1]))
    replay.update_priorities(once_each(replay), np.array([0.1, 0.4, 0.1]))  # 0.9 is history now
    add(replay, numbered(2, first=10))
    expected = {1: 0.1 / 1.4, 2: 0.4 / 1.4, 3: 0.1 / 1.4, 11: 0.4 / 1.4, 12: 0.4 / 1.4}
    assert shares(replay) == pytest.approx(expected, abs=2e-4)


def test_error_of_zero_keeps_a_transition_in_play():
    replay = make_replay("replay.priority_exponent=0.6")
    add(replay, numbered(3))
    replay.update_priorities(once_each(replay), np.zeros(3))
    assert set(number_of(draw(replay, 100))) == {1, 2, 3}
    assert replay.highest_priority == pytest.approx(1e-6**0.6)


@pytest.mark.parametrize(
    ("ending", "discounts"),
    [
        ("timeout", [0.125, 0.125, 0.125, 0.25, 0.5]),
        ("success", [0.125, 0.125, 0.0, 0.0, 0.0]),
        ("dolly_contact", [0.125, 0.125, 0.0, 0.0, 0.0]),
        ("other_contact", [0.125, 0.125, 0.0, 0.0, 0.0]),
    ],
)
def test_three_step_returns_stop_at_the_end_and_bootstrap_unless_the_episode_terminated(ending, discounts):
    replay = make_replay()
    add(replay, numbered(5, ending=ending))
    batch = once_each(replay, n_step=3)  # gamma is 0.5, the rewards are 1 to 5
    assert batch.reward.tolist() == [2.75, 4.5, 6.25, 6.5, 5.0]
    assert batch.discount.tolist() == discounts
    assert batch.next_observation.visual[:, -1, 0].tolist() == [3, 4, 5, 5, 5]


def test_one_step_returns_are_the_rewards():
    replay = make_replay()
    add(replay, numbered(3, ending="success"))
    batch = once_each(replay)
    assert batch.reward.tolist() == [1, 2, 3]
    assert batch.discount.tolist() == [0.5, 0.5, 0.0]
    assert batch.next_observation.visual[:, -1, 0].tolist() == [1, 2, 3]


def test_n_step_returns_never_reach_into_the_following_episode():
    replay = make_replay()
    add(replay, numbered(2))
    add(replay, numbered(6, first=100))
    batch = once_each(replay, n_step=5)
    assert batch.reward[:2].tolist() == [2.0, 2.0]
    assert batch.next_observation.visual[:2, -1, 0].tolist() == [2, 2]


@pytest.mark.parametrize("n_step", [1, 3])
def test_sampled_observations_are_those_the_agent_saw(n_step):
    replay = make_replay()
    episodes = [numbered(steps, first) for steps, first in ((9, 0), (1, 100), (5, 200))]
    for episode in episodes:
        add(replay, episode)
    batch = draw(replay, 300, n_step)
    for i, number in enumerate(number_of(batch)):
        episode, t = episodes[number // 100], number % 100 - 1
        following = min(t + n_step, episode.length)
        for seen, at in ((batch.observation, t), (batch.next_observation, following)):
            expected = naive_observation(episode, at)
            np.testing.assert_array_equal(seen.visual[i], expected.visual)
            np.testing.assert_array_equal(seen.lidar[i], expected.lidar)
            np.testing.assert_allclose(seen.history[i], expected.history)
        np.testing.assert_array_equal(batch.action[i], episode.action[t])


def test_observation_never_contains_the_action_it_leads_to_and_the_next_one_does():
    replay = make_replay()
    add(replay, numbered(20))
    batch = draw(replay, 500)
    for i in range(500):
        assert batch.action[i, 0] not in batch.observation.history[i, :8]
        assert batch.next_observation.history[i, 6:8].tolist() == batch.action[i].tolist()


def test_last_row_is_never_sampled():
    replay = make_replay()
    for first in range(0, 30, 10):
        add(replay, numbered(3, first))
    batch = draw(replay)
    assert set(number_of(batch)) == {1, 2, 3, 11, 12, 13, 21, 22, 23}
    assert set(batch.observation.visual[:, -1, 0].tolist()) == {0, 1, 2, 10, 11, 12, 20, 21, 22}


def test_samples_are_stratified():
    replay = make_replay()
    add(replay, numbered(20))
    add(replay, numbered(12, first=100))
    for _ in range(20):
        numbers = number_of(draw(replay, 32))
        assert numbers == [*range(1, 21), *range(101, 113)]


def test_samples_follow_the_generator():
    batches = []
    for seed in (3, 3, 4):
        replay = make_replay(seed=seed)
        add(replay, numbered(20))
        batches.append(number_of(draw(replay, 7)))
    assert batches[0] == batches[1] != batches[2]


def test_oldest_episode_is_dropped_as_a_whole_and_only_for_room():
    replay = make_replay()
    episodes = [numbered(10, first) for first in range(0, 500, 100)]
    for episode in episodes[:4]:
        add(replay, episode)
    check_consistent(replay, episodes[:4])
    assert replay.transitions == 40
    add(replay, numbered(1, 900))
    assert replay.transitions == 31
    assert set(number_of(draw(replay))) == {n + t for n in (100, 200, 300) for t in range(1, 11)} | {901}


def test_late_priority_for_an_overwritten_transition_changes_nothing():
    replay = make_replay()
    add(replay, numbered(20))
    late = once_each(replay)
    for first in range(100, 500, 100):  # the fourth begins at the first row again
        add(replay, numbered(15, first))
    assert replay._tree.weights[late.rows].max() > 0, "the rows were to be in use again"
    before = replay._tree.weights.copy()
    replay.update_priorities(late, np.full(20, 1e3))
    assert replay._tree.weights.tolist() == before.tolist()


def test_priorities_are_written_for_what_is_left_of_a_batch():
    replay = make_replay()
    add(replay, numbered(20))
    add(replay, numbered(20, first=100))
    batch = once_each(replay)
    add(replay, numbered(1, first=200))
    replay.update_priorities(batch, np.where(np.array(number_of(batch)) == 105, 3.0, 0.0))
    assert replay._tree.total == pytest.approx(3 + 1, abs=1e-3)  # of 105 and of the new one


@pytest.mark.parametrize(
    ("name", "lengths"),
    [
        ("any", lambda rng: int(rng.integers(1, 21))),
        ("long", lambda rng: int(rng.integers(18, 21))),
        ("very short", lambda rng: 1),
        ("short with a rare long one", lambda rng: 20 if rng.random() < 0.05 else int(rng.integers(1, 3))),
        ("in phases", lambda rng: int(rng.choice([1, 2, 3, 20]))),
    ],
)
def test_thousands_of_episodes_of_any_length_leave_the_buffer_consistent(name, lengths):
    replay, rng = make_replay("replay.capacity=60"), np.random.default_rng(len(name))
    added: list[Episode] = []
    fullest = 0
    of_length = {steps: numbered(steps) for steps in range(1, 21)}
    for i in range(2000):
        episode = of_length[lengths(rng)]
        marked = np.full_like(episode.lidar, i)  # exact in float16
        added.append(episode.model_copy(update={"lidar": marked}))
        add(replay, added[-1])
        kept = added[-len(replay._episodes) :]
        assert replay.transitions <= 60
        fullest = max(fullest, replay.transitions)
        if i % 10 == 0 or i > 1900:
            check_consistent(replay, kept)
        else:
            assert replay.transitions == sum(e.length for e in kept)
        if i % 3 == 0:
            batch = draw(replay, 16, n_step=3)
            replay.update_priorities(batch, rng.random(16))
    assert fullest > (60 - 20 if name != "very short" else 40)


@pytest.mark.parametrize("end_to_end", [False, True])
def test_bytes_needed_are_the_bytes_of_all_arrays(end_to_end):
    config = small_config("replay.capacity=100", f"encoder.end_to_end={str(end_to_end).lower()}")
    layout = ObservationLayout.of(config)
    replay = Replay(config.replay, layout, 20, np.random.default_rng(0))
    arrays = [value for value in vars(replay).values() if isinstance(value, np.ndarray | Columns)]
    total = sum(array.nbytes for array in arrays) + sum(
        v.nbytes for v in vars(replay._tree).values() if isinstance(v, np.ndarray)
    )
    assert Replay.bytes_needed(config.replay, layout, 20) == total


def test_frames_are_kept_as_bytes_end_to_end():
    config = small_config("encoder.end_to_end=true")
    layout = ObservationLayout.of(config)
    replay = Replay(config.replay, layout, 20, np.random.default_rng(0))
    episode = tiny_episode(config, 3)
    add(replay, episode)
    batch = replay.sample(3, 1, 0.9, 0.4)
    assert batch.observation.visual.dtype == np.uint8
    assert batch.observation.visual.shape == (3, 4, 16, 16, 3)
    np.testing.assert_array_equal(batch.observation.visual[2, -1], episode.visual[2])
    np.testing.assert_array_equal(batch.next_observation.visual[2, -1], episode.visual[3])


def test_capacity_for_less_than_two_episodes_is_a_usage_error():
    make_replay("replay.capacity=40")
    with pytest.raises(UsageError, match=r"replay\.capacity = 39 holds no two episodes of 20 steps"):
        make_replay("replay.capacity=39")


def test_priorities_are_found_again_in_a_buffer_rebuilt_elsewhere_and_newer_transitions_get_the_highest():
    replay, episodes = make_replay(), [numbered(5, first) for first in (0, 100, 200)]
    for episode in episodes:
        add(replay, episode)
    replay.update_priorities(once_each(replay), np.arange(1.0, 16.0))
    steps, weights = replay.priorities()
    assert sorted(steps) == list(range(15))
    rebuilt = make_replay()
    for i, episode in ((1, episodes[1]), (2, episodes[2]), (3, numbered(4, 300))):  # 0 has been dropped
        rebuilt.add(episode, 5 * i)
    rebuilt.load_priorities(steps, weights)
    assert [len(part) for part in rebuilt.priorities()] == [14, 14]
    found = dict(zip(*(part.tolist() for part in rebuilt.priorities()), strict=True))
    expected = {step: step + 1.0 for step in range(5, 15)} | dict.fromkeys(range(15, 19), 15.0)
    assert found == pytest.approx(expected, abs=1e-5)
    assert rebuilt.highest_priority == pytest.approx(15.0, abs=1e-5)


def test_priorities_that_do_not_fit_are_refused():
    replay = make_replay()
    add(replay, numbered(3))
    with pytest.raises(ValueError, match=r"priorities of shape \(2,\) for steps of shape \(3,\)"):
        replay.load_priorities(np.arange(3), np.ones(2))
    with pytest.raises(ValueError, match="finite and not negative"):
        replay.load_priorities(np.arange(3), np.array([1.0, np.nan, 1.0]))
    replay.load_priorities(np.zeros(0, np.int64), np.zeros(0))
    assert replay._tree.total == 3.0
