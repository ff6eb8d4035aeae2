"""Films of random drives: what is known of each frame against geometry, and the table that holds them."""

import cmath
import math

import numpy as np
import pytest

from actor.evaluation.suites import SUITES, grid, suite
from actor.frames import PROBE_SETS, PROBE_STEPS, film, film_all, probe_tasks
from actor.world.world import DockingWorld
from common.cells import CELLS, ROOMS, arena_index
from common.config import resolve
from common.errors import UsageError
from common.frames import VISIBLE_PIXELS, Film, FrameTable
from common.geometry import SE2
from common.messages import Frames
from common.tasks import (
    FIRST_SUITE_SEED,
    PlacedStart,
    Task,
    build_scene,
    geometric_properties,
    narrowed_task,
    random_task,
)
from tests.helpers import in_frame, small_config

SIZE = 64
NO_NOISE = "world.randomization.training.camera_noise=[0, 0]"
EMPTY = ("world.obstacles.count_min=0", "world.obstacles.count_max=0")
CONFIG = small_config(f"world.camera.size={SIZE}", 'world.randomization.fixed=["all"]', NO_NOISE, *EMPTY)
DOLLY = CONFIG.world.dolly
ORIGIN = SE2(0.0, 4.0)
"""Where the dolly of a placed start stands in a training cell."""


class Watched(DockingWorld):
    """A world that remembers where it stood and how it was driven."""

    def place(self, task: Task) -> None:
        super().place(task)
        self.stood, self.actions = [self.pose], []

    def advance(self, action):
        self.actions.append(np.array(action))
        result = super().advance(action)
        self.stood.append(self.pose)
        return result


@pytest.fixture(scope="module")
def world():
    world = Watched(CONFIG.world, max_steps=20)
    yield world
    world.close()


@pytest.fixture(scope="module")
def noisy():
    """With everything random that may be, on the smallest frames."""
    world = Watched(small_config().world, max_steps=20)
    yield world
    world.close()


def placed(x: float, y: float, yaw: float = 0.0, cell: int = 0, seed: int = 1) -> Task:
    return Task(cell=cell, seed=seed, start=PlacedStart(x=x, y=y, yaw=yaw))


def shot(world: DockingWorld, task: Task) -> FrameTable:
    """The one frame of a drive of no steps, as a table."""
    found = film(world, task, np.random.default_rng(0), 0)
    return FrameTable.of([found], 1, world.config.camera.size)


def seen_from(robot: SE2, dolly: SE2) -> tuple[float, float, float]:
    """Bearing, distance and relative yaw by complex numbers."""
    ahead = 1j * cmath.exp(1j * robot.yaw)
    there = complex(dolly.x - robot.x, dolly.y - robot.y)
    return cmath.phase(there / ahead), abs(there), cmath.phase(cmath.exp(1j * (dolly.yaw - robot.yaw)))


def projected(robot: SE2, dolly: SE2, size: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Columns and rows of the dolly's eight corners by the pinhole model; None when one is not in front."""
    focal = size / 2 / math.tan(math.radians(47.0) / 2)
    c, s = math.cos(robot.yaw), math.sin(robot.yaw)
    columns, rows = [], []
    for side in (-0.41, 0.41):
        for end in (-0.615, 0.615):
            x, y = in_frame(dolly, side, end)
            right, ahead = c * (x - robot.x) + s * (y - robot.y), c * (y - robot.y) - s * (x - robot.x)
            ahead -= 1.273 / 2
            if ahead < 0.3:
                return None
            for z in (0.0, 0.40):
                columns.append(size / 2 + focal * right / ahead)
                rows.append(size / 2 - focal * (z - 0.165) / ahead)
    return np.array(columns), np.array(rows)


@pytest.mark.parametrize(
    ("x", "yaw", "bearing", "relative", "half"),
    [
        (1.0, 0.0, 18.435, 0.0, "left"),
        (-1.0, 0.0, -18.435, 0.0, "right"),
        (0.0, 15.0, -15.0, -15.0, "right"),
        (0.0, -15.0, 15.0, 15.0, "left"),
        (1.0, 30.0, -11.565, -30.0, "right"),
    ],
)
def test_dolly_to_the_left_is_left_in_the_picture_and_positive(world, x, yaw, bearing, relative, half):
    """The robot 3 m before the dolly, `x` m to its right, turned `yaw` degrees to the left."""
    table = shot(world, placed(x, -3.0, yaw))
    assert np.degrees(table.goal[0, [0, 2]]) == pytest.approx([bearing, relative], abs=0.01)
    assert table.goal[0, 1] == pytest.approx(math.hypot(x, 3.0), abs=1e-5)
    columns = table.masks(np.array([0]))[0].nonzero()[1]
    assert len(columns) > 30
    assert columns.max() < SIZE / 2 if half == "left" else columns.min() >= SIZE / 2


def test_relative_yaw_is_wrapped(world):
    behind = shot(world, placed(0.0, 3.0, 180.0)).goal[0]
    assert abs(behind[0]) < 1e-5
    assert abs(abs(behind[2]) - math.pi) < 1e-5
    away = shot(world, placed(0.5, -3.0, -170.0)).goal[0]
    assert np.degrees(away[2]) == pytest.approx(170.0, abs=0.01)
    assert math.cos(away[0]) < 0


def test_every_frame_of_a_drive_has_the_goal_as_seen_from_where_it_was_taken(world):
    rng = np.random.default_rng(4)
    for index in range(10):
        found = film(world, random_task(index % 9, CONFIG, rng), rng, 6)
        expected = np.array([seen_from(pose, world.dolly) for pose in world.stood])
        assert found.goal.dtype == np.float32
        np.testing.assert_allclose(found.goal, expected, atol=1e-5)
        assert len({pose.x for pose in world.stood}) == len(world.stood) == len(found.frame)


def test_mask_lies_where_the_pinhole_model_has_the_dollys_corners(world):
    compared, rng = 0, np.random.default_rng(1)
    for index in range(25):
        start = placed(rng.uniform(-0.6, 0.6), rng.uniform(-3.2, -2.4), rng.uniform(-8, 8), cell=index % 9)
        found = film(world, start, rng, 4)
        assert found.mask.shape == (len(found.frame), SIZE * SIZE // 8)
        for pose, bits in zip(world.stood, found.mask, strict=True):
            corners = projected(pose, ORIGIN, SIZE)
            if corners is None or any(part.min() < 0 or part.max() > SIZE for part in corners):
                continue
            bounds = [edge for part in corners for edge in (part.min(), part.max())]
            rows, columns = np.unpackbits(bits).reshape(SIZE, SIZE).nonzero()
            shown = [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]
            assert shown == pytest.approx(bounds, abs=1.5)
            compared += 1
    assert compared > 40


def test_mask_is_exactly_what_changes_when_the_dolly_is_gone(world):
    for task in (placed(0.3, -2.6, 5.0), placed(-0.8, -3.2, -20.0, cell=5), placed(0.1, -1.7, cell=7)):
        table = shot(world, task)
        world.bodies.hide(world.bodies.dolly)
        without = world.camera.sense(world.pose, np.random.default_rng(0))
        changed = (table.frame[0] != without).any(axis=-1)
        assert changed.sum() > 50
        assert np.array_equal(table.masks(np.array([0]))[0], changed)


def test_bodies_are_those_of_the_picture_and_the_picture_is_the_usual_one(noisy):
    noisy.place(placed(0.5, -2.0, cell=3, seed=8))
    assert noisy.appearance.camera_noise > 0
    for seed in range(3):
        image, bodies = noisy.camera.sense_bodies(noisy.pose, np.random.default_rng(seed))
        assert np.array_equal(image, noisy.camera.sense(noisy.pose, np.random.default_rng(seed)))
        assert bodies.shape == image.shape[:2] == (16, 16)
        assert bodies.dtype == np.int32
        assert noisy.bodies.dolly in bodies
        assert noisy.bodies.robot not in bodies
        assert -1 not in bodies  # nothing but walls and floor behind
    _, beyond = noisy.camera.sense_bodies(SE2(0.0, -60.0, math.pi), np.random.default_rng(0))
    assert (beyond == -1).all()


def test_frames_of_a_film_are_what_the_robot_sees_in_the_order_of_the_drive(noisy):
    task = Task(cell=2, seed=5, start=CONFIG.world.start)
    found = film(noisy, task, np.random.default_rng(3), 5)
    for index, pose in enumerate(noisy.stood):
        clean = noisy.camera._render(noisy.camera.view(pose), noisy.camera._light).astype(int)
        assert np.abs(found.frame[index] - clean).max() <= 6 * noisy.appearance.camera_noise + 1
    assert found.frame.dtype == np.uint8
    assert not np.array_equal(found.frame[0], found.frame[-1])


def test_film_depends_on_its_generator_and_on_nothing_before(noisy):
    task = Task(cell=1, seed=5, start=CONFIG.world.start)
    films = [film(noisy, task, np.random.default_rng(seed), 6) for seed in (3, 4, 3)]
    assert all(np.array_equal(a, b) for a, b in zip(films[0], films[2], strict=True))
    assert not np.array_equal(films[0].goal, films[1].goal)
    assert np.array_equal(films[0].goal[0], films[1].goal[0])


def test_film_has_a_frame_before_the_first_step_and_one_after_each_until_a_contact(noisy):
    task = Task(cell=0, seed=5, start=CONFIG.world.start)
    assert [len(film(noisy, task, np.random.default_rng(0), steps).frame) for steps in (0, 1, 7)] == [1, 2, 8]
    lengths = set()
    for seed in range(20):  # 5 cm before the dolly's leg
        near = placed(0.4, -1.32, seed=seed)
        found = film(noisy, near, np.random.default_rng(seed), 15)
        lengths.add(len(found.frame))
        touched = noisy.bullet.getContactPoints(noisy.bodies.robot)
        assert len(found.frame) == 16 or any(point[8] <= 0.0 for point in touched)
    assert min(lengths) < 5


def test_actions_spread_alike_at_every_step_from_shaking_to_long_curves(noisy):
    drives, rng = [], np.random.default_rng(0)
    for index in range(150):
        film(noisy, Task(cell=0, seed=index, start=CONFIG.world.start), rng, 12)
        if len(noisy.actions) == 12:
            drives.append(noisy.actions)
    actions = np.array(drives)
    assert len(actions) > 100
    for step in (slice(0, 4), slice(4, 8), slice(8, 12)):
        assert actions[:, step].std() == pytest.approx(0.6, rel=0.1)
        assert abs(actions[:, step].mean()) < 0.1
    smoothness = [(drive[1:] * drive[:-1]).sum() / (drive**2).sum() for drive in actions]
    assert np.percentile(smoothness, 10) < 0.15
    assert np.percentile(smoothness, 90) > 0.6


def test_random_drives_are_fit_for_training_in_every_cell(noisy):
    config, rng = small_config(), np.random.default_rng(2)
    for cell in range(len(CELLS)):
        task = narrowed_task(cell, config, rng, config.pretraining.near_share)
        assert task.seed < FIRST_SUITE_SEED
        found = film(noisy, task, rng, 2)
        message = Frames(digest={}, task=task, **found._asdict())
        message.check_layout(16, 3)


def test_probe_tasks_are_the_same_every_time_and_never_those_of_training_or_another_examination():
    config = resolve("smoke")
    sets = {name: probe_tasks(name, config) for name in PROBE_SETS}
    assert sets == {name: probe_tasks(name, config) for name in PROBE_SETS}
    assert list(sets) == ["fit", "training", "validation"]
    seeds = [task.seed for tasks in sets.values() for task in tasks]
    examinations = (*map(suite, SUITES), grid("paper", "validation"), grid("paper", "test", seed=1))
    taken = {task.seed for examination in examinations for task in examination.tasks}
    assert len(seeds) == len(set(seeds)) == 3 * config.pretraining.probe_drives
    assert min(seeds) >= FIRST_SUITE_SEED
    assert not taken & set(seeds)
    starts = [[task.start for task in tasks] for tasks in sets.values()]
    assert all(a != b for a, b in ((starts[0], starts[1]), (starts[1], starts[2]), (starts[0], starts[2])))


def test_only_the_validation_set_is_in_an_arena_and_none_in_the_test_arena():
    config = resolve("smoke")
    for name in ("fit", "training"):
        cells = [task.cell for task in probe_tasks(name, config)]
        assert sorted(set(cells)) == list(range(9))
        assert {cells.count(cell) for cell in range(9)} == {3}
    found = {task.cell for task in probe_tasks("validation", config)}
    assert [ROOMS[cell].name for cell in found] == ["validation"]
    assert arena_index("test") not in found


def test_all_probe_tasks_can_be_placed_and_about_half_are_narrowed():
    config = resolve("smoke")
    for name in PROBE_SETS:
        tasks = probe_tasks(name, config)
        distances = [geometric_properties(t, build_scene(t, config.world)).distance for t in tasks]
        assert min(distances) < 1.5 < 3.0 < max(distances)
        full = sum(task.start == config.world.start for task in tasks)
        assert 0.3 < full / len(tasks) < 0.7


def test_films_of_all_cores_come_in_the_order_of_their_tasks():
    config, heard = small_config(), []
    tasks = probe_tasks("validation", config)[:2] + probe_tasks("fit", config)[:9]
    films = film_all(tasks, config, heard.append)
    assert len(films) == len(tasks)
    assert heard == sorted(heard)
    assert heard[-1] == len(tasks)
    world = DockingWorld(config.world, config.world.max_episode_steps)
    for index in (0, 1, 2, 8, 10):
        expected = film(world, tasks[index], np.random.default_rng([tasks[index].seed, 8]), PROBE_STEPS)
        assert all(np.array_equal(a, b) for a, b in zip(films[index], expected, strict=True)), index
    world.close()


def synthetic(length: int, first: int, size: int = 16) -> Film:
    """Frames that carry the numbers from `first` on, in every pixel, mask and goal."""
    numbers = np.arange(first, first + length)
    return Film(
        np.broadcast_to(numbers[:, None, None, None], (length, size, size, 3)).astype(np.uint8),
        np.broadcast_to(numbers[:, None], (length, size * size // 8)).astype(np.uint8),
        np.stack([numbers, numbers + 0.25, numbers + 0.5], axis=1).astype(np.float32),
    )


LENGTHS = (3, 1, 5, 4)


def table(rows: int) -> FrameTable:
    """Of four films; the frame in row i carries the number i."""
    starts = np.cumsum((0, *LENGTHS[:-1])).tolist()
    films = (synthetic(n, first) for n, first in zip(LENGTHS, starts, strict=True))
    return FrameTable.of(films, rows, 16)


def test_table_holds_the_films_in_order_and_of_the_last_as_much_as_fits():
    for rows in (13, 12, 10, 9, 4, 2, 1):
        found = table(rows)
        assert len(found) == rows
        assert found.frame[:, 3, 5, 1].tolist() == list(range(rows))
        assert found.mask[:, 7].tolist() == list(range(rows))
        assert found.goal[:, 2].tolist() == [i + 0.5 for i in range(rows)]
        assert found.start.tolist() == [0, 0, 0, 3, 4, 4, 4, 4, 4, 9, 9, 9, 9][:rows]


def test_table_of_more_rows_than_the_films_give_is_refused():
    with pytest.raises(UsageError, match="13 frames where 14 are needed"):
        table(14)
    with pytest.raises(
        UsageError, match=r"a table of 10{12} frames needs 820000\.0 GB of memory.*take fewer"
    ):
        FrameTable.of([], 10**12, 16)


def test_stacks_repeat_a_films_first_frame_and_never_reach_into_the_film_before():
    found, rows = table(13), np.array([4, 0, 3, 6, 12, 9, 8, 2])
    four = found.stacks(rows, 4)
    assert four.shape == (8, 4, 16, 16, 3)
    assert four[:, :, 2, 9, 0].tolist() == [
        [4, 4, 4, 4],
        [0, 0, 0, 0],
        [3, 3, 3, 3],
        [4, 4, 5, 6],
        [9, 10, 11, 12],
        [9, 9, 9, 9],
        [5, 6, 7, 8],
        [0, 0, 1, 2],
    ]
    assert found.stacks(rows, 1)[:, 0, 0, 0, 2].tolist() == rows.tolist()
    assert found.stacks(np.array([12]), 2)[0, :, 0, 0, 0].tolist() == [11, 12]


def test_dolly_counts_as_visible_from_ten_pixels_on():
    masks = np.zeros((4, 16, 16), np.uint8)
    masks[1].flat[:9] = masks[2].flat[5:15] = masks[3] = 1
    films = [
        Film(
            np.zeros((4, 16, 16, 3), np.uint8), np.packbits(masks, axis=(-1)).reshape(4, 32), np.zeros((4, 3))
        )
    ]
    found = FrameTable.of(films, 4, 16)
    assert VISIBLE_PIXELS == 10
    assert found.visible.tolist() == [False, False, True, True]
    rows = np.array([3, 1, 2])
    assert np.array_equal(found.masks(rows), masks[rows])
