"""300 updates against a second implementation: numpy, float64, every derivative written out by hand."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from common.config import Config
from common.networks import FusionNetwork
from common.observation import Observation, ObservationLayout
from learner.replay.buffer import Batch
from learner.sac import SAC
from tests.helpers import small_config

Array = NDArray[np.float64]
UPDATES = 300
ABSOLUTE = 1e-9
"""Largest absolute difference of any parameter or TD error."""

SMALL = ("network.hidden=[12, 10]", "world.lidar.beams=2", "sac.learning_rate=1e-3")
CASES = {
    "paper": (
        "network.layer_norm=false",
        "network.lidar_branch=[6, 5]",
        "network.history_branch=[4]",
        "sac.gamma=0.999",
        "sac.n_step=1",
        "sac.batch_size=16",
        "sac.target=hard",
        "sac.target_interval=40",
        "sac.policy_delay=1",
        "sac.initial_alpha=0.2",
        "sac.alpha_floor=0.0",
    ),
    "fast": (
        "network.layer_norm=true",
        "sac.gamma=0.98",
        "sac.n_step=3",
        "sac.batch_size=16",
        "sac.target=soft",
        "sac.tau=0.005",
        "sac.policy_delay=2",
        "sac.initial_alpha=0.1",
        "sac.alpha_floor=0.09",
    ),
    "huber, uniform, normalised": (
        "network.layer_norm=true",
        "network.normalize=true",
        "sac.critic_loss=huber",
        "sac.actor_batch=uniform",
        "sac.batch_size=16",
        "sac.tau=0.02",
        "sac.policy_delay=3",
        "sac.alpha_floor=0.0",
    ),
}

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def double() -> Iterator[None]:
    """Everything that torch makes has float64."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


class Layer:
    """y = x w + b, normalised over its features if there is a gain, cut below 0 if `relu`."""

    def __init__(
        self, w: Array, b: Array, gain: Array | None = None, shift: Array | None = None, relu: bool = True
    ) -> None:
        self.parameters = [w, b] if gain is None or shift is None else [w, b, gain, shift]
        self.relu = relu
        self.gradients: list[Array] = []

    def forward(self, x: Array) -> Array:
        w, b, *norm = self.parameters
        self.x = x
        y = x @ w + b
        if norm:
            centred = y - y.mean(1, keepdims=True)
            self.deviation = np.sqrt((centred**2).mean(1, keepdims=True) + 1e-5)
            self.unit = centred / self.deviation
            y = self.unit * norm[0] + norm[1]
        self.open = y > 0 if self.relu else np.ones_like(y, bool)
        return np.where(self.open, y, 0.0)

    def backward(self, d: Array) -> Array:
        """From the loss's derivative by the output to that by the input; keeps those by the parameters."""
        w, _, *norm = self.parameters
        d, of_norm = np.where(self.open, d, 0.0), []
        if norm:
            of_norm = [(d * self.unit).sum(0), d.sum(0)]
            d = d * norm[0]
            along = self.unit * (d * self.unit).mean(1, keepdims=True)
            d = (d - d.mean(1, keepdims=True) - along) / self.deviation
        self.gradients = [self.x.T @ d, d.sum(0), *of_norm]
        return d @ w.T


class Network:
    """Branches for LiDAR and history, and a head that takes the code, what they give, and any action."""

    def __init__(self, lidar: list[Layer], history: list[Layer], head: list[Layer], cuts: list[int]) -> None:
        self.lidar, self.history, self.head, self.cuts = lidar, history, head, cuts

    @property
    def layers(self) -> list[Layer]:
        return [*self.lidar, *self.history, *self.head]

    @property
    def parameters(self) -> list[Array]:
        return [array for layer in self.layers for array in layer.parameters]

    @property
    def gradients(self) -> list[Array]:
        return [array for layer in self.layers for array in layer.gradients]

    def forward(self, flat: Array, *action: Array) -> Array:
        code, lidar, history = np.split(flat, self.cuts, axis=1)
        for layer in self.lidar:
            lidar = layer.forward(lidar)
        for layer in self.history:
            history = layer.forward(history)
        self.widths = np.cumsum([code.shape[1], lidar.shape[1], history.shape[1]])
        out = np.concatenate([code, lidar, history, *action], axis=1)
        for layer in self.head:
            out = layer.forward(out)
        return out

    def backward(self, d: Array) -> Array:
        """The loss's derivative by the action (B, 0 or 2); keeps those by the parameters."""
        for layer in reversed(self.head):
            d = layer.backward(d)
        _, of_lidar, of_history, of_action = np.split(d, self.widths, axis=1)
        for layer in reversed(self.lidar):
            of_lidar = layer.backward(of_lidar)
        for layer in reversed(self.history):
            of_history = layer.backward(of_history)
        return of_action


class Adam:
    """Kingma and Ba 2015, algorithm 1."""

    def __init__(self, parameters: list[Array], rate: float) -> None:
        self.parameters, self.rate, self.t = parameters, rate, 0
        self.m = [np.zeros_like(p) for p in parameters]
        self.v = [np.zeros_like(p) for p in parameters]

    def step(self, gradients: list[Array]) -> None:
        self.t += 1
        for p, g, m, v in zip(self.parameters, gradients, self.m, self.v, strict=True):
            m[...] = 0.9 * m + 0.1 * g
            v[...] = 0.999 * v + 0.001 * g**2
            p -= self.rate * (m / (1 - 0.9**self.t)) / (np.sqrt(v / (1 - 0.999**self.t)) + 1e-8)


def copied(net: FusionNetwork, member: int, cuts: list[int]) -> Network:
    """One member of a network under test, by value."""

    def numbers(tensor: torch.Tensor) -> Array:
        return tensor.detach()[member].numpy().astype(np.float64)

    def layers(*modules: torch.nn.Module) -> list[Layer]:
        found: list[list[Array]] = []
        for module in modules:
            own = dict(module.named_parameters())
            if "bias" in own and "weight" in own:  # a normalisation belongs to the layer before it
                found[-1] += [numbers(own["weight"])[0], numbers(own["bias"])[0]]
            elif own:
                parts = [numbers(own[f"weights.{i}"]) for i in range(len(own) - 1)]
                found.append([np.concatenate(parts), numbers(own["bias"])[0]])
        return [Layer(*arrays) for arrays in found]

    head = layers(net.fusion, *net.head, net.output)
    head[-1].relu = False
    return Network(layers(*net.lidar_branch), layers(*net.history_branch), head, cuts)


def flat(observation: Observation) -> Array:
    parts = (observation.visual, observation.lidar, observation.history)
    return np.concatenate([part.reshape(len(part), -1).astype(np.float64) for part in parts], axis=1)


class Reference:
    """Soft actor-critic by the paper's equations; of the code under test it takes the first weights."""

    def __init__(self, sac: SAC, config: Config) -> None:
        layout = ObservationLayout.of(config)
        cuts = [layout.visual, layout.visual + layout.lidar]
        self.sac, self.updates = config.sac, 0
        self.policy = copied(sac.policy.net, 0, cuts)
        self.critics = [copied(sac.critic.net, twin, cuts) for twin in range(2)]
        self.targets = [copied(sac.critic.net, twin, cuts) for twin in range(2)]
        self.log_alpha = np.array([math.log(config.sac.initial_alpha)])
        rate = config.sac.learning_rate
        self.critic_adam = Adam([p for critic in self.critics for p in critic.parameters], rate)
        self.policy_adam = Adam(self.policy.parameters, rate)
        self.alpha_adam = Adam([self.log_alpha], rate)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.normalize, self.watched = config.network.normalize, np.zeros((0, layout.size))
        self.copies = 0

    def draw(self, observations: Array) -> tuple[Array, Array]:
        """Actions of the policy and their log densities; keeps what the derivatives need."""
        out = self.policy.forward(observations)
        noise = torch.randn(len(out), 2, generator=self.generator, dtype=torch.float64).numpy()
        self.squashed = np.tanh(out[:, 2:])
        log_std = -5.0 + 3.5 * (self.squashed + 1.0)
        self.spread = np.exp(log_std) * noise
        raw = out[:, :2] + self.spread
        gaussian = -(noise**2) / 2 - log_std - math.log(2 * math.pi) / 2
        return np.tanh(raw), (gaussian + 2 * np.log(np.cosh(raw))).sum(1)

    def seen(self, observation: Observation) -> Array:
        """What the networks see of it."""
        if not self.normalize:
            return flat(observation)
        centred = flat(observation) - self.watched.mean(0)
        return np.clip(centred / np.sqrt(self.watched.var(0) + 1e-4), -5, 5)

    def update(self, batch: Batch, uniform: Observation | None) -> Array:
        size = len(batch.action)
        alpha = math.exp(self.log_alpha[0])
        action, reward, discount, weight = (
            part.astype(np.float64) for part in (batch.action, batch.reward, batch.discount, batch.weight)
        )
        if self.normalize and self.updates % 10 == 0:
            self.watched = np.concatenate([self.watched, flat(batch.observation)])
        following, current = self.seen(batch.next_observation), self.seen(batch.observation)
        next_action, next_density = self.draw(following)
        values = np.min([target.forward(following, next_action)[:, 0] for target in self.targets], axis=0)
        wanted = reward + discount * (values - alpha * next_density)
        errors, gradients = [], []
        for critic in self.critics:
            error = critic.forward(current, action)[:, 0] - wanted
            errors.append(np.abs(error))
            slope = np.clip(error, -1, 1) if self.sac.critic_loss == "huber" else error
            critic.backward((weight * slope / size)[:, None])
            gradients += critic.gradients
        if self.updates % self.sac.policy_delay == 0:  # with the critics as they were
            self.update_policy(current if uniform is None else self.seen(uniform), alpha)
        self.critic_adam.step(gradients)
        self.updates += 1
        self.update_targets()
        return np.mean(errors, axis=0)

    def update_policy(self, observations: Array, alpha: float) -> None:
        action, density = self.draw(observations)
        size = len(action)
        values = [critic.forward(observations, action)[:, 0] for critic in self.critics]
        lesser = np.argmin(values, axis=0)
        by_action = np.zeros_like(action)  # of the mean of alpha log pi - min Q
        for twin, critic in enumerate(self.critics):
            by_action += critic.backward(np.where(lesser == twin, -1.0 / size, 0.0)[:, None])
        by_raw = by_action * (1 - action**2) + alpha / size * 2 * action
        by_log_std = by_raw * self.spread - alpha / size
        self.policy.backward(np.concatenate([by_raw, by_log_std * 3.5 * (1 - self.squashed**2)], axis=1))
        self.policy_adam.step(self.policy.gradients)
        self.alpha_adam.step([np.array([-(density + self.sac.target_entropy).mean()])])
        if self.sac.alpha_floor > 0:
            self.log_alpha[0] = max(self.log_alpha[0], math.log(self.sac.alpha_floor))

    def update_targets(self) -> None:
        for target, critic in zip(self.targets, self.critics, strict=True):
            for old, new in zip(target.parameters, critic.parameters, strict=True):
                if self.sac.target == "soft":
                    old += self.sac.tau * (new - old)
                elif self.updates % self.sac.target_interval == 0:
                    old[...] = new
        self.copies += self.sac.target == "hard" and self.updates % self.sac.target_interval == 0


def random_observation(config: Config, size: int, rng: np.random.Generator) -> Observation:
    layout = ObservationLayout.of(config)
    return Observation(
        rng.uniform(0, 2, (size, layout.stack, *layout.row_shape)).astype(np.float16),
        rng.uniform(0, 1, (size, layout.lidar)).astype(np.float16),
        rng.uniform(-1, 1, (size, layout.history)).astype(np.float32),
    )


def random_batch(config: Config, rng: np.random.Generator) -> Batch:
    """Transitions of which a fifth ended, with importance weights."""
    size, horizon = config.sac.batch_size, config.sac.gamma**config.sac.n_step
    weight = rng.uniform(0.05, 1, size)
    return Batch(
        observation=random_observation(config, size, rng),
        action=rng.uniform(-1, 1, (size, 2)).astype(np.float32),
        reward=rng.normal(-0.2, 2.0, size).astype(np.float32),
        discount=np.where(rng.random(size) < 0.2, 0.0, horizon).astype(np.float32),
        next_observation=random_observation(config, size, rng),
        weight=(weight / weight.max()).astype(np.float32),
        rows=np.arange(size),
        steps=np.arange(size),
    )


def close(found: Array, expected: Array) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=ABSOLUTE)


def check_network(net: FusionNetwork, member: int, expected: Network) -> None:
    found = copied(net, member, expected.cuts)
    for ours, theirs in zip(found.parameters, expected.parameters, strict=True):
        close(ours, theirs)


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("case", CASES)
def test_hundreds_of_updates_equal_those_of_a_second_implementation(case):
    config = small_config(*SMALL, *CASES[case])
    sac, rng = SAC(config), np.random.default_rng(len(case))
    reference = Reference(sac, config)
    begin = [array.copy() for array in (*reference.policy.parameters, *reference.critic_adam.parameters)]
    assert sac.log_alpha.dtype == torch.float64
    alphas, large = [], 0
    for _ in range(UPDATES):
        batch = random_batch(config, rng)
        uniform = None
        if config.sac.actor_batch == "uniform" and sac.policy_due:
            uniform = random_observation(config, 16, rng)
        losses, errors = sac.update(batch, uniform)
        expected = reference.update(batch, uniform)
        close(errors, expected)
        assert losses.alpha == pytest.approx(math.exp(reference.log_alpha[0]), rel=1e-9)
        alphas.append(losses.alpha)
        large += np.count_nonzero(expected > 1)
    check_network(sac.policy.net, 0, reference.policy)
    for twin in range(2):
        check_network(sac.critic.net, twin, reference.critics[twin])
        check_network(sac.target.net, twin, reference.targets[twin])
    close(np.array([sac.log_alpha.item()]), reference.log_alpha)
    # and all that was to be compared has taken place
    end = [*reference.policy.parameters, *reference.critic_adam.parameters]
    assert all(np.abs(a - b).max() > 1e-3 for a, b in zip(begin, end, strict=True))
    assert 0 < large < UPDATES * config.sac.batch_size, "errors on both sides of Huber's kink"
    assert reference.copies == (7 if case == "paper" else 0)
    if config.sac.alpha_floor:
        assert alphas.count(pytest.approx(config.sac.alpha_floor, rel=1e-12)) > 10
    assert len(set(alphas)) > 50
