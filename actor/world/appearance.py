"""What a scene looks like: patterns and colours of floor and walls, colours of boxes, light (section 3.3)."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from actor.world.sensors import Light

TEXTURE_SIZE = 64
Color = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Appearance:
    """Indices into the texture bank, tints and light of one episode."""

    floor_texture: int = 0
    wall_texture: int = 0
    floor: Color = (0.75, 0.75, 0.72, 1.0)
    wall: Color = (0.85, 0.83, 0.78, 1.0)
    boxes: tuple[Color, ...] = ((0.55, 0.4, 0.25, 1.0),)
    light: Light = field(default_factory=Light)


def draw_appearance(rng: np.random.Generator, boxes: int) -> Appearance:
    """A random look for a scene with that many boxes; none of them is as blue as the dolly."""

    def muted() -> Color:
        r, g, b = rng.uniform(0.35, 1.0, 3)
        return float(r), float(g), float(min(b, 0.5 * (r + g))), 1.0

    return Appearance(
        floor_texture=int(rng.integers(len(PATTERNS))),
        wall_texture=int(rng.integers(len(PATTERNS))),
        floor=muted(),
        wall=muted(),
        boxes=tuple(muted() for _ in range(boxes)),
        light=Light(
            direction=(float(rng.uniform(-5, 5)), float(rng.uniform(-5, 5)), float(rng.uniform(3, 8))),
            color=tuple(float(c) for c in rng.uniform(0.85, 1.0, 3)),  # type: ignore[arg-type]
            ambient=float(rng.uniform(0.45, 0.7)),
            diffuse=float(rng.uniform(0.3, 0.6)),
        ),
    )


def _patterns() -> list[NDArray[np.float64]]:
    """Grey patterns in [0, 1], (64, 64) each, that tile seamlessly."""
    rng = np.random.default_rng(0)  # the bank is the same everywhere; episodes differ in choice and tint
    y, x = np.mgrid[0:TEXTURE_SIZE, 0:TEXTURE_SIZE] / TEXTURE_SIZE

    def smooth(cells: int) -> NDArray[np.float64]:
        spectrum = np.fft.rfft2(rng.normal(size=(TEXTURE_SIZE, TEXTURE_SIZE)))
        fy = np.fft.fftfreq(TEXTURE_SIZE)[:, None] * TEXTURE_SIZE
        fx = np.fft.rfftfreq(TEXTURE_SIZE)[None, :] * TEXTURE_SIZE
        noise = np.fft.irfft2(spectrum * np.exp(-(fx**2 + fy**2) / cells**2), s=x.shape)
        return np.asarray((noise - noise.min()) / np.ptp(noise))

    grain = rng.uniform(0.85, 1.0, x.shape)
    return [
        np.full_like(x, 0.95),
        grain,
        np.where((x < 0.03) | (y < 0.03), 0.6, 0.95) * grain,  # slabs
        np.where((np.floor(x * 2) + np.floor(y * 2)) % 2 == 0, 0.65, 1.0),  # checkers
        np.where(x % 0.25 < 0.125, 0.75, 1.0),  # upright stripes
        np.where(y % 0.25 < 0.03, 0.6, 0.95) * grain,  # planks
        np.where((y % 0.25 < 0.02) | ((x + 0.25 * (np.floor(y * 4) % 2)) % 0.5 < 0.02), 0.65, 0.95),  # bricks
        0.6 + 0.4 * smooth(3),
        0.6 + 0.4 * smooth(10),
        np.where(y < 0.3, 0.6, 1.0),  # a band
    ]


PATTERNS = _patterns()


def load_textures(bullet: Any) -> list[int]:
    """Loads the bank into a pybullet client; returns the texture ids."""
    ids = []
    with tempfile.TemporaryDirectory() as folder:
        for index, pattern in enumerate(PATTERNS):
            pixels = np.repeat((255 * pattern).astype(np.uint8)[..., None], 3, axis=2)
            path = Path(folder) / f"{index}.png"
            Image.fromarray(pixels).save(path)
            ids.append(bullet.loadTexture(str(path)))
    return ids
