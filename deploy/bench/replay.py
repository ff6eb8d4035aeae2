"""The replay against cpprb's and TorchRL's prioritised buffers: the same transitions, 256 at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from statistics import median

import numpy as np
import torch

from common.config import Config
from common.messages import Episode, Version
from common.observation import ACTION_SIZE, ObservationLayout
from common.tasks import Task
from deploy.bench.report import Report
from learner.learner import Learner
from learner.replay.buffer import Batch, Replay

CHUNK = 8192
"""Transitions that a rival is given at a time while it is filled."""
Cycle = Callable[[np.random.Generator, int], None]
"""Draws so many batches at one go, with their observations, and writes new priorities back."""


def synthetic_episode(config: Config, steps: int, rng: np.random.Generator) -> Episode:
    """An episode of noise in the layout of a configuration."""
    layout, rows = ObservationLayout.of(config), steps + 1
    visual = rng.random((rows, *layout.row_shape), np.float32)
    if layout.row_dtype == "uint8":
        visual *= 255
    return Episode(
        digest={},
        task=Task(cell=0, seed=0, start=config.world.start),
        visual=visual.astype(layout.row_dtype),
        lidar=rng.random((rows, layout.lidar), np.float32).astype(np.float16),
        action=rng.uniform(-1, 1, (rows, ACTION_SIZE)).astype(np.float32),
        reward=rng.uniform(-1, 0, rows).astype(np.float32),
        ending="timeout",
        first_version=Version(),
        last_version=Version(),
        category="random",
    )


def bench_replay(config: Config, rounds: int, progress: Callable[[int, str], None]) -> Report:
    """Fills a buffer of the configured capacity and as many of its rivals as are installed.

    A cycle is: sample, gather observations, next observations, actions, rewards, discounts and importance
    weights, write the priorities back. The rivals hold each observation as one row, stacked beforehand.
    All draw one batch at a time, and as many at one go as the learner does; the faster way counts.
    """
    report, rng = Report("replay"), np.random.default_rng(config.seed)
    learner = Learner(config)
    progress(0, "filling")
    steps = config.world.max_episode_steps // 4
    templates = [synthetic_episode(config, steps, rng) for _ in range(64)]
    first = 0
    while learner.replay.transitions + steps <= config.replay.capacity:
        learner.insert(templates[int(rng.integers(64))], first)
        first += steps
    report.add("transitions", learner.replay.transitions, "")
    layout = ObservationLayout.of(config)
    need = Replay.bytes_needed(config.replay, layout, config.world.max_episode_steps)
    report.add("memory", need / 1e9, "GB")

    cycles: dict[str, Cycle] = {"navaclq": _ours(learner)}
    for name, make in (("cpprb", _cpprb), ("torchrl", _torchrl)):
        progress(0, f"filling {name}")
        try:
            cycles[name] = make(config, learner)
        except ImportError as error:
            report.skipped.append(f"{name}: {error}; pip install 'navaclq[bench]'")
        except RuntimeError as error:  # TorchRL's own word for an extension that was built for another torch
            report.skipped.append(f"{name}: {error}")
    ahead = config.replay.draw_ahead
    times: dict[tuple[str, int], list[float]] = {(name, n): [] for name in cycles for n in {1, ahead}}
    updates: list[float] = []
    torch.set_num_threads(1)
    for i in range(rounds):
        for (name, batches), seconds in times.items():
            seconds.append(_time(cycles[name], rng, batches, repeat=20) / batches)
        updates.append(_time(learner.sac.update, _sample(learner, 1)[0]))
        progress(i + 1, "")
    for (name, batches), seconds in times.items():
        report.add(f"{name}: cycle, {batches} at one go", 1e3 * median(seconds), "ms per batch")
    report.add("navaclq: SAC update", 1e3 * median(updates), "ms")

    def fastest(*names: str) -> list[float]:
        return [min(values) for values in zip(*(times[key] for key in times if key[0] in names), strict=True)]

    ours = fastest("navaclq")
    if len(cycles) > 1:
        report.compare("over_best_peer", fastest("cpprb", "torchrl"), ours)
    report.compare("update_over_replay_cost", updates, ours)
    return report


def _time(work: Callable[..., object], *arguments: object, repeat: int = 1) -> float:
    began = time.perf_counter()
    for _ in range(repeat):
        work(*arguments)
    return (time.perf_counter() - began) / repeat


def _sample(learner: Learner, batches: int) -> list[Batch]:
    sac = learner.config.sac
    return learner.replay.sample_many(
        batches, sac.batch_size, sac.n_step, sac.gamma, learner.config.replay.importance_start
    )


def _ours(learner: Learner) -> Cycle:
    def cycle(rng: np.random.Generator, batches: int) -> None:
        for batch in _sample(learner, batches):
            learner.replay.update_priorities(batch, rng.random(len(batch.rows)))

    return cycle


def _chunks(learner: Learner) -> Iterator[dict[str, np.ndarray]]:
    """As many transitions as a learner's replay holds, drawn from it, flat, for a rival."""
    capacity = learner.config.replay.capacity
    for start, end in pairwise([*range(0, capacity, CHUNK), capacity]):
        batch = learner.replay.sample(end - start, learner.config.sac.n_step, learner.config.sac.gamma, 0.0)
        flat = [
            np.concatenate([part.reshape(end - start, -1).astype(np.float16) for part in seen], axis=1)
            for seen in (batch.observation, batch.next_observation)
        ]
        yield {
            "obs": flat[0],
            "next_obs": flat[1],
            "action": batch.action,
            "reward": batch.reward[:, None],
            "discount": batch.discount[:, None],
        }


def _cpprb(config: Config, learner: Learner) -> Cycle:
    from cpprb import PrioritizedReplayBuffer

    size = {"shape": ObservationLayout.of(config).size, "dtype": np.float16}
    columns = {"obs": size, "next_obs": size, "action": {"shape": ACTION_SIZE}, "reward": {}, "discount": {}}
    buffer = PrioritizedReplayBuffer(
        config.replay.capacity, columns, alpha=config.replay.priority_exponent, eps=1e-6
    )
    for chunk in _chunks(learner):
        buffer.add(**chunk)

    def cycle(rng: np.random.Generator, batches: int) -> None:
        size = batches * config.sac.batch_size
        batch = buffer.sample(size, beta=config.replay.importance_start)
        buffer.update_priorities(batch["indexes"], rng.random(size))

    return cycle


def _torchrl(config: Config, learner: Learner) -> Cycle:
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer

    buffer = TensorDictPrioritizedReplayBuffer(
        alpha=config.replay.priority_exponent,
        beta=config.replay.importance_start,
        eps=1e-6,
        storage=LazyTensorStorage(config.replay.capacity),
        batch_size=config.sac.batch_size,
    )
    for chunk in _chunks(learner):
        tensors = {name: torch.from_numpy(np.ascontiguousarray(part)) for name, part in chunk.items()}
        buffer.extend(TensorDict(tensors, batch_size=len(chunk["obs"])))

    def cycle(rng: np.random.Generator, batches: int) -> None:
        size = batches * config.sac.batch_size
        batch = buffer.sample(size)
        batch["td_error"] = torch.from_numpy(rng.random(size))
        buffer.update_tensordict_priority(batch)

    return cycle
