import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st
from shapely.geometry.polygon import orient

from common.cells import ROOMS
from common.geometry import (
    SE2,
    Rectangle,
    as_rows,
    bearing,
    distance_to_rectangle,
    inside_polygon,
    rectangles_overlap,
    separations,
    wrap,
)
from tests.helpers import polygon

coordinates = st.floats(-20, 20)
angles = st.floats(-math.pi, math.pi)
poses = st.builds(SE2, coordinates, coordinates, angles)
near_poses = st.builds(SE2, st.floats(-2, 2), st.floats(-2, 2), angles)
rectangles = st.builds(Rectangle, near_poses, st.floats(0.1, 1.5), st.floats(0.1, 1.5))


def matrix(pose: SE2) -> np.ndarray:
    """The homogeneous matrix of a pose, from its definition."""
    rotation = np.array([[math.cos(pose.yaw), -math.sin(pose.yaw)], [math.sin(pose.yaw), math.cos(pose.yaw)]])
    return np.block([[rotation, np.array([[pose.x], [pose.y]])], [np.zeros((1, 2)), np.ones((1, 1))]])


def same(a: SE2, b: SE2) -> bool:
    return np.allclose(matrix(a), matrix(b), atol=1e-9)


@given(poses, poses)
def test_composition_is_the_product_of_homogeneous_matrices(a, b):
    np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-9)


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    assert same((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_identity_is_neutral_on_both_sides(a):
    assert same(a @ SE2(), a)
    assert same(SE2() @ a, a)


@given(poses)
def test_inverse_undoes_from_both_sides(a):
    assert same(a @ a.inverse(), SE2())
    assert same(a.inverse() @ a, SE2())


@given(poses, poses, coordinates, coordinates)
def test_points_follow_the_composition(a, b, x, y):
    np.testing.assert_allclose((a @ b).apply(x, y), a.apply(*b.apply(x, y)), atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrapped_angle_is_the_same_direction_in_the_half_open_circle(angle):
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_half_a_turn_wraps_to_plus_pi_and_small_angles_stay_to_the_bit():
    assert wrap(-math.pi) == wrap(math.pi) == wrap(3 * math.pi) == math.pi
    assert -math.pi < wrap(math.nextafter(math.pi, 4)) < -3.14
    assert wrap(0.1) == 0.1
    assert wrap(1e-30) == 1e-30


def test_yaw_zero_looks_along_y_and_minus_ninety_degrees_at_the_right_hand_wall():
    assert SE2(yaw=0.0).forward == pytest.approx((0, 1))
    assert SE2(yaw=-math.pi / 2).forward == pytest.approx((1, 0))
    assert SE2(yaw=math.pi / 2).forward == pytest.approx((-1, 0))
    assert SE2(2, 3, -math.pi / 2).apply(0, 1) == pytest.approx((3, 3))


@given(poses)
def test_forward_is_the_direction_of_the_bodys_own_y(pose):
    ahead = pose.apply(0, 1)
    assert pose.forward == pytest.approx((ahead[0] - pose.x, ahead[1] - pose.y), abs=1e-9)


def test_bearing_is_positive_to_the_left_and_negative_to_the_right():
    assert bearing(SE2(), 0, 2) == 0
    assert bearing(SE2(), -1, 1) == pytest.approx(math.radians(45))
    assert bearing(SE2(), 1, 1) == pytest.approx(math.radians(-45))
    assert abs(bearing(SE2(), 0, -1)) == pytest.approx(math.pi)
    assert bearing(SE2(1, 1, -math.pi / 2), 2, 2) == pytest.approx(math.radians(45))


@given(poses, angles, st.floats(0.1, 10))
def test_turning_by_the_bearing_faces_the_point(pose, angle, distance):
    assume(abs(angle) < 3.14)
    point = (pose @ SE2(yaw=angle)).apply(0, distance)
    assert bearing(pose, *point) == pytest.approx(angle, abs=1e-6)


def segment_distance(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Distance from p to the closest point of the segment ab."""
    along = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return float(np.linalg.norm(p - (a + along * (b - a))))


def inside(p: np.ndarray, polygon: np.ndarray) -> bool:
    """Whether p lies in a convex counter-clockwise polygon: to the left of every edge."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    to = p - polygon
    return bool((edges[:, 0] * to[:, 1] - edges[:, 1] * to[:, 0] >= 0).all())


def polygon_distance(p: np.ndarray, polygon: np.ndarray) -> float:
    if inside(p, polygon):
        return 0.0
    return min(segment_distance(p, a, b) for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True))


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two disjoint convex polygons: it is attained at a corner of one of them."""
    return min([polygon_distance(p, b) for p in a] + [polygon_distance(p, a) for p in b])


def common_area(a: np.ndarray, b: np.ndarray) -> float:
    """Area of the intersection of two convex polygons, by clipping a at every edge of b."""
    points = list(a)
    for start, end in zip(b, np.roll(b, -1, axis=0), strict=True):
        edge, clipped = end - start, []
        for p, q in zip(points, points[1:] + points[:1], strict=True):
            sp = edge[0] * (p - start)[1] - edge[1] * (p - start)[0]
            sq = edge[0] * (q - start)[1] - edge[1] * (q - start)[0]
            if sp >= 0:
                clipped.append(p)
            if sp * sq < 0:
                clipped.append(p + (q - p) * sp / (sp - sq))
        points = clipped
    if len(points) < 3:
        return 0.0
    x, y = np.array(points).T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def test_corners_are_counter_clockwise_around_the_pose():
    rectangle = Rectangle(SE2(1, 2, math.pi / 2), 0.5, 2.0)
    expected = [(-1, 2.5), (-1, 1.5), (3, 1.5), (3, 2.5)]
    np.testing.assert_allclose(rectangle.corners(), expected, atol=1e-12)


@given(rectangles, rectangles, st.sampled_from([0.0, 0.02, 0.4]))
def test_overlap_agrees_with_clipping_and_with_the_closest_points(a, b, margin):
    grown = Rectangle(a.pose, a.half_x + margin, a.half_y + margin).corners()
    area = common_area(grown, b.corners())
    apart = area == 0 and gap(grown, b.corners()) > 1e-9
    assume(apart or area > 1e-9)
    assert rectangles_overlap(a, b, margin) is not apart


@given(rectangles, rectangles)
def test_overlap_does_not_depend_on_the_order(a, b):
    assert rectangles_overlap(a, b) == rectangles_overlap(b, a)


def test_a_cross_of_rectangles_overlaps_although_no_corner_is_inside_the_other():
    assert rectangles_overlap(Rectangle(SE2(), 2, 0.1), Rectangle(SE2(yaw=math.radians(80)), 2, 0.1))


def test_diagonal_neighbours_whose_axis_aligned_hulls_meet_are_apart():
    tilted = math.radians(45)
    a, b = Rectangle(SE2(0, 0, tilted), 1.0, 0.1), Rectangle(SE2(0.5, -0.5, tilted), 1.0, 0.1)
    assert not rectangles_overlap(a, b)
    assert not rectangles_overlap(a, b, 0.5)
    assert rectangles_overlap(a, b, 0.52)


@given(near_poses, rectangles)
def test_distance_agrees_with_the_closest_point_on_the_edges(point, rectangle):
    expected = polygon_distance(np.array([point.x, point.y]), rectangle.corners())
    assert distance_to_rectangle(point.x, point.y, rectangle) == pytest.approx(expected, abs=1e-9)


def test_distance_by_hand_beside_an_edge_at_a_corner_and_inside():
    rectangle = Rectangle(SE2(1, 1, 0), 1, 0.5)
    assert distance_to_rectangle(1, 3, rectangle) == pytest.approx(1.5)
    assert distance_to_rectangle(5, 5.5, rectangle) == pytest.approx(5)
    assert distance_to_rectangle(1.9, 1.4, rectangle) == 0


# Many rectangles at once


def random_pairs(seed: int, batches: int) -> list[tuple[list[Rectangle], list[Rectangle], np.ndarray]]:
    """Batches of 20 rectangles of one size, 50 of any, and their separations: 1,000 pairs each."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(batches):
        half = (float(rng.uniform(0.1, 1.5)), float(rng.uniform(0.1, 1.5)))
        poses = rng.uniform((-2, -2, -4), (2, 2, 4), (20, 3))
        rows = rng.uniform((-2, -2, -4, 0.1, 0.1), (2, 2, 4, 1.5, 1.5), (50, 5))
        rows[:5, 2] = poses[:5, 2] + np.arange(5) * math.pi / 2  # some at right angles to each other
        ours = [Rectangle(SE2(*pose), *half) for pose in poses]
        theirs = [Rectangle(SE2(*row[:3]), *row[3:]) for row in rows]
        found.append((ours, theirs, separations(poses, half, rows)))
    return found


def signed_gap(a: shapely.Polygon, b: shapely.Polygon) -> float:
    """Largest signed distance of the origin from the edges of the hull of all differences b - a.

    Minkowski: the hull holds the origin exactly when a and b meet, then its boundary is as far away as the
    shortest way apart; its edges are those of a and of b.
    """
    pa, pb = (np.array(shape.exterior.coords)[:-1] for shape in (a, b))
    differences = (pb[None] - pa[:, None]).reshape(-1, 2)
    ring = np.array(orient(shapely.convex_hull(shapely.multipoints(differences))).exterior.coords)
    edges, starts = np.diff(ring, axis=0), ring[:-1]
    lengths = np.linalg.norm(edges, axis=1)
    outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1)[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    return float(np.max(-(starts[lengths > 1e-6] * outward).sum(axis=1)))


def test_sign_of_a_separation_says_whether_shapely_finds_an_intersection():
    pairs = touching = 0
    for ours, theirs, found in random_pairs(seed=1, batches=10):
        a, b = np.array([polygon(r) for r in ours])[:, None], np.array([polygon(r) for r in theirs])[None]
        distance, meet = shapely.distance(a, b), shapely.intersects(a, b)
        clear = np.abs(found) > 1e-9
        assert clear.mean() > 0.999
        assert ((found < 0) == meet)[clear].all()
        assert (found <= distance + 1e-9)[found > 0].all()
        pairs, touching = pairs + found.size, touching + int(meet.sum())
    assert pairs == 10_000
    assert 2000 < touching < 8000


def test_separation_agrees_with_the_scalar_test_for_each_pair():
    for ours, theirs, found in random_pairs(seed=2, batches=10):
        scalar = [[rectangles_overlap(a, b) for b in theirs] for a in ours]
        assert ((found < 0) == scalar)[np.abs(found) > 1e-9].all()


def test_separation_is_the_signed_distance_from_the_edges_of_the_minkowski_difference():
    for ours, theirs, found in random_pairs(seed=3, batches=2):
        expected = [[signed_gap(polygon(a), polygon(b)) for b in theirs] for a in ours]
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("pose", "half", "other", "expected"),
    [
        ((0, 0, 0), (1, 1), (1.5, 0, 0, 1, 1), -0.5),  # side by side, half a metre into each other
        ((0, 0, 0), (1, 1), (0.3, -1.8, 0, 1, 1), -0.2),  # the shorter way out is along y
        ((0, 0, 0), (2, 0.1), (0, 0, 0, 0.1, 2), -2.1),  # a cross, whose bars lie under each other
        ((3, 4, 0), (1, 1), (3, 4, 0, 0.2, 0.3), -1.2),  # one within the other
        ((0, 0, 0), (1, 1), (0, 0, math.pi / 2, 0.2, 0.3), -1.2),  # turned, it is 0.3 wide and 0.2 deep
        ((0, 0, math.pi / 4), (1, 1), (2, 0, 0, 1, 1), 1 - math.sqrt(2)),  # a corner pokes into a side
        ((0, 0, math.pi / 4), (1, 1), (3, 0, 0, 1, 1), 2 - math.sqrt(2)),
        ((0, 0, 0), (1, 0.5), (4, 0, 0, 1, 0.5), 2.0),  # apart along x
        ((0, 0, 0), (1, 0.5), (0, -4, math.pi, 1, 0.5), 3.0),
        ((0, 0, 0), (1, 1), (5, 6, 0, 1, 1), 4.0),  # diagonal: 3 and 4 along the axes, 5 in fact
        ((0, 0, 0), (1, 1), (2, 0, 0, 1, 1), 0.0),  # touching
    ],
)
def test_separation_by_hand(pose, half, other, expected):
    found = separations(np.array([pose], float), half, np.array([other], float))
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(expected, abs=1e-12)


def test_rows_hold_pose_and_half_extents_and_are_empty_for_no_rectangles():
    rows = as_rows([Rectangle(SE2(1, 2, 0.5), 3, 4), Rectangle(SE2(-1, 0, 0), 0.5, 0.25)])
    assert rows.tolist() == [[1, 2, 0.5, 3, 4], [-1, 0, 0, 0.5, 0.25]]
    assert rows.dtype == np.float64
    assert as_rows(iter(())).shape == (0, 5)
    assert separations(np.zeros((4, 3)), (1, 1), as_rows([])).shape == (4, 0)


STAR = ((0, 3), (-0.7, 0.9), (-3, 1), (-1.2, -0.4), (-2, -2.6), (0, -1.3), (2, -2.6), (1.2, -0.4), (3, 1))
"""Slanted edges, which no room has."""


@pytest.mark.parametrize(
    "corners", [*(room.outline for room in ROOMS), STAR], ids=[*(room.name for room in ROOMS), "star"]
)
def test_points_inside_a_polygon_are_those_that_shapely_finds_inside(corners):
    rng, shape = np.random.default_rng(5), shapely.Polygon(corners)
    left, back, right, front = shape.bounds
    points = rng.uniform((left - 1, back - 1), (right + 1, front + 1), (3000, 2))
    points[:1000, 1] = rng.choice([y for _, y in corners], 1000)  # rays that pass through corners
    off = shapely.distance(shape.boundary, shapely.points(points)) > 1e-9
    assert off.mean() > 0.6
    expected = shapely.contains_xy(shape, points)
    for order in (corners, corners[::-1]):
        found = np.array([inside_polygon(x, y, order) for x, y in points.tolist()])
        assert (found == expected)[off].all()
    assert 0.15 < expected[off].mean() < 0.95
