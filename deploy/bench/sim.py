"""`bench sim`: the environment against the raw pybullet calls that one of its steps makes.

Each round drives one episode in the environment, repeats the pybullet calls of the same steps on the same
scene in a bare loop, and drives nine worlds as an actor does; so all rows see the same disturbances, and a
ratio is the median over the rounds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import torch

from actor.inference import Eyes, PolicyActor
from actor.rollout import Rollout
from actor.world.drive import advance, wheel_targets
from actor.world.env import DockingEnv
from actor.world.sensors import SOLID_GROUP
from actor.world.world import DockingWorld
from common.cells import CELLS
from common.config import Config
from common.geometry import SE2
from common.messages import Version
from common.networks import Perception, Policy, compile_encoder, make_encoder, state_of
from common.observation import ObservationLayout
from common.tasks import Task, random_task
from deploy.bench.report import Report

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
    raw, full, wrapped, resets, actor, encoder, policy = (list[float]() for _ in range(7))
    for index in range(rounds + 1):  # the first warms up
        task = random_task(int(rng.integers(len(CELLS))), config, rng)
        reset, steps, driven = _drive(world, task, rng)
        bare = _time_raw(world, driven)
        gym_steps = _repeat(gym, task, driven)
        acting = crew.time_steps(EPISODE)
        seen, decided = _time(encode, 5), _time(decide, 5)
        if index:
            for values, value in zip(
                (raw, full, wrapped, resets, actor, encoder, policy),
                (bare, steps, gym_steps, reset, acting, seen, decided),
                strict=True,
            ):
                values.append(1e3 * value)
            if progress:
                progress(index)
    worlds = len(CELLS)
    limit = [a + (e + p) / worlds for a, e, p in zip(raw, encoder, policy, strict=True)]
    report = Report("sim")
    report.add("raw_calls", 1e3 / median(raw), "steps/s")
    report.add("environment", 1e3 / median(full), "steps/s")
    report.add("gymnasium", 1e3 / median(wrapped), "steps/s")
    report.add("actor", 1e3 / median(actor), "steps/s")
    report.add("actor_limit", 1e3 / median(limit), "steps/s")
    report.add("raw_calls_step", median(raw), "ms")
    report.add("environment_step", median(full), "ms")
    report.add("encoder_of_nine", median(encoder), "ms")
    report.add("policy_of_nine", median(policy), "ms")
    report.add("reset", median(resets), "ms")
    report.add("rss_with_eleven_worlds", _rss(), "MB")
    report.ratios["env_over_raw"] = median(a / b for a, b in zip(raw, full, strict=True))
    report.ratios["actor_over_limit"] = median(a / b for a, b in zip(limit, actor, strict=True))
    if soak:
        before, done = _rss(), 0
        while done < soak:
            task = random_task(int(rng.integers(len(CELLS))), config, rng)
            done += len(_drive(world, task, rng)[2])
        report.add(f"rss_growth_over_{soak}_steps", _rss() - before, "MB")
    else:
        report.skipped.append("growth of memory: ask for it with --soak STEPS")
    for each in (world, gym, crew):
        each.close()
    return report


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
    """Nine worlds in one batch, as an actor process drives them; the policy is untrained."""

    def __init__(self, config: Config, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._rollout = Rollout(config, Eyes(config, make_encoder(config)), len(CELLS), EPISODE)
        self._actor = PolicyActor(config, len(CELLS), np.random.default_rng(config.seed))
        networks = state_of(
            perception=Perception(config), policy=Policy(ObservationLayout.of(config), config.network)
        )
        self._actor.load(Version(counter=1), networks)
        for slot in range(len(CELLS)):
            self._actor.refresh(slot)

    def time_steps(self, count: int) -> float:
        """Seconds per environment step over `count` steps of every world, resets included."""
        began, before = time.perf_counter(), self._rollout.steps
        for _ in range(count):
            for slot in self._rollout.idle:
                self._rollout.reset(slot, random_task(slot, self._config, self._rng))
            self._rollout.step(self._actor)
        return (time.perf_counter() - began) / (self._rollout.steps - before)

    def close(self) -> None:
        self._rollout.close()


def _bare_networks(config: Config) -> tuple[Callable[[], object], Callable[[], object]]:
    """One pass of the encoder in ONNX Runtime and of the policy in torch, for nine worlds."""
    size, worlds, layout = config.world.camera.size, len(CELLS), ObservationLayout.of(config)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (worlds, config.encoder.frames_per_code, size, size, 3), dtype=np.uint8)
    encode = compile_encoder(make_encoder(config), size)
    policy = Policy(layout, config.network).eval()
    flat, noise = torch.zeros(worlds, layout.size), torch.zeros(worlds, 2)

    def decide() -> object:
        with torch.inference_mode():
            return policy.sample(flat, noise)

    return lambda: encode(frames), decide


def _time(call: Callable[[], object], times: int) -> float:
    """Median seconds of a call."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return median(taken)


def _rss() -> float:
    """Memory of this process, MB."""
    status = Path("/proc/self/status").read_text("ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024
