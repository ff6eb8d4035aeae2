"""SAC updates per second against stable-baselines3's and against the matrix products alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from statistics import median

import numpy as np
import torch
from torch import Tensor

from common.config import Config, override
from common.observation import ACTION_SIZE, ObservationLayout
from deploy.bench.replay import synthetic_episode
from deploy.bench.report import Report, rss
from learner.learner import Learner

THREADS = (1, 2)
UPDATES = 10
"""Updates that are timed together."""
TRANSITIONS = 20_000


def bench_learner(config: Config, rounds: int, progress: Callable[[int, str], None]) -> Report:
    """Times whole updates, sampling and priorities included; rivals, limit and thread counts take turns.

    `config` must ask for what stable-baselines3 computes: no LayerNorm, no branches, no policy delay.
    """
    report = Report("learner")
    works: dict[str, Callable[[], None]] = {"navaclq": _ours(config), "products": _products(config)}
    try:
        works["sb3"] = _sb3(config)
    except ImportError as error:
        report.skipped.append(f"stable-baselines3: {error}; pip install 'navaclq[bench]'")
    times: dict[tuple[str, int], list[float]] = {(name, n): [] for n in THREADS for name in works}
    for i in range(rounds):
        for threads in THREADS:
            torch.set_num_threads(threads)
            for name, work in works.items():
                began = time.perf_counter()
                work()
                times[name, threads].append((time.perf_counter() - began) / UPDATES)
        progress(i + 1, "")
    for (name, threads), seconds in times.items():
        report.add(f"{name}, {threads} thread(s)", 1 / median(seconds), "updates/s")
    for threads in THREADS:
        suffix = f"_{threads}_thread{'s' if threads > 1 else ''}"
        of_limit = "over_matmul_limit" + (suffix if threads > 1 else "")
        ours, limit = times["navaclq", threads], times["products", threads]
        if "sb3" in works:
            theirs = times["sb3", threads]
            report.compare(f"over_sb3{suffix}", theirs, ours)
            report.compare(f"sb3_{of_limit}", limit, theirs)
        report.compare(of_limit, limit, ours)
    return report


def soak_learner(config: Config, updates: int, progress: Callable[[int, str], None]) -> float:
    """MB by which memory grows over so many updates, after a tenth as many to warm up.

    Networks and batches are small, the replay overwrites itself all the time, and checkpoints are taken.
    """
    small = (
        "network.hidden=[32, 32]",
        "sac.batch_size=32",
        "replay.capacity=4000",
        "replay.warmup_steps=1000",
    )
    torch.set_num_threads(1)
    learner = Learner(override(config.model_dump(mode="json"), small))
    rng, steps, done, first = np.random.default_rng(config.seed), 25, 0, 0
    before, warm = 0.0, max(1, updates // 10)
    while done < updates + warm:
        learner.insert(synthetic_episode(config, steps, rng), first)
        first += steps
        while learner.update(first):
            done += 1
            if done % 1000 == 0:
                learner.save()
                progress(min(done, updates), "")
            if done == warm:
                before = rss()
    return rss() - before


def _ours(config: Config) -> Callable[[], None]:
    learner, rng = Learner(config), np.random.default_rng(config.seed)
    steps = config.world.max_episode_steps // 4
    for first in range(0, TRANSITIONS, steps):
        learner.insert(synthetic_episode(config, steps, rng), first)

    def work() -> None:
        for _ in range(UPDATES):
            learner.limiter.balance = 0.0
            learner.update(0)

    return work


def _sb3(config: Config) -> Callable[[], None]:
    import gymnasium
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import Logger

    class Still(gymnasium.Env[np.ndarray, np.ndarray]):
        """The spaces of an environment, which is all that is asked of it here."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (ObservationLayout.of(config).size,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,))

    sac = config.sac
    model = SAC(
        "MlpPolicy",
        Still(),
        learning_rate=sac.learning_rate,
        buffer_size=TRANSITIONS,
        batch_size=sac.batch_size,
        tau=sac.tau,
        gamma=sac.gamma,
        ent_coef=f"auto_{sac.initial_alpha}",
        target_entropy=sac.target_entropy,
        policy_kwargs={"net_arch": list(config.network.hidden)},
        seed=config.seed,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    rng, shape = np.random.default_rng(config.seed), (1, ObservationLayout.of(config).size)
    assert model.replay_buffer is not None
    for _ in range(TRANSITIONS):
        now, after = (rng.random(shape, np.float32) for _ in range(2))
        action, reward = rng.uniform(-1, 1, (1, ACTION_SIZE)), rng.uniform(-1, 0, 1)
        model.replay_buffer.add(now, after, action, reward, np.zeros(1), [{}])
    return lambda: model.train(gradient_steps=UPDATES, batch_size=sac.batch_size)


def _products(config: Config) -> Callable[[], None]:
    """The products that an update cannot do without, into memory that is there already.

    Forward: policy on both observations, critics on three pairs, of which two have one observation and so its
    part of the first layer in common. Backward: the weights of critics and policy, and what lies between
    their layers; of the input only the actions' part, and that for the policy alone.
    """
    batch, state = config.sac.batch_size, ObservationLayout.of(config).size
    hidden = config.network.hidden

    def forward(inputs: int, outputs: int) -> list[tuple[int, int, int]]:
        return [(batch, a, b) for a, b in pairwise((inputs, *hidden, outputs))]

    def weights(inputs: int, outputs: int) -> list[tuple[int, int, int]]:
        return [(a, batch, b) for a, b in pairwise((inputs, *hidden, outputs))]

    def between(outputs: int) -> list[tuple[int, int, int]]:
        return [(batch, b, a) for a, b in pairwise((*hidden, outputs))]

    critic, policy = (state + ACTION_SIZE, 1), (state, 2 * ACTION_SIZE)
    shapes = 2 * forward(*policy) + weights(*policy) + between(policy[1])
    shapes += 2 * (2 * forward(*critic) + weights(*critic) + 2 * between(critic[1]))
    shapes += 2 * [(batch, ACTION_SIZE, hidden[0]), *forward(*critic)[1:]]
    shapes += 2 * [(batch, hidden[0], ACTION_SIZE)]
    work: list[tuple[Tensor, Tensor, Tensor]] = [
        (torch.randn(m, k), torch.randn(k, n), torch.empty(m, n)) for m, k, n in shapes
    ]

    def run() -> None:
        for _ in range(UPDATES):
            for a, b, out in work:
                torch.mm(a, b, out=out)

    return run
