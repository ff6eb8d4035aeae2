"""Finding the dolly: leg-like returns, hypotheses, refinement, its blue, and a dolly that moves."""

import colorsys
import itertools
import math

import numpy as np
import pytest

from actor.baseline.detection import DollyFinder, hypotheses
from actor.baseline.legs import Legs
from actor.baseline.occupancy import Occupancy
from actor.baseline.scans import Scanner, are_narrow
from actor.baseline.vision import Sight, is_blue
from common.cells import ROOMS
from common.geometry import SE2, Rectangle
from tests.flatland import WORLD, cast, legs, shoot

WALLS = ROOMS[0].solids
TURNING = SE2(0.0, 0.05, 0.12)


def error(estimate, dolly):
    """Distance (m) and angle (rad) between two dollies, which look the same turned by 180 degrees."""
    off = dolly.inverse() @ estimate
    return math.hypot(off.x, off.y), abs(math.remainder(off.yaw, math.pi))


class Watcher:
    """A finder that is shown a room from one pose after the other."""

    def __init__(self):
        self.occupancy, self.scanner = Occupancy(), Scanner(WORLD)
        self.finder = DollyFinder(WORLD, self.occupancy)

    def watch(self, dolly, pose, step=TURNING, count=15, extra=()):
        for _ in range(count):
            scan = self.scanner.read(pose, cast(pose, [*WALLS, *legs(dolly), *extra]))
            self.occupancy.add(scan)
            self.finder.update(pose, scan, shoot(pose, dolly))
            pose = pose @ step
        return pose


def test_only_narrow_things_before_a_background_are_leg_like():
    ranges = np.full(40, 4.0)
    ranges[8] = 2.0  # one beam
    ranges[15:17] = 1.0  # two, 3.5 cm wide
    ranges[25:31] = 2.0  # 35 cm wide
    ranges[-1] = 2.0  # at the end of the sweep: who knows how wide
    angles = np.radians(1.77) * np.arange(40)
    points = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = are_narrow(ranges, points, np.ones(40, np.bool_))
    assert np.flatnonzero(found).tolist() == [8, 15, 16]


def test_a_wall_seen_at_a_grazing_angle_is_not_leg_like():
    pose, scanner = SE2(0.0, 8.3, 0.4), Scanner(WORLD)  # 0.7 m from the long wall at y = 9
    assert not scanner.read(pose, cast(pose, [Rectangle(SE2(0.0, 9.1), 9.0, 0.1)])).narrow.any()


@pytest.mark.parametrize("pair", list(itertools.combinations(range(4), 2)))
def test_any_two_legs_lead_to_the_dolly(pair):
    dolly, shape = SE2(1.0, 3.0, 0.7), Legs(WORLD.dolly)
    centres = shape.centres(np.array([[dolly.x, dolly.y, dolly.yaw]]))[0]
    found = [error(SE2(*row), dolly) for row in hypotheses(centres[list(pair)], shape).tolist()]
    assert min(found) < (1e-9, 1e-9)


@pytest.mark.parametrize("off", [SE2(0.03, -0.02, 0.03), SE2(-0.02, 0.04, -0.04)])
def test_refinement_puts_an_estimate_right(off):
    dolly, shape, pose = SE2(0.2, 2.4, 0.1), Legs(WORLD.dolly), SE2()
    scan = Scanner(WORLD).read(pose, cast(pose, [*WALLS, *legs(dolly)]))
    near = shape.near(scan, dolly.x, dolly.y)
    away, turn = error(shape.refine(dolly @ off, near, gate=0.08), dolly)
    assert away < 0.02 and turn < math.radians(0.8)  # from one scan


@pytest.mark.parametrize("dolly", [SE2(0.3, 3.5, 0.1), SE2(-1.0, 4.5, -0.2), SE2(1.5, 3.0, 1.2)])
def test_the_dolly_is_found_to_centimetres(dolly):
    watcher = Watcher()
    watcher.watch(dolly, SE2(0.0, 0.0, -0.8))
    assert watcher.finder.dolly is not None
    away, turn = error(watcher.finder.dolly, dolly)
    assert away < 0.02 and turn < math.radians(1.2)


def test_it_is_sure_when_it_has_come_near():
    watcher, dolly = Watcher(), SE2(0.0, 4.0, 0.1)
    watcher.watch(dolly, SE2(0.0, 1.0, 0.1), SE2(0.0, 0.12, 0.0))
    assert watcher.finder.is_sure
    away, turn = error(watcher.finder.dolly, dolly)
    assert away < 0.008 and turn < math.radians(0.5)


def test_an_estimate_that_rests_on_two_legs_yields_to_a_better_one():
    watcher, dolly = Watcher(), SE2(0.0, 4.0)
    watcher.watch(dolly, SE2(0.0, 1.0, -0.2), count=1)
    watcher.finder.dolly = dolly @ SE2(0.0, 1.19)  # its near legs are the true one's far legs
    watcher.watch(dolly, SE2(0.0, 1.0, -0.2), SE2(0.0, 0.06, 0.03), count=12)
    assert watcher.finder.dolly is not None
    assert error(watcher.finder.dolly, dolly)[0] < 0.02


def test_a_room_without_dolly_has_none():
    watcher = Watcher()
    watcher.watch(SE2(0.0, 200.0), SE2(0.0, 2.0, -1.0), count=50)
    assert watcher.finder.dolly is None and watcher.finder.place is None


def test_four_posts_that_are_not_blue_are_no_dolly():
    watcher = Watcher()
    watcher.watch(SE2(0.0, 200.0), SE2(0.0, 0.0, -0.8), extra=legs(SE2(0.0, 4.0)))
    assert watcher.finder.dolly is None


@pytest.mark.parametrize("shift", [SE2(0.8, 0.3, 0.2), SE2(0.1, 0.05, 0.1), SE2(-0.3, 0.9, 0.0)])
def test_a_moved_dolly_is_given_up_and_found_again(shift):
    watcher, dolly = Watcher(), SE2(0.0, 4.0)
    pose = watcher.watch(dolly, SE2(0.0, 0.5, -0.5), SE2(0.0, 0.05, 0.06))
    assert error(watcher.finder.dolly, dolly)[0] < 0.02
    moved = dolly @ shift
    watcher.watch(moved, pose, SE2(0.0, 0.03, -0.06), count=20)
    assert watcher.finder.dolly is not None
    away, turn = error(watcher.finder.dolly, moved)
    assert away < 0.02 and turn < math.radians(1.5)


def test_blue_is_what_dollies_are_and_nothing_else():
    look, rng = WORLD.randomization.training, np.random.default_rng(3)
    blue, others = [], []
    for _ in range(4000):
        lamp = rng.uniform(*look.light_color, 3)
        shade = rng.uniform(*look.light_ambient) + rng.uniform(*look.light_diffuse) * rng.random()
        shade *= rng.uniform(*look.camera_exposure)
        hue, saturation, value = (
            rng.uniform(*part) for part in (look.dolly_hue, look.dolly_saturation, look.dolly_value)
        )
        blue.append(np.array(colorsys.hsv_to_rgb(hue / 360, saturation, value)) * lamp * shade)
        r, g, b = rng.uniform(*look.floor_tone, 3)
        others.append(np.array([r, g, min(b, (r + g) / 2)]) * lamp * shade)
    noise = rng.normal(0, 3.0, (2, 4000, 3))
    colors = np.clip(255 * np.clip([blue, others], 0, 1) + noise, 0, 255).astype(np.uint8)
    found = is_blue(colors)
    assert found[0].mean() > 0.99
    assert found[1].mean() < 0.0005


@pytest.mark.parametrize("size", [80, 320])
def test_the_camera_tells_roughly_where_the_dolly_is(size):
    world = WORLD.model_copy(update={"camera": WORLD.camera.model_copy(update={"size": size})})
    dolly, pose = SE2(0.6, 4.0, 0.1), SE2(0.0, 0.5, 0.1)
    sighting = Sight(world).look(pose, shoot(pose, dolly, world))
    assert sighting.place == pytest.approx((dolly.x, dolly.y), abs=0.4)
    assert Sight(world).look(pose @ SE2(0, 0, 1.5), shoot(pose @ SE2(0, 0, 1.5), dolly, world)).place is None
