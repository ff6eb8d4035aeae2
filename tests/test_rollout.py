"""Acting and rolling out: what is stored is what was seen, one policy per slot, evaluation in order."""

import numpy as np
import pytest
import torch

from actor.inference import Eyes, PolicyActor
from actor.rollout import Rollout
from common.config import resolve
from common.messages import Version
from common.networks import Perception, Policy, make_encoder, state_of
from common.observation import ObservationLayout, observe
from common.policy_files import CONFIG, NETWORKS, save_folder
from common.tasks import random_task

SMOKE = resolve("smoke")


def networks(config, seed=0):
    torch.manual_seed(seed)
    policy = Policy(ObservationLayout.of(config), config.network)
    return state_of(perception=Perception(config), policy=policy, encoder=make_encoder(config))


def save(config, folder, tensors=None):
    save_folder(folder, {CONFIG: config.to_toml()}, {NETWORKS: tensors or networks(config)})
    return folder


class Recorder:
    """An actor that remembers the observations it was shown."""

    def __init__(self):
        self.seen = []
        self.rng = np.random.default_rng(0)

    def act(self, observation, slots):
        self.seen.append((slots, observation))
        return self.rng.uniform(-1, 1, (len(slots), 2)).astype(np.float32)


@pytest.mark.parametrize(
    "overrides", [(), ("encoder.frames_per_code=4", "encoder.kind=residual"), ("encoder.end_to_end=true",)]
)
def test_stored_rows_give_back_exactly_the_observations_that_were_acted_on(overrides):
    config = resolve("smoke", overrides=overrides)
    rollout = Rollout(config, Eyes(config, make_encoder(config)), 2, 8)
    rng, recorder = np.random.default_rng(1), Recorder()
    for slot in range(2):
        rollout.reset(slot, random_task(slot, config, rng))
    finished = []
    while rollout.idle != [0, 1]:
        finished += rollout.step(recorder)
    for episode in finished:
        shown = [
            (observation, slots.index(episode.slot))
            for slots, observation in recorder.seen
            if episode.slot in slots
        ]
        assert len(shown) == len(episode.columns.reward) - 1
        for t, (observation, i) in enumerate(shown):
            again = observe(episode.columns, np.array([t]), np.array([0]), rollout.layout)
            for ours, theirs in zip(again, observation, strict=True):
                assert np.array_equal(ours[0], theirs[i])
    assert rollout.steps == sum(len(f.columns.reward) - 1 for f in finished)
    rollout.close()


def test_candidate_is_the_first_row_of_the_episode_that_its_task_starts():
    rollout = Rollout(SMOKE, Eyes(SMOKE, make_encoder(SMOKE)), 1, 3)
    task = random_task(5, SMOKE, np.random.default_rng(2))
    candidate = rollout.look(0, task)
    assert rollout.idle == [0]
    rollout.reset(0, task)
    while not (finished := rollout.step(Recorder())):
        pass
    assert np.array_equal(finished[0].columns.visual[0], candidate.visual)
    assert np.array_equal(finished[0].columns.lidar[0], candidate.lidar)
    rollout.close()


def observation_of(config, batch):
    layout, rng = ObservationLayout.of(config), np.random.default_rng(3)
    from common.observation import Columns

    columns = Columns.empty(batch, layout)
    columns.visual[:] = rng.random(columns.visual.shape)
    columns.lidar[:] = rng.random(columns.lidar.shape)
    rows = np.arange(batch)
    return observe(columns, rows, rows, layout)


def test_slot_keeps_its_policy_until_it_is_refreshed():
    actor = PolicyActor(SMOKE, 2, np.random.default_rng(0), greedy=True)
    seen = observation_of(SMOKE, 2)
    first, second = networks(SMOKE, 1), networks(SMOKE, 2)
    actor.load(Version(epoch=1, counter=1), first)
    actor.refresh(0)
    actor.refresh(1)
    before = actor.act(seen, [0, 1])
    actor.load(Version(epoch=1, counter=2), second)
    assert np.array_equal(actor.act(seen, [0, 1]), before)
    actor.refresh(1)
    after = actor.act(seen, [0, 1])
    assert np.allclose(after[0], before[0], atol=1e-6)
    assert not np.allclose(after[1], before[1])
    assert (actor.version(0).counter, actor.version(1).counter) == (1, 2)


def test_actions_are_uniform_before_the_first_update_and_the_policys_after_it():
    actor = PolicyActor(SMOKE, 1, np.random.default_rng(0))
    seen = observation_of(SMOKE, 1)
    wild = np.array([actor.act(seen, [0])[0] for _ in range(400)])
    assert np.abs(wild).max() <= 1
    assert wild.std(0) == pytest.approx([1 / 3**0.5] * 2, abs=0.04)
    actor.load(Version(epoch=1, counter=1), networks(SMOKE))
    actor.refresh(0)
    assert np.array([actor.act(seen, [0])[0] for _ in range(200)]).std(0).max() < 0.4


def test_weights_of_another_architecture_are_refused_naming_the_tensor():
    other = resolve("smoke", overrides=("network.hidden=[16,16]",))
    actor = PolicyActor(SMOKE, 1, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"policy\.net\.fusion\.bias"):
        actor.load(Version(epoch=1, counter=1), networks(other))
