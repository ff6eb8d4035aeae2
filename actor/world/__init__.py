"""The docking world in pybullet; importing this package registers `navaclq/Docking-v0` with Gymnasium."""

import gymnasium

gymnasium.register("navaclq/Docking-v0", entry_point="actor.world.env:DockingEnv")
