"""Optimisers as flat dictionaries of tensors, so that they can be kept without pickle."""

from __future__ import annotations

from torch import Tensor
from torch.optim import Optimizer


def moments_of(optimizer: Optimizer) -> dict[str, Tensor]:
    """The state of Adam, `adam.parameter.key`."""
    return {
        f"adam.{index}.{key}": value
        for index, slots in optimizer.state_dict()["state"].items()
        for key, value in slots.items()
    }


def load_moments(optimizer: Optimizer, moments: dict[str, Tensor]) -> None:
    """Takes what `moments_of` gave; parameters that it does not name begin anew."""
    state = optimizer.state_dict()
    state["state"] = {
        index: {
            key: moments[f"adam.{index}.{key}"].clone()  # load_state_dict keeps what it is given
            for key in ("step", "exp_avg", "exp_avg_sq")
            if f"adam.{index}.{key}" in moments
        }
        for group in state["param_groups"]
        for index in group["params"]
        if f"adam.{index}.step" in moments
    }
    optimizer.load_state_dict(state)
