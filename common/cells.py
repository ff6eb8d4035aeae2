"""The nine training cells and the two arenas: outlines, what stands in them, the place of a grid's dolly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from common.errors import UsageError
from common.geometry import SE2, Rectangle, inside_polygon

Kind = Literal["rack", "pillar", "pallet", "crate", "machine"]
WALL_THICKNESS = 0.2
DOLLY = SE2(0.0, 4.0)


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box standing on the floor; `kind` is how it is drawn."""

    footprint: Rectangle
    height: float
    kind: Kind = "crate"


@dataclass(frozen=True, slots=True)
class Door:
    """A loading door painted on a wall: the wall's index, the middle of the door along it, its width (m)."""

    wall: int
    along: float
    width: float = 3.0


@dataclass(frozen=True)
class Cell:
    """A room in the frame of its start point (0, 0), m."""

    name: str
    outline: tuple[tuple[float, float], ...]
    """Corners of the inner faces of the walls, counter-clockwise; walls are parallel to x or y."""
    fixtures: tuple[Box, ...] = ()
    doors: tuple[Door, ...] = ()
    wall_height: float = 3.0
    dolly: SE2 = DOLLY
    """Where the dolly of a placed start stands."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Smallest x, largest x, smallest y, largest y of the inner faces."""
        xs, ys = zip(*self.outline, strict=True)
        return min(xs), max(xs), min(ys), max(ys)

    @cached_property
    def edges(self) -> tuple[tuple[tuple[float, float], tuple[float, float]], ...]:
        """Both ends of each wall's inner face, in the outline's order."""
        return tuple(zip(self.outline, (*self.outline[1:], self.outline[0]), strict=True))

    @cached_property
    def walls(self) -> tuple[Box, ...]:
        """One box for each edge, outside its inner face, that closes the convex corners."""
        t, count, walls = WALL_THICKNESS, len(self.edges), []
        for i, ((x0, y0), (x1, y1)) in enumerate(self.edges):
            length = abs(x1 - x0) + abs(y1 - y0)
            ux, uy = (x1 - x0) / length, (y1 - y0) / length
            before, after = (t if self._convex(k % count) else 0.0 for k in (i, i + 1))
            middle = (length + after - before) / 2
            half = (length + after + before) / 2
            centre = SE2(x0 + ux * middle + uy * t / 2, y0 + uy * middle - ux * t / 2)
            half_x, half_y = (half, t / 2) if ux else (t / 2, half)
            walls.append(Box(Rectangle(centre, half_x, half_y), self.wall_height))
        return tuple(walls)

    @cached_property
    def solids(self) -> tuple[Rectangle, ...]:
        """Footprints of walls and fixtures."""
        return tuple(box.footprint for box in self.walls + self.fixtures)

    def contains(self, x: float, y: float) -> bool:
        """Whether a point lies between the walls."""
        return inside_polygon(x, y, self.outline)

    def _convex(self, corner: int) -> bool:
        (ax, ay), (bx, by) = self.edges[corner - 1]
        (_, _), (cx, cy) = self.edges[corner]
        return (bx - ax) * (cy - by) - (by - ay) * (cx - bx) > 0


def _room(left: float, right: float, back: float, front: float) -> tuple[tuple[float, float], ...]:
    return ((left, back), (right, back), (right, front), (left, front))


def _box(x: float, y: float, width: float, depth: float, height: float, kind: Kind) -> Box:
    return Box(Rectangle(SE2(x, y), width / 2, depth / 2), height, kind)


def _pillar(x: float, y: float) -> Box:
    return _box(x, y, 0.4, 0.4, 3.0, "pillar")


def _pallet(x: float, y: float, turned: bool = False, height: float = 1.1) -> Box:
    return _box(x, y, *((0.8, 1.2) if turned else (1.2, 0.8)), height, "pallet")


CELLS: tuple[Cell, ...] = (
    Cell(
        "hall",
        _room(-5.5, 5.5, -2.5, 9.0),
        (_pallet(-4.8, 8.4), _pallet(-3.5, 8.4, height=0.8), _pallet(4.7, 8.4, height=1.5)),
        (Door(2, 5.5),),
    ),
    Cell(
        "rack wall",
        _room(-4.5, 7.0, -2.0, 8.0),
        (_box(6.4, 3.0, 1.0, 5.0, 2.2, "rack"), _box(-3.9, 7.4, 1.0, 1.0, 1.4, "machine")),
        (Door(3, 5.0, 2.4),),
    ),
    Cell(
        "pillars",
        _room(-7.0, 4.8, -3.0, 10.0),
        (_pillar(-4.2, 2.0), _pillar(-4.2, 6.5), _pallet(4.1, 9.3, height=0.9), _pallet(-6.3, -2.3)),
    ),
    Cell(
        "corner",
        ((-6.0, -2.2), (6.0, -2.2), (6.0, 9.2), (-3.4, 9.2), (-3.4, 6.6), (-6.0, 6.6)),
        (_box(5.3, 5.6, 1.2, 3.2, 1.6, "rack"), _pallet(-5.3, -1.6)),
        (Door(0, 8.5),),
    ),
    Cell(
        "long hall",
        _room(-5.0, 5.0, -4.0, 11.0),
        (
            _box(3.6, -2.6, 1.2, 0.8, 1.1, "crate"),
            _box(-3.8, -2.8, 0.8, 1.2, 0.8, "crate"),
            _box(0.0, 10.4, 3.6, 1.0, 2.4, "rack"),
        ),
        (Door(1, 9.0),),
    ),
    Cell(
        "wide aisle",
        _room(-8.0, 8.0, -2.5, 8.5),
        (
            _box(7.3, 0.5, 1.0, 3.6, 2.0, "rack"),
            _box(7.3, 5.5, 1.0, 3.6, 2.0, "rack"),
            _box(-7.3, 4.0, 1.0, 4.8, 2.0, "rack"),
            _pillar(-4.6, 7.6),
        ),
        (Door(2, 8.0, 3.6),),
    ),
    Cell(
        "deep aisle",
        _room(-4.6, 4.6, -2.0, 12.0),
        (
            _box(0.0, 11.3, 4.0, 1.0, 2.4, "rack"),
            _box(-4.0, 9.4, 1.0, 2.4, 1.8, "machine"),
            _pallet(3.9, 9.0, turned=True),
        ),
    ),
    Cell(
        "loading bay",
        ((-6.5, -3.5), (2.6, -3.5), (2.6, -2.0), (5.2, -2.0), (5.2, 9.5), (-6.5, 9.5)),
        (
            _box(-5.2, -2.8, 2.4, 1.0, 1.2, "machine"),
            _box(4.6, 7.9, 0.8, 2.6, 1.8, "rack"),
            _pallet(-5.7, 8.8),
            _pillar(-5.0, 4.5),
        ),
        (Door(4, 3.0), Door(4, 8.0)),
    ),
    Cell(
        "corner store",
        ((-7.5, -2.8), (6.0, -2.8), (6.0, 5.4), (4.2, 5.4), (4.2, 7.6), (-7.5, 7.6)),
        (_box(-6.9, -2.2, 0.8, 0.8, 1.4, "crate"), _pallet(-6.7, 6.9, height=1.6), _pillar(-5.2, 2.4)),
        (Door(5, 5.2),),
    ),
)
"""The nine training cells (section 3.3 and its figure); layouts decided."""

ARENAS: tuple[Cell, ...] = (
    Cell(
        "validation",
        ((-7.5, -4.0), (7.0, -4.0), (7.0, 9.0), (5.0, 9.0), (5.0, 12.8), (-7.5, 12.8)),
        (
            _box(-6.9, 2.0, 1.0, 6.0, 2.3, "rack"),
            _pillar(4.6, 2.2),
            _pillar(-4.6, 8.4),
            _box(6.2, -3.2, 1.2, 1.2, 1.5, "machine"),
            _pallet(-3.2, 12.1),
            _pallet(3.4, 12.1, height=1.6),
        ),
        (Door(0, 7.0, 3.6),),
        3.5,
        SE2(0.0, 5.0),
    ),
    Cell(
        "test",
        (
            (-9.0, -5.5),
            (6.0, -5.5),
            (6.0, -3.8),
            (10.0, -3.8),
            (10.0, 14.5),
            (-5.0, 14.5),
            (-5.0, 11.0),
            (-9.0, 11.0),
        ),
        (
            _box(9.3, 4.0, 1.0, 8.0, 2.6, "rack"),
            _box(-8.4, 5.0, 1.0, 8.0, 2.6, "rack"),
            _box(2.0, 13.8, 6.0, 1.0, 2.6, "rack"),
            _pillar(-5.2, -2.0),
            _pillar(5.2, 0.6),
            _pillar(5.4, 9.0),
            _pillar(-5.4, 8.2),
            _pallet(8.8, -2.9),
            _pallet(-8.0, -4.7, height=1.5),
            _box(8.6, 12.6, 1.6, 1.6, 1.8, "machine"),
        ),
        (Door(0, 5.0, 3.6), Door(0, 10.0, 3.6)),
        4.5,
        SE2(0.0, 5.5),
    ),
)
"""Validation for probes, tuning and failure analysis; test for final grid tests only."""

ROOMS = CELLS + ARENAS
"""By index: 0 to 8 the training cells, 9 the validation arena, 10 the test arena."""
ROOM_NAMES = (*(str(index) for index in range(len(CELLS))), *(arena.name for arena in ARENAS))
"""What users call them, in the same order."""


def check_cell(cell: int) -> int:
    """The training cell itself; raises UsageError when there is none of that number."""
    if not 0 <= cell < len(CELLS):
        raise UsageError(f"cell {cell} does not exist; cells are 0 to {len(CELLS) - 1}")
    return cell


def arena_index(name: str) -> int:
    """Index in `ROOMS` of an arena by name; raises UsageError when there is none."""
    names = [arena.name for arena in ARENAS]
    if name not in names:
        raise UsageError(f"arena {name!r} does not exist; choose one of {', '.join(names)}")
    return len(CELLS) + names.index(name)
