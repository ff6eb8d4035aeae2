import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import Config, StartRanges, resolve
from common.errors import UsageError
from common.geometry import SE2, Rectangle, bearing, distance_to_rectangle, rectangles_overlap
from common.tasks import (
    CELLS,
    SUITES,
    Box,
    GeometricProperties,
    Scene,
    Task,
    build_scene,
    candidate_task,
    check_cell,
    dolly_sides,
    geometric_properties,
    random_stream,
    random_task,
    suite,
)

CONFIG = Config()
PER_CELL = 300
KNOWN_SCENE = (
    SE2(x=0.3042813117812986, y=0.2521547949254309, yaw=0.7002639952353674),
    SE2(x=-0.25358552026471715, y=4.8791410135873585, yaw=0.17012066035478057),
    2,
)


@pytest.fixture(scope="module")
def scenes() -> list[tuple[Task, Scene]]:
    rng = np.random.default_rng(7)
    tasks = [random_task(cell, CONFIG, rng) for cell in range(len(CELLS)) for _ in range(PER_CELL)]
    return [(task, build_scene(task, CONFIG.world)) for task in tasks]


def footprints(scene: Scene) -> tuple[Rectangle, Rectangle]:
    """Robot and dolly, sizes from appendix C."""
    return Rectangle(scene.robot, 0.630 / 2, 1.273 / 2), Rectangle(scene.dolly, 0.820 / 2, 1.230 / 2)


def test_there_are_nine_cells_of_different_size_and_layout():
    assert len(CELLS) == 9
    assert len({(c.left, c.right, c.back, c.front) for c in CELLS}) == 9
    assert len({c.fixtures for c in CELLS}) >= 8


def test_scene_is_rebuilt_to_the_bit_from_cell_and_seed(scenes):
    for task, scene in scenes[:: PER_CELL // 3]:
        again = Task.model_validate(task.model_dump(mode="json"))
        assert build_scene(again, Config().world) == scene


def test_scene_of_a_known_task_stays_what_it_was():
    scene = build_scene(Task(cell=3, seed=12345, start=StartRanges()), CONFIG.world)
    assert (scene.robot, scene.dolly, len(scene.obstacles)) == KNOWN_SCENE


def test_scene_depends_on_the_seed_and_on_the_cell():
    start = StartRanges()
    a, b, c = (
        build_scene(Task(cell=cell, seed=seed, start=start), CONFIG.world)
        for cell, seed in ((0, 1), (0, 2), (5, 1))
    )
    assert len({a.robot, b.robot, c.robot}) == 3


def test_streams_of_a_task_differ_by_purpose_and_repeat():
    task = Task(cell=1, seed=5, start=StartRanges())
    draws = [random_stream(task, purpose).random() for purpose in (0, 1, 2)]
    assert len(set(draws)) == 3
    assert draws == [random_stream(task, purpose).random() for purpose in (0, 1, 2)]


def test_starts_keep_to_the_ranges_of_appendix_b_and_reach_their_ends(scenes):
    robots, dollies = [s.robot for _, s in scenes], [s.dolly for _, s in scenes]
    distance = [math.dist((r.x, r.y), (d.x, d.y)) for r, d in zip(robots, dollies, strict=True)]
    about_y = [
        math.degrees(bearing(SE2(r.x, r.y, 0.0), d.x, d.y)) for r, d in zip(robots, dollies, strict=True)
    ]
    for values, low, high in (
        ([r.x for r in robots], -0.5, 0.5),
        ([r.y for r in robots], -0.5, 0.5),
        ([math.degrees(r.yaw) for r in robots], -90, 90),
        ([math.degrees(d.yaw) for d in dollies], -15, 15),
        (distance, 1.5, 5.0),
        (about_y, -15, 15),
    ):
        slack = 1e-9 * (high - low)
        assert low - slack <= min(values)
        assert max(values) <= high + slack
        assert min(values) < low + 0.02 * (high - low)
        assert max(values) > high - 0.02 * (high - low)


def test_direction_of_the_dolly_does_not_follow_the_robots_yaw(scenes):
    yaws = np.array([s.robot.yaw for _, s in scenes])
    about_y = np.array([bearing(SE2(s.robot.x, s.robot.y), s.dolly.x, s.dolly.y) for _, s in scenes])
    assert abs(np.corrcoef(yaws, about_y)[0, 1]) < 0.05


def test_distances_are_flat_in_every_cell_and_over_all(scenes):
    for cell in range(len(CELLS)):
        distances = np.sort([geometric_properties(t, s).distance for t, s in scenes if t.cell == cell])
        cdf = (distances - 1.5) / 3.5
        ranks = np.arange(1, PER_CELL + 1) / PER_CELL
        kolmogorov = max(np.max(ranks - cdf), np.max(cdf - ranks + 1 / PER_CELL))
        assert kolmogorov < 1.63 / math.sqrt(PER_CELL), f"cell {cell}"  # the 1% point
    counts, _ = np.histogram([geometric_properties(t, s).distance for t, s in scenes], 7, (1.5, 5.0))
    expected = len(scenes) / 7
    assert ((counts - expected) ** 2 / expected).sum() < 16.81  # chi-square, 6 degrees of freedom, 1%


def test_no_start_overlaps_anything(scenes):
    for task, scene in scenes:
        cell, (robot, dolly) = CELLS[task.cell], footprints(scene)
        fixed = [box.footprint for box in cell.walls() + cell.fixtures]
        assert not rectangles_overlap(robot, dolly)
        for body in (robot, dolly):
            assert not any(rectangles_overlap(body, other) for other in fixed), task
            assert all(cell.left < x < cell.right and cell.back < y < cell.front for x, y in body.corners())


def test_one_to_four_obstacles_stand_left_and_right_of_the_dolly_clear_of_everything(scenes):
    counts, sides = [0] * 6, {-1: 0, 1: 0}
    for task, scene in scenes:
        cell, bodies = CELLS[task.cell], footprints(scene)
        counts[len(scene.obstacles)] += 1
        standing = [box.footprint for box in cell.walls() + cell.fixtures]
        for box in scene.obstacles:
            shape = box.footprint
            dx, dy = shape.pose.x - scene.dolly.x, shape.pose.y - scene.dolly.y
            assert 2.0 <= math.hypot(dx, dy) <= 5.0
            assert abs(dx) > abs(dy)
            sides[1 if dx > 0 else -1] += 1
            assert not any(rectangles_overlap(shape, other) for other in standing)
            assert not any(rectangles_overlap(shape, body, 0.39) for body in bodies)
            assert box.height > 0.2, "lower ones would be invisible to the LiDAR"
            standing.append(shape)
    assert counts[0] == counts[5] == 0
    assert min(counts[1:5]) > 0.15 * len(scenes)
    assert min(sides.values()) > 0.4 * sum(sides.values())


def test_obstacles_keep_their_distance_even_when_they_may_stand_close():
    settings = ("world.obstacles.distance_min=0.1", "world.obstacles.distance_max=1.6")
    world, gaps = resolve(overrides=settings).world, []
    for seed in range(40):
        scene = build_scene(Task(cell=5, seed=seed, start=StartRanges(distance_max=2.0)), world)
        for box in scene.obstacles:
            corners = box.footprint.corners()
            gaps += [distance_to_rectangle(x, y, body) for x, y in corners for body in footprints(scene)]
    assert 0.4 <= min(gaps) < 0.5


def test_favourable_starts_touch_nothing_and_are_not_docked_yet():
    ranges = CONFIG.curriculum.gate.ranges
    for seed in range(200):
        scene = build_scene(Task(cell=seed % 9, seed=seed, start=ranges), CONFIG.world)
        robot, _ = footprints(scene)
        assert not any(rectangles_overlap(robot, side) for side in dolly_sides(scene.dolly, CONFIG.world))
        distance = math.dist((scene.robot.x, scene.robot.y), (scene.dolly.x, scene.dolly.y))
        assert ranges.distance_min - 1e-9 <= distance <= ranges.distance_max + 1e-9
        assert distance > CONFIG.world.reward.success_distance


def test_sides_of_the_dolly_hold_the_legs_and_leave_the_tunnel_free():
    pose = SE2(1.0, 2.0, math.radians(90))
    sides = dolly_sides(pose, CONFIG.world)
    for side in sides:
        assert (side.half_x, side.half_y) == (0.02, 1.230 / 2)
    # turned by 90 deg, the dolly's left is the cell's -y
    assert [round(side.pose.y - 2.0, 9) for side in sides] == [-0.39, 0.39]
    assert not any(rectangles_overlap(Rectangle(pose, 0.369, 0.6), side) for side in sides)
    assert all(rectangles_overlap(Rectangle(pose, 0.371, 0.6), side) for side in sides)


def test_number_of_obstacles_follows_the_configuration():
    world = resolve(overrides=("world.obstacles.count_min=0", "world.obstacles.count_max=0")).world
    assert build_scene(Task(cell=0, seed=1, start=StartRanges()), world).obstacles == ()


def test_a_start_without_free_space_is_a_usage_error():
    world = resolve(overrides=("world.dolly.width=30.0",)).world
    with pytest.raises(UsageError, match=r"no free start in cell 2 for distances 1\.5 to 5"):
        build_scene(Task(cell=2, seed=1, start=StartRanges()), world)


def test_walls_enclose_the_room_without_a_gap_and_outside_its_inner_faces():
    cell = CELLS[1]
    left, right, back, front = (box.footprint for box in cell.walls())
    assert distance_to_rectangle(0, 0, left) == pytest.approx(4.5)
    assert distance_to_rectangle(0, 0, right) == pytest.approx(7.0)
    assert distance_to_rectangle(0, 0, back) == pytest.approx(2.0)
    assert distance_to_rectangle(0, 0, front) == pytest.approx(8.0)
    for x, y in ((-4.55, -2.05), (7.05, -2.05), (7.05, 8.05), (-4.55, 8.05)):
        assert min(distance_to_rectangle(x, y, w) for w in (left, right, back, front)) == 0


def test_properties_of_a_scene_worked_by_hand():
    box = Box(Rectangle(SE2(3.0, 3.0, 0.0), 0.5, 0.5), 1.0)
    scene = Scene(SE2(0, 0, math.radians(-30)), SE2(1, 3, math.radians(10)), (box,))
    found = geometric_properties(Task(cell=0, seed=0, start=StartRanges()), scene)
    towards = math.degrees(math.atan2(1, 3))  # 18.4 deg to the right of +y
    assert found.distance == pytest.approx(math.sqrt(10))
    assert found.agent_clearance == pytest.approx(2.5)  # the wall behind
    assert found.goal_clearance == pytest.approx(1.5)  # the box at the right
    assert math.degrees(found.relative_angle) == pytest.approx(30 - towards)
    assert found.lateral_offset == pytest.approx(math.cos(math.radians(10)) + 3 * math.sin(math.radians(10)))
    assert math.degrees(found.approach_angle) == pytest.approx(10 + towards)


def test_clearance_counts_fixtures_and_obstacles_near_the_robot_but_never_the_dolly():
    box = Box(Rectangle(SE2(-1.5, 0.0, 0.0), 0.5, 0.5), 1.0)
    task = Task(cell=4, seed=0, start=StartRanges())
    bare = geometric_properties(task, Scene(SE2(3.0, -1.0), SE2(3.0, 0.5), ()))
    assert bare.agent_clearance == pytest.approx(1.2)  # the fixture's top face at y = -2.2
    assert bare.goal_clearance == pytest.approx(2.0)  # the right-hand wall
    beside = geometric_properties(task, Scene(SE2(0, 0), SE2(0, 2), (box,)))
    assert beside.agent_clearance == pytest.approx(1.0)


def test_relative_angle_is_unsigned_up_to_half_a_turn():
    task = Task(cell=0, seed=0, start=StartRanges())
    for yaw in (90, -90):
        found = geometric_properties(task, Scene(SE2(0, 0, math.radians(yaw)), SE2(0, 3), ()))
        assert math.degrees(found.relative_angle) == pytest.approx(90)
    behind = geometric_properties(task, Scene(SE2(0, 4, 0.0), SE2(0, 1), ()))
    assert behind.relative_angle == pytest.approx(math.pi)


def test_properties_have_the_papers_four_first():
    assert list(GeometricProperties.model_fields)[:4] == [
        "distance",
        "agent_clearance",
        "goal_clearance",
        "relative_angle",
    ]


def test_suites_have_their_sizes_cells_and_ranges():
    assert SUITES == ("short", "train")
    short, train = suite("short", CONFIG), suite("train", CONFIG)
    assert (len(short), len(train)) == (100, 400)
    assert {t.cell for t in short} == {t.cell for t in train} == set(range(9))
    assert all(t.start == CONFIG.world.start for t in train)
    for task in short:
        found = build_scene(task, CONFIG.world)
        properties = geometric_properties(task, found)
        towards = bearing(SE2(found.robot.x, found.robot.y), found.dolly.x, found.dolly.y)
        assert 1.5 - 1e-9 <= properties.distance <= 2.0 + 1e-9
        assert abs(math.degrees(found.robot.yaw)) <= 20
        assert abs(math.degrees(found.dolly.yaw)) <= 4
        assert abs(math.degrees(towards)) <= 4 + 1e-9


def test_suites_are_the_same_every_time_and_buildable():
    assert suite("train", CONFIG) == suite("train", Config(seed=9))
    for task in suite("train", CONFIG):
        build_scene(task, CONFIG.world)


def test_training_never_draws_a_suites_seed():
    suites = [task.seed for name in SUITES for task in suite(name, CONFIG)]
    assert len(set(suites)) == 500
    rng = np.random.default_rng(0)
    drawn = [random_task(0, CONFIG, rng).seed for _ in range(500)]
    drawn += [candidate_task(0, CONFIG, rng).seed for _ in range(500)]
    assert len(set(drawn)) == 1000
    assert max(drawn) < 2**32 <= min(suites)


def test_unknown_suite_and_cell_are_usage_errors():
    with pytest.raises(UsageError, match="suite 'lang' does not exist; choose one of short, train"):
        suite("lang", CONFIG)
    assert check_cell(8) == 8
    for cell in (-1, 9):
        with pytest.raises(UsageError, match=f"cell {cell} does not exist; cells are 0 to 8"):
            check_cell(cell)


def test_share_of_narrowed_candidates_is_the_configured_one():
    for share, low, high in ((0.0, 0, 0), (0.5, 160, 240), (1.0, 400, 400)):
        config = resolve(overrides=(f"curriculum.narrowed_candidates={share}",))
        rng = np.random.default_rng(3)
        tasks = [candidate_task(2, config, rng) for _ in range(400)]
        assert low <= sum(task.start != config.world.start for task in tasks) <= high
        assert all(Task.model_validate(task.model_dump()) == task for task in tasks)


@st.composite
def start_ranges(draw: st.DrawFn) -> StartRanges:
    low, high = sorted((draw(st.floats(0.5, 5)), draw(st.floats(0.5, 5))))
    return StartRanges(
        distance_min=low,
        distance_max=high,
        yaw=draw(st.floats(0, 180)),
        bearing=draw(st.floats(0, 15)),
        dolly_yaw=draw(st.floats(0, 15)),
    )


@given(start_ranges(), start_ranges(), st.floats(0, 1))
def test_ranges_between_two_others_are_valid_and_leave_neither(ranges, others, share):
    between = ranges.towards(others, share)
    for key in StartRanges.model_fields:
        low, high = sorted((getattr(ranges, key), getattr(others, key)))
        assert low <= getattr(between, key) <= high
    assert ranges.towards(ranges, share) == ranges


def test_ranges_move_evenly_from_one_end_to_the_other():
    near = StartRanges(distance_min=1.0, distance_max=2.0, yaw=10, bearing=5, dolly_yaw=3)
    full = StartRanges(distance_min=1.5, distance_max=5.0, yaw=90, bearing=15, dolly_yaw=15)
    assert near.towards(full, 0.0) == near
    assert near.towards(full, 1.0) == full
    half = near.towards(full, 0.5)
    assert (half.distance_min, half.distance_max) == (1.25, 3.5)
    assert (half.yaw, half.bearing, half.dolly_yaw) == (50, 10, 9)
