"""`bench sim`: the environment against the raw pybullet calls that one of its steps makes.

Each round drives one episode in a world, repeats the pybullet calls of the same steps on the same scene in
a bare loop, drives it again through Gymnasium, and drives nine worlds in one batch as an actor does; so all
rows see the same disturbances, and a ratio is the median over the rounds.

`actor` is worlds, encoder and policy, resets included. `actor_with_duties` does for every finished episode
what the service does besides: it looks at one more start for the curriculum, and spools the episode.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import torch

from actor.inference import Eyes, PolicyActor
from actor.rollout import Finished, Rollout
from actor.world.drive import advance, wheel_targets
from actor.world.env import DockingEnv
from actor.world.sensors import SOLID_GROUP
from actor.world.world import DockingWorld
from common.cells import CELLS
from common.config import Config
from common.delivery import Spool
from common.geometry import SE2
from common.messages import Origin, Version
from common.messages import encode as encode_message
from common.networks import Perception, Policy, compile_encoder, make_encoder, state_of
from common.observation import ObservationLayout
from common.tasks import Task, candidate_task, random_task
from deploy.bench.report import Report, rss

EPISODE = 22
"""Steps of an episode; an optimal one takes about so many, so resets weigh as in a trained actor."""
Driven = tuple[SE2, tuple[float, float], np.ndarray]
"""Pose and wheel speeds before a step, and its action."""


def bench_sim(
    config: Config, rounds: int, soak: int = 0, progress: Callable[[int], None] | None = None
) -> Report:
    """Measures for `rounds` rounds, then drives `soak` steps to see memory grow; `progress` hears rounds."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(config.seed)
    world, gym, crew = DockingWorld(config.world, EPISODE), _gym(config), _Crew(config, rng)
    encode, decide = _bare_networks(config)
    times: dict[str, list[float]] = {}
    for index in range(rounds + 1):  # the first warms up
        task = random_task(int(rng.integers(len(CELLS))), config, rng)
        reset, steps, driven = _drive(world, task, rng)
        measured = {
            "raw_calls": _time_raw(world, driven),
            "environment": steps,
            "gymnasium": _repeat(gym, task, driven),
            "actor": crew.time_steps(EPISODE, duties=False),
            "actor_with_duties": crew.time_steps(EPISODE, duties=True),
            "encoder": _time(encode, 5) / crew.worlds,
            "policy": _time(decide, 5) / crew.worlds,
            "reset": reset,
        }
        if index:
            for name, seconds in measured.items():
                times.setdefault(name, []).append(1e3 * seconds)
            if progress:
                progress(index)
    times["actor_limit"] = [
        sum(parts) for parts in zip(times["raw_calls"], times["encoder"], times["policy"], strict=True)
    ]
    report = Report("sim")
    for name in ("raw_calls", "environment", "gymnasium", "actor", "actor_with_duties", "actor_limit"):
        report.add(name, 1e3 / median(times[name]), "steps/s")
    for name in ("raw_calls", "environment", "encoder", "policy"):
        report.add(f"{name}_per_step", median(times[name]), "ms")
    report.add("reset", median(times["reset"]), "ms")
    report.add(f"rss_with_{crew.worlds + 2}_worlds", rss(), "MB")
    report.compare("env_over_raw", times["raw_calls"], times["environment"])
    report.compare("gymnasium_over_raw", times["raw_calls"], times["gymnasium"])
    report.compare("actor_over_limit", times["actor_limit"], times["actor"])
    report.compare("actor_with_duties_over_limit", times["actor_limit"], times["actor_with_duties"])
    if soak:
        report.add(f"rss_growth_over_{soak}_steps", _soak(world, crew, config, soak, rng), "MB")
    else:
        report.skipped.append("growth of memory: ask for it with --soak STEPS")
    for each in (world, gym, crew):
        each.close()
    return report


def _soak(world: DockingWorld, crew: _Crew, config: Config, steps: int, rng: np.random.Generator) -> float:
    """MB by which memory grows over so many steps, half of them in a world that changes its cell."""
    before, done = rss(), 0
    while done < steps:
        task = random_task(int(rng.integers(len(CELLS))), config, rng)
        alone = len(_drive(world, task, rng)[2])
        crew.time_steps(max(1, alone // crew.worlds), duties=True)
        done += 2 * alone
    return rss() - before


def _drive(world: DockingWorld, task: Task, rng: np.random.Generator) -> tuple[float, float, list[Driven]]:
    """Seconds of the reset, seconds of a step in the mean, and what was driven until the episode ended."""
    began = time.perf_counter()
    world.reset(task)
    reset, driven, ending = time.perf_counter() - began, list[Driven](), None
    actions = rng.uniform((0.0, -1.0), 1.0, (EPISODE, 2))
    total = 0.0
    while ending is None:
        action = actions[len(driven)]
        before = world.pose, world.speeds, action
        began = time.perf_counter()
        ending = world.step(action).ending
        if ending in (None, "timeout") or not driven:
            total += time.perf_counter() - began
            driven.append(before)
    return reset, total / len(driven), driven


def _gym(config: Config) -> DockingEnv:
    world = config.world.model_copy(update={"max_episode_steps": EPISODE})
    return DockingEnv(config.model_copy(update={"world": world}))


def _repeat(gym: DockingEnv, task: Task, driven: list[Driven]) -> float:
    """Seconds of a step in the mean, through Gymnasium."""
    gym.reset(options={"task": task})
    began = time.perf_counter()
    for _, _, action in driven:
        gym.step(action)
    return (time.perf_counter() - began) / len(driven)


def _time_raw(world: DockingWorld, driven: list[Driven]) -> float:
    """Seconds of the pybullet calls of one of these steps in the mean, all arguments made beforehand."""
    import pybullet as p

    config, client, robot = world.config, world.bullet._client, world.bodies.robot
    period = config.control_period / config.substeps
    scripts = []
    for pose, speeds, action in driven:
        targets = wheel_targets(config.robot, float(action[0]), float(action[1]))
        motion = advance(config.robot, pose, speeds, targets, period, config.substeps)
        poses = list(zip(motion.x.tolist(), motion.y.tolist(), motion.yaw.tolist(), strict=True))
        places = [((x, y, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))) for x, y, yaw in poses]
        scripts.append((places, world.camera.view(SE2(*poses[-1]))))
    size, light = config.camera.size, world.appearance.light
    projection = p.computeProjectionMatrixFOV(
        config.camera.fov, 1.0, config.camera.near, config.camera.far, physicsClientId=client
    )
    starts, ends = world.lidar.starts.tolist(), world.lidar.ends.tolist()
    began = time.perf_counter()
    for places, view in scripts:
        for place, turn in places:
            p.resetBasePositionAndOrientation(robot, place, turn, physicsClientId=client)
            p.performCollisionDetection(physicsClientId=client)
            p.getContactPoints(robot, physicsClientId=client)
        p.getCameraImage(
            size,
            size,
            view,
            projection,
            lightDirection=light.direction,
            lightColor=light.color,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=0.0,
            shadow=0,
            renderer=p.ER_TINY_RENDERER,
            flags=p.ER_NO_SEGMENTATION_MASK,
            physicsClientId=client,
        )
        p.rayTestBatch(
            starts,
            ends,
            parentObjectUniqueId=robot,
            parentLinkIndex=-1,
            collisionFilterMask=SOLID_GROUP,
            physicsClientId=client,
        )
    return (time.perf_counter() - began) / len(driven)


class _Crew:
    """The worlds of one actor in one batch; the policy is untrained."""

    def __init__(self, config: Config, rng: np.random.Generator) -> None:
        self._config, self._rng, self.worlds = config, rng, config.actor.worlds
        self._rollout = Rollout(config, Eyes(config, make_encoder(config)), self.worlds, EPISODE)
        self._actor = PolicyActor(config, self.worlds, np.random.default_rng(config.seed))
        networks = state_of(
            perception=Perception(config), policy=Policy(ObservationLayout.of(config), config.network)
        )
        self._actor.load(Version(counter=1), networks)
        for slot in range(self.worlds):
            self._actor.refresh(slot)
        self._folder = tempfile.TemporaryDirectory()
        self._spool = Spool(Path(self._folder.name), 2**30)

    def time_steps(self, count: int, duties: bool) -> float:
        """Seconds per environment step over `count` steps of every world, resets included."""
        began, before = time.perf_counter(), self._rollout.steps
        for _ in range(count):
            for slot in self._rollout.idle:
                self._rollout.reset(slot, random_task(slot % len(CELLS), self._config, self._rng))
            for finished in self._rollout.step(self._actor):
                if duties:
                    self._do_duties(finished)
        return (time.perf_counter() - began) / (self._rollout.steps - before)

    def _do_duties(self, finished: Finished) -> None:
        """What ActorService does at the end of an episode, but for the bus, which has threads of its own."""
        slot = finished.slot
        episode = finished.message({}, Version(), Version(), "random")
        origin = Origin(actor="bench", boot="bench", seq=self._rollout.steps)
        self._spool.put(origin, "episode", encode_message(episode))
        for waiting in self._spool.bundle(set())[1]:
            self._spool.remove(waiting)
        self._rollout.look(slot, candidate_task(slot % len(CELLS), self._config, self._rng))

    def close(self) -> None:
        self._rollout.close()
        self._folder.cleanup()


def _bare_networks(config: Config) -> tuple[Callable[[], object], Callable[[], object]]:
    """One pass of the encoder in ONNX Runtime and of the policy in torch, for nine worlds."""
    size, worlds, layout = config.world.camera.size, config.actor.worlds, ObservationLayout.of(config)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (worlds, config.encoder.frames_per_code, size, size, 3), dtype=np.uint8)
    encode = None if config.encoder.end_to_end else compile_encoder(make_encoder(config), size)
    policy = Policy(layout, config.network).eval()
    flat, noise = torch.zeros(worlds, layout.size), torch.zeros(worlds, 2)

    def decide() -> object:
        with torch.inference_mode():
            return policy.sample(flat, noise)

    return (lambda: encode(frames)) if encode else (lambda: None), decide


def _time(call: Callable[[], object], times: int) -> float:
    """Median seconds of a call."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return median(taken)
