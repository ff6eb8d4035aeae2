import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import resolve
from common.observation import HISTORY, Columns, ObservationLayout, observe

ONE_FRAME = resolve("smoke")
FOUR_FRAMES = resolve("smoke", overrides=("encoder.frames_per_code=4",))
PIXELS = resolve("smoke", variant="e2e", overrides=("world.camera.size=16", "world.lidar.beams=2"))
LAYOUTS = [ObservationLayout.of(config) for config in (ONE_FRAME, FOUR_FRAMES, PIXELS)]


def numbered(rows: int, layout: ObservationLayout) -> Columns:
    """Columns whose rows tell their index i: visual and lidar i, action (i + .25, i + .5), reward -i - 1."""
    columns, index = Columns.empty(rows, layout), np.arange(rows)
    columns.visual[:] = index.reshape(-1, *[1] * len(layout.row_shape))
    columns.lidar[:] = index[:, None]
    columns.action[:] = index[:, None] + np.array([0.25, 0.5])
    columns.reward[:] = -index - 1
    return columns


def at(columns: Columns, row: int, layout: ObservationLayout, start: int = 0):
    """The single observation at one row."""
    seen = observe(columns, np.array([row]), np.array([start]), layout)
    return seen.visual[0], seen.lidar[0], seen.history[0]


def test_layouts_have_the_documented_sizes():
    paper = ObservationLayout.of(resolve("paper"))
    assert (paper.row_shape, paper.row_dtype, paper.stack) == ((800,), "float16", 1)
    assert (paper.visual, paper.lidar, paper.history, paper.size) == (800, 256, 12, 1068)
    fast = ObservationLayout.of(resolve("fast"))
    code = 25 * resolve("fast").encoder.channels[-1]
    assert (fast.row_shape, fast.row_dtype, fast.stack) == ((code,), "float16", 4)
    assert (fast.visual, fast.size) == (4 * code, 4 * code + 256 + 12)
    pixels = ObservationLayout.of(resolve("paper", variant="e2e"))
    assert (pixels.row_shape, pixels.row_dtype, pixels.stack) == ((80, 80, 3), "uint8", 4)
    assert (pixels.visual, pixels.size) == (800, 1068)
    assert ObservationLayout.of(resolve("fast", variant="e2e")).visual == 4 * code


@pytest.mark.parametrize("layout", LAYOUTS)
def test_empty_columns_are_zero_rows_of_the_layout(layout):
    columns = Columns.empty(5, layout)
    assert columns.visual.shape == (5, *layout.row_shape)
    assert columns.visual.dtype == layout.row_dtype
    assert (columns.lidar.shape, columns.lidar.dtype) == ((5, layout.lidar), np.float16)
    assert (columns.action.shape, columns.action.dtype) == ((5, 2), np.float32)
    assert (columns.reward.shape, columns.reward.dtype) == ((5,), np.float32)
    assert all(not part.any() for part in columns.parts())
    assert columns.nbytes == sum(part.nbytes for part in columns.parts())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_observation_has_the_shapes_and_types_of_its_columns(layout):
    seen = observe(numbered(6, layout), np.array([0, 3, 5]), np.zeros(3, np.int64), layout)
    assert seen.visual.shape == (3, layout.stack, *layout.row_shape)
    assert seen.visual.dtype == layout.row_dtype
    assert (seen.lidar.shape, seen.lidar.dtype) == ((3, layout.lidar), np.float16)
    assert (seen.history.shape, seen.history.dtype) == ((3, 12), np.float32)


@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[2]])
def test_stack_is_padded_with_the_first_frame_and_ordered_oldest_first(layout):
    columns = numbered(7, layout)
    for row, frames in (
        (0, [0, 0, 0, 0]),
        (1, [0, 0, 0, 1]),
        (2, [0, 0, 1, 2]),
        (3, [0, 1, 2, 3]),
        (6, [3, 4, 5, 6]),
    ):
        visual, lidar, _ = at(columns, row, layout)
        assert visual.reshape(4, -1)[:, 0].tolist() == frames
        assert (visual.reshape(4, -1) == visual.reshape(4, -1)[:, :1]).all()
        assert (lidar == row).all()


def test_a_code_of_the_whole_stack_is_its_own_row():
    layout = LAYOUTS[1]
    assert layout.stack == 1
    for row in (0, 2, 6):
        visual, _, _ = at(numbered(7, layout), row, layout)
        assert (visual == row).all()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_histories_are_padded_with_zeros_and_ordered_oldest_first(layout):
    columns = numbered(7, layout)
    _, _, first = at(columns, 0, layout)
    assert first.tolist() == [0] * 12
    _, _, third = at(columns, 2, layout)
    assert third.tolist() == [0, 0, 0, 0, 0.25, 0.5, 1.25, 1.5, 0, 0, -1, -2]
    _, _, last = at(columns, 6, layout)
    assert last.tolist() == [2.25, 2.5, 3.25, 3.5, 4.25, 4.5, 5.25, 5.5, -3, -4, -5, -6]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_nothing_of_the_action_taken_at_t_or_of_later_is_seen_at_t(layout):
    columns = numbered(9, layout)
    for row in range(9):
        poisoned = numbered(9, layout)
        poisoned.action[row:] = np.nan
        poisoned.reward[row:] = np.nan
        poisoned.lidar[row + 1 :] = np.nan
        poisoned.visual[row + 1 :] = 255
        for clean, dirty in zip(at(columns, row, layout), at(poisoned, row, layout), strict=True):
            np.testing.assert_array_equal(clean, dirty)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_nothing_of_the_episode_before_is_seen(layout):
    columns = numbered(12, layout)
    for row in range(5, 9):
        poisoned = numbered(12, layout)
        poisoned.visual[:5] = 255
        poisoned.lidar[:5], poisoned.action[:5], poisoned.reward[:5] = np.nan, np.nan, np.nan
        for clean, dirty in zip(at(columns, row, layout, 5), at(poisoned, row, layout, 5), strict=True):
            np.testing.assert_array_equal(clean, dirty)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), st.data())
def test_a_batch_over_several_episodes_is_what_each_episode_alone_gives(lengths, data):
    layout = data.draw(st.sampled_from(LAYOUTS[:2]))
    columns = numbered(sum(n + 1 for n in lengths), layout)
    starts = np.cumsum([0] + [n + 1 for n in lengths[:-1]])
    picks = data.draw(
        st.lists(
            st.integers(0, len(lengths) - 1).flatmap(
                lambda e: st.tuples(st.just(e), st.integers(0, lengths[e]))
            ),
            min_size=1,
            max_size=8,
        )
    )
    seen = observe(
        columns, np.array([starts[e] + t for e, t in picks]), np.array([starts[e] for e, _ in picks]), layout
    )
    for i, (e, t) in enumerate(picks):
        first = starts[e]
        frames = [first + max(t - k, 0) for k in reversed(range(layout.stack))]
        assert seen.visual[i].reshape(layout.stack, -1)[:, 0].tolist() == frames
        assert (seen.lidar[i] == first + t).all()
        past = [first + t - k for k in (4, 3, 2, 1)]
        actions = [x for p in past for x in ((p + 0.25, p + 0.5) if p >= first else (0, 0))]
        rewards = [-p - 1 if p >= first else 0 for p in past]
        assert seen.history[i].tolist() == actions + rewards


def test_observations_are_copies_that_later_rows_cannot_change():
    layout = LAYOUTS[0]
    columns = numbered(5, layout)
    seen = observe(columns, np.array([4]), np.array([0]), layout)
    before = [part.copy() for part in seen]
    for part in columns.parts():
        part[:] = 77
    for part, was in zip(seen, before, strict=True):
        np.testing.assert_array_equal(part, was)


def test_history_reaches_four_steps_back():
    assert HISTORY == 4
