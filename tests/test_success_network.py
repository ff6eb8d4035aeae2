import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from common.config import GEOMETRIC, CurriculumConfig, resolve
from curriculum.success_network import SuccessNetwork
from curriculum.task_space import DOCKING_SCALES
from tests.test_perceptron import flat
from tests.test_perceptron import twin_of as torch_twin

PAPER = resolve("paper").curriculum
PLUS = resolve("fast").curriculum
pytestmark = pytest.mark.usefixtures("one_thread")
Row = tuple[dict[str, float], float | None, bool]


def make_network(config: CurriculumConfig, seed: int = 0) -> SuccessNetwork:
    return SuccessNetwork(config, config.inputs, DOCKING_SCALES, seed)


def random_properties(rng: np.random.Generator) -> dict[str, float]:
    """All that are known of a task, whether the network sees them or not."""
    values = rng.uniform((1.5, 1, 1, 0, 0, 0), (5, 5, 5, math.pi / 2, 1.5, math.pi / 6))
    return dict(zip(GEOMETRIC, values.tolist(), strict=True))


def random_rows(count: int, seed: int = 0, missing: bool = False) -> list[Row]:
    """Outcomes of which every third has no Q when some are to be `missing`."""
    rng = np.random.default_rng(seed)
    return [
        (
            random_properties(rng),
            None if missing and i % 3 == 0 else float(rng.uniform(-5, 8)),
            bool(rng.random() < 0.5),
        )
        for i in range(count)
    ]


def inputs(rows: list[Row], q: list[float]) -> torch.Tensor:
    """The inputs of the paper's f_pi in about [-1, 1]; `q` already scaled."""
    return torch.tensor(
        [
            [
                (p["distance"] - 3.25) / 1.75,
                (p["agent_clearance"] - 3) / 2,
                (p["goal_clearance"] - 3) / 2,
                (p["relative_angle"] - math.pi / 4) / (math.pi / 4),
                value,
            ]
            for (p, _, _), value in zip(rows, q, strict=True)
        ],
        dtype=torch.float64,
    )


def labels(rows: list[Row]) -> torch.Tensor:
    return torch.tensor([float(success) for _, _, success in rows], dtype=torch.float64)


def twin_of(network: SuccessNetwork) -> tuple[nn.Sequential, torch.optim.Adam]:
    """The paper's f_pi and optimiser (appendix B) in torch, from the same start."""
    net = torch_twin(network.net)
    return net, torch.optim.Adam(net.parameters(), lr=4e-4)


def step(net: nn.Sequential, optimizer: torch.optim.Adam, x: torch.Tensor, y: torch.Tensor) -> float:
    loss = F.binary_cross_entropy(torch.sigmoid(net(x)).squeeze(-1), y)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss.item()


def assert_same_weights(network: SuccessNetwork, net: nn.Sequential) -> None:
    np.testing.assert_allclose(network.net.values, flat(net.parameters()), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("config", "size"), [(PAPER, 5), (PLUS, 7)])
def test_network_has_two_hidden_layers_of_32(config, size):
    shapes = [weight.shape for weight, _ in make_network(config, 0).net.layers]
    assert shapes == [(32, size), (32, 32), (1, 32)]


def test_paper_takes_one_adam_step_per_16_outcomes_on_exactly_the_fresh_ones():
    network = make_network(PAPER, 0)
    net, optimizer = twin_of(network)
    low, high = math.inf, -math.inf
    for seed in range(3):
        rows = random_rows(16, seed)
        fitted = [network.add(*row) for row in rows]
        assert fitted == [False] * 15 + [True]
        assert network.fits == seed + 1
        q = [value for _, value, _ in rows]
        low, high = min(low, *q), max(high, *q)
        middle, half = (low + high) / 2, (high - low) / 2
        loss = step(net, optimizer, inputs(rows, [(v - middle) / half for v in q]), labels(rows))
        assert network.loss == pytest.approx(loss, rel=1e-4)
        assert_same_weights(network, net)


def test_prediction_is_the_sigmoid_of_the_network_with_q_at_the_ends_of_its_range():
    network = make_network(PAPER, 0)
    rows = random_rows(16)
    for p, _, success in rows:
        network.add(p, 2.0 if success else -4.0, success)
    net, _ = twin_of(network)
    with torch.no_grad():
        for value, scaled in ((-4.0, -1.0), (2.0, 1.0), (-1.0, 0.0), (100.0, 1.5), (-100.0, -1.5)):
            expected = torch.sigmoid(net(inputs(rows, [scaled] * 16))).squeeze(-1).numpy()
            f = network.predict([p for p, _, _ in rows], [value] * 16)
            assert f.shape == (16,)
            np.testing.assert_allclose(f, expected, rtol=1e-5)


def test_missing_q_is_predicted_at_the_running_mean_of_q():
    network = make_network(PAPER, 0)
    rows = random_rows(10)
    mean = rows[0][1]
    for p, q, success in rows:
        network.add(p, q, success)
        mean += 0.02 * (q - mean)
    properties = [p for p, _, _ in rows]
    np.testing.assert_allclose(
        network.predict(properties, [None] * 10), network.predict(properties, [mean] * 10)
    )
    assert not np.allclose(
        network.predict(properties, [None] * 10), network.predict(properties, [mean + 3] * 10)
    )


def test_running_mean_of_q_lies_within_the_range_of_q_from_the_first_on():
    network = make_network(PAPER, 0)
    for q in (-5.0, -4.0):
        network.add(random_rows(1)[0][0], q, False)
    p = [random_rows(1)[0][0]]
    scaled = 2 * 0.02 - 1  # the mean is -5 + 0.02
    with torch.no_grad():
        expected = torch.sigmoid(twin_of(network)[0](inputs(random_rows(1), [scaled]))).item()
    assert network.predict(p, [None])[0] == pytest.approx(expected, rel=1e-5)


def test_fit_leaves_out_the_outcomes_without_q_when_some_have_one():
    network = make_network(PAPER, 0)
    net, optimizer = twin_of(network)
    rows = random_rows(16, missing=True)
    for row in rows:
        network.add(*row)
    real = [row for row in rows if row[1] is not None]
    q = np.array([row[1] for row in real])
    middle, half = (q.min() + q.max()) / 2, (q.max() - q.min()) / 2
    step(net, optimizer, inputs(real, ((q - middle) / half).tolist()), labels(real))
    assert len(real) == 10
    assert_same_weights(network, net)


def test_fit_without_any_q_takes_all_at_the_mean():
    network = make_network(PAPER, 0)
    net, optimizer = twin_of(network)
    rows = [(p, None, success) for p, _, success in random_rows(16)]
    for row in rows:
        network.add(*row)
    step(net, optimizer, inputs(rows, [0.0] * 16), labels(rows))
    assert_same_weights(network, net)


def test_plus_fits_several_steps_from_all_that_its_reservoir_holds():
    config = PLUS.model_copy(update={"fit_steps": 3, "reservoir": 20})
    network = make_network(config, 0)
    for row in random_rows(48):
        network.add(*row)
    assert network.fits == 3
    arrays, numbers = network.state()
    assert numbers["steps"] == 9
    assert arrays["reservoir"].shape == (20, 8), "the oldest outcomes went"
    kept = {round(float(row[-2]), 9) for row in arrays["reservoir"]}
    assert kept == {round(q, 9) for _, q, _ in random_rows(48)[28:]}


def test_average_predicts_by_a_running_mean_of_the_weights_and_learns_as_without():
    config = PLUS.model_copy(update={"average": 0.9})
    network, plain = make_network(config), make_network(PLUS)
    mean, steps = plain.net.values.copy(), 0
    for row in random_rows(96):
        before = plain.net.values.copy()
        network.add(*row)
        plain.add(*row)
        if (plain.net.values != before).any():
            steps += config.fit_steps
    assert steps == 48
    assert (network.net.values == plain.net.values).all()
    # of 48 steps: a mean that has moved, but not as far as the weights
    moved, gone = np.abs(network.mean.values - mean).sum(), np.abs(plain.net.values - mean).sum()
    assert 0.3 * gone < moved < 0.99 * gone
    one, two = make_network(config.model_copy(update={"fit_steps": 1})), make_network(config)
    first = one.net.values.copy()
    for row in random_rows(16):
        one.add(*row)
    np.testing.assert_allclose(one.mean.values, 0.1 * first + 0.9 * one.net.values, rtol=1e-9)
    two.restore(*network.state())
    p = [random_properties(np.random.default_rng(3))]
    assert two.predict(p, [1.0]) == network.predict(p, [1.0]) != plain.predict(p, [1.0])


def test_plus_learns_a_separable_problem():
    rng, network = np.random.default_rng(0), make_network(PLUS, 0)
    for _ in range(480):
        p = random_properties(rng)
        network.add(p, float(rng.normal()), p["lateral_offset"] < 0.75)
    unseen = [random_properties(rng) for _ in range(500)]
    f = network.predict(unseen, [0.0] * 500)
    truth = np.array([p["lateral_offset"] < 0.75 for p in unseen])
    assert ((f > 0.5) == truth).mean() > 0.95
    assert f[truth].mean() > 0.85
    assert f[~truth].mean() < 0.15
    assert network.loss < 0.2


def test_network_sees_the_inputs_it_is_given_whatever_their_names():
    scales = {"wind": (10.0, 10.0), "mass": (2.0, 1.0)}
    network = SuccessNetwork(PAPER, ("mass", "wind"), scales, 0)
    seen = torch.tensor([[-1.0, 0.5], [1.0, -1.0]], dtype=torch.float64)
    with torch.no_grad():
        expected = torch.sigmoid(twin_of(network)[0](seen)).squeeze(-1).numpy()
    tasks = [{"wind": 15.0, "mass": 1.0}, {"wind": 0.0, "mass": 3.0, "other": 7.0}]
    np.testing.assert_allclose(network.predict(tasks, [None, 4.0]), expected, rtol=1e-6)
    with pytest.raises(KeyError, match="wind"):
        network.predict([{"mass": 1.0}], [None])


@pytest.mark.parametrize("q", [[], ["q"]])
def test_network_without_q_is_blind_to_it_and_one_of_q_alone_to_all_else(q):
    inputs = tuple(q) or GEOMETRIC
    config = PLUS.model_copy(update={"inputs": inputs})
    network, rng = make_network(config), np.random.default_rng(1)
    for row in random_rows(64):
        network.add(*row)
    assert network.net.layers[0][0].shape[1] == len(inputs)
    tasks = [random_properties(rng) for _ in range(6)]
    by_q = network.predict(tasks[:1] * 6, [-4.0, -2.0, 0.0, 2.0, 4.0, 6.0])
    by_geometry = network.predict(tasks, [1.0] * 6)
    seen, unseen = (by_q, by_geometry) if q else (by_geometry, by_q)
    assert len(set(unseen.tolist())) == 1 < len(set(seen.tolist()))


def test_both_learn_that_a_high_q_means_success():
    for config, count in ((PLUS, 480), (PAPER.model_copy(update={"learning_rate": 4e-3}), 4800)):
        rng, network = np.random.default_rng(0), make_network(config, 0)
        for _ in range(count):
            q = float(rng.uniform(-10, 10))
            network.add(random_properties(rng), q, q > 0)
        p = [random_properties(rng) for _ in range(50)]
        assert network.predict(p, [8.0] * 50).min() > 0.8
        assert network.predict(p, [-8.0] * 50).max() < 0.2


def test_network_starts_from_its_seed():
    a, b, c = (make_network(PAPER, seed).net.values for seed in (1, 1, 2))
    assert (a == b).all()
    assert (a != c).any()


@pytest.mark.parametrize("config", [PAPER, PLUS])
def test_restored_network_predicts_to_the_bit_what_the_saved_one_did(config):
    saved, restored = make_network(config, 0), make_network(config, 9)
    for row in random_rows(40, missing=True):
        saved.add(*row)
    restored.restore(*saved.state())
    rows = random_rows(30, seed=1)
    for q in ([value for _, value, _ in rows], [None] * 30):
        properties = [p for p, _, _ in rows]
        assert restored.predict(properties, q).tolist() == saved.predict(properties, q).tolist()
    assert restored.fits == saved.fits == 2


@pytest.mark.parametrize("config", [PAPER, PLUS, PLUS.model_copy(update={"reservoir": 30})])
def test_restored_network_learns_on_to_the_bit_as_the_saved_one(config):
    saved, restored = make_network(config, 0), make_network(config, 9)
    for row in random_rows(40):  # two fits, and eight fresh outcomes on the way to the third
        saved.add(*row)
    restored.restore(*saved.state())
    rows = random_rows(24, seed=2)
    assert [saved.add(*row) for row in rows] == [restored.add(*row) for row in rows]
    assert saved.fits == 4
    assert saved.loss == restored.loss
    assert (saved.net.values == restored.net.values).all()


def test_state_before_the_first_outcome_can_be_restored():
    restored = make_network(PAPER, 9)
    restored.restore(*make_network(PAPER, 0).state())
    assert restored.fits == 0
    assert [restored.add(*row) for row in random_rows(16)][-1]


def test_state_of_the_other_algorithm_is_refused():
    with pytest.raises(ValueError, match=r"net\.0\.weight is of shape \(32, 7\), expected \(32, 5\)"):
        make_network(PAPER, 0).restore(*make_network(PLUS, 0).state())
