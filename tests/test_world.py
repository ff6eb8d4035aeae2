"""The docking world: endings and rewards by driving into them, sensors against geometry, reproducibility."""

import math
from pathlib import Path

import numpy as np
import pytest

from actor.world.drive import advance, wheel_targets
from actor.world.reward import ending_of, reward
from actor.world.world import NEAR, DockingWorld
from common.cells import CELLS, ROOMS, Box
from common.config import resolve
from common.geometry import SE2, Rectangle
from common.tasks import DollyShift, Obstacle, Scene, Task, obstacle_catalogue, random_task
from common.world_config import RewardConfig, RobotConfig, StartRanges

CONFIG = resolve(overrides=('world.randomization.fixed=["all"]',))
STRAIGHT = StartRanges(distance_min=2.0, distance_max=2.0, yaw=0.0, bearing=0.0, dolly_yaw=0.0)
STEP = CONFIG.world.reward.step
SLOW = CONFIG.world.reward.slow


@pytest.fixture(scope="module")
def world():
    world = DockingWorld(CONFIG.world, max_steps=100)
    yield world
    world.close()


def put(world: DockingWorld, robot: SE2, dolly: SE2 = SE2(0.0, 3.0)) -> None:  # noqa: B008 - immutable
    """An episode of cell 0 with robot and dolly at these poses and nothing else near them."""
    world.place(Task(cell=0, seed=0, start=STRAIGHT))
    world.bodies.arrange(())
    world.scene = Scene(robot, dolly, ())
    world.stand(robot, dolly)


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
    left, right, back, _ = CELLS[0].extent
    assert min(x - left, right - x, y - back) == pytest.approx(0.0, abs=0.006)


def test_obstacle_contact_is_other_contact_at_its_face(world):
    put(world, SE2())
    half_x, half_y, height, kind = obstacle_catalogue(CONFIG.world.obstacles)[3]
    box = Box(Rectangle(SE2(0.0, 2.0, math.pi / 2), half_x, half_y), height, kind)
    world.scene = Scene(SE2(), world.dolly, (Obstacle(3, box),))
    world.bodies.arrange(world.scene.obstacles)
    world.stand(SE2(), world.dolly)
    assert drive(world, (1.0, 0.0))[-1].ending == "other_contact"
    front = world.pose.y + CONFIG.world.robot.length / 2
    assert front == pytest.approx(2.0 - half_x, abs=0.006)


def test_fixture_contact_is_other_contact(world):
    cell = next(i for i, room in enumerate(CELLS) if any(box.kind == "pillar" for box in room.fixtures))
    pillar = next(box for box in CELLS[cell].fixtures if box.kind == "pillar").footprint
    world.place(Task(cell=cell, seed=1, start=STRAIGHT))
    world.bodies.arrange(())
    world.stand(SE2(pillar.pose.x, pillar.pose.y - 1.5), world.dolly)
    assert drive(world, (1.0, 0.0))[-1].ending == "other_contact"
    front = world.pose.y + CONFIG.world.robot.length / 2
    assert front == pytest.approx(pillar.pose.y - pillar.half_y, abs=0.006)


def test_nothing_is_passed_through_at_full_speed_backwards_into_a_leg_edge_on(world):
    """One leg is 40 mm thin, a substep at full speed 6 mm long."""
    put(world, SE2(-0.42 - 0.63 / 2 + 0.01, 6.0))
    last = drive(world, (-1.0, 0.0))[-1]
    assert last.ending == "dolly_contact"
    assert world.pose.y - CONFIG.world.robot.length / 2 == pytest.approx(3.615, abs=0.006)


def test_an_action_that_is_no_number_is_refused(world):
    put(world, SE2())
    for action in ((math.nan, 0.0), (0.0, math.nan)):
        with pytest.raises(ValueError, match="is not a number"):
            world.step(action)
    assert world.steps == 0
    assert world.pose == SE2()


def test_actions_beyond_the_limits_are_cut(world):
    put(world, SE2())
    world.step((math.inf, -7.0))
    far = world.pose
    put(world, SE2())
    world.step((1.0, -1.0))
    assert world.pose == far


def test_watching_every_substep_of_every_step_would_change_nothing(monkeypatch):
    """Drives of all kinds, by the world as it is and by one that never takes anything to be out of reach."""
    config, rng = resolve("smoke").world, np.random.default_rng(6)
    usual, watchful = DockingWorld(config, 40), DockingWorld(config, 40)
    monkeypatch.setattr(watchful, "_is_anything_near", lambda targets: True)
    near = steps = 0
    for index in range(60):
        task = random_task(index % len(ROOMS), resolve("smoke"), rng)
        habit = rng.choice([-0.8, 0.8]), rng.uniform(-0.3, 0.3)
        for world in (usual, watchful):
            world.place(task)
        ending = None
        while ending is None:
            action = np.clip(habit + rng.normal(0, 0.5, 2), -1, 1)
            ending = (found := usual.advance(action))[1]
            assert found == watchful.advance(action)
            assert (usual.pose, usual.speeds) == (watchful.pose, watchful.speeds)
            near += usual._gap < NEAR
            steps += 1
    assert 100 < near < steps / 2
    usual.close()
    watchful.close()


def test_docking_under_a_wide_dolly_is_seen_at_its_substep():
    """Its legs are too far away to tell that the robot is about to dock."""
    config = resolve(overrides=("world.dolly.width=2.5",)).world
    world = DockingWorld(config, 100)
    put(world, SE2(0.0, 1.0))
    assert drive(world, (1.0, 0.0))[-1].ending == "success"
    distance = math.hypot(world.pose.x - world.dolly.x, world.pose.y - world.dolly.y)
    assert distance == pytest.approx(config.reward.success_distance, abs=0.006)
    world.close()


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
    robot, dt = RobotConfig(), 0.005
    motion = advance(robot, SE2(), (0.0, 0.0), wheel_targets(robot, 1.0, 0.0), dt, 200)
    expected = np.minimum(1.0, 3.0 * dt * np.arange(1, 201))
    assert motion.left == pytest.approx(expected)
    assert motion.right == pytest.approx(expected)
    assert motion.y[-1] == pytest.approx(1.0 * 1.0 - 1.0 / (2 * 3.0), abs=0.003)  # v t - v^2 / 2a
    assert not motion.x.any()
    back = advance(robot, SE2(), (1.0, -0.5), (0.9, 0.0), dt, 50)
    assert (back.left[0], back.left[-1]) == pytest.approx((0.985, 0.9))
    assert (back.right[0], back.right[-1]) == pytest.approx((-0.485, 0.0))


def test_a_motion_in_one_piece_equals_the_same_in_two():
    robot, dt = RobotConfig(), 0.005
    whole = advance(robot, SE2(1.0, 2.0, 0.3), (0.2, -0.4), (1.0, 0.7), dt, 36)
    first = advance(robot, SE2(1.0, 2.0, 0.3), (0.2, -0.4), (1.0, 0.7), dt, 10)
    pose = SE2(first.x[-1], first.y[-1], first.yaw[-1])
    rest = advance(robot, pose, (first.left[-1], first.right[-1]), (1.0, 0.7), dt, 26)
    assert (rest.x[-1], rest.y[-1], rest.yaw[-1]) == pytest.approx((whole.x[-1], whole.y[-1], whole.yaw[-1]))


def test_turning_on_the_spot_keeps_the_centre_and_circles_have_radius_v_over_w():
    robot = RobotConfig(wheel_acceleration=1e6)
    motion = advance(robot, SE2(1.0, 2.0), (0.0, 0.0), wheel_targets(robot, 0.0, 1.0), 0.005, 200)
    assert motion.x == pytest.approx(1.0)
    assert motion.y == pytest.approx(2.0)
    assert motion.yaw[-1] == pytest.approx(1.0)
    steps = int(2 * math.pi / 0.5 / 0.001)
    circle = advance(robot, SE2(), (0.0, 0.0), wheel_targets(robot, 0.5, 0.5), 0.001, steps)
    assert np.hypot(circle.x + 1.0, circle.y) == pytest.approx(1.0, abs=1e-3)


def test_wheels_slow_down_together_so_that_the_curve_stays():
    left, right = wheel_targets(RobotConfig(), 1.0, 1.0)
    assert right == pytest.approx(1.2)
    assert (right - left) / 0.5 / ((right + left) / 2) == pytest.approx(1.0)


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


def test_dolly_moves_at_its_step_and_the_episode_is_about_its_new_place(world):
    task = Task(cell=5, seed=3, start=STRAIGHT, shift=DollyShift(step=4, x=1.0, y=0.5, yaw=10.0))
    world.place(task)
    first = world.dolly
    seen = []
    for _ in range(6):
        seen.append(world.dolly)
        world.step((0.0, 0.0))
    assert seen == [first] * 5 + [world.dolly]
    assert world.dolly == world.scene.shifted == first @ SE2(1.0, 0.5, math.radians(10.0))
    position, _ = world.bullet.getBasePositionAndOrientation(world.bodies.dolly)
    assert position[:2] == pytest.approx((world.dolly.x, world.dolly.y))
    world.stand(world.dolly @ SE2(0.0, -1.5), world.dolly)
    assert drive(world, (1.0, 0.0))[-1].ending == "success"
    world.place(task.model_copy(update={"shift": None}))
    assert world.dolly == first


def test_dolly_waits_while_the_robot_stands_in_its_new_place(world):
    world.place(Task(cell=5, seed=3, start=STRAIGHT, shift=DollyShift(step=1, x=2.0)))
    first, away = world.dolly, world.pose
    world.stand(world.scene.shifted, first)
    world.step((0.0, 0.0))
    world.step((0.0, 0.0))
    assert world.dolly == first
    world.stand(away, first)
    world.step((0.0, 0.0))
    assert world.dolly == world.scene.shifted


def test_every_room_can_be_entered_again_without_a_trace_and_memory_stays():
    """Bullet never gives back all that a removed body or shape took."""
    config = resolve("smoke", overrides=("world.camera.size=16", "world.lidar.beams=2"))
    world, rng = DockingWorld(config.world, 10), np.random.default_rng(0)

    def resets(count: int) -> None:
        for i in range(count):
            world.reset(random_task(i % len(ROOMS), config, rng))

    resets(100)
    before, bodies = resident(), world.bullet.getNumBodies()
    resets(450)
    assert world.bullet.getNumBodies() == bodies
    assert resident() - before < 4 * 2**20
    world.close()


def resident() -> int:
    """Bytes of memory in use by this process."""
    status = Path("/proc/self/status").read_text("ascii")
    return 1024 * int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


def test_frame_is_uint8_and_lidar_is_float16_in_the_unit_interval(world):
    sensed = world.reset(Task(cell=1, seed=3, start=CONFIG.world.start))
    assert sensed.frame.shape == (80, 80, 3)
    assert sensed.frame.dtype == np.uint8
    assert sensed.frame.std() > 5  # a picture, not a blank
    assert sensed.lidar.shape == (256,)
    assert sensed.lidar.dtype == np.float16
    assert 0 < sensed.lidar.min() <= sensed.lidar.max() <= 1
