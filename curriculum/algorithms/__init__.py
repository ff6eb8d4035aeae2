"""The algorithms of the curriculum, one interface: see base.py."""

from __future__ import annotations

from common.config import Config
from curriculum.algorithms.base import Algorithm
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.algorithms.rnd import Rnd
from curriculum.algorithms.schedule import Schedule
from curriculum.algorithms.sfl import Sfl
from curriculum.task_space import TaskSpace


def make_algorithm(config: Config, space: TaskSpace) -> Algorithm:
    """The algorithm that a configuration names, at its beginning."""
    settings = config.curriculum
    match settings.algorithm:
        case "rnd":
            return Rnd()
        case "schedule":
            return Schedule(settings.schedule)
        case "sfl":
            return Sfl(settings.sfl)
        case _:
            return NavaclQ(settings, space, config.seed)
