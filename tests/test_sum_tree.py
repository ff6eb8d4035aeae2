import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from learner.replay.sum_tree import SumTree

WEIGHTS = st.lists(st.integers(0, 50).map(float), min_size=1, max_size=70).filter(lambda w: sum(w) > 0)


def tree_of(weights: list[float]) -> SumTree:
    tree = SumTree(len(weights))
    tree.set(np.arange(len(weights)), np.array(weights))
    return tree


@given(WEIGHTS, st.data())
def test_find_agrees_with_a_cumulative_sum(weights, data):
    tree, edges = tree_of(weights), np.cumsum(weights)
    whole = data.draw(st.lists(st.integers(0, int(edges[-1]) - 1), min_size=1, max_size=20))
    for prefixes in (np.array(whole, float), np.array(whole) + 0.5):
        naive = [int(np.argmax(edges > prefix)) for prefix in prefixes]
        assert tree.find(prefixes).tolist() == naive
    assert tree.total == edges[-1]


@given(
    st.integers(1, 70), st.lists(st.tuples(st.integers(0, 69), st.integers(0, 9)), max_size=120), st.data()
)
def test_total_and_leaves_follow_any_history_of_writes(capacity, writes, data):
    tree, mirror = SumTree(capacity), np.zeros(capacity)
    writes = [(index % capacity, float(weight)) for index, weight in writes]
    while writes:
        size = data.draw(st.integers(1, len(writes)))
        indices, weights = (np.array(part) for part in zip(*writes[:size], strict=True))
        tree.set(indices, weights)
        for index, weight in writes[:size]:
            mirror[index] = weight
        writes = writes[size:]
        assert tree.total == mirror.sum()
        assert tree.weights.tolist() == mirror.tolist()
        assert tree.get(indices).tolist() == mirror[indices].tolist()


@given(st.lists(st.floats(0, 1e3), min_size=2, max_size=40).filter(lambda w: sum(w) > 1e-3))
def test_leaf_of_weight_zero_is_never_found_even_when_a_prefix_is_rounded_up_to_the_total(weights):
    tree = tree_of(weights)
    total = tree.total
    prefixes = np.array([0.0, total / 3, np.nextafter(total, 0), total, np.nextafter(total, 2 * total)])
    assert (tree.get(tree.find(prefixes)) > 0).all()


@pytest.mark.parametrize("seed", range(20))
def test_leaf_of_weight_zero_is_never_found_at_the_edges_of_any_other(seed):
    rng = np.random.default_rng(seed)
    weights = rng.random(700) * 10.0 ** rng.integers(-6, 2, 700) * (rng.random(700) < rng.choice([0.02, 0.5]))
    tree, edges = tree_of(weights.tolist()), np.cumsum(weights)
    near = [np.nextafter(edges, -1), edges, np.nextafter(edges, 1e9)]
    found = tree.find(np.sort(np.concatenate(near)))
    assert (tree.get(found) > 0).all()
    assert (np.diff(found) >= 0).all()


def test_rounding_between_levels_does_not_lead_to_an_empty_leaf():
    """What the first block gives back of this prefix is less than nothing."""
    tree = SumTree(512)
    tree.set(np.array([0, 257]), np.array([0.4858353588317891, 0.8894878343490003]))
    assert tree.find(np.array([0.4858353588317891])).tolist() == [257]


def test_last_leaves_of_weight_zero_are_passed_over_at_the_total():
    tree = tree_of([0.0, 1.0, 2.0, 0.0, 0.0])
    assert tree.find(np.array([0.0, 0.999, 1.0, 3.0, 3.5])).tolist() == [1, 1, 2, 2, 2]


def test_leaves_are_found_in_proportion_to_their_weights():
    weights = np.array([0.5, 0.0, 3.0, 1.5, 1e-3, 7.0, 2.0])
    tree, draws = tree_of(weights.tolist()), 200_000
    found = tree.find(np.random.default_rng(0).random(draws) * tree.total)
    counts = np.bincount(found, minlength=len(weights))
    expected = draws * weights / weights.sum()
    alive = weights > 0
    chi_square = ((counts - expected)[alive] ** 2 / expected[alive]).sum()
    assert counts[1] == 0
    assert chi_square < 15.09  # 5 degrees of freedom, 1%


def test_shares_of_the_unit_interval_are_exactly_the_proportions():
    tree = tree_of([1.0, 2.0, 5.0])
    found = tree.find((np.arange(800) + 0.5) / 800 * tree.total)
    assert np.bincount(found).tolist() == [100, 200, 500]


def test_of_an_index_written_twice_the_last_weight_counts():
    tree = tree_of([1.0, 1.0, 1.0])
    tree.set(np.array([1, 0, 1, 1]), np.array([5.0, 2.0, 7.0, 4.0]))
    assert tree.weights.tolist() == [2.0, 4.0, 1.0]
    assert tree.total == 7.0


@pytest.mark.parametrize("capacity", [1, 2, 3, 5, 8, 1000, 1023, 1024, 1025])
def test_any_capacity_holds_that_many_leaves(capacity):
    tree = SumTree(capacity)
    tree.set(np.arange(capacity), 1.0)
    assert tree.weights.shape == (capacity,)
    assert tree.total == capacity
    assert tree.find(np.arange(capacity) + 0.5).tolist() == list(range(capacity))


@pytest.mark.parametrize("bad", [-1e-9, float("nan"), float("inf")])
def test_negative_and_not_finite_weights_are_refused_and_change_nothing(bad):
    tree = tree_of([1.0, 2.0])
    with pytest.raises(ValueError, match="finite and not negative"):
        tree.set(np.array([0, 1]), np.array([9.0, bad]))
    with pytest.raises(ValueError, match="finite and not negative"):
        tree.set(np.array([0]), bad)
    assert tree.weights.tolist() == [1.0, 2.0]
    assert tree.total == 3.0


def test_writing_nothing_changes_nothing():
    tree = tree_of([1.0, 2.0])
    tree.set(np.array([], np.int64), np.array([]))
    assert tree.total == 3.0


def test_ten_thousand_fractional_writes_leave_no_drift():
    rng, tree = np.random.default_rng(1), SumTree(37)
    for _ in range(10_000):
        tree.set(rng.integers(37, size=3), rng.random(3) * 10.0 ** rng.integers(-6, 6))
    assert tree.total == pytest.approx(tree.weights.sum(), rel=1e-12)
