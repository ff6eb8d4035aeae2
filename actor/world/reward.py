"""Reward and ending of a step (section 3.3), as pure functions."""

from __future__ import annotations

from common.messages import Ending
from common.world_config import RewardConfig


def reward(config: RewardConfig, speed: float, ending: Ending | None) -> float:
    """r(t) for the forward speed at the end of the step (m/s) and the ending, if the step has one."""
    total = config.step
    if speed < config.slow_speed:
        total += config.slow
    if ending == "success":
        total += config.success
    elif ending == "dolly_contact":
        total += config.dolly_contact
    elif ending == "other_contact":
        total += config.other_contact
    return total


def ending_of(
    config: RewardConfig, distance: float, touches_dolly: bool, touches_other: bool
) -> Ending | None:
    """How a physics substep ends the episode, if it does; success wins a tie, then the worse contact."""
    if distance < config.success_distance:
        return "success"
    if touches_other:
        return "other_contact"
    return "dolly_contact" if touches_dolly else None
