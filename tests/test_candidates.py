"""The candidates of a cell in arrays, against a plain list of them."""

import time
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.messages import Candidate, Version
from common.tasks import Task
from curriculum.candidates import Cell
from curriculum.task_space import Entry, Scaling, make_space
from tests.helpers import small_config

MOST = 6
SPACE = make_space(small_config('curriculum.parameters=[{name="x", low=0.0, high=8.0, easy=0.0}]'))
SCALING = Scaling(SPACE.inputs, SPACE.scales)


@dataclass
class Plain:
    """What a candidate must be like."""

    row: int
    x: float
    lease: float = 0.0
    q: float | None = None
    version: Version | None = None


def make_cell(seed: int = 0) -> Cell:
    return Cell(0, SPACE, SCALING, 0.5, np.random.default_rng(seed))


def add(cell: Cell, *plain: Plain, most: int = MOST) -> None:
    entries = [SPACE.entry({"x": p.x}) for p in plain]
    scaled = SCALING([entry.properties for entry in entries])
    cell.add([p.row for p in plain], [entry.text for entry in entries], scaled, most)


def filled(count: int) -> Cell:
    cell = make_cell()
    add(cell, *(Plain(row, row % 8.0) for row in range(1, count + 1)), most=count)
    return cell


def value(cell: Cell, q: dict[int, float], version: tuple[int, int] = (1, 0)) -> None:
    cell.value(list(q), np.array(list(q.values())), np.array(version))


def drawn(cell: Cell, count: int = 99) -> list[int | None]:
    """Rows, in the order of the draw; None for what is no candidate."""
    found = cell.draw(count)
    return [found.entry(i).row for i in range(len(found.q))]


changes = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(1, 4)),
        st.tuples(st.sampled_from(["drop", "lend", "value"]), st.integers(0, 30)),
    ),
    max_size=25,
)


@given(changes)
@settings(max_examples=150)
def test_arrays_say_of_each_candidate_what_a_list_would(changes):
    cell, plain, row = make_cell(), list[Plain](), 0
    for number, (kind, argument) in enumerate(changes):
        if kind == "add":
            new = [Plain(row + i, (row + i) % 8.0) for i in range(argument)]
            row += argument
            add(cell, *new)
            plain = (plain + new)[-MOST:]
        elif kind == "drop":
            cell.drop(argument)
            plain = [p for p in plain if p.row != argument]
        elif found := [p for p in plain if p.row == argument]:
            (one,) = found
            if kind == "lend":
                one.lease = number + 0.5
                cell.lend(argument, one.lease)
            else:
                one.q, one.version = number / 3, Version(epoch=1, counter=number)
                value(cell, {argument: number / 3}, (1, number))
    assert len(cell) == len(plain)
    entries = [cell.entry(p.row) for p in plain]
    assert [(e.row, e.lease, e.q, e.q_version) for e in entries] == [
        (p.row, p.lease, p.q, p.version) for p in plain
    ]
    assert [e.task for e in entries] == [{"x": p.x} for p in plain]
    assert cell.table.scaled[:, 0] == pytest.approx([(p.x - 4) / 4 for p in plain])


def test_draw_says_of_each_task_what_its_entry_says():
    cell = filled(30)
    value(cell, {row: row / 7 for row in range(1, 31)})
    found = cell.draw(10)
    entries = [found.entry(i) for i in range(10)]
    assert len(found.q) == len(found.scaled) == 10
    assert found.q.tolist() == [entry.q for entry in entries]
    assert (found.scaled == SCALING([entry.properties for entry in entries])).all()


def test_draw_leaves_out_what_is_in_somebodys_hands_until_its_lease_ends():
    cell = filled(3)
    cell.lend(1, time.time() + 60)
    cell.lend(2, time.time() - 60)
    assert sorted(drawn(cell)) == [2, 3]


def test_draw_mixes_none_without_q_among_those_that_have_one():
    cell = filled(4)
    assert sorted(drawn(cell)) == [1, 2, 3, 4]
    value(cell, {2: 0.5, 4: -0.5})
    assert sorted(drawn(cell)) == [2, 4]
    for row in (2, 4):
        cell.lend(row, time.time() + 60)
    assert sorted(drawn(cell)) == [1, 3]


def test_draw_without_a_free_candidate_makes_tasks_up():
    cell = filled(1)
    cell.lend(1, time.time() + 60)
    assert drawn(cell, 7) == [None] * 7


def test_draws_of_one_seed_are_the_same():
    first, second, third = (make_cell(seed) for seed in (1, 1, 2))
    for cell in (first, second, third):
        add(cell, *(Plain(row, 1.0) for row in range(20)), most=20)
    draws = [[drawn(cell, 5) for _ in range(3)] for cell in (first, second, third)]
    assert draws[0] == draws[1] != draws[2]


def test_stale_are_those_whose_q_is_missing_or_of_other_weights():
    cell = filled(4)
    value(cell, {2: 0.0, 3: 0.0}, (1, 7))
    value(cell, {4: 0.0}, (1, 8))
    assert cell.stale(Version(epoch=1, counter=7)).tolist() == [[-1, -1, 1], [1, 8, 4]]
    assert cell.stale(Version(epoch=2, counter=7))[:, -1].tolist() == [1, 2, 3, 4]
    value(cell, {1: 0.0}, (2, 6))
    assert cell.stale(Version(epoch=2, counter=7))[:, -1].tolist() == [2, 3, 4, 1], "the oldest first"


def test_start_observations_are_kept_of_those_that_are_there():
    task = Task(cell=0, seed=0, start=small_config().world.start)
    starts = {
        row: Candidate(task=task, visual=np.array([float(row)]), lidar=np.zeros(1)) for row in range(1, 6)
    }
    cell = filled(4)
    assert cell.unread([1, 2, 4, 5]) == [1, 2, 4]
    cell.drop(2)
    cell.observe(starts)
    assert cell.unread([1, 2, 4, 5]) == []
    assert cell.observed([4, 1, 2, 5]) == {4: starts[4], 1: starts[1]}
    cell.drop(4)
    assert cell.observed([4, 1]) == {1: starts[1]}


def test_q_of_a_candidate_that_has_left_is_nobodys():
    cell = filled(4)
    cell.drop(2)
    value(cell, {1: 0.1, 2: 0.2, 3: 0.3, 9: 0.9})
    assert [cell.entry(row).q for row in (1, 3, 4)] == [0.1, 0.3, None]


def test_entry_of_a_candidate_keeps_its_text():
    cell = filled(1)
    entry = cell.entry(1)
    assert entry.text == Entry.read(entry.text).text == SPACE.entry({"x": 1.0}).text
