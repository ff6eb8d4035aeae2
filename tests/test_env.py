"""The Gymnasium environment: checker, seeding, history, starts from options, views, vectors, sensors."""

import math
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

import actor.world  # noqa: F401 - registers the environment
from common.cells import ROOMS, arena_index
from common.config import resolve
from common.errors import UsageError
from common.geometry import SE2
from common.tasks import DollyShift, PlacedStart, Task
from common.world_config import StartRanges
from tests.helpers import small_config

NAME = "navaclq/Docking-v0"
STRAIGHT = StartRanges(distance_min=1.6, distance_max=1.6, yaw=0, bearing=0, dolly_yaw=0)
EMPTY = ("world.obstacles.count_min=0", "world.obstacles.count_max=0")
PLAIN = (*EMPTY, 'world.randomization.fixed=["all"]')
QUIET = tuple(
    f"world.randomization.{place}.camera_noise=[0, 0]" for place in ("training", "validation", "test")
)
STILL = np.zeros(2, np.float32)
SMALL = small_config()


@pytest.fixture
def make():
    """Makes environments with overrides of the default configuration, and closes them."""
    made = []

    def one(*overrides: str, **options):
        made.append(gymnasium.make(NAME, config=resolve(overrides=overrides), **options))
        return made[-1]

    yield one
    for env in made:
        env.close()


def middle_of_blue(picture: np.ndarray) -> tuple[float, float]:
    """Mean column and row of the dolly's pixels: nothing else is that blue."""
    red, green, blue = (picture[..., channel].astype(float) for channel in range(3))
    rows, columns = np.nonzero((blue > 1.5 * red) & (blue > 1.5 * green) & (blue > 40))
    assert len(rows) > 10
    return columns.mean(), rows.mean()


def middle_of_yellow(picture: np.ndarray) -> tuple[float, float]:
    """Mean column and row of the arrow on the robot."""
    red, green, blue = (picture[..., channel].astype(float) for channel in range(3))
    rows, columns = np.nonzero((red > 120) & (green > 0.6 * red) & (blue < 0.4 * green))
    assert len(rows) > 10
    return columns.mean(), rows.mean()


def placed(cell: int, x: float, y: float, yaw: float = 0.0, seed: int = 0, **more) -> Task:
    return Task(cell=cell, seed=seed, start=PlacedStart(x=x, y=y, yaw=yaw), **more)


@pytest.mark.filterwarnings("error::UserWarning")  # what it finds doubtful, it warns of
def test_environment_passes_gymnasiums_checker_without_a_warning(make):
    check_env(make(render_mode="rgb_array").unwrapped)


def test_observations_are_a_dict_of_the_declared_spaces(make):
    env = make()
    assert env.observation_space == spaces.Dict(
        camera=spaces.Box(0, 255, (4, 80, 80, 3), np.uint8),
        lidar=spaces.Box(0, 1, (256,), np.float32),
        actions=spaces.Box(-1, 1, (4, 2), np.float32),
        rewards=spaces.Box(-100, 100, (4,), np.float32),
    )
    assert env.action_space == spaces.Box(-1, 1, (2,), np.float32)
    observation, _ = env.reset(seed=4)
    assert observation in env.observation_space
    for _ in range(10):
        observation, reward, ended, cut, _ = env.step(np.array([-1.0, 1.0], np.float32))
        assert observation in env.observation_space
        assert type(reward) is float
        if ended or cut:
            break


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


def test_an_episode_is_the_same_whatever_the_environment_did_before(make):
    fresh, used = make(), make()
    for cell in (10, 3):
        used.reset(options={"cell": cell})
        used.step(np.array([1.0, 1.0], np.float32))
    for env in (fresh, used):
        env.reset(seed=11)
    for _ in range(5):
        one, other = (env.step(np.array([0.6, 0.3], np.float32))[0] for env in (fresh, used))
        assert all(np.array_equal(one[key], other[key]) for key in one)


def test_histories_hold_the_latest_actions_and_rewards_oldest_first(make):
    env = make()
    observation, _ = env.reset(seed=1)
    assert not observation["actions"].any()
    assert not observation["rewards"].any()
    assert all(np.array_equal(observation["camera"][0], frame) for frame in observation["camera"])
    first, reward, *_ = env.step(np.array([0.5, -0.25], np.float32))
    assert first["actions"][-1] == pytest.approx([0.5, -0.25])
    assert not first["actions"][:-1].any()
    assert first["rewards"] == pytest.approx([0, 0, 0, reward])
    assert np.array_equal(first["camera"][2], observation["camera"][3])
    env.step(STILL)
    again, _ = env.reset()
    assert not again["actions"].any()
    assert not again["rewards"].any()


def test_task_in_the_options_sets_the_start_and_ending_stands_in_the_info(make):
    env, task = make(), Task(cell=6, seed=4, start=STRAIGHT)
    _, info = env.reset(options={"task": task})
    assert info["task"] == task.model_dump()
    for _ in range(20):
        _, reward, ended, cut, info = env.step(np.array([1.0, 0.0], np.float32))
        if ended or cut:
            break
        assert (info["ending"], info["is_success"]) == (None, False)
    assert (ended, cut, info["ending"], info["is_success"]) == (True, False, "success", True)
    assert reward == pytest.approx(9.9)


def test_cell_in_the_options_leaves_the_rest_to_the_seed(make):
    env = make()
    tasks = [env.reset(seed=8, options={"cell": cell})[1]["task"] for cell in (3, 3, 10)]
    assert [task["cell"] for task in tasks] == [3, 3, 10]
    assert tasks[0] == tasks[1]
    assert env.reset(options={"cell": 3})[1]["task"]["seed"] != tasks[0]["seed"]


def test_without_options_all_training_cells_are_drawn_and_no_arena(make):
    env = make()
    env.reset(seed=0)
    assert {env.reset()[1]["task"]["cell"] for _ in range(60)} == set(range(9))


def test_running_out_of_time_truncates_and_does_not_terminate():
    env = gymnasium.make(NAME, config=resolve("smoke"))
    env.reset(seed=2)
    for step in range(20):
        _, _, ended, cut, info = env.step(STILL)
        assert ended is False
        assert cut == (step == 19)
    assert info["ending"] == "timeout"
    env.close()


@pytest.mark.parametrize(
    "task",
    [
        placed(arena_index("validation"), -2.5, -6.5, -135),
        placed(arena_index("test"), 2.0, -4.0, 90),
        placed(2, 1.0, -3.0, 180),
    ],
    ids=["validation", "test", "cell 2"],
)
def test_placed_start_stands_where_it_says_in_the_dollys_frame(make, task):
    env = make()
    _, info = env.reset(options={"task": task})
    world, dolly = env.unwrapped._world, ROOMS[task.cell].dolly
    assert (world.dolly.x, world.dolly.y, world.dolly.yaw) == (dolly.x, dolly.y, dolly.yaw)
    expected = (dolly.x + task.start.x, dolly.y + task.start.y)  # a room's own dolly stands straight
    assert (world.pose.x, world.pose.y) == pytest.approx(expected)
    turn = math.remainder(world.pose.yaw - math.radians(task.start.yaw), 2 * math.pi)
    assert turn == pytest.approx(0.0, abs=1e-9)
    assert info["task"]["start"] == task.start.model_dump()


def test_start_beyond_ten_metres_is_possible_in_the_test_arena(make):
    far = StartRanges(distance_min=10.5, distance_max=11.5, bearing=5, yaw=20)
    env, test = make(*PLAIN), arena_index("test")
    observation, _ = env.reset(options={"task": Task(cell=test, seed=1, start=far)})
    world = env.unwrapped._world
    assert 10.5 <= math.hypot(world.dolly.x - world.pose.x, world.dolly.y - world.pose.y) <= 11.5
    assert observation in env.observation_space
    observation, _ = env.reset(options={"task": placed(test, -2.0, -10.2, -10)})
    assert math.hypot(world.dolly.x - world.pose.x, world.dolly.y - world.pose.y) > 10
    assert middle_of_blue(observation["camera"][-1])  # a dolly so far away still is to be seen


def test_impossible_task_is_a_usage_error_and_the_environment_goes_on(make):
    env = make()
    with pytest.raises(UsageError, match=r"no free start in cell 0 \(hall\): .* wall or fixture"):
        env.reset(options={"task": placed(0, 0.0, -15.0)})
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space


def test_dolly_shifts_in_mid_episode_and_is_seen_elsewhere(make):
    env = make(*PLAIN, *QUIET)
    task = placed(0, 0.0, -3.0, shift=DollyShift(step=3, x=0.7, y=-0.4, yaw=20))
    first, info = env.reset(options={"task": task})
    assert info["task"]["shift"] == {"step": 3, "x": 0.7, "y": -0.4, "yaw": 20.0}
    world, before = env.unwrapped._world, env.unwrapped._world.dolly
    for step in range(1, 4):
        observation, *_ = env.step(STILL)
        assert world.dolly == before, f"moved too early, after {step} steps"
        assert np.array_equal(observation["camera"][-1], first["camera"][-1])
    observation, *_ = env.step(STILL)
    expected = before @ SE2(0.7, -0.4, math.radians(20))
    assert (world.dolly.x, world.dolly.y, world.dolly.yaw) == pytest.approx(
        (expected.x, expected.y, expected.yaw)
    )
    place, _ = world.bullet.getBasePositionAndOrientation(world.bodies.dolly)
    assert place == pytest.approx((0.7, 3.6, 0.0))
    columns = [middle_of_blue(frame)[0] for frame in observation["camera"]]
    assert columns[0] == columns[1] == columns[2] == pytest.approx(39.5, abs=1.0)
    assert columns[3] > columns[2] + 10  # to the right
    assert not np.array_equal(observation["lidar"], first["lidar"])
    env.reset(options={"task": placed(0, 0.0, -3.0)})
    assert world.dolly == before


def test_shifted_dolly_is_the_one_to_dock_under(make):
    env = make(*PLAIN)
    env.reset(options={"task": placed(0, 0.0, -3.0, shift=DollyShift(step=1, y=1.5))})
    endings = []
    for _ in range(40):
        _, _, ended, cut, info = env.step(np.array([1.0, 0.0], np.float32))
        endings.append(info["ending"])
        if ended or cut:
            break
    assert endings[-1] == "success"
    world = env.unwrapped._world
    assert (world.dolly.y, world.pose.y) == (pytest.approx(5.5), pytest.approx(5.5, abs=0.3))


def test_birds_eye_view_shows_robot_and_dolly_where_they_are(make):
    env = make(*PLAIN, render_mode="rgb_array", view="birds_eye")
    env.reset(options={"task": placed(0, 2.0, -3.0, 30)})
    picture = env.render()
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    scale = 480 / 12.3  # the hall is 11.5 m deep, and there is an edge of 0.4 m
    for found, (x, y) in (
        (middle_of_blue(picture), (0.0, 4.0)),
        (middle_of_yellow(picture), (2.0, 1.0)),
    ):
        assert found == pytest.approx((240 + scale * x, 240 - scale * (y - 3.25)), abs=8)


def test_chase_view_looks_ahead_from_behind_the_robot(make):
    env = make(*PLAIN, render_mode="rgb_array", view="chase")
    env.reset(options={"task": placed(0, 0.0, -3.0)})
    picture = env.render()
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    dolly, arrow = middle_of_blue(picture), middle_of_yellow(picture)
    assert dolly[0] == pytest.approx(240, abs=5)
    assert arrow[0] == pytest.approx(240, abs=5)
    assert dolly[1] < arrow[1] - 50
    for _ in range(3):
        env.step(np.array([0.0, 1.0], np.float32))
    turned = env.render()
    assert middle_of_yellow(turned) == pytest.approx(arrow, abs=10)  # it turns with the robot
    assert middle_of_blue(turned)[0] > dolly[0] + 50


def test_unknown_view_is_refused():
    with pytest.raises(ValueError, match="'side' does not exist; choose one of birds_eye, chase"):
        gymnasium.make(NAME, view="side")


def run_vector(mode: str, **options) -> tuple[list[dict], list]:
    """25 steps of two environments, over an end of both: observations, and the workers' exit codes."""
    envs = gymnasium.make_vec(NAME, num_envs=2, vectorization_mode=mode, config=SMALL, **options)
    workers = list(getattr(envs, "processes", ()))
    try:
        observation, _ = envs.reset(seed=1)
        seen = [observation]
        actions, cuts = np.array([[-0.1, 0.4], [-0.05, -0.7]], np.float32), []
        for _ in range(25):
            observation, _, _, cut, _ = envs.step(actions)
            seen.append({key: part.copy() for key, part in observation.items()})
            cuts.append(cut.tolist())
    finally:
        envs.close()
    assert [index for index, cut in enumerate(cuts) if any(cut)] == [19]  # max_episode_steps is 20
    return seen, [worker.exitcode for worker in workers]


def test_vector_environments_step_alike_in_this_process_and_in_others_which_exit():
    here, _ = run_vector("sync")
    there, exit_codes = run_vector("async", vector_kwargs={"context": "spawn"})
    assert exit_codes == [0, 0]
    assert here[0]["camera"].shape == (2, 4, 16, 16, 3)
    assert here[0]["lidar"].shape == (2, 4)
    for one, other in zip(here, there, strict=True):
        assert all(np.array_equal(one[key], other[key]) for key in one)
    assert not np.array_equal(here[0]["lidar"][0], here[0]["lidar"][1])  # two seeds
    assert here[20]["actions"].any()
    assert not here[21]["actions"].any()  # a new episode


@pytest.mark.parametrize("noisy", [False, True])
def test_standing_still_brings_the_same_pixels_and_distances_unless_there_is_noise(make, noisy):
    noise = ("world.randomization.training.camera_noise=[2, 3]", "world.lidar.noise=0.02")
    env = make(*(noise if noisy else QUIET))
    env.reset(seed=3)
    first = env.step(STILL)[0]
    second = env.step(STILL)[0]
    assert np.array_equal(first["camera"][-1], second["camera"][-1]) is not noisy
    assert np.array_equal(first["lidar"], second["lidar"]) is not noisy
    difference = second["camera"][-1].astype(int) - first["camera"][-1]
    assert abs(difference).max() < 30
    assert abs(second["lidar"] - first["lidar"]).max() < 0.04  # 0.02 m of 6 m


def test_noise_of_the_sensors_is_seeded_too(make):
    config = (*PLAIN, "world.lidar.noise=0.02", "world.lidar.dropout=0.05")

    def sensed(env, seed: int) -> dict[str, np.ndarray]:
        env.reset(options={"task": placed(0, 0.0, -3.0, seed=seed)})
        return env.step(STILL)[0]

    one, other = make(*config), make(*config)
    sensed(other, 6)
    first, same, different = sensed(one, 5), sensed(other, 5), sensed(other, 6)
    assert all(np.array_equal(first[key], same[key]) for key in first)
    for key in ("camera", "lidar"):  # all the same but the noise
        assert not np.array_equal(first[key], different[key])


def test_lidar_takes_577_beams_over_270_degrees_with_a_short_range(make):
    env = make(*EMPTY, "world.lidar.beams=577", "world.lidar.fov=270", "world.lidar.range=1.5")
    half_length = 1.273 / 2
    # faces the left wall of the hall, x = -5.5, with its front 1 m away
    observation, _ = env.reset(options={"task": placed(0, -5.5 + half_length + 1.0, -4.0, 90)})
    lidar = observation["lidar"]
    assert lidar.shape == (1154,)
    assert lidar in env.observation_space["lidar"]
    front, rear = lidar[:577], lidar[577:]
    angles = 45 + np.linspace(-135, 135, 577)  # of the front one, from straight ahead
    assert front[192] == pytest.approx(1.0 / 1.5, abs=1e-3)  # straight ahead
    for index in (150, 230):
        assert front[index] == pytest.approx(1 / 1.5 / math.cos(math.radians(angles[index])), abs=1e-3)
    assert front[abs(angles) > 50].min() == 1.0  # nothing within 1.5 m
    assert rear[angles < 90].min() == 1.0
