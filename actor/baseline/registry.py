"""The classical rivals by name: how each is made, and the world that it asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from actor.baseline.scripted import ScriptedActor
from actor.inference import Actor
from actor.rollout import Rollout
from common.config import Config, override
from common.errors import UsageError


@dataclass(frozen=True, slots=True)
class Baseline:
    """A rival: what makes its actor, and the settings in which its world differs from the configured one."""

    make: Callable[[Rollout], Actor]
    overrides: tuple[str, ...] = ()
    """As `section.key=value`."""

    def configure(self, config: Config) -> Config:
        """`config` with the overrides."""
        return override(config.model_dump(mode="json"), self.overrides)


def _scripted(rollout: Rollout) -> Actor:
    return ScriptedActor(rollout.worlds)


def _mapped(rollout: Rollout) -> Actor:
    from actor.baseline.sensing import MappedActor  # scipy is an extra

    return MappedActor(rollout)


def _mapless(rollout: Rollout) -> Actor:
    from actor.baseline.sensing import MaplessActor

    return MaplessActor(rollout)


BASELINES: dict[str, Baseline] = {
    "b0": Baseline(_scripted),
    "b1": Baseline(_mapped),
    "b2": Baseline(_mapless),
    "b1-wide": Baseline(_mapped, ("world.lidar.beams=577", "world.lidar.range=20", "world.camera.size=320")),
}
"""b0 true poses; b1 map, LiDAR and camera; b2 LiDAR and camera; b1-wide b1 with about the sensors of the
paper's baseline (577 beams, 20 m; its 720 x 1280 camera would cost the software renderer 0.25 s a frame)."""


def make_baseline(name: str, rollout: Rollout) -> Actor:
    """The actor of a rival for a rollout in a world configured by `BASELINES[name].configure`.

    Raises UsageError for an unknown name, or when scipy is missing.
    """
    if name not in BASELINES:
        raise UsageError(f"baseline {name!r} does not exist; choose one of {', '.join(BASELINES)}")
    try:
        return BASELINES[name].make(rollout)
    except ModuleNotFoundError as error:
        raise UsageError(
            f"baseline {name} needs {error.name}; install it with pip install 'navaclq[baseline]'"
        ) from None
