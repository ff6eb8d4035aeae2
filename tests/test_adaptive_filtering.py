from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import CurriculumConfig, resolve
from curriculum.algorithms.adaptive_filtering import (
    fit_normal,
    get_anchored_task,
    get_dynamic_task,
    get_task_type,
    is_easy,
    is_frontier,
    task_type_probabilities,
)

PAPER = resolve("paper").curriculum
PLUS = resolve("fast").curriculum


def test_paper_has_the_hyper_parameters_of_its_table():
    assert (PAPER.beta, PAPER.gamma, PAPER.chi, PAPER.max_draws, PAPER.filter_samples) == (
        1.0,
        0.1,
        0.95,
        100,
        100,
    )


@pytest.mark.parametrize(
    ("f", "mu", "sigma", "easy"),
    [
        # mu + beta sigma = 0.75 < 1: above it, or above chi
        (0.75, 0.5, 0.25, False),
        (0.7500001, 0.5, 0.25, True),
        (0.6, 0.5, 0.25, False),
        (0.96, 0.5, 0.25, True),
        # mu + beta sigma = 0.96875 < 1: chi = 0.95 is the lower of the two
        (0.94, 0.71875, 0.25, False),
        (0.95, 0.71875, 0.25, False),
        (0.955, 0.71875, 0.25, True),
        (0.97, 0.71875, 0.25, True),
        # mu + beta sigma = 1: above mu
        (0.75, 0.75, 0.25, False),
        (0.76, 0.75, 0.25, True),
        # above 1
        (0.9, 0.9, 0.25, False),
        (0.901, 0.9, 0.25, True),
        (0.6, 0.5, 0.6, True),
    ],
)
def test_easy_by_algorithm_1(f, mu, sigma, easy):
    assert is_easy(f, mu, sigma, PAPER) is easy


def test_beta_scales_the_threshold_of_easy():
    config = PAPER.model_copy(update={"beta": 2.0})
    assert is_easy(0.76, 0.25, 0.25, config)
    assert not is_easy(0.74, 0.25, 0.25, config)
    assert is_easy(0.51, 0.5, 0.25, config), "0.5 + 2 * 0.25 is not below 1"


def test_frontier_is_an_open_interval_of_gamma_sigma_around_mu():
    config = PAPER.model_copy(update={"gamma": 0.125})  # exact in binary, as are the bounds
    lower, upper = 0.5 - 0.125 * 0.25, 0.5 + 0.125 * 0.25
    for f in (0.5, np.nextafter(lower, 1), np.nextafter(upper, 0)):
        assert is_frontier(f, 0.5, 0.25, config)
    for f in (lower, upper, 0.3, 0.9):
        assert not is_frontier(f, 0.5, 0.25, config)


def test_nothing_is_frontier_while_all_predictions_are_equal():
    assert not is_frontier(0.5, 0.5, 0.0, PAPER)


def test_first_draw_that_meets_the_request_is_taken():
    draws = [0.2, 0.5, 0.9, 0.51, 0.99]  # easy is above 0.75, the frontier within 0.475 and 0.525
    assert get_dynamic_task("easy", draws, 0.5, 0.25, PAPER) == 2
    assert get_dynamic_task("frontier", draws, 0.5, 0.25, PAPER) == 1
    assert get_dynamic_task("random", draws, 0.5, 0.25, PAPER) == 0


def test_easy_at_the_final_stage_is_the_first_above_the_mean():
    assert get_dynamic_task("easy", [0.2, 0.5, 0.61, 0.99], 0.6, 0.5, PAPER) == 2


@pytest.mark.parametrize("requested", ["easy", "frontier"])
def test_none_when_no_draw_meets_the_request(requested):
    assert get_dynamic_task(requested, [0.3] * 100, 0.5, 0.25, PAPER) is None


def test_draws_beyond_n_t_are_not_looked_at():
    draws = [0.0] * 99 + [0.9, 0.9]
    assert get_dynamic_task("easy", draws, 0.5, 0.25, PAPER) == 99
    assert get_dynamic_task("easy", [0.0, *draws], 0.5, 0.25, PAPER) is None
    assert get_dynamic_task("easy", draws, 0.5, 0.25, PAPER.model_copy(update={"max_draws": 99})) is None


def test_no_draws_give_none():
    for requested in ("easy", "frontier", "random"):
        assert get_dynamic_task(requested, [], 0.5, 0.25, PAPER) is None


@pytest.mark.parametrize(
    ("t", "random"), [(0, 0.0), (1000, 0.001), (75_000, 0.075), (150_000, 0.15), (10**9, 0.15)]
)
def test_random_tasks_grow_with_the_agents_steps_to_their_limit(t, random):
    shares = task_type_probabilities(t, PAPER)
    assert shares == pytest.approx({"random": random, "easy": (1 - random) / 2, "frontier": (1 - random) / 2})


def test_easy_share_divides_what_is_not_random():
    config = PLUS.model_copy(update={"easy_share": 0.25, "random_limit": 0.2, "random_steps": 100.0})
    assert task_type_probabilities(0, config) == {"easy": 0.25, "frontier": 0.75, "random": 0.0}
    assert task_type_probabilities(50, config) == pytest.approx({"easy": 0.2, "frontier": 0.6, "random": 0.2})


@given(st.integers(0, 10**12), st.sampled_from([PAPER, PLUS]))
def test_shares_of_the_task_types_are_probabilities(t, config):
    shares = task_type_probabilities(t, config)
    assert sum(shares.values()) == pytest.approx(1)
    assert all(0 <= share <= 1 for share in shares.values())


@pytest.mark.parametrize(("t", "config"), [(0, PAPER), (100_000, PAPER), (10**7, PLUS)])
def test_task_types_are_drawn_with_their_probabilities(t, config: CurriculumConfig):
    rng, draws = np.random.default_rng(0), 20_000
    counts = Counter(get_task_type(t, config, rng) for _ in range(draws))
    chi_square, freedom = 0.0, -1
    for name, share in task_type_probabilities(t, config).items():
        if share == 0:
            assert counts[name] == 0
            continue
        chi_square += (counts[name] - draws * share) ** 2 / (draws * share)
        freedom += 1
    assert chi_square < {1: 6.63, 2: 9.21}[freedom]  # 1%


def test_normal_fit_is_mean_and_maximum_likelihood_deviation():
    assert fit_normal(np.array([0.2, 0.4, 0.9])) == pytest.approx((0.5, (0.26 / 3) ** 0.5))
    assert fit_normal(np.full(7, 0.25)) == (0.25, 0.0)


def test_anchored_frontier_picks_evenly_among_the_ten_nearest_to_one_half():
    rng = np.random.default_rng(1)
    f = rng.permutation(
        np.concatenate([np.linspace(0.0, 0.4, 20), np.linspace(0.45, 0.55, 10), [0.97, 0.99]])
    )
    picked = Counter(get_anchored_task("frontier", f, *fit_normal(f), PLUS, rng) for _ in range(5000))
    assert {f[i] for i in picked} == set(np.linspace(0.45, 0.55, 10))
    chi_square = sum((count - 500) ** 2 / 500 for count in picked.values())
    assert chi_square < 21.67  # 9 degrees of freedom, 1%


@pytest.mark.parametrize("reach", [(0.0, 0.2), (0.8, 1.0)])
def test_anchored_frontier_is_the_least_hopeless_or_least_sure_when_none_is_near_one_half(reach):
    rng = np.random.default_rng(2)
    f = np.linspace(*reach, 100)
    picked = {get_anchored_task("frontier", f, *fit_normal(f), PLUS, rng) for _ in range(500)}
    assert picked == set(range(90, 100) if reach[0] == 0 else range(10))


def test_anchored_frontier_serves_a_database_of_fewer_than_ten():
    rng = np.random.default_rng(3)
    assert {
        get_anchored_task("frontier", np.array([0.1, 0.2, 0.3]), 0.2, 0.1, PLUS, rng) for _ in range(100)
    } == {
        0,
        1,
        2,
    }


def test_anchored_easy_and_random_are_those_of_algorithm_1():
    rng = np.random.default_rng(4)
    f = np.array([0.1, 0.2, 0.9, 0.95, 0.15])
    mu, sigma = fit_normal(f)
    assert mu + sigma < 0.9
    assert get_anchored_task("easy", f, *fit_normal(f), PLUS, rng) == 2
    assert get_anchored_task("random", f, *fit_normal(f), PLUS, rng) == 0
    assert get_anchored_task("easy", np.full(5, 0.3), 0.3, 0.0, PLUS, rng) is None
