import dataclasses
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from shapely import Polygon, prepare, union_all

from common.cells import CELLS, ROOMS, Box
from common.config import GEOMETRIC, Config, FavourableRanges, resolve
from common.errors import UsageError
from common.geometry import SE2, Rectangle, bearing, rectangles_overlap
from common.tasks import (
    DollyShift,
    GeometricProperties,
    Obstacle,
    PlacedStart,
    Scene,
    Task,
    build_scene,
    candidate_task,
    docking_corridor,
    dolly_sides,
    geometric_properties,
    obstacle_catalogue,
    random_stream,
    random_task,
)
from common.world_config import ObstacleConfig, StartRanges
from curriculum.task_space import DOCKING_SCALES, make_space
from tests.helpers import in_frame, polygon, strip

CONFIG = Config()
WORLD = CONFIG.world
FEW, MANY = 200, 2223  # tasks of each of the nine cells: 4,860 and 20,007
WIDE = StartRanges(jitter=2.5, distance_min=1.0, distance_max=6.0, yaw=180, bearing=60, dolly_yaw=90)
KNOWN_SCENE = Scene(
    SE2(x=0.2521547949254309, y=0.2229009526219764, yaw=1.2660576619661172),
    SE2(x=-0.2643539891271358, y=4.506860651147172, yaw=0.17012066035478057),
    (),
)
KNOWN_OBSTACLES = [(9, 2.0215678618009223, 3.4071390511215967), (5, -3.5625698513162645, 3.8896068559272026)]
SOLIDS = [union_all([polygon(solid) for solid in room.solids]) for room in ROOMS]
INTERIORS = [Polygon(room.outline) for room in ROOMS]
for shape in (*SOLIDS, *INTERIORS):
    prepare(shape)


def draw(per_cell: int) -> list[tuple[Task, Scene]]:
    rng = np.random.default_rng(7)
    tasks = [random_task(cell, CONFIG, rng) for cell in range(len(CELLS)) for _ in range(per_cell)]
    return [(task, build_scene(task, WORLD)) for task in tasks]


@pytest.fixture(scope="module", params=[FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def scenes(request) -> list[tuple[Task, Scene]]:
    """Tasks of the full training distribution, as many of each cell, and their scenes."""
    return draw(request.param)


@pytest.fixture(scope="module")
def wide() -> list[tuple[Task, Scene]]:
    """Starts from ranges so wide that most draws hit something, in all eleven rooms."""
    tasks = [Task(cell=seed % len(ROOMS), seed=seed, start=WIDE) for seed in range(440)]
    return [(task, build_scene(task, WORLD)) for task in tasks]


# What a free start is, by shapely and with the sizes of appendix C


def robot_of(scene: Scene) -> Polygon:
    return strip(scene.robot, -0.315, 0.315, -0.6365, 0.6365)


def dolly_at(pose: SE2) -> Polygon:
    return strip(pose, -0.41, 0.41, -0.615, 0.615)


def corridor_of(dolly: SE2, robot: SE2) -> Polygon:
    """The robot's length and width with 10 cm on every side, from the dolly's edge towards the robot."""
    along = (robot.x - dolly.x) * -math.sin(dolly.yaw) + (robot.y - dolly.y) * math.cos(dolly.yaw)
    near, far = 0.615, 0.615 + 1.273 + 0.2
    return strip(dolly, -0.415, 0.415, *((near, far) if along > 0 else (-far, -near)))


def assert_no_contact(task: Task, scene: Scene) -> None:
    robot = robot_of(scene)
    for body in (robot, dolly_at(scene.dolly)):
        assert INTERIORS[task.cell].contains(body), task
        assert SOLIDS[task.cell].distance(body) >= 0.02 - 1e-9, task
    for legs in ((-0.41, -0.37), (0.37, 0.41)):
        assert strip(scene.dolly, *legs, -0.615, 0.615).distance(robot) >= 0.02 - 1e-9, task


def assert_corridor(task: Task, scene: Scene, dolly: SE2 | None = None) -> None:
    corridor = corridor_of(dolly or scene.dolly, scene.robot)
    assert INTERIORS[task.cell].buffer(1e-9).contains(corridor), task
    assert SOLIDS[task.cell].intersection(corridor).area < 1e-9, task
    for obstacle in scene.obstacles:
        assert polygon(obstacle.box.footprint).distance(corridor) >= 0.4 - 1e-9, task


def assert_obstacles(task: Task, scene: Scene) -> None:
    catalogue, standing = obstacle_catalogue(WORLD.obstacles), list[Polygon]()
    assert len({obstacle.index for obstacle in scene.obstacles}) == len(scene.obstacles)
    for obstacle in scene.obstacles:
        box, shape = obstacle.box, polygon(obstacle.box.footprint)
        assert (box.footprint.half_x, box.footprint.half_y, box.height, box.kind) == catalogue[obstacle.index]
        assert INTERIORS[task.cell].contains(shape), task
        assert SOLIDS[task.cell].intersection(shape).area < 1e-9, task
        assert all(shape.intersection(other).area < 1e-9 for other in standing), task
        standing.append(shape)
        for body in (robot_of(scene), dolly_at(scene.dolly)):
            assert shape.distance(body) >= 0.4 - 1e-9, task
        away, angle = beside(obstacle, scene)
        assert 2.0 - 1e-9 <= away <= 5.0 + 1e-9
        assert angle <= 30 + 1e-9


def beside(obstacle: Obstacle, scene: Scene) -> tuple[float, float]:
    """Distance of an obstacle from the dolly and its angle from the cell's x axis, degrees."""
    pose = obstacle.box.footprint.pose
    dx, dy = pose.x - scene.dolly.x, pose.y - scene.dolly.y
    return math.hypot(dx, dy), math.degrees(math.atan2(abs(dy), abs(dx)))


# Random starts


def test_scene_is_rebuilt_to_the_bit_from_cell_and_seed(scenes):
    for task, scene in scenes[:: len(scenes) // 30]:
        again = Task.model_validate(task.model_dump(mode="json"))
        assert build_scene(again, Config().world) == scene


def test_scene_of_a_known_task_stays_what_it_was():
    scene = build_scene(Task(cell=3, seed=12345, start=StartRanges()), WORLD)
    assert dataclasses.replace(scene, obstacles=()) == KNOWN_SCENE
    poses = [(o.index, o.box.footprint.pose.x, o.box.footprint.pose.y) for o in scene.obstacles]
    assert poses == KNOWN_OBSTACLES


def test_scene_depends_on_the_seed_and_on_the_cell():
    start = StartRanges()
    a, b, c = (
        build_scene(Task(cell=cell, seed=seed, start=start), WORLD) for cell, seed in ((0, 1), (0, 2), (5, 1))
    )
    assert len({a.robot, b.robot, c.robot}) == 3


def test_streams_of_a_task_differ_by_purpose_and_repeat():
    task = Task(cell=1, seed=5, start=StartRanges())
    draws = [random_stream(task, purpose).random() for purpose in (0, 1, 2)]
    assert len(set(draws)) == 3
    assert draws == [random_stream(task, purpose).random() for purpose in (0, 1, 2)]


def quantities(scenes: list[tuple[Task, Scene]]) -> list[tuple[list[float], float, float]]:
    """Everything that is drawn of a start, with its range in appendix B."""
    robots, dollies = [s.robot for _, s in scenes], [s.dolly for _, s in scenes]
    distance = [math.dist((r.x, r.y), (d.x, d.y)) for r, d in zip(robots, dollies, strict=True)]
    about_y = [math.degrees(math.atan2(r.x - d.x, d.y - r.y)) for r, d in zip(robots, dollies, strict=True)]
    return [
        ([r.x for r in robots], -0.5, 0.5),
        ([r.y for r in robots], -0.5, 0.5),
        ([math.degrees(r.yaw) for r in robots], -90, 90),
        ([math.degrees(d.yaw) for d in dollies], -15, 15),
        (distance, 1.5, 5.0),
        (about_y, -15, 15),
    ]


def kolmogorov(values: list[float], low: float, high: float) -> float:
    """Kolmogorov's statistic against the uniform distribution; above 1.63 once in a hundred."""
    cdf = (np.sort(values) - low) / (high - low)
    ranks = np.arange(1, len(cdf) + 1) / len(cdf)
    return float(max(np.max(ranks - cdf), np.max(cdf - ranks + 1 / len(cdf))) * math.sqrt(len(cdf)))


def test_starts_keep_to_the_ranges_of_appendix_b_and_reach_their_ends(scenes):
    for values, low, high in quantities(scenes):
        slack = 1e-9 * (high - low)
        assert low - slack <= min(values) < low + 0.005 * (high - low)
        assert high - 0.005 * (high - low) < max(values) <= high + slack


def test_all_that_is_drawn_of_a_start_is_flat_within_its_range(scenes):
    assert max(kolmogorov(*quantity) for quantity in quantities(scenes)) < 1.63


def test_direction_of_the_dolly_does_not_follow_the_robots_yaw(scenes):
    yaws = np.array([s.robot.yaw for _, s in scenes])
    about_y = np.array([bearing(SE2(s.robot.x, s.robot.y), s.dolly.x, s.dolly.y) for _, s in scenes])
    assert abs(np.corrcoef(yaws, about_y)[0, 1]) < 0.05


def test_distances_are_flat_in_every_cell_and_over_all(scenes):
    for cell in range(len(CELLS)):
        distances = [geometric_properties(t, s).distance for t, s in scenes if t.cell == cell]
        assert len(distances) == len(scenes) / 9
        assert kolmogorov(distances, 1.5, 5.0) < 1.63, f"cell {cell}"
    counts, _ = np.histogram([geometric_properties(t, s).distance for t, s in scenes], 7, (1.5, 5.0))
    expected = len(scenes) / 7
    assert ((counts - expected) ** 2 / expected).sum() < 16.81  # chi-square, 6 degrees of freedom, 1%


def test_no_robot_starts_in_contact_and_every_dolly_stands_clear(scenes):
    for task, scene in scenes:
        assert_no_contact(task, scene)
        assert not robot_of(scene).intersects(dolly_at(scene.dolly))


def test_every_dolly_has_a_free_docking_corridor_on_the_robots_side(scenes):
    for task, scene in scenes:
        assert_corridor(task, scene)


def test_one_to_four_obstacles_stand_left_and_right_of_the_dolly_clear_of_everything(scenes):
    counts, sides, used = Counter[int](), Counter[bool](), Counter[int]()
    for task, scene in scenes:
        assert_obstacles(task, scene)
        counts[len(scene.obstacles)] += 1
        sides.update(o.box.footprint.pose.x > scene.dolly.x for o in scene.obstacles)
        used.update(o.index for o in scene.obstacles)
    assert set(counts) == {1, 2, 3, 4}
    assert min(counts.values()) > 0.2 * len(scenes)
    assert min(sides.values()) > 0.45 * sum(sides.values())
    assert set(used) == set(range(12))
    assert min(used.values()) > 0.05 * sum(used.values())


def test_obstacles_reach_the_ends_of_their_ranges(scenes):
    away, angles = zip(*(beside(o, scene) for _, scene in scenes for o in scene.obstacles), strict=True)
    assert min(away) < 2.05
    assert max(away) > 4.95
    assert max(angles) > 29.7
    yaws = [o.box.footprint.pose.yaw for _, scene in scenes for o in scene.obstacles]
    assert min(yaws) < -3.1
    assert max(yaws) > 3.1


def test_starts_from_wide_ranges_are_as_free_in_every_room(wide):
    for task, scene in wide:
        assert_no_contact(task, scene)
        assert_corridor(task, scene)
        assert_obstacles(task, scene)
    behind = [scene for _, scene in wide if (scene.dolly.inverse() @ scene.robot).y > 0]
    assert len(behind) > 10, "some dollies have their corridor at the other end"


def test_distances_stay_flat_where_far_ones_seldom_fit():
    ranges, distances = StartRanges(jitter=1.5, distance_max=10.5), []
    for seed in range(500):
        scene = build_scene(Task(cell=6, seed=seed, start=ranges), WORLD)  # 10.8 m from the start to its rack
        distances.append(math.dist((scene.robot.x, scene.robot.y), (scene.dolly.x, scene.dolly.y)))
    assert kolmogorov(distances, 1.5, 10.5) < 1.63


def test_jitter_of_the_ranges_bounds_the_robots_place():
    for jitter in (0.0, 1.5):
        start = StartRanges(jitter=jitter)
        robots = [build_scene(Task(cell=0, seed=seed, start=start), WORLD).robot for seed in range(100)]
        reach = max(max(abs(robot.x), abs(robot.y)) for robot in robots)
        assert 0.95 * jitter <= reach <= jitter


def test_obstacles_keep_their_distance_even_when_they_may_stand_close():
    settings = ("world.obstacles.distance_min=0.1", "world.obstacles.distance_max=1.6")
    world, gaps = resolve(overrides=settings).world, []
    for seed in range(40):
        scene = build_scene(Task(cell=5, seed=seed, start=StartRanges(distance_max=2.0)), world)
        kept = (robot_of(scene), dolly_at(scene.dolly), corridor_of(scene.dolly, scene.robot))
        gaps += [polygon(o.box.footprint).distance(body) for o in scene.obstacles for body in kept]
    assert 0.4 - 1e-9 <= min(gaps) < 0.42


def test_clearance_and_spread_of_the_obstacles_follow_the_configuration():
    world = resolve(overrides=("world.obstacles.clearance=0.9", "world.obstacles.spread=80")).world
    angles, gaps = [], []
    for seed in range(200):
        scene = build_scene(Task(cell=5, seed=seed, start=StartRanges()), world)
        kept = (robot_of(scene), dolly_at(scene.dolly), corridor_of(scene.dolly, scene.robot))
        gaps += [polygon(o.box.footprint).distance(body) for o in scene.obstacles for body in kept]
        angles += [beside(o, scene)[1] for o in scene.obstacles]
    assert 0.9 - 1e-9 <= min(gaps) < 0.95
    assert 60 < max(angles) <= 80


def test_favourable_starts_touch_nothing_and_are_not_docked_yet():
    ranges = CONFIG.curriculum.gate.ranges
    under = 0
    for seed in range(200):
        task = Task(cell=seed % 9, seed=seed, start=ranges)
        scene = build_scene(task, WORLD)
        assert_no_contact(task, scene)
        distance = math.dist((scene.robot.x, scene.robot.y), (scene.dolly.x, scene.dolly.y))
        assert ranges.distance_min - 1e-9 <= distance <= ranges.distance_max + 1e-9
        assert distance > WORLD.reward.success_distance
        under += robot_of(scene).intersects(dolly_at(scene.dolly))
    assert under > 50


def test_sides_of_the_dolly_hold_the_legs_and_leave_the_tunnel_free():
    pose = SE2(1.0, 2.0, math.radians(90))
    sides = dolly_sides(pose, WORLD)
    for side in sides:
        assert (side.half_x, side.half_y) == (0.02, 1.230 / 2)
    # turned by 90 deg, the dolly's left is the cell's -y
    assert [round(side.pose.y - 2.0, 9) for side in sides] == [-0.39, 0.39]
    assert not any(rectangles_overlap(Rectangle(pose, 0.369, 0.6), side) for side in sides)
    assert all(rectangles_overlap(Rectangle(pose, 0.371, 0.6), side) for side in sides)


def test_docking_corridor_by_hand_on_either_side_of_a_turned_dolly():
    dolly = SE2(1.0, 2.0, math.radians(90))  # its forward is the cell's -x
    for robot_x, expected in ((4.0, (1.615, 1.585, 3.088, 2.415)), (-2.0, (-1.088, 1.585, 0.385, 2.415))):
        found = docking_corridor(dolly, SE2(robot_x, 2.5, 0.3), WORLD)
        assert polygon(found).bounds == pytest.approx(expected)
        assert found.pose.yaw == dolly.yaw


# The boxes that stand about


def test_number_of_obstacles_follows_the_configuration():
    for count in (0, 3, 12):
        settings = (f"world.obstacles.count_min={count}", f"world.obstacles.count_max={count}")
        for cell in range(len(ROOMS)):
            task = Task(cell=cell, seed=1, start=StartRanges())
            scene = build_scene(task, resolve(overrides=settings).world)
            assert len(scene.obstacles) == count
            assert_obstacles(task, scene)


@pytest.mark.parametrize("config", [ObstacleConfig(), ObstacleConfig(size=(0.2, 3.0), height=(1.0, 1.1))])
def test_catalogue_fills_the_ranges_of_the_configuration(config):
    catalogue = obstacle_catalogue(config)
    assert len(catalogue) == 12
    half_x, half_y, height, kinds = zip(*catalogue, strict=True)
    for values, (low, high) in ((half_x, config.size), (half_y, config.size), (height, config.height)):
        share = (np.sort(values) * (1 if values is height else 2) - low) / (high - low)
        assert 0 <= share[0] < 0.1
        assert 0.9 < share[-1] <= 1
        assert np.diff(share).max() < 0.15
    assert abs(np.corrcoef(half_x, half_y)[0, 1]) < 0.5, "long ones and square ones"
    assert Counter(kinds) == {"crate": 4, "pallet": 4, "machine": 4}


def test_catalogue_of_a_single_size_has_only_that():
    for half_x, half_y, height, _ in obstacle_catalogue(ObstacleConfig(size=(0.8, 0.8), height=(1.5, 1.5))):
        assert (half_x, half_y, height) == (0.4, 0.4, 1.5)


# Placed starts and the grid


@pytest.mark.parametrize("cell", range(len(ROOMS)))
def test_placed_start_puts_the_robot_at_its_pose_in_the_dollys_frame(cell):
    task = Task(cell=cell, seed=3, start=PlacedStart(x=0.75, y=-2.5, yaw=-35))
    scene = build_scene(task, WORLD)
    room = ROOMS[cell]
    assert scene.dolly == room.dolly
    assert room.dolly.yaw == 0
    assert (scene.robot.x, scene.robot.y) == pytest.approx((room.dolly.x + 0.75, room.dolly.y - 2.5))
    assert math.degrees(scene.robot.yaw) == pytest.approx(-35)
    assert_no_contact(task, scene)
    assert_corridor(task, scene)
    assert_obstacles(task, scene)


def test_placed_start_follows_a_dolly_that_is_turned(monkeypatch):
    turned = dataclasses.replace(ROOMS[0], dolly=SE2(1.0, 4.0, math.radians(90)))  # looks along -x
    monkeypatch.setattr("common.tasks.ROOMS", (turned, *ROOMS[1:]))
    scene = build_scene(Task(cell=0, seed=1, start=PlacedStart(x=1.0, y=-2.0, yaw=30)), WORLD)
    assert scene.dolly == SE2(1.0, 4.0, math.radians(90))
    assert (scene.robot.x, scene.robot.y) == pytest.approx((3.0, 5.0))
    assert math.degrees(scene.robot.yaw) == pytest.approx(120)


def test_placed_start_may_be_behind_the_dolly_or_under_it():
    behind = Task(cell=9, seed=1, start=PlacedStart(x=0.3, y=3.0, yaw=180))
    assert_corridor(behind, build_scene(behind, WORLD))
    assert corridor_of(ROOMS[9].dolly, SE2(0.3, 8.0)).bounds[1] > ROOMS[9].dolly.y
    under = Task(cell=9, seed=1, start=PlacedStart(x=0.0, y=0.0, yaw=0.0))
    scene = build_scene(under, WORLD)
    assert scene.robot == scene.dolly == ROOMS[9].dolly
    assert_no_contact(under, scene)


# A dolly that moves


def test_shifted_dolly_is_where_the_displacement_in_its_own_frame_says():
    shift = DollyShift(step=20, x=1.0, y=-0.5, yaw=20)
    placed = Task(cell=9, seed=1, start=PlacedStart(x=0.5, y=-4, yaw=10), shift=shift)
    found = build_scene(placed, WORLD).shifted
    assert found is not None
    assert (found.x, found.y, math.degrees(found.yaw)) == pytest.approx((1.0, 4.5, 20))
    for seed in range(20):
        scene = build_scene(Task(cell=5, seed=seed, start=StartRanges(), shift=shift), WORLD)
        assert scene.shifted is not None
        assert (scene.shifted.x, scene.shifted.y) == pytest.approx(in_frame(scene.dolly, 1.0, -0.5))
        assert scene.shifted.yaw == pytest.approx(scene.dolly.yaw + math.radians(20))


def test_dolly_that_does_not_move_has_no_second_place():
    assert build_scene(Task(cell=9, seed=1, start=StartRanges()), WORLD).shifted is None


def test_second_place_of_the_dolly_and_its_corridor_are_kept_free_too():
    shift, would_hit = DollyShift(step=20, x=2.5, y=0.5, yaw=-15), 0
    for seed in range(100):
        start = PlacedStart(x=0.0, y=-3.0, yaw=0)
        still = build_scene(Task(cell=10, seed=seed, start=start), WORLD)
        task = Task(cell=10, seed=seed, start=start, shift=shift)
        scene = build_scene(task, WORLD)
        assert scene.shifted is not None
        assert_obstacles(task, scene)
        assert_corridor(task, scene)
        assert_corridor(task, scene, scene.shifted)
        assert all(
            polygon(o.box.footprint).distance(dolly_at(scene.shifted)) >= 0.4 - 1e-9 for o in scene.obstacles
        )
        would_hit += any(
            polygon(o.box.footprint).intersects(dolly_at(scene.shifted)) for o in still.obstacles
        )
    assert would_hit > 10


@pytest.mark.parametrize(
    ("shift", "reason"),
    [
        (DollyShift(step=5, x=10.0), "the shifted dolly stands in a wall or fixture"),
        (DollyShift(step=5, x=8.7), "the shifted dolly stands in a wall or fixture"),  # the rack
        (DollyShift(step=5, y=10.0), "the shifted dolly stands in a wall or fixture"),
        # between the pillar at (5.2, 0.6) and the robot's line: free itself, the pillar in its way
        (DollyShift(step=5, x=5.2, y=-2.9), "the shifted dolly has no free docking corridor"),
    ],
)
def test_shift_into_a_wall_or_to_where_none_can_dock_is_refused(shift, reason):
    task = Task(cell=10, seed=1, start=PlacedStart(x=0, y=-3.5, yaw=0), shift=shift)
    assert build_scene(task.model_copy(update={"shift": None}), WORLD).shifted is None
    with pytest.raises(UsageError) as caught:
        build_scene(task, WORLD)
    assert str(caught.value) == f"no free start in cell 10 (test): {reason} in 200 of 200 draws"


# What cannot be had


@pytest.mark.parametrize(
    ("cell", "start", "settings", "said"),
    [
        (
            0,
            StartRanges(distance_min=15, distance_max=15),
            (),
            "cell 0 (hall) at a distance of 15.00 m: the dolly stands in a wall or fixture",
        ),
        (
            9,
            PlacedStart(x=4.6, y=-2.8, yaw=0),  # the pillar at (4.6, 2.2)
            (),
            "cell 9 (validation): the robot stands in a wall or fixture",
        ),
        (
            9,
            PlacedStart(x=0, y=-8.5, yaw=0),
            (),
            "cell 9 (validation): the robot stands in a wall or fixture",
        ),
        (
            9,
            PlacedStart(x=20, y=-20, yaw=0),
            (),
            "cell 9 (validation): the robot stands in a wall or fixture",
        ),
        (9, PlacedStart(x=0, y=0, yaw=90), (), "cell 9 (validation): the robot touches the dolly"),
        (9, PlacedStart(x=0.7, y=0.2, yaw=0), (), "cell 9 (validation): the robot touches the dolly"),
        (
            2,
            PlacedStart(x=0, y=-3, yaw=0),
            ("world.dolly.width=30.0",),
            "cell 2 (pillars): the dolly stands in a wall or fixture",
        ),
        (2, PlacedStart(x=0, y=-9, yaw=0), (), "cell 2 (pillars): the robot stands in a wall or fixture"),
        (
            1,
            PlacedStart(x=0, y=-3, yaw=0),
            ("world.obstacles.distance_min=20", "world.obstacles.distance_max=21"),
            "cell 1 (rack wall): the room has no space for the obstacles",
        ),
        pytest.param(
            1,
            PlacedStart(x=0, y=-3, yaw=0),
            (
                "world.obstacles.count_min=12",
                "world.obstacles.count_max=12",
                "world.obstacles.size=[3, 3]",
            ),
            "cell 1 (rack wall): the room has no space for the obstacles",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_impossible_request_is_a_usage_error_that_names_the_reason(cell, start, settings, said):
    with pytest.raises(UsageError) as caught:
        build_scene(Task(cell=cell, seed=1, start=start), resolve(overrides=settings).world)
    draws = 200 if isinstance(start, PlacedStart) else 1000
    assert str(caught.value) == f"no free start in {said} in {draws} of {draws} draws"


def test_a_distance_at_which_nothing_fits_gives_way_to_another():
    ranges = StartRanges(distance_min=0.8, distance_max=4.0, yaw=90.0)
    tasks = [Task(cell=0, seed=seed, start=ranges) for seed in range(2**20, 2**20 + 200)]
    # a robot so near must stand straight between the legs, which one draw in hundreds does
    first = [random_stream(task, 0).uniform(0.8, 4.0) for task in tasks]
    near = [(task, distance) for task, distance in zip(tasks, first, strict=True) if distance < 0.9]
    scenes = [build_scene(task, WORLD) for task, _ in near]
    found = [math.hypot(scene.dolly.x - scene.robot.x, scene.dolly.y - scene.robot.y) for scene in scenes]
    kept = [distance == pytest.approx(drawn) for distance, (_, drawn) in zip(found, near, strict=True)]
    assert any(kept)
    assert not all(kept)


def test_commonest_reason_is_the_one_that_is_named():
    ranges = StartRanges(jitter=4.0, distance_min=14.0, distance_max=14.0)  # a third of the robots do not fit
    said = r"cell 6 \(deep aisle\) at a distance of 14\.00 m: the dolly stands .* in \d+ of 1000 draws"
    with pytest.raises(UsageError, match=said) as caught:
        build_scene(Task(cell=6, seed=1, start=ranges), WORLD)
    count = int(str(caught.value).split(" of 1000")[0].split()[-1])
    assert 500 < count < 800


@pytest.mark.parametrize(
    ("cell", "start"),
    [
        (9, StartRanges(distance_min=10.5, distance_max=11.5)),
        (10, StartRanges(distance_min=10.5, distance_max=11.5)),
        (9, PlacedStart(x=-6, y=-8.2, yaw=-40)),
        (10, PlacedStart(x=-6, y=-9.2, yaw=-40)),
    ],
)
def test_starts_beyond_ten_metres_are_possible_in_both_arenas(cell, start):
    for seed in range(30):
        task = Task(cell=cell, seed=seed, start=start)
        scene = build_scene(task, WORLD)
        assert math.dist((scene.robot.x, scene.robot.y), (scene.dolly.x, scene.dolly.y)) > 10
        assert_no_contact(task, scene)
        assert_corridor(task, scene)
        assert_obstacles(task, scene)


# Tasks as data


degrees = st.floats(-180, 180)
tasks = st.builds(
    Task,
    cell=st.integers(0, 10),
    seed=st.integers(0, 2**53 - 1),
    start=st.builds(StartRanges, jitter=st.floats(0, 5), bearing=st.floats(0, 180))
    | st.builds(PlacedStart, x=st.floats(-20, 20), y=st.floats(-20, 20), yaw=degrees),
    shift=st.none()
    | st.builds(
        DollyShift, step=st.integers(1, 10_000), x=st.floats(-10, 10), y=st.floats(-10, 10), yaw=degrees
    ),
)


@given(tasks)
def test_task_survives_json_to_the_bit(task):
    again = Task.model_validate_json(task.model_dump_json())
    assert again == task
    assert type(again.start) is type(task.start)
    assert Task.model_validate(task.model_dump()) == task


@pytest.mark.parametrize(
    "task",
    [
        Task(cell=10, seed=2**53 - 1, start=PlacedStart(x=-1.1, y=-3.3, yaw=77.7)),
        Task(
            cell=9,
            seed=5,
            start=PlacedStart(x=0.1, y=-3.3, yaw=-33.3),
            shift=DollyShift(step=3, x=0.7, y=0.1, yaw=12.3),
        ),
        Task(cell=4, seed=6, start=StartRanges(yaw=33.3), shift=DollyShift(step=3, x=-0.7)),
    ],
)
def test_scene_is_the_same_to_the_bit_after_json(task):
    scene = build_scene(task, WORLD)
    assert build_scene(Task.model_validate_json(task.model_dump_json()), Config().world) == scene
    assert (scene.shifted is None) == (task.shift is None)


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        ({}, StartRanges),
        ({"yaw": 5}, StartRanges),
        ({"jitter": 0.1, "yaw": 5}, StartRanges),
        ({"x": 1, "y": -2, "yaw": 5}, PlacedStart),
    ],
)
def test_kind_of_a_start_follows_from_its_keys(start, kind):
    task = Task.model_validate({"cell": 0, "seed": 0, "start": start})
    assert type(task.start) is kind
    assert start.items() <= task.start.model_dump().items()


@pytest.mark.parametrize(
    "start",
    [
        {"x": 1, "y": -2},
        {"x": 1, "yaw": 5},
        {"x": 1, "y": -2, "yaw": 5, "jitter": 0.1},
        {"jitter": 0.1, "x": 1},
        {"x": 21, "y": -2, "yaw": 5},
        {"x": 1, "y": -2, "yaw": 181},
        {"yaw": 181},
        {"z": 1},
        None,
    ],
)
def test_start_that_is_neither_kind_is_refused(start):
    with pytest.raises(ValidationError, match="start"):
        Task.model_validate({"cell": 0, "seed": 0, "start": start})


@pytest.mark.parametrize(
    "change",
    [
        {"cell": 11},
        {"cell": -1},
        {"seed": 2**53},
        {"seed": -1},
        {"shift": {}},
        {"shift": {"step": 0}},
        {"shift": {"step": 10_001}},
        {"shift": {"step": 1, "x": 10.5}},
        {"shift": {"step": 1, "yaw": 181}},
        {"shift": {"step": 1, "z": 1}},
        {"other": 1},
    ],
)
def test_task_out_of_bounds_is_refused(change):
    good = {"cell": 0, "seed": 0, "start": {}}
    Task.model_validate(good)
    with pytest.raises(ValidationError, match=next(iter(change))):
        Task.model_validate({**good, **change})


def test_favourable_ranges_arrive_as_ranges_with_the_same_numbers():
    task = Task(cell=3, seed=4, start=FavourableRanges())
    again = Task.model_validate_json(task.model_dump_json())
    assert type(again.start) is StartRanges
    assert again.start.model_dump() == FavourableRanges().model_dump()
    assert build_scene(again, WORLD) == build_scene(task, WORLD)


# What the curriculum sees


def test_properties_of_a_scene_worked_by_hand():
    box = Box(Rectangle(SE2(3.0, 3.0, 0.0), 0.5, 0.5), 1.0)
    scene = Scene(SE2(0, 0, math.radians(-30)), SE2(1, 3, math.radians(10)), (Obstacle(0, box),))
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
    beside = geometric_properties(task, Scene(SE2(0, 0), SE2(0, 2), (Obstacle(0, box),)))
    assert beside.agent_clearance == pytest.approx(1.0)


def test_relative_angle_is_unsigned_up_to_half_a_turn():
    task = Task(cell=0, seed=0, start=StartRanges())
    for yaw in (90, -90):
        found = geometric_properties(task, Scene(SE2(0, 0, math.radians(yaw)), SE2(0, 3), ()))
        assert math.degrees(found.relative_angle) == pytest.approx(90)
    behind = geometric_properties(task, Scene(SE2(0, 4, 0.0), SE2(0, 1), ()))
    assert behind.relative_angle == pytest.approx(math.pi)


def test_properties_have_the_papers_four_first_and_the_configuration_names_them_all():
    names = tuple(GeometricProperties.model_fields)
    assert names[:4] == ("distance", "agent_clearance", "goal_clearance", "relative_angle")
    assert names == GEOMETRIC
    task = Task(cell=3, seed=7, start=StartRanges())
    assert tuple(make_space(CONFIG).entry(task).properties) == GEOMETRIC == tuple(DOCKING_SCALES)


def test_share_of_narrowed_candidates_is_the_configured_one():
    for share, low, high in ((0.0, 0, 0), (0.5, 160, 240), (1.0, 400, 400)):
        config = resolve(overrides=(f"curriculum.narrowed_candidates={share}",))
        rng = np.random.default_rng(3)
        tasks = [candidate_task(2, config, rng) for _ in range(400)]
        assert low <= sum(task.start != config.world.start for task in tasks) <= high
        assert all(Task.model_validate(task.model_dump()) == task for task in tasks)
        tasks = [candidate_task(2, config, rng, solved=1.0) for _ in range(100)]
        assert all(task.start == config.world.start for task in tasks)


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
