"""Measures of predictions against numbers made by hand, and the correction of distorted ones."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curriculum.calibration import Calibration, brier_score, reliability


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def logit(p: np.ndarray) -> np.ndarray:
    return np.log(p / (1 - p))


def distorted(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True probabilities of tasks, what is predicted for them, and how they end."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.02, 0.98, count)
    return true, sigmoid(2 * logit(true) + 1), rng.random(count) < true


def learned(window: int, predicted: np.ndarray, success: np.ndarray) -> Calibration:
    calibration = Calibration(window)
    for p, y in zip(predicted, success, strict=True):
        calibration.add(float(p), bool(y))
    return calibration


# Measures


def test_brier_score_of_numbers_made_by_hand():
    assert brier_score([1.0, 0.0], [True, False]) == 0.0
    assert brier_score([0.0, 1.0], [True, False]) == 1.0
    assert brier_score([0.5] * 4, [1, 0, 0, 1]) == 0.25
    assert brier_score([0.9, 0.6, 0.2], [1, 0, 0]) == pytest.approx((0.01 + 0.36 + 0.04) / 3)


def test_reliability_of_numbers_made_by_hand():
    found = reliability([0.0, 0.05, 0.1, 0.45, 0.95, 1.0], [0, 1, 1, 0, 1, 1])
    expected = [(0.025, 0.5, 2), (0.1, 1.0, 1), (0.45, 0.0, 1), (0.975, 1.0, 2)]
    assert found == [pytest.approx(row) for row in expected]
    assert reliability([0.4, 0.6], [1, 0], bins=1) == [pytest.approx((0.5, 0.5, 2))]


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=60))
@settings(max_examples=50)
def test_reliability_counts_every_outcome_once_in_its_own_tenth(pairs):
    rows = reliability([p for p, _ in pairs], [y for _, y in pairs])
    assert sum(count for _, _, count in rows) == len(pairs)
    assert sum(share * count for _, share, count in rows) == pytest.approx(sum(y for _, y in pairs))
    means = [mean for mean, _, _ in rows]
    assert means == sorted(means)
    tenths = [min(int(mean * 10 + 1e-9), 9) for mean in means]
    assert len(set(tenths)) >= len(tenths) - 1  # a mean may be rounded across a bound


# The correction


def test_window_of_nothing_changes_nothing():
    _, predicted, success = distorted(200)
    calibration = learned(0, predicted, success)
    assert (calibration.correct(predicted) == predicted).all()
    assert calibration.state() == [1.0, 0.0, []]


def test_before_the_first_outcome_nothing_is_changed():
    predicted = np.array([0.0, 0.3, 1.0])
    assert (Calibration(100).correct(predicted) == predicted).all()


def test_known_distortion_is_mended():
    _, predicted, success = distorted(600)
    calibration = learned(600, predicted, success)
    # logit p = (logit p' - 1) / 2
    assert calibration.a == pytest.approx(0.5, abs=0.1)
    assert calibration.b == pytest.approx(-0.5, abs=0.25)
    true, predicted, success = distorted(4000, seed=1)
    best, raw = brier_score(true, success), brier_score(predicted, success)
    mended = brier_score(calibration.correct(predicted), success)
    assert mended - best < 0.1 * (raw - best)
    assert raw - best > 0.01


def test_honest_predictions_are_left_about_as_they_are():
    true, _, success = distorted(600)
    calibration = learned(600, true, success)
    assert np.abs(calibration.correct(true) - true).max() < 0.07


def test_only_the_last_outcomes_count():
    _, predicted, success = distorted(500)
    old = learned(300, np.concatenate([1 - predicted[:100], predicted]), np.append(success[:100], success))
    new = learned(300, predicted, success)
    assert old.state()[2] == new.state()[2]
    assert len(new.state()[2]) == 300
    assert (old.a, old.b) == pytest.approx((new.a, new.b), abs=0.01)


def test_correction_keeps_the_order_of_predictions():
    _, predicted, success = distorted(300)
    calibration = learned(300, predicted, ~success)  # the worst predictions there are
    corrected = calibration.correct(np.linspace(0, 1, 101))
    assert (np.diff(corrected) >= 0).all()


@pytest.mark.parametrize("success", [True, False])
@pytest.mark.parametrize("predicted", [0.0, 0.5, 0.99, 1.0])
def test_correction_stays_bounded_when_all_succeed_or_all_fail(success, predicted):
    calibration = learned(300, np.full(400, predicted), np.full(400, success))
    corrected = calibration.correct(np.array([0.0, 0.01, 0.5, 0.99, 1.0]))
    assert np.isfinite(corrected).all()
    assert ((corrected > 0) & (corrected < 1)).all()
    here = calibration.correct(np.array([predicted]))[0]
    assert (here > 0.9) if success else (here < 0.1), "it believes what it saw"


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=80), st.integers(1, 30))
@settings(max_examples=60)
def test_whatever_comes_corrections_are_probabilities(pairs, window):
    calibration = learned(window, np.array([p for p, _ in pairs]), np.array([y for _, y in pairs]))
    assert 0.1 <= calibration.a <= 10
    assert -5 <= calibration.b <= 5
    corrected = calibration.correct(np.linspace(0, 1, 11))
    assert np.isfinite(corrected).all()
    assert ((corrected >= 0) & (corrected <= 1)).all()


def test_state_goes_on_as_before_through_json():
    _, predicted, success = distorted(250)
    whole = learned(100, predicted, success)
    first = learned(100, predicted[:120], success[:120])
    second = Calibration(100)
    second.restore(json.loads(json.dumps(first.state())))
    assert second.state() == first.state()
    for p, y in zip(predicted[120:], success[120:], strict=True):
        second.add(float(p), bool(y))
    assert second.state() == whole.state()
    assert math.isfinite(second.a)
    assert (second.correct(predicted) == whole.correct(predicted)).all()
