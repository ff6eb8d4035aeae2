"""All pictures of the warehouse, drawn on import: seamless patterns, and an atlas for objects; row 0 = top.

Shares of 1 measure everything: colours, and places in a pattern (2 m x 2 m) or in a tile of the atlas.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.world_config import Pattern

SIZE = 128
"""Pixels along a side of a pattern."""
ATLAS_SIZE = 512

Picture = NDArray[np.uint8]
Plane = NDArray[Any]
"""float32; a row or a column where nothing changes along the other axis."""
Color = float | Sequence[float]
Area = tuple[float, float, float, float]
"""Left, top, right, bottom."""

BLACK, YELLOW, ORANGE, STEEL = 0.1, (0.95, 0.78, 0.12), (0.93, 0.43, 0.08), (0.45, 0.48, 0.45)
WOOD, PALE_WOOD, DARK_WOOD = (0.80, 0.62, 0.40), (0.90, 0.72, 0.48), (0.38, 0.27, 0.15)
BOARD, BOARD_EDGE, TAPE = (0.74, 0.55, 0.34), (0.46, 0.34, 0.21), (0.88, 0.76, 0.55)

_X = (np.arange(SIZE, dtype=np.float32)[None, :] + 0.5) / SIZE
_Y = _X.T


def _noise(seed: int, cells: float, wide: float = 1.0) -> Plane:
    """Smooth periodic noise of mean 0 and deviation 1: about `cells` blots per side, each so wide."""
    real, imaginary = np.random.default_rng(seed).standard_normal((2, SIZE, SIZE // 2 + 1), np.float32)
    down, across = np.fft.fftfreq(SIZE, cells / SIZE), np.fft.rfftfreq(SIZE, cells / SIZE / wide)
    low = np.exp(-(down[:, None] ** 2)) * np.exp(-(across**2))
    low[0, 0] = 0.0
    noise: Plane = np.fft.irfft2((real + 1j * imaginary) * low.astype(np.float32))
    noise /= noise.std()
    return noise


def _step(values: Plane, softness: float) -> Plane:
    """0 where negative and 1 where positive, with a soft edge."""
    return np.clip(values / softness + 0.5, 0.0, 1.0)


def _line(place: Plane, at: float, width: float) -> Plane:
    """1 on a line through `at` (place is periodic in 1), 0 elsewhere."""
    return _step(width / 2 - np.abs((place - at + 0.5) % 1.0 - 0.5), 1 / SIZE)


def _bond(seed: int, rows: int, columns: int, shift: float, joint: float) -> tuple[Plane, Plane]:
    """Courses of bricks: a tone in +-1 for each brick, and 1 on the joints between them."""
    course = np.floor(_Y * rows).astype(int)
    along = _X * columns + np.float32(shift) * course.astype(np.float32)
    tones = np.random.default_rng(seed).uniform(-1, 1, (rows, columns)).astype(np.float32)
    joints = np.maximum(_line(along, 0.0, joint * columns), _line(_Y * rows, 0.0, joint * rows))
    return tones[course, along.astype(int) % columns], joints


def _herringbone(seed: int, cells: int, length: int) -> tuple[Plane, Plane]:
    """The same for blocks of 1 x `length` cells that lie and stand by turns."""
    row, column = np.floor(_Y * cells).astype(int), np.floor(_X * cells).astype(int)
    place = (column - row) % (2 * length)  # counts along a block that lies, then up one that stands
    lies, part = place < length, place % length
    tones = np.random.default_rng(seed).uniform(-1, 1, (2, cells, cells)).astype(np.float32)
    tone = np.where(lies, tones[0, row, (column - part) % cells], tones[1, column, (row + part) % cells])
    first, last, u, v = part == 0, part == length - 1, _X * cells % 1, _Y * cells % 1
    sides = ((~lies | first, u), (~lies | last, 1 - u), (lies | last, v), (lies | first, 1 - v))
    edge = np.min([np.where(ends, distance, 1.0) for ends, distance in sides], axis=0)
    return tone, _step(0.08 - edge, 0.12)


def _channels(color: Color) -> Plane:
    return np.asarray(color, np.float32).reshape(-1, 1, 1)


def _pixels(image: Plane) -> Picture:
    """From (3, height, width), in which drawing is fast, to (height, width, 3)."""
    return np.ascontiguousarray((255 * image.clip(0.0, 1.0) + 0.5).astype(np.uint8).transpose(1, 2, 0))


def _picture(grey: Plane, hue: Color = 1.0, *marks: tuple[Plane, Color]) -> Picture:
    """A grey plane in a hue; marks are masks, each with the colour that it blends in."""
    image = np.empty((3, SIZE, SIZE), np.float32)
    image[:] = grey * _channels(hue)
    for mask, color in marks:
        image += mask * (_channels(color) - image)
    return _pixels(image)


def _draw_patterns() -> dict[Pattern, Picture]:
    fine, soft, broad = _noise(1, 60), _noise(2, 12), _noise(3, 3)
    rough = 0.015 * fine + 0.015 * soft
    _, pour_joint = _bond(0, 1, 1, 0.0, 0.012)
    slab, slab_joint = _bond(4, 4, 4, 0.0, 0.012)
    plank, plank_joint = _bond(5, 10, 1, 0.37, 0.010)
    brick, brick_joint = _bond(7, 16, 8, 0.5, 0.012)
    panel, panel_joint = _bond(9, 2, 2, 0.0, 0.014)
    block, block_joint = _bond(8, 6, 3, 0.5, 0.018)
    paver, paver_joint = _herringbone(10, 16, 4)
    checker = (np.floor(_X * 4) + np.floor(_Y * 4)) % 2
    worn = _step(_noise(11, 14) + 1.6, 0.6)
    dashes = _line(_Y, 0.5, 0.05) * _step(0.3 - np.abs(_X * 2 % 1 - 0.5), 0.02)
    dark_chip, brown_chip, light_chip = (_step(_noise(seed, 16) - 1.25, 0.3) for seed in (12, 13, 14))
    dirt = 0.55 * _step(_noise(15, 5) + 0.25 * soft - 0.9, 1.6)
    rust = 0.65 * _step(_noise(16, 7) + 0.25 * soft - 1.4, 1.2)
    rivet = _step(0.012 - np.hypot((_X * 16 % 1 - 0.5) / 16, (_Y * 2 % 1 - 0.06) / 2), 0.008)
    sheet = 0.93 + 0.03 * panel - 0.12 * (_Y * 2 % 1) + 0.01 * _noise(17, 60, wide=10)
    stripe = _step(0.25 - np.abs(_X * 4 % 1 - 0.5), 0.06)
    slant = (_X + _Y) * 4
    board = np.array([0.70, 0.98, 0.80, 0.90], np.float32)[slant.astype(int) % 4]
    rib = np.interp(_X * 8 % 1, [0, 0.35, 0.45, 0.60, 0.70, 1], [0.95, 0.95, 1.08, 0.72, 0.62, 0.62])
    warm, tan, red = (1.0, 0.99, 0.96), (1.0, 0.94, 0.85), (1.0, 0.91, 0.87)
    skirting = (
        (_line(_Y, 0.745, 0.025), 0.80),
        (_step(_Y - 0.76, 0.01), 0.5),
        (_step(_Y - 0.94, 0.01), 0.25),
    )
    return {
        "plain": _picture(0.93 + 0.008 * fine),
        "concrete": _picture(0.83 + 0.05 * broad + 0.035 * soft + 0.015 * fine, warm, (pour_joint, 0.67)),
        "slabs": _picture(0.87 + 0.06 * slab + rough, warm, (slab_joint, 0.5)),
        "checkers": _picture(0.62 + 0.36 * checker + 0.5 * rough),
        "planks": _picture(0.89 + 0.08 * plank + 0.035 * _noise(6, 40, wide=12), tan, (plank_joint, 0.45)),
        "lanes": _picture(
            0.82 + 0.03 * broad + rough, 1.0, (worn * dashes, 1.0), (worn * _line(_X, 0.25, 0.07), YELLOW)
        ),
        "terrazzo": _picture(
            0.88 + 0.01 * fine, warm, (dark_chip, 0.5), (brown_chip, (0.82, 0.66, 0.5)), (light_chip, 1.0)
        ),
        "stains": _picture(0.92 + 0.02 * broad + rough, 1.0, (dirt, 0.35), (rust, (0.62, 0.36, 0.18))),
        "bricks": _picture(0.91 + 0.10 * brick + rough, red, (brick_joint, 0.62)),
        "panels": _picture(sheet, 1.0, (rivet, 0.55), (panel_joint, 0.35)),
        "stripes": _picture(0.68 + 0.31 * stripe + 0.5 * rough),
        "band": _picture(0.95 + 0.5 * rough, 1.0, *skirting),
        "blocks": _picture(0.78 + 0.05 * block + 0.03 * fine + rough, warm, (block_joint, 0.98)),
        "diagonal": _picture(board + rough, warm, (_line(slant, 0.0, 0.10), 0.42)),
        "louvres": _picture(0.50 + 0.50 * (_Y * 8 % 1) ** 0.6, warm, (_line(_X, 0.0, 0.05), 0.62)),
        "herringbone": _picture(0.89 + 0.11 * paver + rough, tan, (paver_joint, 0.50)),
        "cladding": _picture(rib - 0.02 * broad, warm, (_line(_Y, 0.5, 0.03), 0.40)),
    }


class _Canvas:
    """A tile of the atlas while it is drawn."""

    def __init__(self, wide: int, high: int, base: Color) -> None:
        self.image = np.empty((3, high, wide), np.float32)
        self.image[:] = _channels(base)
        self.x = (np.arange(wide, dtype=np.float32)[None, :] + 0.5) / wide
        self.y = (np.arange(high, dtype=np.float32)[:, None] + 0.5) / high

    def _part(self, box: Area) -> tuple[slice, slice]:
        _, high, wide = self.image.shape
        left, top, right, bottom = box
        return slice(round(top * high), round(bottom * high)), slice(round(left * wide), round(right * wide))

    def fill(self, color: Color, *boxes: Area) -> None:
        for box in boxes:
            rows, columns = self._part(box)
            self.image[:, rows, columns] = _channels(color)

    def frame(self, color: Color, width: float, box: Area = (0, 0, 1, 1)) -> None:
        """The border of a box."""
        left, top, right, bottom = box
        self.fill(color, (left, top, right, top + width), (left, bottom - width, right, bottom))
        self.fill(color, (left, top, left + width, bottom), (right - width, top, right, bottom))

    def stripes(self, color: Color, box: Area, x: float, y: float, share: float, cover: float = 1.0) -> None:
        """Parallel stripes in a box, so many per tile along x and y."""
        rows, columns = self._part(box)
        part, place = self.image[:, rows, columns], self.x[:, columns] * x + self.y[rows] * y
        np.copyto(part, part + cover * (_channels(color) - part), where=place - np.floor(place) < share)

    def hazard(self, box: Area, x: float, y: float) -> None:
        self.fill(YELLOW, box)
        self.stripes(BLACK, box, x, y, 0.5)

    def bar(self, color: Color, width: float, x0: float, y0: float, x1: float, y1: float) -> None:
        """A straight bar from one point to another."""
        dx, dy = x1 - x0, y1 - y0
        along = (((self.x - x0) * dx + (self.y - y0) * dy) / (dx**2 + dy**2)).clip(0, 1)
        away = np.hypot(self.x - x0 - along * dx, self.y - y0 - along * dy)
        np.copyto(self.image, _channels(color), where=away < width / 2)

    def triangle(self, color: Color, middle: float, half: float, top: float, bottom: float) -> None:
        """A triangle that points upwards."""
        slim = np.abs(self.x - middle) / half <= (self.y - top) / (bottom - top)
        np.copyto(self.image, _channels(color), where=slim & (self.y < bottom))

    def cartons(self, box: Area, rows: int, columns: int) -> None:
        """A stack of cartons with tape and labels."""
        left, top, right, bottom = box
        w, h = (right - left) / columns, (bottom - top) / rows
        for index in range(rows * columns):
            x, y = left + index % columns * w, top + index // columns * h
            shade = (1.0, 0.84, 0.93, 0.78, 0.9)[(3 * index + rows + round(50 * left)) % 5]
            self.fill([shade * c for c in BOARD], (x, y, x + w, y + h))
            self.fill([shade * c for c in TAPE], (x + 0.45 * w, y, x + 0.55 * w, y + h))
            self.fill(0.92, (x + 0.64 * w, y + 0.5 * h, x + 0.88 * w, y + 0.76 * h))
            self.frame(BOARD_EDGE, 0.008, (x, y, x + w, y + h))

    def film(self, box: Area) -> None:
        """Goods in stretch film."""
        self.fill((0.86, 0.87, 0.84), box)
        self.stripes(0.72, box, 9, 22, 0.3)
        self.frame(0.64, 0.016, box)

    def pallet(self, box: Area) -> None:
        """A wooden pallet from the side: boards above and below three blocks."""
        left, top, right, bottom = box
        w, h = right - left, bottom - top
        self.fill(0.12, box)
        self.fill(DARK_WOOD, *((left + s * w, top, left + (s + 0.16) * w, bottom) for s in (0.0, 0.42, 0.84)))
        self.fill(WOOD, (left, top, right, top + 0.3 * h), (left, bottom - 0.2 * h, right, bottom))


def _draw_rack(c: _Canvas) -> None:
    for level, (top, floor) in enumerate(((0.0, 0.30), (0.335, 0.635), (0.665, 0.965))):
        for bay in range(3):
            left, kind = 0.065 + 0.30 * bay, (level + bay) % 3
            c.pallet((left, floor - 0.045, left + 0.27, floor))
            goods = (left + 0.01, top + (0.04, 0.06, 0.12)[kind], left + 0.26, floor - 0.045)
            if kind == 1:
                c.film(goods)
            else:
                c.cartons(goods, 2, 3 - kind // 2)
        c.fill(ORANGE, (0, floor, 1, floor + 0.035))
        c.fill((0.56, 0.26, 0.05), (0, floor + 0.027, 1, floor + 0.035))
    for left in (0.0, 0.955):
        c.fill(STEEL, (left, 0, left + 0.045, 1))
        c.stripes(0.18, (left + 0.016, 0, left + 0.029, 1), 0, 24, 0.4)
        c.hazard((left, 0.86, left + 0.045, 1), 14, 14)


def _draw_rack_end(c: _Canvas) -> None:
    c.cartons((0.14, 0.06, 0.86, 0.30), 1, 1)
    c.film((0.16, 0.40, 0.84, 0.64))
    c.cartons((0.14, 0.72, 0.86, 0.97), 2, 2)
    c.image *= 0.55  # behind the bracing
    for y, x0, x1 in ((0.0, 0.05, 0.95), (0.25, 0.95, 0.05), (0.5, 0.05, 0.95), (0.75, 0.95, 0.05)):
        c.bar(0.68, 0.05, x0, y, x1, y + 0.25)
    c.fill(ORANGE, *((0, y, 1, y + 0.04) for y in (0.0, 0.33, 0.66, 0.96)))
    for left in (0.0, 0.90):
        c.fill(STEEL, (left, 0, left + 0.10, 1))
        c.hazard((left, 0.85, left + 0.10, 1), 8, 8)


def _draw_pillar(c: _Canvas) -> None:
    c.image *= 1 + 0.03 * _noise(20, 4) + 0.02 * _noise(21, 40)
    c.fill(0.58, (0, 0.2, 1, 0.21), (0, 0.4, 1, 0.41))
    c.hazard((0, 0.60, 1, 1), 1, 6)  # aslant on a pillar, which is seven times as high as wide
    c.fill(0.25, (0, 0.59, 1, 0.61))


def _draw_pallet(c: _Canvas) -> None:
    c.cartons((0.03, 0.03, 0.97, 0.88), 3, 3)
    c.stripes(0.95, (0.03, 0.03, 0.97, 0.88), 5, 2.5, 0.22, cover=0.45)  # the film shines
    c.pallet((0, 0.88, 1, 1))


def _draw_crate(c: _Canvas) -> None:
    c.image *= 0.80 + 0.08 * (np.floor(c.y * 7) % 3) + 0.06 * _noise(22, 40, wide=10)
    c.stripes((0.28, 0.19, 0.10), (0, 0, 1, 1), 0, 7, 0.12)
    for color, more in ((DARK_WOOD, 0.035), (PALE_WOOD, 0.0)):
        c.bar(color, 0.135 + more, 0.1, 0.9, 0.9, 0.1)
    for color, more in ((DARK_WOOD, 0.02), (PALE_WOOD, 0.0)):
        c.frame(color, 0.125 + more)
    c.fill(0.2, *((x, y, x + 0.025, y + 0.025) for x in (0.05, 0.925) for y in (0.05, 0.925)))


def _draw_machine(c: _Canvas) -> None:
    c.frame((0.36, 0.41, 0.36), 0.03)
    c.fill((0.30, 0.34, 0.30), (0.49, 0.03, 0.51, 0.9), (0.44, 0.44, 0.47, 0.58))
    c.fill((0.22, 0.24, 0.22), (0.08, 0.10, 0.42, 0.36))
    c.fill((0.55, 0.72, 0.50), (0.11, 0.13, 0.31, 0.28))
    for y, color in ((0.13, (0.85, 0.15, 0.1)), (0.20, (0.2, 0.75, 0.25)), (0.27, YELLOW)):
        c.fill(color, (0.34, y, 0.39, y + 0.05))
    c.stripes(0.16, (0.58, 0.50, 0.92, 0.82), 0, 18, 0.45)
    c.triangle(BLACK, 0.75, 0.16, 0.12, 0.38)
    c.triangle(YELLOW, 0.75, 0.115, 0.165, 0.36)
    c.fill(BLACK, (0.735, 0.23, 0.765, 0.31), (0.735, 0.325, 0.765, 0.345))
    c.fill(0.22, (0, 0.92, 1, 1))


def _draw_top(c: _Canvas) -> None:
    c.image *= 1 + 0.02 * _noise(23, 30, wide=6)
    c.frame(BOARD_EDGE, 0.02)
    c.fill(TAPE, (0.42, 0, 0.58, 1))
    c.fill(BOARD_EDGE, (0.495, 0, 0.505, 1))
    c.fill(0.94, (0.66, 0.64, 0.92, 0.84))
    c.stripes(0.3, (0.69, 0.67, 0.86, 0.81), 0, 20, 0.4)


def _draw_door(c: _Canvas) -> None:
    c.image *= 0.72 + 0.28 * (c.y * 11 % 1) ** 0.5
    for left in (0.16, 0.34, 0.52, 0.70):
        c.fill((0.16, 0.17, 0.16), (left, 0.30, left + 0.14, 0.44))
        c.frame(0.35, 0.016, (left, 0.30, left + 0.14, 0.44))
        c.fill(0.55, (left + 0.03, 0.33, left + 0.06, 0.37))
    c.fill(0.15, (0, 0.94, 1, 1))
    for left in (0.05, 0.91):
        c.hazard((left, 0.07, left + 0.04, 1), 11, 5.5)
    c.fill(0.24, (0, 0, 1, 0.08), (0, 0, 0.05, 1), (0.95, 0, 1, 1))


def _draw_robot_side(c: _Canvas) -> None:
    c.frame(0.62, 0.03, (0, 0, 1, 0.62))
    c.fill(0.5, (0.32, 0.08, 0.33, 0.48), (0.67, 0.08, 0.68, 0.48))
    c.fill(ORANGE, (0.38, 0.16, 0.62, 0.40))
    c.fill(0.25, (0.06, 0.20, 0.20, 0.36), (0.80, 0.20, 0.94, 0.36))
    c.hazard((0, 0.52, 1, 0.66), 12, 3)
    c.fill(0.16, (0, 0.66, 1, 1))
    c.fill(0.30, *((x, 0.76, x + 0.08, 1) for x in (0.12, 0.46, 0.80)))


def _draw_robot_top(c: _Canvas) -> None:
    c.image[:, ((c.x * 16 + np.floor(c.y * 16) / 2) % 1 < 0.4) & (c.y * 16 % 1 < 0.4)] = 0.34
    c.frame(0.12, 0.095)
    c.frame(0.72, 0.08)
    c.fill(YELLOW, (0.43, 0.40, 0.57, 0.80))
    c.triangle(YELLOW, 0.5, 0.24, 0.16, 0.42)


def _draw_deck(c: _Canvas) -> None:
    for rib in (0.25, 0.5, 0.75):
        c.fill(0.98, (0, rib - 0.02, 1, rib))
        c.fill(0.68, (0, rib, 1, rib + 0.02))
    c.frame(0.5, 0.105)
    c.frame(0.66, 0.09)
    c.fill(0.4, *((x, y, x + 0.03, y + 0.03) for x in (0.03, 0.94) for y in (0.03, 0.94)))


_OBJECTS: dict[str, tuple[tuple[int, int, int, int], Color, Callable[[_Canvas], None]]] = {
    "rack": ((0, 0, 256, 256), 0.13, _draw_rack),
    "door": ((256, 0, 512, 128), (0.80, 0.81, 0.78), _draw_door),
    "rack_end": ((256, 128, 384, 256), 0.16, _draw_rack_end),
    "pillar": ((384, 128, 512, 256), (0.76, 0.75, 0.73), _draw_pillar),
    "pallet": ((0, 256, 128, 384), 0.30, _draw_pallet),
    "crate": ((128, 256, 256, 384), WOOD, _draw_crate),
    "machine": ((256, 256, 384, 384), (0.56, 0.64, 0.55), _draw_machine),
    "top": ((384, 256, 512, 384), BOARD, _draw_top),
    "robot_side": ((0, 384, 128, 512), 0.86, _draw_robot_side),
    "robot_top": ((128, 384, 256, 512), 0.22, _draw_robot_top),
    "deck": ((256, 384, 384, 512), 0.88, _draw_deck),
    "plain": ((384, 384, 512, 512), 1.0, lambda _: None),
}


def _draw_atlas() -> Picture:
    atlas = np.empty((ATLAS_SIZE, ATLAS_SIZE, 3), np.uint8)
    for (left, top, right, bottom), base, draw in _OBJECTS.values():
        canvas = _Canvas(right - left, bottom - top, base)
        draw(canvas)
        atlas[top:bottom, left:right] = _pixels(canvas.image)
    return atlas


def _tile(left: int, top: int, right: int, bottom: int) -> Area:
    inset, size = 0.5, ATLAS_SIZE  # between the centres of its texels: neighbours never show
    return (left + inset) / size, (top + inset) / size, (right - inset) / size, (bottom - inset) / size


PATTERNS: dict[Pattern, Picture] = _draw_patterns()
"""Tiles of 2 m x 2 m, nearly grey: a random tint multiplies them."""
ATLAS: Picture = _draw_atlas()
TILES: dict[str, Area] = {name: _tile(*pixels) for name, (pixels, _, _) in _OBJECTS.items()}
"""Left, top, right and bottom of an object's face, as shares of the atlas."""
