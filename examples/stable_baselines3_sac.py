"""Another library's SAC on `navaclq/Docking-v0`: of this project it uses the Gymnasium environment alone.

Stable-Baselines3 takes Dict observations as they are, but one image instead of four: a wrapper stacks the
frames as channels. A few thousand steps show that it runs; learning to dock takes far more.

    pip install 'navaclq[examples]'
    python examples/stable_baselines3_sac.py --steps 2000 --seed 0
"""

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import SAC

import actor.world  # noqa: F401 - registers navaclq/Docking-v0


class FramesAsChannels(gymnasium.ObservationWrapper):
    """Camera (4, S, S, 3) to one image (S, S, 12), oldest frame first."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        count, height, width, colours = env.observation_space["camera"].shape
        image = gymnasium.spaces.Box(0, 255, (height, width, count * colours), np.uint8)
        self.observation_space = gymnasium.spaces.Dict({**env.observation_space, "camera": image})

    def observation(self, observation: dict) -> dict:
        """The observation with its frames side by side in the last axis."""
        return observation | {"camera": np.concatenate(observation["camera"], axis=-1)}


def drive(model: SAC, env: gymnasium.Env) -> tuple[float, bool]:
    """Sum of rewards of one episode with the mean actions, and whether it docked."""
    observation, _ = env.reset()
    total, ended, truncated = 0.0, False, False
    while not (ended or truncated):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, ended, truncated, info = env.step(action)
        total += reward
    return total, info["is_success"]


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--steps", type=int, default=2000, help="environment steps to train for")
parser.add_argument("--seed", type=int, default=0, help="seed of networks, actions and tasks")
options = parser.parse_args()

env = FramesAsChannels(gymnasium.make("navaclq/Docking-v0"))
model = SAC(
    "MultiInputPolicy",
    env,
    buffer_size=5_000,  # a transition takes 150 kB
    batch_size=32,
    train_freq=8,
    learning_starts=200,
    seed=options.seed,
)
model.learn(options.steps)
rewards, successes = zip(*(drive(model, env) for _ in range(10)), strict=True)
env.close()
print(f"10 episodes: mean reward {np.mean(rewards):.2f}, success rate {np.mean(successes):.2f}")
