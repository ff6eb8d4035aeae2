"""The scripted controller on a kinematic model of the robot, the arithmetic of drive.py without simulator."""

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from actor.baseline.docking import ScriptedController
from actor.baseline.planning import plan
from actor.baseline.tracking import approach
from actor.evaluation.examiner import Rival, Terms, examine
from actor.evaluation.suites import grid
from actor.world.world import DockingWorld
from common.cells import Box
from common.config import Config
from common.geometry import SE2, Rectangle, as_rows, separations, wrap
from common.tasks import Obstacle, Scene, build_scene, dolly_sides, random_task, surfaces
from deploy.task_table import starts_to_solve

CONFIG = Config()
WORLD = CONFIG.world
HALF = WORLD.robot.width / 2, WORLD.robot.length / 2
DOLLY = SE2(0.0, 4.0)


@dataclass
class Run:
    ending: str = "timeout"
    poses: list[SE2] = field(default_factory=list)
    """At the start of each control step, and at the end."""
    actions: list[tuple[float, float]] = field(default_factory=list)


def crate(x, y, half_x, half_y):
    return Obstacle(0, Box(Rectangle(SE2(x, y), half_x, half_y), 1.0))


def drive(scene, steps, cell=0, dolly_at=None, push_at=None):
    """Runs the controller; `dolly_at(step)` moves the dolly, `push_at(step, pose)` the robot."""
    controller = ScriptedController(WORLD, surfaces(cell, scene))
    pose, wheels, run = scene.robot, np.zeros(2), Run()
    dt = WORLD.control_period / WORLD.substeps
    for step in range(steps):
        dolly = dolly_at(step) if dolly_at else scene.dolly
        pose = push_at(step, pose) if push_at else pose
        run.poses.append(pose)
        v, w = controller.act(pose, dolly, (float(wheels[0]), float(wheels[1])))
        assert abs(v) <= 1 and abs(w) <= 1
        run.actions.append((v, w))
        targets = v + np.array([-1, 1]) * w * WORLD.robot.track / 2
        targets *= min(1.0, WORLD.robot.max_speed / max(np.abs(targets).max(), 1e-9))
        swept = []
        for _ in range(WORLD.substeps):
            limit = WORLD.robot.wheel_acceleration * dt
            wheels = wheels + np.clip(targets - wheels, -limit, limit)
            turn = (wheels[1] - wheels[0]) / WORLD.robot.track * dt
            pose = pose @ SE2(0.0, 0.0, turn / 2) @ SE2(0.0, wheels.mean() * dt, turn / 2)
            swept.append((pose.x, pose.y, pose.yaw))
        solids = as_rows([*surfaces(cell, scene), *dolly_sides(dolly, WORLD)])
        touching = separations(np.array(swept), HALF, solids).min(axis=1) <= 0
        docked = [math.hypot(x - dolly.x, y - dolly.y) <= WORLD.reward.success_distance for x, y, _ in swept]
        if touching.any() or any(docked):
            first = np.argmax(docked | touching)
            run.ending = "contact" if touching[first] else "docked"
            run.poses.append(SE2(*swept[first]))
            break
    return run


@pytest.mark.parametrize("rate", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("distance", [-1.3, 0.02, 0.4, 3.0])
def test_a_drive_stops_where_it_should(rate, distance):
    acceleration, period, done, furthest = 3.0, 0.18, 0.0, -math.inf
    for _ in range(40):
        command = approach(distance - done, rate, acceleration, period)
        assert abs(command) <= 1
        for _ in range(180):
            rate += min(max(command - rate, -acceleration * 1e-3), acceleration * 1e-3)
            done += rate * 1e-3
        furthest = max(furthest, math.copysign(1.0, distance) * (done - distance))
    assert done == pytest.approx(distance, abs=0.002)
    braking = rate * rate / (2 * acceleration)
    if abs(distance) >= 0.4:
        assert furthest < 0.005 + braking


def test_it_goes_round_an_obstacle_to_the_other_side():
    scene = Scene(SE2(0.0, 0.0), DOLLY, (crate(0.0, 2.4, 0.6, 0.3),))
    run = drive(scene, 200)
    assert run.ending == "docked"
    assert run.poses[-1].y > DOLLY.y  # no robot fits between the box and the near side
    assert drive(Scene(SE2(0.0, 0.0), DOLLY, ()), 200).poses[-1].y < DOLLY.y


def test_paths_keep_their_margin():
    scene = Scene(SE2(0.0, 0.0), DOLLY, (crate(0.0, 2.4, 0.6, 0.3),))
    path = plan(scene.robot, DOLLY, surfaces(0, scene), WORLD)
    solids = as_rows(surfaces(0, scene))
    for a, b in itertools.pairwise(path):
        assert wrap(a.yaw - b.yaw) == 0 or math.hypot(a.x - b.x, a.y - b.y) < 1e-9
        share = np.linspace(0, 1, 60)[:, None]
        move = np.array([b.x - a.x, b.y - a.y, wrap(b.yaw - a.yaw)])
        between = np.array([a.x, a.y, a.yaw]) + share * move
        assert separations(between, HALF, solids).min() > 0.05


def test_it_reverses_out_where_it_cannot_turn():
    alley = (crate(-0.55, 0.5, 0.1, 1.2), crate(0.55, 0.5, 0.1, 1.2), crate(0.0, 1.7, 0.6, 0.1))
    run = drive(Scene(SE2(0.0, 0.5), SE2(0.0, 5.0), alley), 200)
    assert run.ending == "docked"
    first = next(i for i, (v, _) in enumerate(run.actions) if v)
    assert run.actions[first][0] < 0
    assert min(pose.y for pose in run.poses) < -0.5


@pytest.mark.parametrize("yaw", [0, 45, 90, -90, 180])
@pytest.mark.parametrize("side", [-0.5, 0.3])
def test_a_near_start_beside_the_axis_docks(side, yaw):
    run = drive(Scene(DOLLY @ SE2(side, -1.5, math.radians(yaw)), DOLLY, ()), 80)
    assert run.ending == "docked"


@pytest.mark.parametrize("step", [2, 10, 16])
@pytest.mark.parametrize("shift", [SE2(1.0, 0.3, 0.4), SE2(-0.8, 0.8, -0.3), SE2(0.3, 1.0, 0.0)])
def test_it_follows_a_shifted_dolly(step, shift):
    shifted = DOLLY @ shift
    scene = Scene(SE2(0.3, 0.5), DOLLY, (), shifted)
    run = drive(scene, 150, dolly_at=lambda now: shifted if now >= step else DOLLY)
    assert run.ending == "docked" and len(run.actions) > step
    end = run.poses[-1]
    assert math.hypot(end.x - shifted.x, end.y - shifted.y) == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("push", [SE2(0.045), SE2(-0.045), SE2(0.025, 0.0, -0.03)])
def test_pushed_aside_under_the_dolly_it_stops_and_plans_anew(push):
    pushed = []

    def push_at(step, pose):
        if not pushed and pose.y > DOLLY.y - 0.9:
            pushed.append(step)
            return pose @ push  # steering on would swing the rear into a leg
        return pose

    run = drive(Scene(SE2(0.0, 1.5), DOLLY, ()), 150, push_at=push_at)
    assert pushed and run.ending == "docked"
    v, w = run.actions[pushed[0]]
    assert v < 0.5 and w == 0


@pytest.mark.parametrize("push", [0.07, -0.07])
def test_it_steers_back_to_its_line(push):
    def push_at(step, pose):
        return SE2(pose.x + push, pose.y, pose.yaw) if step == 5 else pose

    run = drive(Scene(SE2(0.0, 0.0), DOLLY, ()), 60, push_at=push_at)
    assert run.ending == "docked" and min(v for v, _ in run.actions) > 0
    assert abs(run.poses[-1].x) < 0.01


def test_it_drives_in_along_the_middle():
    run = drive(Scene(SE2(0.7, 1.0, 0.8), DOLLY, ()), 60)
    assert run.ending == "docked"
    under = [pose for pose in run.poses if pose.y > DOLLY.y - 1.3]
    assert len(under) > 3
    assert max(max(abs(pose.x), abs(pose.yaw)) for pose in under) < 0.006


def test_it_waits_while_there_is_no_way_and_goes_when_there_is():
    walled = (crate(0.0, 2.6, 1.0, 0.2), crate(0.0, 5.4, 1.0, 0.2))
    scene = Scene(SE2(3.0, 2.0, 1.0), DOLLY, walled)
    run = drive(scene, 150, dolly_at=lambda now: SE2(-2.5, 4.0) if now >= 5 else DOLLY)
    assert run.actions[:5] == [(0.0, 0.0)] * 5
    assert run.ending == "docked"


def test_it_docks_from_a_sample_of_training_starts():
    rng = np.random.default_rng(11)
    tasks = [random_task(i % 9, CONFIG, rng) for i in range(60)]
    endings = [drive(build_scene(task, WORLD), 100, task.cell).ending for task in tasks]
    assert endings == ["docked"] * 60


def test_it_docks_from_a_sample_of_the_grid():
    tasks = grid("quick", "validation").tasks[::25]
    endings = [drive(build_scene(task, WORLD), 200, task.cell).ending for task in tasks]
    assert endings == ["docked"] * len(tasks)


@pytest.mark.slow
def test_it_docks_from_98_of_100_training_starts_in_the_simulator():
    tasks, limit = starts_to_solve(CONFIG, 500), WORLD.max_episode_steps
    drives = examine(Rival("b0", CONFIG), tasks, 2, Terms(max_steps=limit))
    assert [drive.ending for drive in drives].count("success") >= 0.98 * len(tasks)


@pytest.mark.slow
def test_it_docks_from_97_of_100_grid_starts_in_the_simulator():
    drives = examine(Rival("b0", CONFIG), grid("quick", "validation").tasks, 2)
    assert [drive.ending for drive in drives].count("success") >= 0.97 * 968


def test_the_simulator_agrees_with_the_model_of_it_used_here():
    """The same controller in pybullet: an ending after as many steps, at the same place."""
    world = DockingWorld(WORLD, 100)
    rng = np.random.default_rng(4)
    for index in range(9):
        task = random_task(index, CONFIG, rng)
        world.place(task)
        controller, ending = ScriptedController(WORLD, surfaces(task.cell, world.scene)), None
        while ending is None:
            _, ending = world.advance(controller.act(world.pose, world.dolly, world.speeds))
        run = drive(build_scene(task, WORLD), 100, task.cell)
        assert (ending, run.ending) == ("success", "docked")
        assert world.steps == len(run.actions)
        assert (world.pose.x, world.pose.y) == pytest.approx((run.poses[-1].x, run.poses[-1].y), abs=1e-6)
    world.close()
