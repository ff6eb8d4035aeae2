"""The docking world: endings and rewards by driving into them, sensors against geometry, reproducibility."""

import math

import numpy as np
import pytest

from actor.world.drive import DifferentialDrive
from actor.world.reward import ending_of, reward
from actor.world.sensors import Light, render
from actor.world.world import DockingWorld
from common.config import RewardConfig, RobotConfig, StartRanges, resolve
from common.geometry import SE2
from common.tasks import CELLS, Box, Scene, Task, random_task

CONFIG = resolve(overrides=("world.randomize_appearance=false",))
STRAIGHT = StartRanges(distance_min=2.0, distance_max=2.0, yaw=0.0, bearing=0.0, dolly_yaw=0.0)
STEP = CONFIG.world.reward.step
SLOW = CONFIG.world.reward.slow


@pytest.fixture(scope="module")
def world():
    world = DockingWorld(CONFIG.world, max_steps=100)
    yield world
    world.close()


def put(world: DockingWorld, robot: SE2, dolly: SE2 = SE2(0.0, 3.0)) -> None:  # noqa: B008 - immutable
    """An episode of cell 0 with robot and dolly at these poses and nothing else in the room."""
    world.reset(Task(cell=0, seed=0, start=STRAIGHT))
    world.bodies.build_boxes((), world.appearance)
    world.pose, world.dolly = robot, dolly
    world.scene = Scene(robot, dolly, ())
    world.bodies.place(world.bodies.robot, robot)
    world.bodies.place(world.bodies.dolly, dolly)
    world.bullet.performCollisionDetection()


def drive(world: DockingWorld, action: tuple[float, float], limit: int = 60):
    """Repeats an action until the episode ends; all steps."""
    steps = []
    for _ in range(limit):
        steps.append(world.step(action))
        if steps[-1].ending:
            return steps
    raise AssertionError(f"no ending within {limit} steps")


@pytest.mark.parametrize(("side", "v"), [(-1, 1.0), (1, 1.0), (-1, -1.0)])
def test_entry_through_either_short_side_forwards_or_backwards_is_success(world, side, v):
    heading = 0.0 if (side < 0) == (v > 0) else math.pi
    put(world, SE2(0.0, 3.0 + side * 2.0, heading))
    steps = drive(world, (v, 0.0))
    last = steps[-1]
    assert last.ending == "success"
    assert math.hypot(world.pose.x, world.pose.y - 3.0) < CONFIG.world.reward.success_distance
    slow = SLOW if v < 0 else 0.0
    assert last.reward == pytest.approx(STEP + slow + 10.0)
    assert steps[-2].reward == pytest.approx(STEP + slow)
    assert math.hypot(world.pose.x, world.pose.y - 3.0) > 0.25  # seen at once, not a control step later


def test_sideways_entry_is_contact_not_success(world):
    put(world, SE2(-2.0, 3.0, -math.pi / 2))
    last = drive(world, (1.0, 0.0))[-1]
    assert last.ending == "dolly_contact"
    assert last.reward == pytest.approx(STEP - 0.1)
    front = world.pose.x + CONFIG.world.robot.length / 2
    assert front == pytest.approx(-CONFIG.world.dolly.width / 2, abs=0.006)  # at the rail


@pytest.mark.parametrize("offset", [0.07, -0.07])
def test_entry_beside_the_clearance_touches_a_leg(world, offset):
    put(world, SE2(offset, 1.0))
    last = drive(world, (1.0, 0.0))[-1]
    assert last.ending == "dolly_contact"
    front = world.pose.y + CONFIG.world.robot.length / 2
    assert front == pytest.approx(3.0 - CONFIG.world.dolly.length / 2, abs=0.006)


@pytest.mark.parametrize("offset", [0.045, -0.045])
def test_entry_within_the_clearance_docks(world, offset):
    put(world, SE2(offset, 1.0))
    assert drive(world, (1.0, 0.0))[-1].ending == "success"


@pytest.mark.parametrize("yaw", [math.pi / 2, -math.pi / 2, math.pi])
def test_wall_contact_is_other_contact_at_the_wall(world, yaw):
    put(world, SE2(0.0, 0.0, yaw))
    last = drive(world, (1.0, 0.0))[-1]
    assert last.ending == "other_contact"
    assert last.reward == pytest.approx(STEP - 10.0)
    x, y = world.pose.apply(0.0, CONFIG.world.robot.length / 2)
    cell = CELLS[0]
    assert min(x - cell.left, cell.right - x, y - cell.back) == pytest.approx(0.0, abs=0.006)


def test_obstacle_contact_is_other_contact(world):
    put(world, SE2())
    from common.geometry import Rectangle

    box = Box(Rectangle(SE2(0.0, 1.5, 0.4), 0.3, 0.2), 0.5)
    world.bodies.build_boxes((box,), world.appearance)
    assert drive(world, (1.0, 0.0))[-1].ending == "other_contact"


def test_standing_still_runs_out_of_time_and_costs_the_slow_penalty(world):
    put(world, SE2())
    steps = drive(world, (0.0, 0.0), limit=100)
    assert len(steps) == 100
    assert steps[-1].ending == "timeout"
    assert {round(step.reward, 9) for step in steps} == {round(STEP + SLOW, 9)}


def test_speed_for_the_slow_penalty_is_measured_at_the_end_of_the_step(world):
    put(world, SE2())
    assert world.step((0.29, 0.0)).reward == pytest.approx(STEP + SLOW)
    put(world, SE2())
    assert world.step((0.31, 0.0)).reward == pytest.approx(STEP)


def test_success_wins_a_tie_then_the_worse_contact():
    config = RewardConfig()
    assert ending_of(config, 0.29, True, True) == "success"
    assert ending_of(config, 0.30, True, True) == "other_contact"
    assert ending_of(config, 0.30, True, False) == "dolly_contact"
    assert ending_of(config, 0.30, False, False) is None


def test_reward_terms_add_up_as_in_section_3_3():
    config = RewardConfig()
    assert reward(config, 0.3, None) == pytest.approx(-0.1)
    assert reward(config, 0.299, None) == pytest.approx(-0.15)
    assert reward(config, -1.0, "timeout") == pytest.approx(-0.15)
    assert reward(config, 0.5, "dolly_contact") == pytest.approx(-0.2)
    assert reward(config, 0.5, "other_contact") == pytest.approx(-10.1)
    assert reward(config, 0.0, "success") == pytest.approx(9.85)


def test_wheels_accelerate_within_their_limit_and_stop_at_the_target():
    drive_ = DifferentialDrive(RobotConfig())
    pose, dt = SE2(), 0.005
    for k in range(1, 201):
        pose = drive_.advance(pose, drive_.targets(1.0, 0.0), dt)
        assert drive_.speed == pytest.approx(min(1.0, 3.0 * k * dt))
    assert pose.y == pytest.approx(1.0 * 1.0 - 1.0 / (2 * 3.0), abs=0.003)  # v t - v^2 / 2a
    assert pose.x == 0.0


def test_turning_on_the_spot_keeps_the_centre_and_circles_have_radius_v_over_w():
    drive_ = DifferentialDrive(RobotConfig(wheel_acceleration=1e6))
    pose = SE2(1.0, 2.0)
    for _ in range(200):
        pose = drive_.advance(pose, drive_.targets(0.0, 1.0), 0.005)
    assert (pose.x, pose.y) == (1.0, 2.0)
    assert pose.yaw == pytest.approx(1.0)
    drive_, pose = DifferentialDrive(RobotConfig(wheel_acceleration=1e6)), SE2()
    for _ in range(int(2 * math.pi / 0.5 / 0.001)):
        pose = drive_.advance(pose, drive_.targets(0.5, 0.5), 0.001)
        assert math.hypot(pose.x + 1.0, pose.y) == pytest.approx(1.0, abs=1e-3)


def test_wheels_slow_down_together_so_that_the_curve_stays():
    drive_ = DifferentialDrive(RobotConfig())
    left, right = drive_.targets(1.0, 1.0)
    assert right == pytest.approx(1.2)
    assert (right - left) / 0.5 / ((right + left) / 2) == pytest.approx(1.0)


def test_lidar_measures_the_distance_to_the_walls_of_an_empty_room(world):
    far = SE2(20.0, 20.0)  # the dolly outside the room
    cell = CELLS[0]
    for pose in (SE2(), SE2(3.0, 5.0, 0.7), SE2(-2.0, 6.5, -2.5)):
        put(world, pose, far)
        measured = world.lidar.sense(world.bullet, pose).astype(float) * 6.0
        starts, ends = world.lidar.rays(pose)
        direction = (ends - starts)[:, :2] / 6.0
        with np.errstate(divide="ignore"):
            bounds = np.stack(
                [
                    (np.where(direction[:, 0] > 0, cell.right, cell.left) - starts[:, 0]) / direction[:, 0],
                    (np.where(direction[:, 1] > 0, cell.front, cell.back) - starts[:, 1]) / direction[:, 1],
                ]
            )
        expected = np.minimum(np.abs(bounds).min(0), 6.0)
        assert np.abs(measured - expected).max() < 0.01
        assert (expected < 6.0).any()


def test_lidars_sit_on_diagonal_corners_and_never_see_the_robot(world):
    put(world, SE2(), SE2(20.0, 20.0))
    starts, ends = world.lidar.rays(SE2())
    assert starts[0] == pytest.approx([-0.315, 0.6365, 0.2])
    assert starts[-1] == pytest.approx([0.315, -0.6365, 0.2])
    half = len(starts) // 2
    assert half == 128
    for part, middle in ((slice(0, half), math.pi / 4), (slice(half, None), -3 * math.pi / 4)):
        d = (ends - starts)[part]
        angles = np.unwrap(np.arctan2(-d[:, 0], d[:, 1]))
        assert np.degrees(angles[-1] - angles[0]) == pytest.approx(225.0)
        assert math.cos(np.mean([angles[0], angles[-1]]) - middle) == pytest.approx(1.0)
    assert world.lidar.sense(world.bullet, SE2()).min() > 0.2  # nothing within 1.2 m: not even itself


def test_lidar_sees_the_dollys_legs_but_neither_rails_nor_deck(world):
    put(world, SE2(0.0, 1.0))
    starts, ends = world.lidar.rays(SE2(0.0, 1.0))
    reach = world.lidar.sense(world.bullet, SE2(0.0, 1.0)).astype(float)[:, None]
    hits = (starts + reach * (ends - starts))[reach[:, 0] < 1.0]
    inside = hits[(np.abs(hits[:, 0]) < 0.42) & (np.abs(hits[:, 1] - 3.0) < 0.63)]
    assert len(inside) >= 2
    legs = [(sx * 0.39, 3.0 + sy * 0.595) for sx in (-1, 1) for sy in (-1, 1)]
    nearest = [min(max(abs(x - lx), abs(y - ly)) for lx, ly in legs) for x, y, _ in inside]
    assert max(nearest) < 0.02 + 0.006  # a hit lies on the surface of a leg, in float16


def test_camera_sees_the_dolly_where_the_pinhole_model_says(world):
    pose = SE2(0.3, 0.2, 0.2)
    put(world, pose)
    image = world.camera.sense(world.bullet, pose, Light()).astype(int)
    blue = (image[..., 2] > 1.8 * image[..., 0]) & (image[..., 2] > 1.5 * image[..., 1])
    rows, columns = np.nonzero(blue)
    focal = 40 / math.tan(math.radians(47.0) / 2)
    d = CONFIG.world.dolly
    eye = pose @ SE2(0.0, CONFIG.world.robot.length / 2)
    us, vs = [], []
    for sx in (-1, 1):
        for sy in (-1, 1):
            for z in (0.0, d.underside + d.deck):
                x, y = eye.inverse().apply(sx * d.width / 2, 3.0 + sy * d.length / 2)
                us.append(40 + focal * x / y)
                vs.append(40 - focal * (z - 0.165) / y)
    assert columns.min() == pytest.approx(min(us), abs=1.5)
    assert columns.max() == pytest.approx(max(us), abs=1.5)
    assert rows.min() == pytest.approx(min(vs), abs=1.5)
    assert rows.max() == pytest.approx(max(vs), abs=1.5)


def test_same_task_gives_the_same_episode_to_the_bit_in_a_used_and_in_a_fresh_world():
    config = resolve().world
    rng = np.random.default_rng(5)
    actions = rng.uniform(-1, 1, (30, 2))
    task = Task(cell=4, seed=99, start=config.start)

    def episode(world: DockingWorld):
        rows = [world.reset(task)]
        rewards = []
        for action in actions:
            step = world.step(action)
            rows.append(step.sensed)
            rewards.append(step.reward)
            if step.ending:
                break
        return rows, rewards, world.pose

    used = DockingWorld(config, 100)
    for other in range(4):  # other cells and boxes before must leave no trace
        used.reset(random_task(other, resolve(), rng))
        used.step((1.0, 0.5))
    first, fresh = episode(used), episode(DockingWorld(config, 100))
    assert first[1:] == fresh[1:]
    for a, b in zip(first[0], fresh[0], strict=True):
        assert np.array_equal(a.frame, b.frame)
        assert np.array_equal(a.lidar, b.lidar)


def test_appearance_differs_between_seeds_and_can_be_switched_off(world):
    random = DockingWorld(resolve().world, 10)
    start = resolve().world.start
    looks = [random.reset(Task(cell=2, seed=s, start=start)) and random.appearance for s in (1, 2)]
    assert looks[0] != looks[1]
    world.reset(Task(cell=2, seed=1, start=start))
    plain = world.appearance
    world.reset(Task(cell=2, seed=2, start=start))
    assert world.appearance == plain
    random.close()


def test_frame_is_uint8_and_lidar_is_float16_in_the_unit_interval(world):
    sensed = world.reset(Task(cell=1, seed=3, start=CONFIG.world.start))
    assert sensed.frame.shape == (80, 80, 3)
    assert sensed.frame.dtype == np.uint8
    assert sensed.frame.std() > 5  # a picture, not a blank
    assert sensed.lidar.shape == (256,)
    assert sensed.lidar.dtype == np.float16
    assert 0 < sensed.lidar.min() <= sensed.lidar.max() <= 1


def test_robot_is_not_in_its_own_picture(world):
    put(world, SE2(), SE2(20.0, 20.0))
    front = world.camera.sense(world.bullet, SE2(), Light())
    world.bodies.place(world.bodies.robot, SE2(20.0, 20.0))
    assert np.array_equal(front, world.camera.sense(world.bullet, SE2(), Light()))
    view = world.bullet.computeViewMatrix((0, 0, 40), (0, 0, 0), (0, 1, 0))
    clip = world.config.camera.model_copy(update={"near": 10.0, "far": 45.0})
    away = render(world.bullet, view, 80, 5.0, clip, Light())
    world.bodies.place(world.bodies.robot, SE2())
    assert not np.array_equal(away, render(world.bullet, view, 80, 5.0, clip, Light()))
