"""What the sensing rivals remember of a room: returns as boxes, seen floor, and ways to see more."""

import math

import numpy as np
import pytest

from actor.baseline.occupancy import Occupancy, outside
from actor.baseline.planning import plan_to
from actor.baseline.scans import Scanner
from actor.baseline.searching import Coverage, ring
from actor.baseline.space import FreeSpace
from common.cells import ROOMS
from common.geometry import SE2, Rectangle, distance_to_rectangle
from tests.flatland import WORLD, cast, legs

WALLS = ROOMS[0].solids
START = SE2()
SCREEN = Rectangle(SE2(0.0, 2.0), 1.5, 0.1)


def sweep(solids, pose=START, count=20):
    """A robot that turns about; what it remembers."""
    occupancy, coverage, scanner = Occupancy(), Coverage(WORLD), Scanner(WORLD)
    for _ in range(count):
        scan = scanner.read(pose, cast(pose, solids))
        occupancy.add(scan)
        coverage.add(pose, scan)
        pose = pose @ SE2(0.0, 0.0, math.tau / count)
    return occupancy, coverage


def test_boxes_lie_where_the_returns_were():
    occupancy, _ = sweep([*WALLS, SCREEN])
    boxes = occupancy.boxes()
    assert len(boxes) > 100
    gaps = [min(distance_to_rectangle(b.pose.x, b.pose.y, s) for s in (*WALLS, SCREEN)) for b in boxes]
    assert max(gaps) < 0.01
    assert max(max(b.half_x, b.half_y) for b in boxes) <= 0.041


def test_what_is_cleared_is_gone_and_news_again():
    occupancy, _ = sweep([*WALLS, SCREEN])
    assert occupancy.news()
    occupancy.clear(0.0, 2.0, 1.7)
    assert not any(distance_to_rectangle(b.pose.x, b.pose.y, SCREEN) < 0.05 for b in occupancy.boxes())
    occupancy.add(Scanner(WORLD).read(SE2(), cast(SE2(), [*WALLS, SCREEN])))
    assert any(distance_to_rectangle(b.pose.x, b.pose.y, SCREEN) < 0.05 for b in occupancy.news())
    occupancy.add(Scanner(WORLD).read(SE2(), cast(SE2(), [*WALLS, SCREEN])))
    assert occupancy.news() == []


@pytest.mark.parametrize("side", [-1, 1])
def test_a_wall_beside_the_robot_goes_on_where_no_beam_reaches(side):
    pose, scanner = SE2(0.0, 3.0, 0.0), Scanner(WORLD)
    wall = Rectangle(SE2(side * 0.6, 3.0), 0.1, 3.0)
    scan = scanner.read(pose, cast(pose, [*WALLS, wall]))
    points = scanner.bridges(scan)
    assert np.abs(points[:, 0] - side * 0.5).max() < 0.01
    corner = 3.0 + side * 0.55  # the front right one and the rear left one turn towards it unseen
    assert np.abs(points[:, 1] - corner).min() < 0.1
    seen = scan.points[scan.hits & (np.abs(scan.points[:, 0] - side * 0.5) < 0.01)]
    assert np.abs(seen[:, 1] - corner).min() > 0.1
    assert len(scanner.bridges(scanner.read(pose, cast(pose, [])))) == 0


def test_posts_are_alone_and_walls_are_not():
    dolly = SE2(0.0, 3.0)
    occupancy, _ = sweep([*WALLS, *legs(dolly)])
    posts = np.array([(leg.pose.x, leg.pose.y) for leg in legs(dolly)])
    assert occupancy.are_alone(posts).all()
    assert not occupancy.are_alone(np.array([(5.5, 3.0), (0.0, -2.5)])).any()


def test_a_dollys_own_returns_are_left_out():
    dolly = SE2(0.5, 3.0, 0.3)
    boxes = [*legs(dolly), SCREEN]
    assert outside(boxes, dolly, 0.5, 0.7) == [SCREEN]
    assert outside([], dolly, 0.5, 0.7) == []


def test_floor_behind_a_screen_is_unseen_and_worth_going_for():
    occupancy, coverage = sweep([*WALLS, SCREEN])
    seen = {(x, y): s for (x, y), s in zip(coverage._places.tolist(), coverage.seen.tolist(), strict=True)}
    assert seen[(0.0, 1.0)] and seen[(-3.0, 1.0)]
    assert not seen[(0.0, 3.0)] and not seen[(0.0, 4.0)]
    views = coverage.viewpoints(SE2(), occupancy.boxes())
    assert views
    best = views[0]
    path = plan_to(SE2(), views, occupancy.boxes(), WORLD)
    assert path and math.hypot(path[-1].x - best.x, path[-1].y - best.y) < 9
    assert abs(best.x) > 0.7


def test_a_way_to_several_goals_ends_at_one_of_them_and_is_free():
    solids = [*WALLS, SCREEN]
    goals = ring(0.0, 4.5, (2.0,), 12)
    path = plan_to(SE2(0.0, 0.0, 0.2), goals, solids, WORLD)
    end = path[-1]
    assert min(math.hypot(end.x - g.x, end.y - g.y) + abs(end.yaw - g.yaw) for g in goals) < 1e-6
    x, y = end.apply(0.0, 2.0)
    assert (x, y) == pytest.approx((0.0, 4.5))
    assert FreeSpace(solids, None, path[0], WORLD).is_free(path, docking=False)
    assert not FreeSpace(solids, None, path[0], WORLD).is_free([SE2(), SE2(0.0, 4.5)], docking=False)
    assert plan_to(SE2(), [], solids, WORLD) == []
