"""How an episode looks: patterns and colours, light, and what the camera makes of it (section 3.3)."""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass

import numpy as np

from common.cells import ROOMS
from common.tasks import CATALOGUE_SIZE
from common.world_config import LookRanges, Pattern, RandomizationConfig

Color = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Light:
    """Illumination of a scene: direction towards the light, colour, ambient and diffuse shares."""

    direction: tuple[float, float, float]
    color: tuple[float, float, float]
    ambient: float
    diffuse: float


@dataclass(frozen=True, slots=True)
class Appearance:
    """What one episode drew from the ranges of its place."""

    floor_pattern: Pattern
    wall_pattern: Pattern
    floor: Color
    wall: Color
    fixtures: Color
    obstacles: tuple[Color, ...]
    """One for each box of the catalogue."""
    dolly: Color
    light: Light
    camera_noise: float
    """Standard deviation of a pixel, grey levels."""
    camera_exposure: float


def look_ranges(config: RandomizationConfig, cell: int) -> LookRanges:
    """The ranges of a room by its index: each arena has its own."""
    arenas = {"validation": config.validation, "test": config.test}
    return arenas.get(ROOMS[cell].name, config.training)


def draw_appearance(rng: np.random.Generator, config: RandomizationConfig, cell: int) -> Appearance:
    """A random look; fixed quantities are drawn all the same, so that the others stay as they were."""
    ranges = look_ranges(config, cell)

    def is_fixed(name: str) -> bool:
        return name in config.fixed or "all" in config.fixed

    def pattern(name: str) -> Pattern:
        choices: tuple[Pattern, ...] = getattr(ranges, name)
        drawn = int(rng.integers(len(choices)))
        return choices[0] if is_fixed(name) else choices[drawn]

    def value(name: str) -> float:
        low, high = getattr(ranges, name)
        drawn = rng.uniform(low, high)
        return (low + high) / 2 if is_fixed(name) else float(drawn)

    def tint(name: str) -> Color:
        r, g, b = value(name), value(name), value(name)
        return r, g, min(b, (r + g) / 2), 1.0  # never as blue as the dolly

    azimuth, elevation = math.radians(value("light_azimuth")), math.radians(value("light_elevation"))
    flat = math.cos(elevation)
    return Appearance(
        floor_pattern=pattern("floor_pattern"),
        wall_pattern=pattern("wall_pattern"),
        floor=tint("floor_tone"),
        wall=tint("wall_tone"),
        fixtures=tint("box_tone"),
        obstacles=tuple(tint("box_tone") for _ in range(CATALOGUE_SIZE)),
        dolly=(
            *colorsys.hsv_to_rgb(value("dolly_hue") / 360, value("dolly_saturation"), value("dolly_value")),
            1.0,
        ),
        light=Light(
            (-math.sin(azimuth) * flat, math.cos(azimuth) * flat, math.sin(elevation)),
            (value("light_color"), value("light_color"), value("light_color")),
            value("light_ambient"),
            value("light_diffuse"),
        ),
        camera_noise=value("camera_noise"),
        camera_exposure=value("camera_exposure"),
    )
