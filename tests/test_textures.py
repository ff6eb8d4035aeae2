import hashlib
import subprocess
import sys
from itertools import combinations
from typing import get_args

import numpy as np
import pytest

from actor.world import textures
from actor.world.textures import ATLAS, ATLAS_SIZE, PATTERNS, SIZE, TILES
from common.world_config import Pattern

NAMES = get_args(Pattern)
SHAPELESS = ("plain", "terrazzo", "stains")
"""Patterns without lines."""
OBJECTS = [
    "plain",
    "rack",
    "rack_end",
    "pillar",
    "pallet",
    "crate",
    "machine",
    "top",
    "door",
    "robot_side",
    "robot_top",
    "deck",
]


def seam(name: str, axis: int) -> tuple[float, np.ndarray]:
    """Mean difference of two neighbour lines of pixels: across the seam, and of all pairs inside."""
    picture = PATTERNS[name].astype(float)
    difference = np.abs(picture - np.roll(picture, 1, axis)).mean(axis=(1 - axis, 2))
    return difference[0], difference[1:]


def pixels(name: str) -> tuple[int, int, int, int]:
    """Left, top, right and bottom pixel of a tile; the last two are the first outside."""
    left, top, right, bottom = (ATLAS_SIZE * share for share in TILES[name])
    return round(left - 0.5), round(top - 0.5), round(right + 0.5), round(bottom + 0.5)


def tile(name: str) -> np.ndarray:
    left, top, right, bottom = pixels(name)
    return ATLAS[top:bottom, left:right]


def digest() -> str:
    pictures = [*(PATTERNS[name] for name in NAMES), ATLAS]
    return hashlib.sha256(b"".join(picture.tobytes() for picture in pictures)).hexdigest()


def test_every_pattern_and_object_is_drawn():
    assert set(PATTERNS) == set(NAMES)
    assert set(TILES) == set(OBJECTS)
    assert all(p.shape == (SIZE, SIZE, 3) and p.dtype == np.uint8 for p in PATTERNS.values())
    assert ATLAS.shape == (ATLAS_SIZE, ATLAS_SIZE, 3) and ATLAS.dtype == np.uint8


@pytest.mark.parametrize("name", NAMES)
def test_a_pattern_is_bright_and_not_bluish(name):
    red, green, blue = PATTERNS[name].mean(axis=(0, 1))
    assert 0.75 <= np.mean([red, green, blue]) / 255 <= 0.95
    assert blue <= 1.1 * (red + green) / 2


@pytest.mark.parametrize("axis", (0, 1))
@pytest.mark.parametrize("name", NAMES)
def test_opposite_edges_of_a_pattern_meet(name, axis):
    across, inside = seam(name, axis)
    if (name, axis) != ("band", 0):  # its skirting ends where the wall above begins
        assert across <= 1.01 * inside.max() + 0.01
    if name in SHAPELESS:
        assert across <= 1.6 * np.median(inside)


def test_patterns_differ_by_more_than_detail():
    cell = SIZE // 32
    coarse = {n: p.reshape(32, cell, 32, cell, 3).mean(axis=(1, 3)) for n, p in PATTERNS.items()}
    pairs = {(a, b): np.abs(coarse[a] - coarse[b]).mean() for a, b in combinations(NAMES, 2)}
    closest = min(pairs, key=pairs.__getitem__)
    assert pairs[closest] > 9, closest  # measured: 11.8, concrete and lanes


def test_pictures_are_the_same_in_every_process():
    code = "from tests.test_textures import digest; print(digest())"
    fresh = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert fresh.stdout.strip() == digest()
    again = textures._draw_patterns()
    assert all(np.array_equal(PATTERNS[name], again[name]) for name in NAMES)
    assert np.array_equal(ATLAS, textures._draw_atlas())


def test_tiles_share_the_atlas_without_overlap():
    taken = np.zeros((ATLAS_SIZE, ATLAS_SIZE), int)
    for name in TILES:
        left, top, right, bottom = pixels(name)
        assert 0 <= left < right <= ATLAS_SIZE and 0 <= top < bottom <= ATLAS_SIZE
        taken[top:bottom, left:right] += 1
    assert (taken == 1).all()


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_not_bluish(name):
    red, green, blue = tile(name).mean(axis=(0, 1))
    assert blue <= 1.1 * (red + green) / 2


def test_objects_stand_upright():
    yellow = np.abs(tile("pillar") / 255.0 - textures.YELLOW).max(axis=2) < 0.01
    assert yellow[: SIZE // 2].mean() == 0 and yellow[-SIZE // 3 :].mean() > 0.3  # hazard stripes are low
    arrow = (np.abs(tile("robot_top") / 255.0 - textures.YELLOW).max(axis=2) < 0.01).sum(axis=1)
    assert arrow.argmax() < SIZE / 2  # its head, the widest part, is ahead
    assert (tile("plain") == 255).all()
    assert np.ptp(tile("deck"), axis=2).max() == 0  # grey: the dolly's blue is its tint
