"""The docking world in pybullet and its Gymnasium environment."""
