"""Actors: the docking world, the rollout worker and evaluation."""
