"""The map-based rival's localisation, against rays cast at the map."""

import math

import numpy as np
import pytest

from actor.baseline.localization import KnownRoom, LikelihoodField, ParticleFilter
from actor.baseline.odometry import Odometry
from actor.baseline.scans import Scanner
from actor.baseline.sensing import START_ERROR
from actor.world.world import DockingWorld
from common.cells import ROOMS
from common.config import Config
from common.geometry import SE2, Rectangle, wrap
from common.tasks import random_task
from tests.flatland import WORLD, cast, legs

FIELDS = {cell: LikelihoodField(ROOMS[cell]) for cell in (0, 3, 5)}


def test_the_field_holds_distances_to_the_nearest_surface():
    field = FIELDS[0]  # walls at x = -5.5 and 5.5, y = -2.5 and 9; a pallet about (-4.8, 8.4)
    places = np.array([(5.0, 3.0), (0.0, -2.4), (-4.8, 7.0), (-4.8, 8.4), (0.0, 3.0)])
    assert field.distances(places) == pytest.approx([0.5, 0.1, 0.7, 0.4, 5.5], abs=0.06)


def run(cell, seed, extra=(), steps=25):
    """Drives an arc in a room with `extra` things that its map lacks; errors of the pose at every step."""
    rng = np.random.default_rng(seed)
    pose = SE2(0.3, 0.5, rng.uniform(-3, 3))
    start = SE2(
        pose.x + rng.normal(0, START_ERROR[0]),
        pose.y + rng.normal(0, START_ERROR[0]),
        pose.yaw + rng.normal(0, START_ERROR[1]),
    )
    room, scanner = ROOMS[cell], Scanner(WORLD)
    known = KnownRoom(room, ParticleFilter(FIELDS[cell], start, START_ERROR, rng))
    motion, origin, errors = SE2(), pose, []
    for _ in range(steps):
        odometry = origin.inverse() @ pose
        scan = scanner.read(odometry, cast(pose, [*room.solids, *extra]))
        known.update(motion, scan, odometry)
        error = pose.inverse() @ known.filter.pose
        errors.append((math.hypot(error.x, error.y), abs(error.yaw)))
        motion = SE2(0.0, 0.05, 0.15)
        pose = pose @ motion
    return np.array(errors), known, origin


@pytest.mark.parametrize("cell", [0, 3, 5])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_filter_finds_the_pose_from_a_rough_one(cell, seed):
    errors, known, _ = run(cell, seed)
    assert known.filter.is_known
    assert errors[-10:, 0].max() < 0.13
    assert errors[-10:, 1].max() < math.radians(1.5)


def test_things_that_the_map_lacks_do_not_mislead_it():
    strange = [
        *legs(SE2(0.0, 4.0)),
        Rectangle(SE2(2.5, 3.0, 0.4), 0.5, 0.4),
        Rectangle(SE2(-2.0, 2.0), 0.3, 0.3),
    ]
    errors, _, _ = run(0, 4, strange)
    assert errors[-10:, 0].max() < 0.13
    assert errors[-10:, 1].max() < math.radians(1.5)


def test_the_map_comes_in_the_frame_of_odometry():
    _, known, origin = run(0, 3)
    found = known.solids()
    assert len(found) == len(ROOMS[0].solids)
    for solid, placed in zip(ROOMS[0].solids, found, strict=True):
        true = origin.inverse() @ solid.pose
        assert math.hypot(placed.pose.x - true.x, placed.pose.y - true.y) < 0.25
        assert abs(wrap(placed.pose.yaw - true.yaw)) < math.radians(2)
        assert placed.half_x < solid.half_x


def test_nothing_is_claimed_of_the_room_before_the_pose_is_known():
    rng = np.random.default_rng(0)
    known = KnownRoom(ROOMS[0], ParticleFilter(FIELDS[0], SE2(), START_ERROR, rng))
    assert not known.filter.is_known
    assert known.solids() == []


def test_odometry_reckons_what_the_simulator_drives():
    world, rng = DockingWorld(WORLD, 40), np.random.default_rng(8)
    world.place(random_task(0, Config(), rng))
    odometry, start = Odometry(WORLD), world.pose
    for _ in range(12):
        action = rng.uniform([-0.3, -1.2], [0.3, 1.2]).astype(np.float32)
        _, ended = world.advance(action)
        assert ended is None
        odometry.move(action)
        there = start @ odometry.pose
        assert (there.x, there.y) == pytest.approx((world.pose.x, world.pose.y), abs=1e-9)
        assert wrap(there.yaw - world.pose.yaw) == pytest.approx(0.0, abs=1e-9)
        assert odometry.speeds == pytest.approx(world.speeds)
    world.close()
