"""Drives a policy through tasks, in worker processes that share nothing, and keeps what was driven."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

from actor.baseline.registry import make_baseline
from actor.evaluation.measures import Drive
from actor.evaluation.work_list import WorkList
from actor.inference import Actor, Blind, Eyes, PolicyActor
from actor.rollout import Rollout
from actor.world.world import DockingWorld
from common.cells import CELLS
from common.config import Config, override
from common.errors import RunError, UsageError
from common.files import content_hash
from common.messages import Version
from common.networks import load_state, make_encoder
from common.policy_files import NETWORKS, load_policy
from common.signals import workers_start
from common.tasks import Task

CHUNK = 22
"""Tasks of one piece of work. Always the same ones drive side by side, so that all is repeated to the bit."""
SLOTS = len(CELLS)


@dataclass(frozen=True, slots=True)
class Rival:
    """A baseline by its name, in the world of `config`."""

    name: str
    config: Config

    @property
    def identity(self) -> str:
        """What it is by its content."""
        return f"{self.name} {content_hash(self.config.to_toml().encode())}"


@dataclass(frozen=True, slots=True)
class Trained:
    """A policy as read once from its folder, which may be replaced while it drives."""

    name: str
    config: Config
    networks: bytes
    """Safetensors."""

    @classmethod
    def read(cls, folder: Path) -> Trained:
        """Raises UsageError when `folder` is no policy, or a damaged one."""
        config, _ = load_policy(folder)
        try:
            return cls(str(folder), config, (folder / NETWORKS).read_bytes())
        except OSError as error:
            raise UsageError(f"{folder / NETWORKS} cannot be read: {error.strerror}") from None

    @property
    def identity(self) -> str:
        """What it is by its content."""
        return content_hash(self.config.to_toml().encode() + self.networks)


Subject = Trained | Rival
"""Who is examined."""


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


def world_of(subject: Subject, terms: Terms) -> Config:
    """The configuration in which a subject drives."""
    return override(subject.config.model_dump(mode="json"), terms.overrides)


def load_driver(subject: Subject, terms: Terms, slots: int) -> tuple[Rollout, Actor]:
    """Worlds and what drives in them; raises UsageError for networks that do not fit."""
    config = world_of(subject, terms)
    limit = terms.max_steps or config.world.max_evaluation_steps
    if isinstance(subject, Rival):
        rollout = Rollout(config, Blind(config), slots, limit)
        return rollout, make_baseline(subject.name, rollout)
    encoder, actor = make_encoder(config), PolicyActor(config, slots, np.random.default_rng(0), terms.greedy)
    try:
        tensors = safetensors.torch.load(subject.networks)
        if not config.encoder.end_to_end:
            load_state(tensors, encoder=encoder)
        actor.load(Version(counter=1), tensors)
    except (ValueError, safetensors.SafetensorError) as error:
        raise UsageError(
            f"{subject.name} holds other networks than its configuration says: {error}"
        ) from None
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


Piece = tuple[int, Sequence[Task]]
"""Number of the first task, and tasks that drive side by side."""


def _work(pipe: Connection) -> None:
    """A worker process: told subject and terms, drives each piece that comes, until its parent has gone."""
    try:
        subject, terms = pipe.recv()
        examiner = Examiner(subject, terms)
        while True:
            first, tasks = pipe.recv()
            try:
                found: list[Drive] | UsageError = examiner.run(
                    tasks, np.random.default_rng([terms.seed, 4, first])
                )
            except UsageError as error:
                found = error
            pipe.send((first, found))
    except (EOFError, OSError):
        return


def _drive(
    subject: Subject, terms: Terms, pieces: Sequence[Piece], processes: int
) -> Iterator[tuple[int, list[Drive]]]:
    """Pieces as they are driven. Raises UsageError for an impossible task, RunError when a worker dies."""
    context = multiprocessing.get_context("spawn")
    waiting, workers, busy = list(pieces)[::-1], [], list[Connection]()
    try:
        for _ in range(min(processes, len(pieces))):
            ours, theirs = context.Pipe()
            worker = context.Process(target=_work, args=(theirs,), daemon=True)
            with workers_start():
                worker.start()
                workers.append(worker)
            theirs.close()
            busy.append(ours)
        try:
            for pipe in busy:
                pipe.send((subject, terms))  # as arguments they would hold up the start until torch is loaded
                pipe.send(waiting.pop())
            while busy:
                for ready in wait(busy):
                    assert isinstance(ready, Connection)
                    first, found = ready.recv()
                    if isinstance(found, UsageError):
                        raise found
                    if waiting:
                        ready.send(waiting.pop())
                    else:
                        busy.remove(ready)
                    yield first, found
        except (EOFError, OSError):
            raise RunError(
                "a worker process of the evaluation died; what was driven is kept, run it again"
            ) from None
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join()


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
    work as a whole. Raises UsageError for networks that do not fit or an impossible task, RunError when a
    worker dies.
    """
    load_driver(subject, terms, 0)  # what does not fit is refused here, not in a worker
    drives = work.load() if work else {}
    pieces = [(i, tasks[i : i + CHUNK]) for i in range(0, len(tasks), CHUNK)]
    missing = [piece for piece in pieces if any(piece[0] + k not in drives for k in range(len(piece[1])))]
    for done, found in _drive(subject, terms, missing, processes):
        if work:
            work.add(done, found)
        drives.update({done + k: drive for k, drive in enumerate(found)})
        if progress:
            progress(len(drives))
    return [drives[index] for index in range(len(tasks))]
