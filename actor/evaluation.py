"""Evaluation: a policy on a fixed list of tasks, in worker processes that share nothing."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
import torch

from actor.inference import Eyes, PolicyActor
from actor.rollout import Rollout
from common.errors import UsageError
from common.messages import ENDINGS, Ending, Version
from common.networks import load_state, make_encoder
from common.policy_files import load_policy
from common.tasks import CELLS, Task

CHUNK = 10
"""Tasks that a worker takes at a time."""


class Examiner:
    """Drives one policy through tasks, side by side in as many worlds as there are cells."""

    def __init__(self, policy: Path, greedy: bool, seed: int) -> None:
        torch.set_num_threads(1)
        config, tensors = load_policy(policy)
        encoder = make_encoder(config)
        slots = min(len(CELLS), CHUNK)
        self._actor = PolicyActor(config, slots, np.random.default_rng([seed, 4]), greedy)
        try:
            if not config.encoder.end_to_end:
                load_state(tensors, encoder=encoder)
            self._actor.load(Version(counter=1), tensors)
        except ValueError as error:
            raise UsageError(f"{policy} holds other networks than its configuration says: {error}") from None
        self._rollout = Rollout(config, Eyes(config, encoder), slots, config.world.max_evaluation_steps)
        for slot in range(slots):
            self._actor.refresh(slot)

    def run(self, tasks: list[Task]) -> list[Ending]:
        """How each task ended, in the tasks' order."""
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


def _start_worker(policy: Path, greedy: bool, seed: int) -> None:
    global _examiner
    _examiner = Examiner(policy, greedy, seed)


def _examine(tasks: list[Task]) -> list[Ending]:
    assert _examiner is not None
    return _examiner.run(tasks)


def evaluate(
    policy: Path,
    tasks: list[Task],
    processes: int,
    greedy: bool = True,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[Ending]:
    """How each task ended, in order; `progress` hears the number done. Raises UsageError for a bad policy."""
    load_policy(policy)  # a bad one is refused here, not in a worker
    chunks = [tasks[i : i + CHUNK] for i in range(0, len(tasks), CHUNK)]
    context = multiprocessing.get_context("spawn")
    start = partial(_start_worker, policy, greedy, seed)
    results: dict[int, list[Ending]] = {}
    with ProcessPoolExecutor(processes, mp_context=context, initializer=start) as pool:
        futures = {pool.submit(_examine, chunk): index for index, chunk in enumerate(chunks)}
        for future in as_completed(futures):
            results[futures[future]] = future.result()
            if progress:
                progress(sum(len(endings) for endings in results.values()))
    return [ending for index in range(len(chunks)) for ending in results[index]]


def rates(endings: list[Ending]) -> dict[str, float]:
    """Share of each ending, in [0, 1]."""
    counts = Counter(endings)
    return {name: counts[name] / len(endings) for name in ENDINGS}
