"""Evaluation: a policy on a fixed list of tasks, in worker processes that share nothing."""

from __future__ import annotations

import math
import multiprocessing
import signal
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from actor.baseline.scripted import ScriptedActor
from actor.inference import Actor, Eyes, PolicyActor
from actor.rollout import Rollout
from common.cells import CELLS
from common.config import Config
from common.errors import UsageError
from common.messages import ENDINGS, Ending, Version
from common.networks import load_state, make_encoder
from common.policy_files import load_policy
from common.tasks import Task

CHUNK = 10
"""Tasks that a worker takes at a time."""
SLOTS = len(CELLS)


@dataclass(frozen=True, slots=True)
class Scripted:
    """Stands for a policy: the scripted controller with true poses (B0), in the world of `config`."""

    config: Config


def load_driver(
    policy: Path | Scripted, greedy: bool, slots: int, max_steps: int | None = None
) -> tuple[Rollout, Actor]:
    """Worlds and what drives in them; raises UsageError when `policy` is no policy, or damaged.

    `max_steps` is by default the configured length of an evaluation.
    """
    config, tensors = (policy.config, {}) if isinstance(policy, Scripted) else load_policy(policy)
    encoder, limit = make_encoder(config), max_steps or config.world.max_evaluation_steps
    if isinstance(policy, Scripted):
        rollout = Rollout(config, Eyes(config, encoder), slots, limit)
        return rollout, ScriptedActor(rollout.worlds)
    actor = PolicyActor(config, slots, np.random.default_rng(0), greedy)
    try:
        if not config.encoder.end_to_end:
            load_state(tensors, encoder=encoder)
        actor.load(Version(counter=1), tensors)
    except ValueError as error:
        raise UsageError(f"{policy} holds other networks than its configuration says: {error}") from None
    for slot in range(slots):
        actor.refresh(slot)
    return Rollout(config, Eyes(config, encoder), slots, limit), actor


class Examiner:
    """Drives one policy through tasks, side by side in as many worlds as there are cells."""

    def __init__(self, policy: Path | Scripted, greedy: bool, max_steps: int | None = None) -> None:
        torch.set_num_threads(1)
        self._rollout, self._actor = load_driver(policy, greedy, SLOTS, max_steps)

    def run(self, tasks: list[Task], rng: np.random.Generator) -> list[Ending]:
        """How each task ended, in the tasks' order; `rng` draws the actions unless they are greedy."""
        if isinstance(self._actor, PolicyActor):
            self._actor.rng = rng
        waiting = list(enumerate(tasks))[::-1]
        running: dict[int, int] = {}
        endings: dict[int, Ending] = {}
        while waiting or running:
            for slot in self._rollout.idle:
                if waiting:
                    running[slot], task = waiting.pop()
                    self._rollout.reset(slot, task)
            for finished in self._rollout.step(self._actor):
                endings[running.pop(finished.slot)] = finished.ending
        return [endings[index] for index in range(len(tasks))]


_examiner: Examiner | None = None


def _start_worker(policy: Path | Scripted, greedy: bool, max_steps: int | None) -> None:
    global _examiner
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    _examiner = Examiner(policy, greedy, max_steps)


def _examine(work: tuple[int, list[Task], int]) -> tuple[int, list[Ending]]:
    assert _examiner is not None
    index, tasks, seed = work
    return index, _examiner.run(tasks, np.random.default_rng([seed, 4, index]))


def evaluate(
    policy: Path | Scripted,
    tasks: list[Task],
    processes: int,
    greedy: bool = True,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
    max_steps: int | None = None,
) -> list[Ending]:
    """How each task ended, in order; `progress` hears the number done. Raises UsageError for a bad policy.

    `max_steps` is by default the configured length of an evaluation.
    """
    load_driver(policy, greedy, 0, max_steps)  # a bad one is refused here, not in a worker
    chunks = [(i, tasks[i : i + CHUNK], seed) for i in range(0, len(tasks), CHUNK)]
    endings: dict[int, list[Ending]] = {}
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, _start_worker, (policy, greedy, max_steps)) as pool:
        for index, found in pool.imap_unordered(_examine, chunks):
            endings[index] = found
            if progress:
                progress(sum(len(part) for part in endings.values()))
    return [ending for index, *_ in chunks for ending in endings[index]]


def rates(endings: list[Ending]) -> dict[str, float]:
    """Share of each ending, in [0, 1]."""
    counts = Counter(endings)
    return {name: counts[name] / len(endings) for name in ENDINGS}


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95% confidence interval of a rate (Wilson 1927), within [0, 1]."""
    z = 1.959963984540054
    rate, spread = successes / trials, z**2 / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = z * math.sqrt(rate * (1 - rate) / trials + spread / trials / 4) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)
