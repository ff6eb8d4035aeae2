"""Acting: frames to codes, codes to observations, observations to actions, for all worlds in one batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.config import Config
from common.messages import Version
from common.networks import Encoder, Perception, Policy, compile_encoder, load_state
from common.observation import HISTORY, Observation, ObservationLayout


class Actor(Protocol):
    """What chooses actions for the worlds in `slots`."""

    def act(self, observation: Observation, slots: list[int]) -> NDArray[np.float32]:
        """(B,) observations, one per slot, to (B, 2) actions in [-1, 1]."""
        ...


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """A policy as of one version of the weights."""

    version: Version
    perception: Perception
    policy: Policy


class PolicyActor:
    """The SAC policy on the CPU; samples its actions, or with `greedy` takes the mean's.

    With `actor.uniform_start` it samples uniformly until the first update.

    Every slot drives with the weights that were newest when it was last refreshed, so that an episode can
    keep one policy to its end (algorithm 2).
    """

    def __init__(self, config: Config, slots: int, rng: np.random.Generator, greedy: bool = False) -> None:
        self.rng = rng
        self._config, self._greedy = config, greedy
        self._uniform_start = config.actor.uniform_start and not greedy
        self.newest = self._blank(Version())
        self._in_slot = [self.newest] * slots

    def _blank(self, version: Version) -> LoadedPolicy:
        policy = Policy(ObservationLayout.of(self._config), self._config.network)
        return LoadedPolicy(version, Perception(self._config).eval(), policy.eval())

    def load(self, version: Version, tensors: dict[str, Tensor]) -> None:
        """Makes these weights the newest; ValueError when they do not fit."""
        loaded = self._blank(version)
        load_state(tensors, perception=loaded.perception, policy=loaded.policy)
        self.newest = loaded

    def refresh(self, slot: int) -> None:
        """Lets a slot drive with the newest weights from now on."""
        self._in_slot[slot] = self.newest

    def version(self, slot: int) -> Version:
        """Version of the weights that a slot drives with."""
        return self._in_slot[slot].version

    def act(self, observation: Observation, slots: list[int]) -> NDArray[np.float32]:
        """One forward pass for each version in use."""
        actions = np.empty((len(slots), 2), np.float32)
        noise = self.rng.standard_normal(actions.shape, np.float32)
        loaded = [self._in_slot[slot] for slot in slots]
        for one in {id(item): item for item in loaded}.values():
            mine = np.array([item is one for item in loaded])
            if self._uniform_start and one.version.counter == 0:
                actions[mine] = self.rng.uniform(-1, 1, (mine.sum(), 2))
                continue
            with torch.inference_mode():
                flat = one.perception(Observation(*(part[mine] for part in observation)))
                if self._greedy:
                    chosen = one.policy.mode(flat)
                else:
                    chosen = one.policy.sample(flat, torch.from_numpy(noise[mine]))[0]
            actions[mine] = chosen.numpy()
        return actions


class Eyes:
    """Turns a world's newest frames into its next visual row: a code, or the frame itself end to end."""

    def __init__(self, config: Config, encoder: Encoder) -> None:
        self._frames_per_code = config.encoder.frames_per_code
        self._encode = None
        if not config.encoder.end_to_end:
            self._encode = compile_encoder(encoder, config.world.camera.size)

    def see(self, recent: list[list[NDArray[np.uint8]]]) -> NDArray[Any]:
        """(B, *row_shape) visual rows for B worlds, each with up to four recent frames, oldest first."""
        if self._encode is None:
            return np.stack([frames[-1] for frames in recent])
        count = self._frames_per_code
        stacks = [([frames[0]] * HISTORY + frames)[-count:] for frames in recent]
        return self._encode(np.stack([np.stack(stack) for stack in stacks]))


class Blind(Eyes):
    """For controllers that look at the frames themselves: visual rows of zeros."""

    def __init__(self, config: Config) -> None:
        layout = ObservationLayout.of(config)
        self._row = np.zeros(layout.row_shape, layout.row_dtype)

    def see(self, recent: list[list[NDArray[np.uint8]]]) -> NDArray[Any]:
        """(B, *row_shape) zeros for B worlds."""
        return np.stack([self._row] * len(recent))
