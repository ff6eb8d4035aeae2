"""What tasks there are: ranges by level, what is refused, and that a task survives JSON."""

import math

import numpy as np
import pytest

from common.cells import CELLS
from common.config import Config
from common.errors import UsageError
from common.tasks import PlacedStart, Task, build_scene, geometric_properties
from curriculum.task_space import NARROWEST, BoxSpace, DockingSpace, Entry, make_space
from tests.helpers import small_config

PARAMETERS = (
    "curriculum.parameters=["
    '{name="mass", low=0.0, high=10.0, easy=2.0},'
    '{name="slope", low=-1.0, high=1.0, easy=-1.0}]'
)
DOCKING = small_config()
START = DOCKING.world.start


def box(*overrides: str) -> Config:
    return small_config(PARAMETERS, *overrides)


def drawn(level: float, count: int = 400) -> dict[str, np.ndarray]:
    """Values of tasks of a box at a level, by name."""
    space, rng = make_space(box()), np.random.default_rng(0)
    tasks = [space.draw(0, level, rng).task for _ in range(count)]
    return {name: np.array([task[name] for task in tasks]) for name in ("mass", "slope")}


# Boxes of numbers


def test_configuration_decides_the_space():
    assert isinstance(make_space(box()), BoxSpace)
    assert isinstance(make_space(DOCKING), DockingSpace)


def test_box_has_one_cell_and_f_pi_sees_its_parameters_and_no_q():
    space = make_space(box())
    assert (space.cells, space.inputs) == (1, ("mass", "slope"))
    assert space.scales == {"mass": (5.0, 5.0), "slope": (0.0, 1.0)}
    assert not box().curriculum.uses_q


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_box_widens_with_the_level_from_the_easiest_value_to_all_of_the_range(level):
    share, values = NARROWEST + (1 - NARROWEST) * level, drawn(level)
    bounds = {"mass": (2 - 2 * share, 2 + 8 * share), "slope": (-1.0, -1 + 2 * share)}
    for name, (low, high) in bounds.items():
        assert low <= values[name].min() < low + 0.03 * (high - low)
        assert high - 0.03 * (high - low) < values[name].max() <= high


def test_box_is_drawn_uniformly_at_full_level():
    counts, _ = np.histogram(drawn(1.0, 2000)["mass"], 10, (0, 10))
    assert ((counts - 200) ** 2 / 200).sum() < 21.67  # 9 degrees of freedom, 1%


def test_parameters_are_drawn_independently():
    values = drawn(1.0, 1000)
    assert abs(np.corrcoef(values["mass"], values["slope"])[0, 1]) < 0.1


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ({"mass": 3.0}, "a number for each of mass, slope"),
        ({"mass": 3.0, "slope": 0.0, "wind": 1.0}, "a number for each of mass, slope"),
        ({}, "a number for each of mass, slope"),
        ({"mass": 10.5, "slope": 0.0}, r"mass is 10\.5; it lies between 0 and 10"),
        ({"mass": 3.0, "slope": -1.01}, r"slope is -1\.01; it lies between -1 and 1"),
        ({"mass": math.nan, "slope": 0.0}, "mass is nan"),
        (Task(cell=0, seed=1, start=START), "a number for each of mass, slope"),
    ],
)
def test_impossible_task_of_a_box_is_refused_naming_the_field(task, words):
    with pytest.raises(UsageError, match=words):
        make_space(box()).entry(task)


@pytest.mark.parametrize("task", [{"mass": 0.0, "slope": -1.0}, {"slope": 1.0, "mass": 10.0}])
def test_bounds_of_a_box_belong_to_it(task):
    entry = make_space(box()).entry(task)
    assert (entry.cell, entry.task, entry.properties, entry.poses) == (0, task, task, None)


@pytest.mark.parametrize(
    "text",
    [
        '{name="x", low=0.0, high=1.0, easy=1.1}',
        '{name="x", low=0.0, high=1.0, easy=-0.1}',
        '{name="x", low=1.0, high=0.0, easy=0.5}',
        '{name="x", low=1.0, high=1.0, easy=1.0}',
        '{name="x", low=0.0, high=inf, easy=1.0}',
        '{name="x", low=0.0, high=1.0}',
        '{name="a b", low=0.0, high=1.0, easy=0.0}',
        '{name="", low=0.0, high=1.0, easy=0.0}',
    ],
)
def test_impossible_parameter_is_refused(text):
    with pytest.raises(UsageError, match=r"curriculum\.parameters\.0"):
        small_config(f"curriculum.parameters=[{text}]")


@pytest.mark.parametrize("name", ["q", "cell"])
def test_parameter_whose_name_means_something_here_is_refused(name):
    """f_pi would take `q` for Q(s0, a0), and a `cell` in JSON means a task of the docking world."""
    with pytest.raises(UsageError, match=rf"curriculum\.parameters.*'?{name}\b"):
        small_config(f'curriculum.parameters=[{{name="{name}", low=0.0, high=1.0, easy=0.0}}]')


def test_parameter_named_twice_is_refused():
    one = '{name="x", low=0.0, high=1.0, easy=0.0}'
    with pytest.raises(UsageError, match="parameters"):
        small_config(f"curriculum.parameters=[{one}, {one}]")


# The docking world


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_docking_task_of_a_level_has_the_ranges_of_that_level(level):
    space, gate = make_space(DOCKING), DOCKING.curriculum.gate.ranges
    entry = space.draw(4, level, np.random.default_rng(1))
    assert (entry.cell, entry.task.cell) == (4, 4)
    for name in ("distance_min", "distance_max", "yaw", "bearing", "dolly_yaw", "jitter"):
        easy, full = getattr(gate, name), getattr(START, name)
        assert getattr(entry.task.start, name) == pytest.approx((1 - level) * easy + level * full)
    assert entry.task.start.distance_min - 1e-9 <= entry.properties["distance"]
    assert entry.properties["distance"] <= entry.task.start.distance_max + 1e-9


def test_docking_entry_is_what_the_scene_is():
    task = Task(cell=3, seed=7, start=START)
    entry = make_space(DOCKING).entry(task)
    scene = build_scene(task, DOCKING.world)
    assert entry.properties == geometric_properties(task, scene).model_dump()
    assert entry.poses == tuple((pose.x, pose.y, pose.yaw) for pose in (scene.robot, scene.dolly))
    assert entry.properties.keys() == make_space(DOCKING).scales.keys()
    assert (entry.observed, entry.q, entry.row) == (None, None, None)


def test_docking_space_has_all_training_cells_and_the_inputs_that_are_configured():
    space = make_space(small_config('curriculum.inputs=["distance", "q"]'))
    assert (space.cells, space.inputs) == (len(CELLS), ("distance", "q"))


def test_scales_bring_properties_of_tasks_to_about_one():
    space, rng = make_space(DOCKING), np.random.default_rng(2)
    rows = [space.draw(int(cell), 1.0, rng).properties for cell in rng.integers(9, size=60)]
    for name, (centre, half) in space.scales.items():
        scaled = (np.array([row[name] for row in rows]) - centre) / half
        assert np.abs(scaled).max() < 1.6, name
        assert np.ptp(scaled) > 0.5, name


def test_candidates_are_of_all_levels_or_of_the_full_one():
    space = make_space(DOCKING)
    full = [space.candidate(0, 0.0, np.random.default_rng(i)).task.start for i in range(5)]
    assert full == [START] * 5
    narrowed = {space.candidate(0, 1.0, np.random.default_rng(i)).task.start.yaw for i in range(5)}
    assert len(narrowed) == 5
    assert all(10 < yaw < 90 for yaw in narrowed)


def test_impossible_task_of_the_docking_world_is_refused_with_the_reason():
    space = make_space(DOCKING)
    with pytest.raises(UsageError, match=r"a task of the docking world is \{cell, seed, start\}"):
        space.entry({"distance": 2.0})
    outside = Task(cell=2, seed=0, start=PlacedStart(x=20, y=-20, yaw=0))
    with pytest.raises(UsageError, match=r"no free start in cell 2 .*stands in a wall"):
        space.entry(outside)


def test_same_generator_draws_the_same_tasks():
    for config in (DOCKING, box()):
        space = make_space(config)
        first, second = ([space.draw(0, 1.0, np.random.default_rng(s)).task for s in (3, 4)] for _ in "ab")
        assert first == second
        assert first[0] != first[1]


# Through JSON


@pytest.mark.parametrize("config", [DOCKING, box()], ids=["docking", "box"])
def test_entry_survives_json_to_the_bit(config):
    entry = make_space(config).draw(0, 0.4, np.random.default_rng(5))
    loaded = Entry.read(entry.text)
    for name in ("cell", "task", "properties", "poses"):
        assert getattr(loaded, name) == getattr(entry, name), name
    assert type(loaded.task) is type(entry.task)
    assert (loaded.q, loaded.row, loaded.lease) == (None, None, 0.0)


def test_entry_of_a_placed_start_survives_json():
    task = Task(cell=0, seed=1, start=PlacedStart(x=0.0, y=-2.0, yaw=30))
    entry = make_space(DOCKING).entry(task)
    assert Entry.read(entry.text).task == task
