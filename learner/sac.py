"""Soft actor-critic (section 3.1, algorithm 3), written to be read against the paper's equations."""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from common.config import Config
from common.errors import UsageError
from common.networks import Perception, Policy, TwinCritic, load_state, state_of
from common.observation import ACTION_SIZE, Observation, ObservationLayout
from learner.optimizers import load_moments, moments_of
from learner.replay.buffer import Batch

WATCH_INTERVAL = 10
"""Updates between batches shown to the running normalisation."""


class Losses(NamedTuple):
    """One update's figures; policy figures are NaN when the policy was not updated."""

    critic: float
    q: float
    policy: float
    entropy: float
    alpha: float


def td_target(reward: Tensor, discount: Tensor, q_next: Tensor, alpha: Tensor, log_density: Tensor) -> Tensor:
    """r + discount (min_i Q_i(s', a') - alpha log pi(a' | s')); all (B,) but q_next (2, B)."""
    return reward + discount * (torch.minimum(*q_next) - alpha * log_density)


def critic_loss(q: Tensor, target: Tensor, weight: Tensor, kind: str = "squared") -> Tensor:
    """J_Q: importance-weighted mean of (Q - target)^2 / 2, summed over the twins; q (2, B).

    With `kind` huber it is |Q - target| - 1/2 where that difference is larger than 1.
    """
    twins = target.expand_as(q)
    if kind == "huber":
        errors = F.huber_loss(q, twins, reduction="none")
    else:
        errors = 0.5 * F.mse_loss(q, twins, reduction="none")
    return (weight * errors).mean(1).sum()


def policy_loss(q: Tensor, alpha: Tensor, log_density: Tensor) -> Tensor:
    """J_pi: mean of alpha log pi(a | s) - min_i Q_i(s, a); q (2, B)."""
    return (alpha * log_density - torch.minimum(*q)).mean()


def temperature_loss(log_alpha: Tensor, log_density: Tensor, target_entropy: float) -> Tensor:
    """Mean of -log(alpha) (log pi(a | s) + target entropy): J(alpha), its factor by custom the logarithm."""
    return -(log_alpha * (log_density + target_entropy)).mean()


def pick_device(wanted: str) -> torch.device:
    """The device of `learner.device`; raises UsageError for a GPU that is not there."""
    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise UsageError("learner.device = cuda, but torch finds no GPU; use auto or cpu")
    return torch.device("cuda" if there and wanted != "cpu" else "cpu")


class SAC:
    """Networks, targets and optimisers, updated from batches; what the learner checkpoints.

    n-step targets leave out the entropy of the steps in between, as is usual. End to end the encoder is part
    of the critic: its target has a target encoder, the policy reads codes without a gradient.
    """

    def __init__(self, config: Config) -> None:
        self.config, self.updates = config, 0
        self.device = pick_device(config.learner.device)
        self._generator = torch.Generator().manual_seed(config.seed)
        layout = ObservationLayout.of(config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed + 1)
            self.policy = Policy(layout, config.network).to(self.device)
            self.critic = TwinCritic(layout, config.network).to(self.device)
            self.perception = Perception(config).to(self.device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.target_perception = copy.deepcopy(self.perception).requires_grad_(False)
        self.target_perception.normalizer = self.perception.normalizer
        initial = math.log(config.sac.initial_alpha)
        self.log_alpha = torch.tensor(initial, device=self.device, requires_grad=True)
        self._modules = {
            "perception": self.perception,
            "policy": self.policy,
            "critic": self.critic,
            "target": self.target,
        }
        if config.encoder.end_to_end:
            self._modules["target_perception"] = self.target_perception
        self._end_to_end = config.encoder.end_to_end
        self._online: list[Tensor] = [*self.critic.parameters(), *self.perception.parameters()]
        self._targets: list[Tensor] = [*self.target.parameters(), *self.target_perception.parameters()]
        self._learned: dict[str, list[Tensor]] = {
            "critic": self._online,
            "policy": list(self.policy.parameters()),
            "temperature": [self.log_alpha],
        }
        groups = [{"name": name, "params": parameters} for name, parameters in self._learned.items()]
        self.optimizer = torch.optim.Adam(groups, config.sac.learning_rate, fused=True)

    @property
    def alpha(self) -> Tensor:
        """The temperature, without gradient."""
        return self.log_alpha.detach().exp()

    @property
    def policy_due(self) -> bool:
        """Whether the next update is one of the policy too."""
        return self.updates % self.config.sac.policy_delay == 0

    def update(
        self, batch: Batch, actor_batch: Observation | None = None
    ) -> tuple[Losses, NDArray[np.float64]]:
        """One gradient step on all that is due; returns figures and |TD error| (B,), the twins' mean.

        All gradients are taken before any step; the code of Haarnoja et al. 2018 too runs its steps at once,
        though their listing, like algorithm 3, has them in turn. What the critics' first layer makes of the
        observations so serves J_Q and J_pi alike.
        With `actor_batch` policy and temperature learn from those observations in place of the batch's.
        """
        sac = self.config.sac
        action, reward, discount, weight = (
            torch.from_numpy(part).to(self.log_alpha)
            for part in (batch.action, batch.reward, batch.discount, batch.weight)
        )
        if self.updates % WATCH_INTERVAL == 0:
            self.perception.watch(batch.observation)
        with torch.no_grad():
            following = self.perception(batch.next_observation)
            next_action, next_log_density = self.policy.sample(following, self._noise(len(reward)))
            if self._end_to_end:
                following = self.target_perception(batch.next_observation)
            target = td_target(
                reward, discount, self.target(following, next_action), self.alpha, next_log_density
            )
        flat = self.perception(batch.observation)
        embedded = self.critic.net.embed(flat)
        q = self.critic.judge(embedded, action)
        loss = critic_loss(q, target, weight, sac.critic_loss)
        self.optimizer.zero_grad()
        self._descend("critic", loss)
        policy, entropy = math.nan, math.nan
        if self.policy_due:
            if actor_batch is not None:
                with torch.no_grad():
                    flat = self.perception(actor_batch)
                    embedded = self.critic.net.embed(flat)
            policy, entropy = self._descend_policy(flat.detach(), embedded.detach())
        self.optimizer.step()
        self.updates += 1
        self._bound_temperature()
        self._update_targets()
        errors = (q.detach() - target).abs().mean(0).double().cpu().numpy()
        figures = Losses(loss.item(), q.detach().mean().item(), policy, entropy, self.alpha.item())
        return figures, errors

    def _descend_policy(self, flat: Tensor, embedded: Tensor) -> tuple[float, float]:
        action, log_density = self.policy.sample(flat, self._noise(len(flat)))
        loss = policy_loss(self.critic.judge(embedded, action), self.alpha, log_density)
        self._descend("policy", loss)
        log_density = log_density.detach()
        self._descend(
            "temperature", temperature_loss(self.log_alpha, log_density, self.config.sac.target_entropy)
        )
        return loss.item(), -log_density.mean().item()

    def _bound_temperature(self) -> None:
        if self.config.sac.alpha_floor > 0:
            with torch.no_grad():
                self.log_alpha.clamp_(min=math.log(self.config.sac.alpha_floor))

    def _update_targets(self) -> None:
        sac = self.config.sac
        with torch.no_grad():
            if sac.target == "soft":
                torch._foreach_lerp_(self._targets, self._online, sac.tau)
            elif self.updates % sac.target_interval == 0:
                torch._foreach_copy_(self._targets, self._online)

    def _descend(self, name: str, loss: Tensor) -> None:
        """Sets the gradients of one group of parameters, and of nothing else, to those of its loss."""
        parameters = self._learned[name]
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient

    def _noise(self, size: int) -> Tensor:
        return torch.randn(size, ACTION_SIZE, generator=self._generator).to(self.log_alpha)

    def policy_state(self) -> dict[str, Tensor]:
        """What an actor needs."""
        return state_of(perception=self.perception, policy=self.policy)

    def critic_state(self) -> dict[str, Tensor]:
        """What Q(s0, a0) needs: the target critics to the letter (alg. 2), else the current ones."""
        critic = self.target if self.config.curriculum.algorithm == "navacl-q" else self.critic
        return self.policy_state() | state_of(critic=critic)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Networks and optimisers as flat dictionaries of tensors."""
        networks = state_of(**self._modules)
        networks["log_alpha"] = self.log_alpha.detach()
        moments = moments_of(self.optimizer)
        moments["generator"] = self._generator.get_state()
        return networks, moments

    def load_weights(self, networks: dict[str, Tensor]) -> None:
        """The networks alone; raises ValueError naming the first tensor that does not fit."""
        load_state(networks, **self._modules)

    def load(self, networks: dict[str, Tensor], moments: dict[str, Tensor], updates: int) -> None:
        """Takes what `state` gave; raises ValueError naming the first tensor that does not fit."""
        self.load_weights(networks)
        with torch.no_grad():
            self.log_alpha.copy_(networks["log_alpha"])
        load_moments(self.optimizer, moments)
        self._generator.set_state(moments["generator"])
        self.updates = updates
