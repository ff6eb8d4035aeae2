import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from common.geometry import SE2, Rectangle, bearing, distance_to_rectangle, rectangles_overlap, wrap

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
