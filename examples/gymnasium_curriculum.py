"""A curriculum for an environment of one's own: NavACL-Q+ against uniform tasks (RND) on a toy.

An agent in the plane must reach a round goal in forty steps; only that is rewarded. It learns a linear
policy by REINFORCE. In uniform tasks it seldom succeeds by chance, and so has little to learn from; NavACL-Q+
begins with near, wide goals in calm air, and goes on to those whose outcome is uncertain.

    python examples/gymnasium_curriculum.py --seed 0

starts each curriculum itself. For an environment of one's own that is, in a shell and in the program,

    navaclq curriculum serve --config examples/gymnasium_curriculum.toml --listen tcp/127.0.0.1:7447
    env = CurriculumWrapper(env, "tcp/127.0.0.1:7447", Path("spool"), "env-0")
"""

import argparse
import math
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium
import numpy as np

from curriculum.gymnasium_wrapper import CurriculumWrapper
from deploy.launcher import free_port

CONFIG = Path(__file__).with_suffix(".toml")
PARAMETERS = tomllib.loads(CONFIG.read_text("utf-8"))["curriculum"]["parameters"]
STEPS, SPEED = 40, 0.1
NOISE, RATE = 0.5, 0.05
PART, EXAM = 60, 150
"""Episodes between two examinations, and tasks in one."""


class Reach(gymnasium.Env):
    """Reach the goal; it sees the direction to it, and the wind. Lengths in m, speeds in m per step."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):
        """Starts the task in `options`, or a random one."""
        super().reset(seed=seed)
        task = options or {p["name"]: self.np_random.uniform(p["low"], p["high"]) for p in PARAMETERS}
        self.place, self.gap = task["distance"] * self._somewhere(), task["gap"]
        self.wind, self.left = task["wind"] * self._somewhere(), STEPS
        return self._see(), {}

    def _somewhere(self):
        angle = self.np_random.uniform(0, 2 * math.pi)
        return np.array([math.cos(angle), math.sin(angle)])

    def _see(self):
        return np.concatenate([-self.place / np.linalg.norm(self.place), self.wind])

    def step(self, action):
        """Moves as the action says, at most at full speed, and with the wind."""
        own = action / max(1.0, np.linalg.norm(action))
        self.place = self.place + SPEED * (own + self.wind)
        self.left -= 1
        done = bool(np.linalg.norm(self.place) < self.gap / 2)
        return self._see(), float(done), done, self.left == 0, {"is_success": done}


class Learner:
    """REINFORCE: the action is normal around a linear function of what it sees."""

    def __init__(self, seed: int) -> None:
        self.weights, self.baseline = np.zeros((2, 4)), 0.0
        self.rng = np.random.default_rng(seed)

    def drive(self, env: gymnasium.Env, noise: float = NOISE) -> tuple[bool, np.ndarray]:
        """Success of an episode, and the gradient of the log-probability of its actions."""
        seen, _ = env.reset()
        gradient, ended, truncated = np.zeros((2, 4)), False, False
        while not (ended or truncated):
            chance = self.rng.normal(size=2)
            gradient += np.outer(chance, seen)
            seen, _, ended, truncated, info = env.step(self.weights @ seen + noise * chance)
        return info["is_success"], gradient / NOISE

    def learn(self, env: gymnasium.Env) -> None:
        """One episode, and a step along its gradient."""
        success, gradient = self.drive(env)
        self.weights += RATE * (success - self.baseline) * gradient / math.sqrt(STEPS)
        self.baseline += 0.05 * (success - self.baseline)


@contextmanager
def serving(variant: str) -> Iterator[str]:
    """A curriculum in a process of its own; gives its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "deploy.cli", "curriculum", "serve"]
    asked = ["--config", str(CONFIG), "--variant", variant, "--listen", endpoint]
    with subprocess.Popen([*command, *asked], stderr=subprocess.PIPE, text=True) as process:
        try:
            if not any("answers at" in line for line in process.stderr):
                raise SystemExit("the curriculum did not start")
            yield endpoint
        finally:
            process.terminate()


def train(variant: str, seed: int, parts: int) -> list[float]:
    """Success rates on the same uniform tasks before each part of the training, and after the last."""
    learner, rates = Learner(seed), []

    def examine() -> None:
        exam = Reach()
        exam.reset(seed=99)
        rates.append(float(np.mean([learner.drive(exam, noise=0.0)[0] for _ in range(EXAM)])))

    with serving(variant) as endpoint, tempfile.TemporaryDirectory() as spool:
        env = CurriculumWrapper(Reach(), endpoint, Path(spool), "reach-0")
        env.unwrapped.reset(seed=seed)
        examine()
        for _ in range(parts):
            for _ in range(PART):
                learner.learn(env)
            examine()
        env.close()
        told = f"{env.reports.sent} outcomes acknowledged, {env.unserved} resets unserved"
    print(f"{variant}: {told}", flush=True)
    return rates


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--seed", type=int, default=0, help="seed of environment, noise and learner")
parser.add_argument("--parts", type=int, default=4, help=f"examinations, one after each {PART} episodes")
options = parser.parse_args()

rnd, navacl = (train(variant, options.seed, options.parts) for variant in ("rnd", "navacl-q"))
print("episodes   RND  NavACL-Q+")
for part, (a, b) in enumerate(zip(rnd, navacl, strict=True)):
    print(f"{part * PART:8d}  {a:.2f}  {b:9.2f}")
