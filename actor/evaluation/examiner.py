"""Drives a policy through tasks, in worker processes that share nothing, and keeps what was driven."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from actor.baseline.registry import make_baseline
from actor.evaluation.measures import Drive
from actor.evaluation.work_list import WorkList
from actor.inference import Actor, Blind, Eyes, PolicyActor
from actor.rollout import Rollout
from actor.world.world import DockingWorld
from common.cells import CELLS
from common.config import Config, override
from common.errors import UsageError
from common.files import content_hash
from common.messages import Version
from common.networks import load_state, make_encoder
from common.policy_files import CONFIG, NETWORKS, load_policy
from common.tasks import Task

CHUNK = 22
"""Tasks of one piece of work. Always the same ones drive side by side, so that all is repeated to the bit."""
SLOTS = len(CELLS)


@dataclass(frozen=True, slots=True)
class Rival:
    """Stands for a policy: a baseline by its name, in the world of `config`."""

    name: str
    config: Config

    def __str__(self) -> str:
        return self.name


Subject = Path | Rival
"""Who is examined: the folder of a policy, or a baseline."""


@dataclass(frozen=True, slots=True)
class Terms:
    """How a subject is examined."""

    greedy: bool = True
    seed: int = 0
    """Of sampled actions."""
    overrides: tuple[str, ...] = ()
    """Settings of the world on top of the subject's own."""
    max_steps: int | None = None
    """By default the configured length of an evaluation."""


def world_of(subject: Subject, terms: Terms = Terms()) -> Config:
    """The configuration in which a subject drives; raises UsageError when there is none."""
    config = subject.config if isinstance(subject, Rival) else load_policy(subject)[0]
    return override(config.model_dump(mode="json"), terms.overrides) if terms.overrides else config


def identity(subject: Subject) -> str:
    """What a subject is by its content: a hash of a policy's files, or a baseline's name and world."""
    if isinstance(subject, Rival):
        return f"{subject.name} {content_hash(subject.config.to_toml().encode())}"
    load_policy(subject)  # or a missing or damaged file would have no sentence
    return content_hash((subject / CONFIG).read_bytes() + (subject / NETWORKS).read_bytes())


def load_driver(subject: Subject, terms: Terms, slots: int) -> tuple[Rollout, Actor]:
    """Worlds and what drives in them; raises UsageError when `subject` is no policy, or damaged."""
    config = world_of(subject, terms)
    limit = terms.max_steps or config.world.max_evaluation_steps
    if isinstance(subject, Rival):
        rollout = Rollout(config, Blind(config), slots, limit)
        return rollout, make_baseline(subject.name, rollout)
    encoder, tensors = make_encoder(config), load_policy(subject)[1]
    actor = PolicyActor(config, slots, np.random.default_rng(0), terms.greedy)
    try:
        if not config.encoder.end_to_end:
            load_state(tensors, encoder=encoder)
        actor.load(Version(counter=1), tensors)
    except ValueError as error:
        raise UsageError(f"{subject} holds other networks than its configuration says: {error}") from None
    for slot in range(slots):
        actor.refresh(slot)
    return Rollout(config, Eyes(config, encoder), slots, limit), actor


class Examiner:
    """Drives one subject through tasks, side by side in as many worlds as there are cells."""

    def __init__(self, subject: Subject, terms: Terms) -> None:
        torch.set_num_threads(1)
        self._rollout, self._actor = load_driver(subject, terms, SLOTS)

    def run(self, tasks: Sequence[Task], rng: np.random.Generator) -> list[Drive]:
        """The drives, in the tasks' order; `rng` draws the actions unless they are greedy."""
        if isinstance(self._actor, PolicyActor):
            self._actor.rng = rng
        worlds = self._rollout.worlds
        waiting = list(enumerate(tasks))[::-1]
        running: dict[int, tuple[int, list[tuple[float, ...]]]] = {}
        drives: dict[int, Drive] = {}
        while waiting or running:
            for slot in self._rollout.idle:
                if waiting:
                    index, task = waiting.pop()
                    self._rollout.reset(slot, task)
                    running[slot] = index, [_row(worlds[slot])]
            finished = self._rollout.step(self._actor)
            for slot, (_, rows) in running.items():
                rows.append(_row(worlds[slot]))
            for episode in finished:
                index, rows = running.pop(episode.slot)
                dolly = worlds[episode.slot].dolly
                drives[index] = Drive(episode.ending, np.array(rows, np.float32), dolly)
        return [drives[index] for index in range(len(tasks))]


def _row(world: DockingWorld) -> tuple[float, ...]:
    return world.pose.x, world.pose.y, world.pose.yaw, sum(world.speeds) / 2


_examiner: Examiner | None = None


def _start_worker(subject: Subject, terms: Terms) -> None:
    global _examiner
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    _examiner = Examiner(subject, terms)


def _examine(work: tuple[int, Sequence[Task], int]) -> tuple[int, list[Drive]]:
    assert _examiner is not None
    first, tasks, seed = work
    return first, _examiner.run(tasks, np.random.default_rng([seed, 4, first]))


def examine(
    subject: Subject,
    tasks: Sequence[Task],
    processes: int,
    terms: Terms = Terms(),
    progress: Callable[[int], None] | None = None,
    work: WorkList | None = None,
) -> list[Drive]:
    """The drives, in the tasks' order; `progress` hears the number done.

    What `work` holds already is not driven again, and everything that is driven is in it at once, a piece of
    work as a whole. Raises UsageError for a bad subject or an impossible task.
    """
    load_driver(subject, terms, 0)  # a bad one is refused here, not in a worker
    drives = work.load() if work else {}
    pieces = [(i, tasks[i : i + CHUNK], terms.seed) for i in range(0, len(tasks), CHUNK)]
    missing = [piece for piece in pieces if any(piece[0] + k not in drives for k in range(len(piece[1])))]

    def take(first: int, found: list[Drive]) -> None:
        if work:
            work.add(first, found)
        drives.update({first + k: drive for k, drive in enumerate(found)})
        if progress:
            progress(len(drives))

    if progress and drives:
        progress(len(drives))
    if missing:
        context = multiprocessing.get_context("spawn")
        with context.Pool(min(processes, len(missing)), _start_worker, (subject, terms)) as pool:
            for first, found in pool.imap_unordered(_examine, missing):
                take(first, found)
    return [drives[index] for index in range(len(tasks))]
