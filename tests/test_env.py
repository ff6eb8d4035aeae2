"""The Gymnasium environment: checker, seeding, history, and its two ways to set a start."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import actor.world  # noqa: F401 - registers the environment
from common.config import StartRanges, resolve
from common.tasks import Task


@pytest.fixture
def env():
    env = gymnasium.make("navaclq/Docking-v0", render_mode="rgb_array")
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_environment_passes_gymnasiums_checker(env):
    check_env(env.unwrapped)


def test_seeded_reset_reproduces_an_episode_bit_for_bit_across_processes():
    script = """
import hashlib, gymnasium, numpy, actor.world
env = gymnasium.make("navaclq/Docking-v0")
digest = hashlib.sha256()
observation, _ = env.reset(seed=11)
env.action_space.seed(3)
for _ in range(15):
    for key in sorted(observation):
        digest.update(observation[key].tobytes())
    observation, reward, ended, cut, _ = env.step(env.action_space.sample())
    digest.update(numpy.float64(reward).tobytes())
    if ended or cut:
        break
print(digest.hexdigest())
"""
    outputs = [
        subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert outputs[0] == outputs[1]
    assert len(outputs[0].split()[-1]) == 64


def test_histories_hold_the_latest_actions_and_rewards_oldest_first(env):
    observation, _ = env.reset(seed=1)
    assert not observation["actions"].any()
    assert not observation["rewards"].any()
    assert all(np.array_equal(observation["camera"][0], frame) for frame in observation["camera"])
    first, reward, *_ = env.step(np.array([0.5, -0.25], np.float32))
    assert first["actions"][-1] == pytest.approx([0.5, -0.25])
    assert not first["actions"][:-1].any()
    assert first["rewards"] == pytest.approx([0, 0, 0, reward])
    assert np.array_equal(first["camera"][2], observation["camera"][3])


def test_task_in_the_options_sets_the_start_and_ending_stands_in_the_info(env):
    straight = StartRanges(distance_min=1.6, distance_max=1.6, yaw=0, bearing=0, dolly_yaw=0)
    task = Task(cell=6, seed=4, start=straight)
    _, info = env.reset(options={"task": task})
    assert info["task"] == task.model_dump()
    for _ in range(20):
        _, reward, ended, cut, info = env.step(np.array([1.0, 0.0], np.float32))
        if ended or cut:
            break
    assert (ended, cut, info["ending"], info["is_success"]) == (True, False, "success", True)
    assert reward == pytest.approx(9.9)


def test_running_out_of_time_truncates_and_does_not_terminate():
    env = gymnasium.make("navaclq/Docking-v0", config=resolve("smoke"))
    env.reset(seed=2)
    for step in range(20):
        _, _, ended, cut, info = env.step(np.zeros(2, np.float32))
        assert ended is False
        assert cut == (step == 19)
    assert info["ending"] == "timeout"
    env.close()


def test_render_shows_the_scene_from_above(env):
    env.reset(seed=3)
    picture = env.render()
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    orange = (picture[..., 0] > 1.4 * picture[..., 1]) & (picture[..., 1] > 2 * picture[..., 2])
    assert orange.sum() > 100  # the robot


def test_vector_environments_work():
    envs = gymnasium.make_vec("navaclq/Docking-v0", num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=1)
    assert observation["lidar"].shape == (2, 256)
    envs.close()
