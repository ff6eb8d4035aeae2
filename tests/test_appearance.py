"""Domain randomisation: every quantity within its range, each of them fixed by name, arenas apart."""

import colorsys
import math
from typing import get_args

import numpy as np
import pytest

from actor.world.appearance import draw_appearance, look_ranges
from actor.world.meshes import Mesh, slabs
from actor.world.world import DockingWorld
from common.cells import ARENAS, CELLS, ROOMS
from common.config import resolve
from common.geometry import SE2
from common.tasks import Task
from common.world_config import LookRanges, Quantity, RandomizationConfig

CONFIG = RandomizationConfig()
QUANTITIES = get_args(Quantity)


def measured(look) -> dict[str, list]:
    """What an appearance holds, by the names of the configuration."""
    x, y, z = look.light.direction
    hue, saturation, value = colorsys.rgb_to_hsv(*look.dolly[:3])
    return {
        "floor_pattern": [look.floor_pattern],
        "wall_pattern": [look.wall_pattern],
        "floor_tone": list(look.floor[:2]),
        "wall_tone": list(look.wall[:2]),
        "box_tone": [tone for box in (look.fixtures, *look.obstacles) for tone in box[:2]],
        "dolly_hue": [360 * hue],
        "dolly_saturation": [saturation],
        "dolly_value": [value],
        "light_azimuth": [math.degrees(math.atan2(-x, y))],
        "light_elevation": [math.degrees(math.asin(z))],
        "light_color": list(look.light.color),
        "light_ambient": [look.light.ambient],
        "light_diffuse": [look.light.diffuse],
        "camera_noise": [look.camera_noise],
        "camera_exposure": [look.camera_exposure],
    }


def draw(seed: int, config: RandomizationConfig = CONFIG, cell: int = 0) -> dict[str, list]:
    return measured(draw_appearance(np.random.default_rng(seed), config, cell))


def test_every_randomised_quantity_has_a_range_and_a_name():
    assert set(QUANTITIES) == set(LookRanges.model_fields) == set(draw(0))


@pytest.mark.parametrize("cell", [0, len(CELLS), len(CELLS) + 1])
def test_draws_stay_in_their_ranges_and_fill_them(cell):
    ranges, looks = look_ranges(CONFIG, cell), [draw(seed, cell=cell) for seed in range(300)]
    for name in QUANTITIES:
        values, limits = [value for look in looks for value in look[name]], getattr(ranges, name)
        if name.endswith("pattern"):
            assert set(values) == set(limits)
            continue
        low, high = limits
        slack, width = 1e-6 * (high - low), high - low
        assert low - slack <= min(values) < low + 0.05 * width
        assert high - 0.05 * width < max(values) <= high + slack


@pytest.mark.parametrize("name", QUANTITIES)
def test_a_quantity_fixed_by_name_stays_in_the_middle_and_leaves_the_others_as_they_were(name):
    fixed = RandomizationConfig(fixed=(name,))
    limits = getattr(CONFIG.training, name)
    middle = limits[0] if name.endswith("pattern") else pytest.approx((limits[0] + limits[1]) / 2)
    for seed in range(5):
        free, held = draw(seed), draw(seed, fixed)
        assert all(value == middle for value in held.pop(name))
        free.pop(name)
        assert held == {key: pytest.approx(values) for key, values in free.items()}


def test_all_fixed_looks_the_same_whatever_the_seed():
    fixed = RandomizationConfig(fixed=("all",))
    assert draw(1, fixed) == draw(2, fixed)
    assert draw(1) != draw(2)


def test_nothing_but_the_dolly_is_blue():
    for seed in range(100):
        look = draw_appearance(np.random.default_rng(seed), CONFIG, seed % len(ROOMS))
        for r, g, b, _ in (look.floor, look.wall, look.fixtures, *look.obstacles):
            assert b <= (r + g) / 2
        r, g, b, _ = look.dolly
        assert b > 1.5 * max(r, (r + g) / 2)


def test_arenas_have_patterns_of_their_own():
    training = {*CONFIG.training.floor_pattern, *CONFIG.training.wall_pattern}
    seen = [look_ranges(CONFIG, len(CELLS) + i) for i in range(len(ARENAS))]
    patterns = [{*ranges.floor_pattern, *ranges.wall_pattern} for ranges in seen]
    assert not patterns[0] & training
    assert not patterns[1] & training
    assert not patterns[0] & patterns[1]


def test_exposure_brightens_and_noise_has_its_standard_deviation():
    def frame(exposure: float, noise: float) -> np.ndarray:
        settings = (
            'world.randomization.fixed=["all"]',
            f"world.randomization.training.camera_exposure=[{exposure}, {exposure}]",
            f"world.randomization.training.camera_noise=[{noise}, {noise}]",
        )
        config = resolve(overrides=settings).world
        world = DockingWorld(config, 10)
        seen = world.reset(Task(cell=0, seed=5, start=config.start)).frame.astype(float)
        world.close()
        return seen

    plain, bright, noisy = frame(1.0, 0.0), frame(1.2, 0.0), frame(1.0, 4.0)
    inside = (plain > 20) & (plain < 200)
    assert inside.mean() > 0.3
    assert (bright[inside] / plain[inside]).mean() == pytest.approx(1.2, abs=0.02)
    difference = (noisy - plain)[inside]
    assert difference.std() == pytest.approx(4.0, rel=0.05)
    assert abs(difference.mean()) < 0.2


def test_slabs_cover_a_room_once():
    for room in ROOMS:
        area = sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in room.edges) / 2  # the shoelace formula
        rectangles = slabs(room.outline)
        assert sum((x1 - x0) * (y1 - y0) for x0, x1, y0, y1 in rectangles) == pytest.approx(area)
        assert all(room.contains((x0 + x1) / 2, (y0 + y1) / 2) for x0, x1, y0, y1 in rectangles)


def test_faces_of_a_box_look_outwards_and_their_tiles_stand_upright():
    mesh = Mesh()
    mesh.box(SE2(1.0, 2.0, 0.3), (0.5, 0.2), (0.1, 0.9), "crate", columns=2)
    shape = mesh.arguments()
    corners, normals, uvs = (np.array(shape[key]) for key in ("vertices", "normals", "uvs"))
    centre = np.array([1.0, 2.0, 0.5])
    assert len(corners) == 4 * 7  # two sides in two columns, two ends, the top
    assert (((corners - centre) * normals).sum(axis=1) > 0.1).all()
    triangles = corners[np.array(shape["indices"])].reshape(-1, 3, 3)
    wound = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert ((wound * (triangles.mean(axis=1) - centre)).sum(axis=1) > 0).all()
    upright = np.abs(normals[:, 2]) < 0.5
    high = corners[:, 2] > 0.5
    assert uvs[upright & high, 1].min() > uvs[upright & ~high, 1].max()
    assert (uvs >= 0).all()
