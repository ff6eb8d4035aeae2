"""Rooms: what their outlines, walls, fixtures and doors must be, judged by shapely."""

import itertools
import math

import numpy as np
import pytest
from shapely import LineString, MultiPoint, Point, Polygon, union_all

from common.cells import (
    ARENAS,
    CELLS,
    ROOMS,
    WALL_THICKNESS,
    Box,
    Cell,
    arena_index,
    check_cell,
)
from common.errors import UsageError
from common.geometry import SE2, Rectangle
from common.tasks import START_MARGIN
from common.world_config import WorldConfig
from tests.helpers import polygon, strip

WORLD = WorldConfig()
every_room = pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)


def interior(room: Cell) -> Polygon:
    return Polygon(room.outline)


def around(room: Cell, reach: float) -> Polygon:
    """The room with a border of that width, square at its corners."""
    return interior(room).buffer(reach, join_style="mitre")


def walls_of(room: Cell) -> Polygon:
    return union_all([polygon(wall.footprint) for wall in room.walls])


def turns(room: Cell) -> list[float]:
    """Cross product of the two edges at every corner, of unit length: 1 convex, -1 reflex, 0 straight."""
    corners = np.array(room.outline)
    edges = np.roll(corners, -1, axis=0) - corners
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    before = np.roll(edges, 1, axis=0)
    return list(before[:, 0] * edges[:, 1] - before[:, 1] * edges[:, 0])


def test_there_are_nine_training_cells_and_two_arenas():
    assert (len(CELLS), len(ARENAS), len(ROOMS)) == (9, 2, 11)
    assert (ROOMS[:9], ROOMS[9:]) == (CELLS, ARENAS)
    assert [arena.name for arena in ARENAS] == ["validation", "test"]


def test_rooms_differ_in_name_size_outline_and_furniture():
    assert len({room.name for room in ROOMS}) == 11
    assert len({round(interior(room).area, 6) for room in ROOMS}) == 11
    assert len({room.outline for room in ROOMS}) == 11
    assert len({room.fixtures for room in ROOMS}) == 11
    sizes = {(right - left, front - back) for left, right, back, front in (r.extent for r in ROOMS)}
    assert len(sizes) == 11


def test_some_cells_and_both_arenas_have_a_reflex_corner_and_the_test_arena_the_most_corners():
    angled = [room.name for room in ROOMS if min(turns(room)) < 0]
    assert angled == ["corner", "loading bay", "corner store", "validation", "test"]
    assert {len(room.outline) for room in ROOMS[:-1]} == {4, 6}
    assert len(ROOMS[-1].outline) == 8


def test_test_arena_is_the_largest_room_and_the_validation_arena_the_next():
    by_area = sorted(ROOMS, key=lambda room: interior(room).area)
    assert by_area[-2:] == list(ARENAS)
    left, right, back, front = ARENAS[1].extent
    for room in ROOMS[:-1]:
        other_left, other_right, other_back, other_front = room.extent
        assert right - left > other_right - other_left
        assert front - back > other_front - other_back


@every_room
def test_outline_is_simple_counter_clockwise_and_rectilinear(room):
    shape = interior(room)
    assert shape.is_valid
    assert shape.exterior.is_ccw
    assert len(set(room.outline)) == len(room.outline)
    for (x0, y0), (x1, y1) in zip(room.outline, room.outline[1:] + room.outline[:1], strict=True):
        assert (x0 == x1) != (y0 == y1), "every edge is parallel to x or y and has a length"
    assert np.abs(turns(room)) == pytest.approx(1), "every corner turns"


@every_room
def test_extent_is_the_bounding_box_of_the_outline(room):
    left, back, right, front = interior(room).bounds
    assert room.extent == (left, right, back, front)


@every_room
def test_walls_enclose_the_room_without_a_gap(room):
    band = around(room, WALL_THICKNESS - 1e-6).difference(interior(room))
    assert band.difference(walls_of(room)).area < 1e-9
    assert band.area > 0.19 * interior(room).length


@every_room
def test_walls_are_closed_at_convex_and_at_reflex_corners(room):
    walls = walls_of(room)
    for corner, turn in zip(room.outline, turns(room), strict=True):
        outside = Point(corner).buffer(WALL_THICKNESS - 1e-6).difference(interior(room))
        share = outside.area / Point(corner).buffer(WALL_THICKNESS).area
        assert share == pytest.approx(0.75 if turn > 0 else 0.25, abs=1e-3)
        assert outside.difference(walls).area < 1e-9, corner


@every_room
def test_walls_lie_outside_the_inner_faces_and_are_no_thicker_than_said(room):
    assert len(room.walls) == len(room.edges) == len(room.outline)
    for wall in room.walls:
        assert polygon(wall.footprint).intersection(interior(room)).area < 1e-9
        assert 2 * min(wall.footprint.half_x, wall.footprint.half_y) == pytest.approx(WALL_THICKNESS)
        assert wall.height == room.wall_height
    assert walls_of(room).difference(around(room, WALL_THICKNESS + 1e-6)).area < 1e-9


@every_room
def test_each_wall_has_its_own_edge_for_inner_face_in_the_outlines_order(room):
    for wall, edge in zip(room.walls, room.edges, strict=True):
        face = LineString(edge)
        assert polygon(wall.footprint).exterior.buffer(1e-9).covers(face)
        middle = face.interpolate(0.5, normalized=True)
        assert middle.distance(Point(wall.footprint.pose.x, wall.footprint.pose.y)) < face.length / 2 + 0.3
    assert [edge[0] for edge in room.edges] == list(room.outline)
    assert [edge[1] for edge in room.edges] == [*room.outline[1:], room.outline[0]]


def test_walls_of_an_angled_room_worked_by_hand():
    room = Cell("angle", ((0, 0), (4, 0), (4, 2), (1, 2), (1, 5), (0, 5)), wall_height=2.5)
    bounds = [
        (-0.2, -0.2, 4.2, 0.0),
        (4.0, -0.2, 4.2, 2.2),
        (1.0, 2.0, 4.2, 2.2),  # ends at the reflex corner (1, 2)
        (1.0, 2.0, 1.2, 5.2),  # begins there
        (-0.2, 5.0, 1.2, 5.2),
        (-0.2, -0.2, 0.0, 5.2),
    ]
    for wall, expected in zip(room.walls, bounds, strict=True):
        assert polygon(wall.footprint).bounds == pytest.approx(expected)
        assert wall.height == 2.5
    assert room.extent == (0, 4, 0, 5)


@every_room
def test_fixtures_stand_inside_the_room_clear_of_walls_and_of_each_other(room):
    shapes, walls = [polygon(box.footprint) for box in room.fixtures], walls_of(room)
    assert len(shapes) >= 2
    for shape in shapes:
        assert interior(room).buffer(1e-9).contains(shape)
        assert shape.intersection(walls).area < 1e-9
    for a, b in itertools.combinations(shapes, 2):
        assert a.distance(b) > 0.05


@every_room
def test_fixtures_reach_above_the_lidars_and_not_above_the_walls(room):
    mounts = WORLD.robot.mounts
    for box in room.fixtures:
        assert max(mounts.front_lidar.z, mounts.rear_lidar.z) < box.height <= room.wall_height


@every_room
def test_solids_are_the_footprints_of_walls_and_fixtures(room):
    assert len(room.solids) == len(room.walls) + len(room.fixtures)
    expected = walls_of(room).union(union_all([polygon(box.footprint) for box in room.fixtures]))
    found = union_all([polygon(solid) for solid in room.solids])
    assert found.symmetric_difference(expected).area < 1e-9


@every_room
def test_doors_fit_on_their_wall_and_beside_each_other(room):
    spans = []
    for door in room.doors:
        length = math.dist(*room.edges[door.wall])
        assert 0 <= door.along - door.width / 2 < door.along + door.width / 2 <= length
        spans.append((door.wall, door.along - door.width / 2, door.along + door.width / 2))
    for (wall, _, end), (other_wall, start, _) in itertools.pairwise(sorted(spans)):
        assert wall != other_wall or end < start


def test_most_rooms_have_a_door():
    assert sum(bool(room.doors) for room in CELLS) >= 6
    assert all(arena.doors for arena in ARENAS)


@every_room
def test_a_robot_fits_anywhere_in_the_jitter_at_any_yaw_of_the_full_ranges(room):
    jitter, yaw = WORLD.start.jitter, WORLD.start.yaw
    x, y = WORLD.robot.width / 2, WORLD.robot.length / 2
    middles = [(dx, dy) for dx in (-jitter, jitter) for dy in (-jitter, jitter)]
    swept = union_all(
        [
            # the bodies at the four ends of the jitter; those in between lie within their convex hull
            MultiPoint(
                [
                    corner
                    for dx, dy in middles
                    for corner in strip(SE2(dx, dy, math.radians(a)), -x, x, -y, y).exterior.coords
                ]
            ).convex_hull
            for a in np.linspace(-yaw, yaw, 181)
        ]
    )
    assert interior(room).contains(swept)
    assert min(swept.distance(polygon(solid)) for solid in room.solids) > START_MARGIN + 0.1


@every_room
def test_dolly_of_a_placed_start_stands_free_with_a_corridor_at_either_end(room):
    half = WORLD.dolly.width / 2
    reach = WORLD.dolly.length / 2 + WORLD.robot.length + 0.2
    place = strip(room.dolly, -half, half, -reach, reach)
    assert interior(room).contains(place)
    assert min(place.distance(polygon(solid)) for solid in room.solids) > START_MARGIN


def test_containment_by_hand_in_a_room_with_a_niche():
    room = CELLS[3]  # its back left corner is filled: x < -3.4 and y > 6.6
    assert room.contains(0, 0)
    assert room.contains(-3.3, 9.1)
    assert room.contains(-5.9, 6.5)
    for x, y in ((-3.5, 6.7), (-5.9, 9.1), (6.1, 0.0), (0.0, -2.3), (0.0, 9.3), (-6.1, 0.0)):
        assert not room.contains(x, y)


def test_boxes_are_crates_unless_said_otherwise():
    assert Box(Rectangle(SE2(), 1, 1), 1.0).kind == "crate"
    kinds = {box.kind for room in ROOMS for box in room.fixtures}
    assert kinds == {"rack", "pillar", "pallet", "crate", "machine"}


def test_training_cells_are_0_to_8_and_arenas_are_none_of_them():
    assert [check_cell(cell) for cell in range(9)] == list(range(9))
    for cell in (-1, 9, 10, 11):
        with pytest.raises(UsageError, match=f"cell {cell} does not exist; cells are 0 to 8"):
            check_cell(cell)


def test_arenas_are_found_by_name_only():
    assert ROOMS[arena_index("validation")].name == "validation"
    assert (arena_index("validation"), arena_index("test")) == (9, 10)
    for name in ("hall", "Test", ""):
        with pytest.raises(UsageError, match=f"arena '{name}' does not exist; choose one of validation"):
            arena_index(name)
