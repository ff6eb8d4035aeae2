"""Classical controllers, examined like policies (section 4.4)."""

from __future__ import annotations

from actor.baseline.scripted import ScriptedActor
from actor.inference import Actor
from actor.rollout import Rollout

BASELINES: dict[str, tuple[str, ...]] = {"b0": ()}
"""By name, with the settings of the world that it asks for."""


def make_baseline(name: str, rollout: Rollout) -> Actor:
    """A controller for the worlds of a rollout."""
    return ScriptedActor(rollout.worlds)
