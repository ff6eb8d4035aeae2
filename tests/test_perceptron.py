"""The perceptron in NumPy against torch: the same predictions, gradients, steps and kind of first weights."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from curriculum.perceptron import Adam, Perceptron, cross_entropy, sigmoid

pytestmark = pytest.mark.usefixtures("one_thread")
SIZES = (7, 32, 32)


def twin_of(net: Perceptron) -> nn.Sequential:
    """The same network in torch, of the same weights."""
    layers = [nn.Linear(*weight.shape[::-1], dtype=torch.float64) for weight, _ in net.layers]
    with torch.no_grad():
        for layer, (weight, bias) in zip(layers, net.layers, strict=True):
            layer.weight.copy_(torch.from_numpy(weight))
            layer.bias.copy_(torch.from_numpy(bias))
    return nn.Sequential(*(m for layer in layers[:-1] for m in (layer, nn.ReLU())), layers[-1])


def flat(parameters) -> np.ndarray:
    """All of torch's parameters, or their gradients, in the order of ours."""
    return np.concatenate([p.detach().numpy().ravel() for p in parameters])


@pytest.mark.parametrize("sizes", [SIZES, (1, 8), (3, 16, 8, 4), (5,)], ids=str)
def test_gradients_and_adam_are_torchs_over_sixty_steps(sizes):
    rng = np.random.default_rng(0)
    net = Perceptron(sizes, rng)
    twin = twin_of(net)
    ours, theirs = Adam(net.values, 4e-3), torch.optim.Adam(twin.parameters(), 4e-3)
    for _ in range(60):
        x, y = rng.normal(size=(64, sizes[0])), (rng.random(64) < 0.3).astype(float)
        gradient, logits = net.gradient(x, y)
        expected = twin(torch.from_numpy(x)).squeeze(-1)
        loss = F.binary_cross_entropy_with_logits(expected, torch.from_numpy(y))
        theirs.zero_grad()
        loss.backward()
        np.testing.assert_allclose(logits, expected.detach().numpy(), atol=1e-6, rtol=0)
        assert cross_entropy(logits, y) == pytest.approx(loss.item(), abs=1e-9)
        np.testing.assert_allclose(gradient, flat(p.grad for p in twin.parameters()), atol=1e-6, rtol=0)
        ours.step(gradient)
        theirs.step()
        np.testing.assert_allclose(net.values, flat(twin.parameters()), atol=1e-6, rtol=0)
    first = Perceptron(sizes, np.random.default_rng(0)).values
    assert np.abs(net.values - first).max() > 0.05


def test_first_weights_are_uniform_within_the_bounds_of_torch_linear():
    net = Perceptron(SIZES, np.random.default_rng(1))
    for (weight, bias), (inputs, outputs) in zip(net.layers, ((7, 32), (32, 32), (32, 1)), strict=True):
        assert (weight.shape, bias.shape) == ((outputs, inputs), (outputs,))
        theirs = nn.Linear(inputs, outputs)
        bound = inputs**-0.5
        for own, other in ((weight, theirs.weight), (bias, theirs.bias)):
            assert np.abs(own).max() <= bound
            assert other.abs().max() <= bound
    weight = net.layers[1][0] * 32**0.5
    counts, _ = np.histogram(weight, 8, (-1, 1))
    assert ((counts - 128) ** 2 / 128).sum() < 18.48  # 7 degrees of freedom, 1%


def test_same_seed_same_weights():
    a, b, c = (Perceptron(SIZES, np.random.default_rng(seed)).values for seed in (1, 1, 2))
    assert (a == b).all()
    assert (a != c).any()


def test_layers_are_views_of_the_vector_and_cover_all_of_it_once():
    net = Perceptron(SIZES, np.random.default_rng(0))
    net.values[:] = 0.0
    for weight, bias in net.layers:
        weight += 1.0
        bias += 1.0
    assert (net.values == 1.0).all()


@pytest.mark.parametrize("logit", [-1e5, -40.0, 0.0, 40.0, 1e5])
def test_extreme_logits_overflow_nowhere(logit):
    with np.errstate(over="raise", invalid="raise"):
        p, loss = sigmoid(np.array([logit])), cross_entropy(np.array([logit]), np.array([1.0]))
    assert p == pytest.approx(float(torch.sigmoid(torch.tensor(logit, dtype=torch.float64))), abs=1e-15)
    assert loss == pytest.approx(max(-logit, 0.0), abs=0.7)
