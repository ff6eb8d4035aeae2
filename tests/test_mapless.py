"""The rivals that sense, as a whole: in a plane world without simulator, and blind to everything else."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from actor.baseline.localization import KnownRoom, LikelihoodField, ParticleFilter
from actor.baseline.pilot import NoMap, Pilot
from actor.baseline.registry import BASELINES, make_baseline
from actor.baseline.sensing import START_ERROR, MaplessActor, MappedActor
from actor.rollout import Rollout
from actor.world.drive import advance, wheel_targets
from common.cells import ROOMS
from common.config import Config
from common.errors import UsageError
from common.geometry import SE2, Rectangle
from common.observation import Observation, ObservationLayout
from common.tasks import PlacedStart, Task
from tests.flatland import WORLD, cast, ending, legs, shoot

DOLLY = SE2(0.0, 4.0)


def drive(pilot, pose, cell=0, steps=200, dolly_at=lambda step: DOLLY, extra=()):
    """How it ends, and the poses on the way."""
    solids, speeds, last, poses = [*ROOMS[cell].solids, *extra], (0.0, 0.0), None, [pose]
    dt = WORLD.control_period / WORLD.substeps
    for step in range(steps):
        dolly = dolly_at(step)
        lidar = cast(pose, [*solids, *legs(dolly)])
        last = np.array(pilot.act(shoot(pose, dolly), lidar, last), np.float32)
        assert np.abs(last).max() <= 1
        targets = wheel_targets(WORLD.robot, *last.tolist())
        motion = advance(WORLD.robot, pose, speeds, targets, dt, WORLD.substeps)
        for k in range(3, WORLD.substeps, 4):
            pose = SE2(float(motion.x[k]), float(motion.y[k]), float(motion.yaw[k]))
            if end := ending(pose, dolly, solids):
                return end, [*poses, pose]
        speeds = float(motion.left[-1]), float(motion.right[-1])
        poses.append(pose)
    return "timeout", poses


@pytest.mark.parametrize(
    "start", [SE2(0.5, 0.5, 0.3), SE2(-1.0, 2.0, math.pi), SE2(2.0, -1.0, -1.6), SE2(-2.0, 1.0, 2.4)]
)
def test_without_a_map_it_finds_the_dolly_and_docks(start):
    assert drive(Pilot(WORLD, NoMap()), start)[0] == "docked"


@pytest.mark.parametrize("start", [SE2(0.5, 0.5, 2.5), SE2(-2.0, -1.5, -1.0)])
def test_with_a_map_it_does_too(start):
    rough = start @ SE2(0.2, -0.3, 0.15)
    rng = np.random.default_rng(1)
    known = KnownRoom(ROOMS[0], ParticleFilter(LikelihoodField(ROOMS[0]), rough, START_ERROR, rng))
    assert drive(Pilot(WORLD, known), start)[0] == "docked"


@pytest.mark.parametrize("yaw", [math.pi / 2, -math.pi / 2])
def test_it_comes_away_from_a_wall_beside_it(yaw):
    assert drive(Pilot(WORLD, NoMap()), SE2(0.5, -2.0, yaw))[0] == "docked"  # 0.185 m from the wall


def test_a_wrong_map_does_not_keep_it_from_its_way():
    class Wrong(NoMap):
        def solids(self):
            return [Rectangle(SE2(0.4, 0.0), 0.02, 3.0), Rectangle(SE2(-0.4, 0.0), 0.02, 3.0)]

    assert drive(Pilot(WORLD, Wrong()), SE2(0.0, 1.0, -math.pi / 2))[0] == "docked"


def test_it_goes_round_what_stands_in_its_way():
    crate = Rectangle(SE2(0.0, 2.2), 0.6, 0.2)
    end, poses = drive(Pilot(WORLD, NoMap()), SE2(0.0, 0.0), extra=[crate])
    assert end == "docked"
    assert max(abs(pose.x) for pose in poses) > 0.9


def test_it_searches_behind_what_hides_the_dolly():
    screen = Rectangle(SE2(0.0, 1.9), 1.6, 0.1)
    assert drive(Pilot(WORLD, NoMap()), SE2(0.0, 0.0, 0.0), extra=[screen])[0] == "docked"


@pytest.mark.parametrize("step", [12, 25])
def test_it_follows_a_dolly_that_moves(step):
    moved = DOLLY @ SE2(0.9, 0.4, 0.3)
    end, poses = drive(
        Pilot(WORLD, NoMap()), SE2(0.3, -0.5, 0.4), dolly_at=lambda now: moved if now >= step else DOLLY
    )
    assert end == "docked"
    assert math.hypot(poses[-1].x - moved.x, poses[-1].y - moved.y) < 0.31


class Only:
    """Shows some attributes of a thing, and fails a test that asks for others."""

    def __init__(self, thing, *names):
        self._thing, self._names = thing, names

    def __getattr__(self, name):
        assert name in self._names, f"{name} is not for a rival's eyes"
        return getattr(self._thing, name)


@pytest.fixture
def rollout():
    config = Config()
    layout = ObservationLayout.of(config)
    eyes = SimpleNamespace(see=lambda recent: np.zeros((len(recent), *layout.row_shape), layout.row_dtype))
    rollout = Rollout(config, eyes, 1, 200)
    yield rollout
    rollout.close()


@pytest.mark.parametrize("name", ["b1", "b2"])
def test_they_see_nothing_but_their_sensors(name, rollout):
    task = Task(cell=2, seed=5, start=PlacedStart(x=0.5, y=-3.0, yaw=45))
    rollout.reset(0, task)
    start = rollout.worlds[0].pose
    world = Only(rollout.worlds[0], "steps", "config", "task")
    world.task = Only(task, "seed", "cell")
    bandaged = SimpleNamespace(newest=rollout.newest, worlds=[world])
    if name == "b1":
        actor = MappedActor(bandaged, lambda task, world, rng: start @ SE2(0.2, -0.2, 0.1))
    else:
        actor = MaplessActor(bandaged)
    while not (finished := rollout.step(actor)):
        pass
    assert finished[0].ending == "success"


def test_each_episode_has_a_new_pilot(rollout):
    actor = make_baseline("b2", rollout)
    for start in (PlacedStart(x=0.0, y=-1.5, yaw=0), PlacedStart(x=0.5, y=-2.0, yaw=-45)):
        rollout.reset(0, Task(cell=0, seed=3, start=start))
        while not (finished := rollout.step(actor)):
            pass
        assert finished[0].ending == "success"


def test_rivals_are_had_by_name_with_their_world(rollout):
    assert set(BASELINES) == {"b0", "b1", "b2", "b1-wide"}
    wide = BASELINES["b1-wide"].configure(Config())
    assert (wide.world.lidar.beams, wide.world.lidar.range, wide.world.camera.size) == (577, 20.0, 320)
    assert BASELINES["b1"].configure(Config()) == Config()
    rollout.reset(0, Task(cell=0, seed=3, start=PlacedStart(x=0.0, y=-2.0, yaw=0)))
    observation = Observation(*(np.zeros(0) for _ in Observation._fields))
    for name in ("b0", "b1", "b2"):
        assert make_baseline(name, rollout).act(observation, [0]).shape == (1, 2)
    with pytest.raises(UsageError, match="b3"):
        make_baseline("b3", rollout)
