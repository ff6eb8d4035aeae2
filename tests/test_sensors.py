"""Sensors and contacts against independent geometry, in random scenes of all rooms."""

import math

import numpy as np
import pytest
import shapely
from shapely import affinity

from actor.world.sensors import Lidar, Renderer
from actor.world.world import DockingWorld
from common.cells import ROOMS
from common.config import resolve
from common.geometry import SE2, Rectangle, bearing
from common.tasks import Task, random_task, surfaces
from common.world_config import StartRanges

NO_NOISE = "world.randomization.training.camera_noise=[0, 0]"
CONFIG = resolve(overrides=('world.randomization.fixed=["all"]', NO_NOISE, "world.start.yaw=180"))
DOLLY = CONFIG.world.dolly
FINE = 5


@pytest.fixture(scope="module")
def world():
    world = DockingWorld(CONFIG.world, max_steps=100)
    yield world
    world.close()


def polygon(shape: Rectangle) -> shapely.Polygon:
    """The rectangle, by shapely's own rotation."""
    box = shapely.box(-shape.half_x, -shape.half_y, shape.half_x, shape.half_y)
    turned = affinity.rotate(box, shape.pose.yaw, origin=(0, 0), use_radians=True)
    return affinity.translate(turned, shape.pose.x, shape.pose.y)


def legs(dolly: SE2) -> list[Rectangle]:
    x, y = DOLLY.width / 2 - DOLLY.leg / 2, DOLLY.length / 2 - DOLLY.leg / 2
    return [
        Rectangle(dolly @ SE2(sx * x, sy * y), DOLLY.leg / 2, DOLLY.leg / 2)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]


def rails(dolly: SE2) -> list[Rectangle]:
    x = DOLLY.width / 2 - DOLLY.leg / 2
    return [Rectangle(dolly @ SE2(s * x), DOLLY.leg / 2, DOLLY.length / 2 - DOLLY.leg) for s in (-1, 1)]


def cast(starts: np.ndarray, ends: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Fractions (R,) at which rays first meet one of (S, 2, 2) segments; 1 where they meet none."""
    d = (ends - starts)[:, None]
    a, e = segments[None, :, 0], segments[None, :, 1] - segments[None, :, 0]
    to = a - starts[:, None]
    cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to[..., 0] * e[..., 1] - to[..., 1] * e[..., 0]) / cross
        on = (to[..., 0] * d[..., 1] - to[..., 1] * d[..., 0]) / cross
        hit = (along >= 0) & (along <= 1) & (on >= 0) & (on <= 1)
    return np.where(hit, along, 1.0).min(axis=1)


def outlines(shapes: list[Rectangle], grow: float) -> np.ndarray:
    """(4 S, 2, 2) edges of rectangles, each grown by `grow` m."""
    rings = [
        np.array(polygon(Rectangle(s.pose, s.half_x + grow, s.half_y + grow)).exterior.coords) for s in shapes
    ]
    return np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])


def beams(pose: SE2) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (256, 2) of the paper's beams: 128 over 225 deg from each of two corners, 6 m long."""
    starts, ends = [], []
    for x, y, middle in ((-0.315, 0.6365, 45.0), (0.315, -0.6365, -135.0)):
        for angle in np.radians(middle + np.linspace(-112.5, 112.5, 128)):
            starts.append(pose.apply(x, y))
            ends.append(pose.apply(x - 6.0 * math.sin(angle), y + 6.0 * math.cos(angle)))
    return np.array(starts), np.array(ends)


@pytest.mark.parametrize("scenes", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_lidar_agrees_with_ray_and_segment_within_a_centimetre_in_random_scenes(world, scenes):
    rng, reach = np.random.default_rng(3), CONFIG.world.lidar.range
    worst = seen = legs_hit = 0.0
    for index in range(scenes):
        task = random_task(index % len(ROOMS), CONFIG, rng)
        world.place(task)
        measured = reach * world.lidar.sense(rng).astype(float)
        starts, ends = beams(world.pose)
        fixed = surfaces(task.cell, world.scene)
        # a beam along an edge may pass it or not: between half a millimetre less and more of everything
        low, high = (
            reach * cast(starts, ends, outlines([*fixed, *legs(world.dolly)], grow)) for grow in (5e-4, -5e-4)
        )
        worst = max(worst, (low - measured).max(), (measured - high).max())
        seen += (measured < reach).mean() / scenes
        legs_hit += (reach * cast(starts, ends, outlines(fixed, 0.0)) - measured > 0.05).sum()
    assert worst < 0.01
    assert 0.2 < seen < 0.9
    assert legs_hit > scenes  # the dolly is seen, not only what stands about


def test_lidars_sit_on_diagonal_corners_and_never_see_the_robot(world):
    starts, ends = world.lidar.starts, world.lidar.ends
    assert starts[0] == pytest.approx([-0.315, 0.6365, 0.2])
    assert starts[-1] == pytest.approx([0.315, -0.6365, 0.2])
    half = len(starts) // 2
    assert half == 128
    for part, middle in ((slice(0, half), math.pi / 4), (slice(half, None), -3 * math.pi / 4)):
        d = (ends - starts)[part]
        angles = np.unwrap(np.arctan2(-d[:, 0], d[:, 1]))
        assert np.degrees(angles[-1] - angles[0]) == pytest.approx(225.0)
        assert math.cos(np.mean([angles[0], angles[-1]]) - middle) == pytest.approx(1.0)
    world.place(Task(cell=0, seed=1, start=StartRanges(distance_min=4.0)))
    world.bodies.arrange(())
    assert world.lidar.sense(np.random.default_rng(0)).min() > 0.2  # nothing within 1.2 m: not even itself


def test_lidar_sees_the_legs_under_the_deck_but_no_rail(world):
    world.place(Task(cell=0, seed=1, start=CONFIG.world.start))
    world.bodies.arrange(())
    world.stand(SE2(0.0, 3.0, 0.4), SE2(0.0, 3.0, 0.4))  # every beam leaves from under the deck
    reading = world.lidar.sense(np.random.default_rng(0)).astype(float)[:, None]
    hits = world.lidar.starts + reading * (world.lidar.ends - world.lidar.starts)
    near = hits[np.abs(hits[:, 0]) < 0.6]
    near = near[np.abs(near[:, 1]) < 1.0][:, :2]
    assert len(near) > 10
    corner = np.abs(near) - [DOLLY.width / 2, DOLLY.length / 2]
    assert np.abs(corner).max() < DOLLY.leg + 0.005


def test_lidar_noise_and_dropouts_are_as_configured_and_off_by_default(world):
    assert (CONFIG.world.lidar.noise, CONFIG.world.lidar.dropout) == (0.0, 0.0)
    world.place(Task(cell=6, seed=4, start=CONFIG.world.start))

    def lidar(**settings: float) -> Lidar:
        config = CONFIG.world.lidar.model_copy(update=settings)
        return Lidar(config, CONFIG.world.robot.mounts, world.bullet, world.bodies.robot)

    def readings(sensor: Lidar, seed: int, times: int = 1) -> np.ndarray:
        rng = np.random.default_rng(seed)
        return np.stack([sensor.sense(rng) for _ in range(times)]).astype(float)

    clean = readings(lidar(), 0)[0]
    assert np.array_equal(readings(lidar(), 0, 2), np.stack([clean, clean]))
    noisy = readings(lidar(noise=0.05), 0, 200)
    hit = (clean < 0.9) & (clean > 0.1)
    assert noisy[:, hit].std(axis=0).mean() * 6.0 == pytest.approx(0.05, rel=0.05)
    assert np.abs(noisy[:, hit].mean(axis=0) - clean[hit]).max() * 6.0 < 0.02
    assert (noisy[:, clean == 1.0] == 1.0).all()
    assert np.array_equal(readings(lidar(noise=0.05), 7), readings(lidar(noise=0.05), 7))
    dropped = readings(lidar(dropout=0.2), 0, 200)
    assert (dropped[:, hit] == 1.0).mean() == pytest.approx(0.2, abs=0.01)


def test_lidar_of_another_range_and_number_of_beams(world):
    world.place(Task(cell=2, seed=4, start=CONFIG.world.start))
    config = CONFIG.world.lidar.model_copy(update={"beams": 577, "range": 1.5})
    fine = Lidar(config, CONFIG.world.robot.mounts, world.bullet, world.bodies.robot)
    reading = fine.sense(np.random.default_rng(0)).astype(float)
    assert reading.shape == (1154,)
    coarse = world.lidar.sense(np.random.default_rng(0)).astype(float) * 6.0
    ends = [0, -1]  # the outermost beams of both are the same
    assert np.minimum(coarse[ends], 1.5) == pytest.approx(1.5 * reading[ends], abs=0.005)


def dolly_mask(world: DockingWorld) -> np.ndarray:
    """Where the camera's picture, five times finer, shows the dolly; a far leg is thinner than a pixel."""
    size, camera = FINE * CONFIG.world.camera.size, world.camera
    image = world.bullet.getCameraImage(
        size, size, camera.view(world.pose), camera._render.projection, renderer=world.bullet.ER_TINY_RENDERER
    )
    return np.reshape(image[4], (size, size)) == world.bodies.dolly


def test_camera_shows_the_dolly_where_the_pinhole_model_says_within_a_pixel(world):
    """The picture's outermost pixels of the dolly against its outermost projected corners."""
    rng, compared = np.random.default_rng(2), 0
    size, fov, height = 80, math.radians(47.0), 0.165
    focal = size / 2 / math.tan(fov / 2)
    corners = [
        (sx * DOLLY.width / 2, sy * DOLLY.length / 2, z)
        for sx in (-1, 1)
        for sy in (-1, 1)
        for z in (0.0, DOLLY.underside + DOLLY.deck)
    ]
    world.place(Task(cell=4, seed=1, start=CONFIG.world.start))
    world.bodies.arrange(())
    while compared < 60:
        world.stand(
            SE2(rng.uniform(-1, 1), rng.uniform(-3, 3), rng.uniform(-0.6, 0.6)),
            SE2(rng.uniform(-1.5, 1.5), rng.uniform(5, 8), rng.uniform(-3, 3)),
        )
        eye = (world.pose @ SE2(0.0, CONFIG.world.robot.length / 2)).inverse()
        seen = [(*eye.apply(*world.dolly.apply(x, y)), z) for x, y, z in corners]
        u = [size / 2 + focal * x / y for x, y, _ in seen]
        v = [size / 2 - focal * (z - height) / y for _, y, z in seen]
        if min(u) < 1 or max(u) > size - 1 or min(v) < 1 or max(v) > size - 1:
            continue
        rows, columns = np.nonzero(dolly_mask(world))
        bounds = np.array([columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]) / FINE
        assert bounds == pytest.approx((min(u), max(u), min(v), max(v)), abs=0.5)
        compared += 1


def test_camera_looks_along_its_mount(world):
    """Turned by 90 deg to the left, it sees what a robot turned so would see from there."""
    mounts = CONFIG.world.robot.mounts
    side = mounts.camera.model_copy(update={"x": -0.315, "y": 0.0, "yaw": 90.0, "z": 0.25})
    config = CONFIG.world.robot.model_copy(update={"mounts": mounts.model_copy(update={"camera": side})})
    other = DockingWorld(CONFIG.world.model_copy(update={"robot": config}), 10)
    pose = SE2(0.4, -0.3, 0.7)
    eye = pose.apply(-0.315, 0.0)
    ahead = (pose @ SE2(0.0, 0.0, math.pi / 2)).forward
    expected = other.bullet.computeViewMatrix(
        (*eye, 0.25), (eye[0] + ahead[0], eye[1] + ahead[1], 0.25), (0, 0, 1)
    )
    assert other.camera.view(pose) == pytest.approx(expected, abs=1e-6)
    other.close()


def test_robot_is_not_in_its_own_picture_but_in_that_of_others(world):
    world.place(Task(cell=0, seed=1, start=CONFIG.world.start))
    front = world.sense().frame
    view = world.bullet.computeViewMatrix((0, 0, 40), (0, 0, 0), (0, 1, 0))
    clip = CONFIG.world.camera.model_copy(update={"near": 10.0, "far": 45.0})
    above = Renderer(world.bullet, 80, clip, 5.0)
    with_robot = above(view, world.appearance.light)
    world.bodies.place(world.bodies.robot, SE2(20.0, 20.0))
    assert np.array_equal(front, world.sense().frame)
    assert not np.array_equal(with_robot, above(view, world.appearance.light))


def test_contact_agrees_with_exact_rectangles_for_10000_poses_beyond_3_mm(world):
    """3 mm larger and still apart there is no contact, 3 mm smaller and still overlapping there is one."""
    rng, robot = np.random.default_rng(5), CONFIG.world.robot
    half = robot.width / 2, robot.length / 2
    touching = apart = close = 0
    for scene in range(100):
        task = random_task(scene % len(ROOMS), CONFIG, rng)
        world.place(task)
        on_dolly = [polygon(r) for r in legs(world.dolly) + rails(world.dolly)]
        others = [polygon(r) for r in surfaces(task.cell, world.scene)]
        goals = [world.dolly, world.dolly, *(o.box.footprint.pose for o in world.scene.obstacles)]
        for _ in range(100):
            goal = goals[rng.integers(len(goals))]
            away, direction = rng.uniform(0, 1.4), rng.uniform(-math.pi, math.pi)
            there = SE2(away * math.cos(direction), away * math.sin(direction), rng.uniform(-3.2, 3.2))
            world.stand(goal @ there, world.dolly)
            points = world.bullet.getContactPoints(world.bodies.robot)
            touched = {point[2] for point in points if point[8] <= 0.0}
            small, large = (polygon(Rectangle(world.pose, half[0] + g, half[1] + g)) for g in (-0.003, 0.003))
            for found, shapes in (
                (world.bodies.dolly in touched, on_dolly),
                (bool(touched - {world.bodies.dolly}), others),
            ):
                surely = shapely.intersects(small, shapes).any()
                surely_not = not shapely.intersects(large, shapes).any()
                assert not (surely and not found), (task, world.pose)
                assert not (surely_not and found), (task, world.pose)
                touching, apart = touching + surely, apart + surely_not
                close += not (surely or surely_not)
    assert min(touching, apart) > 3000
    assert close < 1000


def test_drives_end_in_contact_only_where_rectangles_touch(world):
    """Straight on into whatever comes, from wherever the last drive has ended."""
    rng, half, contacts = np.random.default_rng(8), (0.315, 0.6365), 0
    for index in range(150):
        task = random_task(index % len(ROOMS), CONFIG, rng)
        world.place(task)
        ending, v, w = None, rng.choice([-1.0, 1.0]), rng.uniform(-0.3, 0.3)
        while ending is None:
            _, ending = world.advance((v, w))
        solid = legs(world.dolly) + rails(world.dolly)
        if ending == "other_contact":
            solid = surfaces(task.cell, world.scene)
        elif ending != "dolly_contact":
            continue
        contacts += 1
        robot = polygon(Rectangle(world.pose, *half))
        assert min(robot.distance(polygon(shape)) for shape in solid) < 0.003
        smaller = polygon(Rectangle(world.pose, half[0] - 0.012, half[1] - 0.012))
        assert min(smaller.distance(polygon(shape)) for shape in solid) > 0  # a substep goes 6 mm
    assert contacts > 100


def test_appearance_never_changes_what_the_lidar_measures(world):
    plain = world.reset(Task(cell=7, seed=9, start=CONFIG.world.start)).lidar
    colourful = DockingWorld(resolve(overrides=("world.start.yaw=180",)).world, 10)
    assert np.array_equal(colourful.reset(Task(cell=7, seed=9, start=CONFIG.world.start)).lidar, plain)
    colourful.close()


def test_pose_and_bearing_used_here_agree_with_the_worlds_frame(world):
    """The dolly at the left of the robot is at the left of the picture."""
    world.place(Task(cell=4, seed=1, start=CONFIG.world.start))
    world.bodies.arrange(())
    world.stand(SE2(0.0, 0.0, 0.1), SE2(-0.9, 4.0, 0.1))
    assert bearing(world.pose, world.dolly.x, world.dolly.y) > 0
    assert np.nonzero(dolly_mask(world))[1].mean() < FINE * 40
