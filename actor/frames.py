"""Filming random drives: the frames that the encoder is pre-trained on, and those that examine it."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import zenoh

from actor.world.world import DockingWorld
from common.bus import Keys, Member, announce
from common.cells import CELLS, arena_index
from common.config import Config
from common.delivery import Sender, Spool, count_life
from common.frames import Film
from common.geometry import bearing, wrap
from common.messages import ContractReply, Frames
from common.signals import stop_on_signals, workers_start
from common.tasks import FIRST_SUITE_SEED, Task, narrowed_task
from common.telemetry import Rate, Reporter

log = logging.getLogger(__name__)
SPREAD = 0.6
"""Standard deviation of an action; that of uniform ones is 0.58."""
SMOOTHEST = 0.95
"""Largest correlation of an action with the one before."""


def film(world: DockingWorld, task: Task, rng: np.random.Generator, steps: int) -> Film:
    """A drive with random actions, from shaking on the spot to long curves; raises what `place` raises."""
    world.place(task)
    smoothness = rng.uniform(0.0, SMOOTHEST)
    action = SPREAD * rng.standard_normal(2)
    shots = [_shoot(world, rng)]
    for _ in range(steps):
        _, ending = world.advance(action)
        shots.append(_shoot(world, rng))
        if ending:
            break
        fresh = SPREAD * rng.standard_normal(2)
        action = smoothness * action + math.sqrt(1 - smoothness**2) * fresh
    frames, masks, goals = zip(*shots, strict=True)
    return Film(np.stack(frames), np.stack(masks), np.array(goals, np.float32))


def _shoot(
    world: DockingWorld, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, tuple[float, float, float]]:
    frame, bodies = world.camera.sense_bodies(world.pose, rng)
    robot, dolly = world.pose, world.dolly
    goal = (
        bearing(robot, dolly.x, dolly.y),
        math.hypot(dolly.x - robot.x, dolly.y - robot.y),
        wrap(dolly.yaw - robot.yaw),
    )
    return frame, np.packbits(bodies == world.bodies.dolly), goal


PROBE_SETS = {"fit": "training", "training": "training", "validation": "validation"}
"""Sets of frames that examine an encoder, and where they are filmed."""
PROBE_STEPS = 8
FIRST_PROBE_SEED = 6 * FIRST_SUITE_SEED


def probe_tasks(name: str, config: Config) -> list[Task]:
    """Where the drives of a probe set begin: the same ones every time, none of them ever trained on."""
    index = list(PROBE_SETS).index(name)
    rng, tasks = np.random.default_rng([index, 7]), []
    for i in range(config.pretraining.probe_drives):
        task = narrowed_task(i % len(CELLS), config, rng, config.pretraining.near_share)
        cell = task.cell if PROBE_SETS[name] == "training" else arena_index(PROBE_SETS[name])
        seed = FIRST_PROBE_SEED + index * 2**20 + i
        tasks.append(task.model_copy(update={"cell": cell, "seed": seed}))
    return tasks


def film_all(
    tasks: list[Task], config: Config, progress: Callable[[int], None] = lambda done: None
) -> list[Film]:
    """A drive of up to PROBE_STEPS from each task, in order, on all cores; `progress` hears how many."""
    chunks = [tasks[i::FILM_CHUNKS] for i in range(FILM_CHUNKS)]
    films: list[Film | None] = [None] * len(tasks)
    done = 0
    with ExitStack() as stack:
        with workers_start():
            pool = stack.enter_context(
                multiprocessing.get_context("spawn").Pool(os.cpu_count(), _start_worker, (config,))
            )
        for index, found in enumerate(pool.imap(_film_chunk, chunks)):
            films[index::FILM_CHUNKS] = found
            done += len(found)
            progress(done)
    return [film for film in films if film is not None]


FILM_CHUNKS = len(CELLS)
"""Tasks go through the training cells in turn: so a chunk stays in one room."""


_world: DockingWorld | None = None


def _start_worker(config: Config) -> None:
    global _world
    _world = DockingWorld(config.world, config.world.max_episode_steps)


def _film_chunk(tasks: list[Task]) -> list[Film]:
    assert _world is not None
    return [film(_world, task, np.random.default_rng([task.seed, 8]), PROBE_STEPS) for task in tasks]


class FrameService:
    """An actor process of a pre-training: films drives in its cells in turn and ships them."""

    def __init__(
        self,
        session: zenoh.Session,
        contract: ContractReply,
        config: Config,
        member: Member,
        spool: Path,
        cells: list[int],
    ) -> None:
        self.config, self.contract = config, contract
        self.keys = Keys(contract.run)
        self._token = announce(session, self.keys, member)
        self._rng = np.random.default_rng([config.seed, 5, count_life(spool), *member.name.encode()])
        self._worlds = {cell: DockingWorld(config.world, config.world.max_episode_steps) for cell in cells}
        self._sender = Sender(
            session,
            Spool(spool / "learner", config.actor.spool_megabytes * 2**20),
            member,
            uuid.uuid4().hex[:12],
        )
        self._reporter = Reporter(session, self.keys, member)
        self._frames, self._rate = 0, Rate()

    @property
    def worlds(self) -> int:
        """How many worlds it drives."""
        return len(self._worlds)

    def run(self) -> None:
        """Films until SIGTERM or SIGINT."""
        stopping = stop_on_signals()
        while not stopping.is_set():
            for cell, world in self._worlds.items():
                while self._sender.spool.full and not stopping.is_set():
                    stopping.wait(0.1)  # back-pressure: the receiver is behind or away
                if stopping.is_set():
                    break
                task = narrowed_task(cell, self.config, self._rng, self.config.pretraining.near_share)
                found = film(world, task, self._rng, self.config.pretraining.drive_steps)
                message = Frames(digest=self.contract.digest, task=task, **found._asdict())
                self._sender.put(self.keys.frames, message)
                self._frames += len(found.frame)
                if self._reporter.due:
                    rate = round(self._rate.read(self._frames), 1)
                    refused = sum(self._sender.refused.values())
                    self._reporter.report({"frames": self._frames, "frames_per_s": rate, "refused": refused})

    def close(self) -> None:
        """What is waiting stays in the spool."""
        self._sender.close(patience=0.2)
        for world in self._worlds.values():
            world.close()
