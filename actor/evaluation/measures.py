"""What is measured of a drive, and of many: pure functions on tracks, without simulator."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.geometry import SE2, wrap
from common.messages import ENDINGS, Ending
from common.world_config import WorldConfig

Z95 = 1.959963984540054
"""The normal distribution's 97.5% quantile."""
STANDING = 0.05
"""Forward speeds below this are neither ahead nor back, m/s."""
FASTEST = 1.0
"""Largest speed (m/s) and rate of turn (rad/s) that an action can ask for."""
WORST = 0.1
"""Share of the start positions over which CVaR is the mean."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """An episode as driven: `track` (T + 1, 4) float32 rows of x, y (m), yaw (rad), forward speed (m/s)."""

    ending: Ending
    track: NDArray[np.float32]
    """At the start and after each control step, in the cell's frame."""
    dolly: SE2
    """Where the dolly stood at the end."""


@dataclass(frozen=True, slots=True)
class Measures:
    """Of one drive; units m, s, rad."""

    ending: Ending
    time: float
    """Control steps times their period."""
    path_length: float
    """Of the robot's centre, from one control step to the next."""
    spl: float
    """Success weighted by path length (Anderson et al. 2018), against `shortest_length`; 0 for a failure."""
    sct: float
    """Success weighted by completion time (Yokoyama et al. 2021), against `fastest_time`."""
    lateral_error: float
    """Unsigned distance of the robot's centre from the dolly's long axis at the end."""
    yaw_error: float
    """Unsigned angle between both axes at the end, whichever way round; at most pi / 2."""
    far_side: bool
    """Whether it came from beyond the dolly: of the last row clear of the dolly, not of the start."""
    reversals: int
    """Changes between driving ahead and back."""
    jerk: float
    """Root mean square of the forward speed's second difference, m/s^3."""


def shortest_length(start: SE2, dolly: SE2, world: WorldConfig) -> float:
    """No path that docks is shorter (m): the straight line to where the centres are near enough."""
    distance = math.hypot(dolly.x - start.x, dolly.y - start.y)
    return max(distance - world.reward.success_distance, 0.0)


def yaw_tolerance(world: WorldConfig) -> float:
    """Largest angle (rad) between the axes at which the robot still fits under the dolly when docked.

    Over the length on which both overlap the robot's width grows by that times the angle.
    """
    width = world.robot.width
    slack = world.dolly.width - 2 * world.dolly.leg - width
    overlap = (world.dolly.length + world.robot.length) / 2 - world.reward.success_distance
    root = overlap**2 - 2 * width * slack
    return (overlap - math.sqrt(root)) / width if root > 0 else math.pi / 2


def fastest_time(start: SE2, dolly: SE2, world: WorldConfig) -> float:
    """No drive from standstill docks sooner (s): the longer of driving straight and turning on the spot."""
    acceleration = world.robot.wheel_acceleration
    turn = max(axis_angle(start, dolly) - yaw_tolerance(world), 0.0)
    return max(
        _time_from_rest(shortest_length(start, dolly, world), FASTEST, acceleration),
        _time_from_rest(turn, FASTEST, 2 * acceleration / world.robot.track),
    )


def _time_from_rest(way: float, fastest: float, acceleration: float) -> float:
    """Time for a way (m or rad) from standstill, arriving at any speed."""
    speeding_up = fastest**2 / (2 * acceleration)
    if way < speeding_up:
        return math.sqrt(2 * way / acceleration)
    return fastest / acceleration + (way - speeding_up) / fastest


def axis_angle(pose: SE2, dolly: SE2) -> float:
    """Unsigned angle (rad) between the long axes of robot and dolly, at most pi / 2."""
    angle = abs(wrap(pose.yaw - dolly.yaw))
    return min(angle, math.pi - angle)


def measure(drive: Drive, world: WorldConfig) -> Measures:
    """Everything about one drive."""
    track, period = drive.track.astype(np.float64), world.control_period
    start, end = (SE2(*track[i, :3].tolist()) for i in (0, -1))
    time = period * (len(track) - 1)
    length = float(np.hypot(*np.diff(track[:, :2], axis=0).T).sum())
    success = float(drive.ending == "success")
    shortest, fastest = shortest_length(start, drive.dolly, world), fastest_time(start, drive.dolly, world)
    seen = [drive.dolly.inverse().apply(x, y) for x, y in track[:, :2].tolist()]
    clear = (world.dolly.length + world.robot.length) / 2
    outside = [y for _, y in seen if abs(y) >= clear] or [seen[0][1]]
    moving = np.sign(track[:, 3])[np.abs(track[:, 3]) >= STANDING]
    jerk = np.diff(track[:, 3], 2) / period**2
    return Measures(
        ending=drive.ending,
        time=time,
        path_length=length,
        spl=success * _ratio(shortest, length),
        sct=success * _ratio(fastest, time),
        lateral_error=abs(seen[-1][0]),
        yaw_error=axis_angle(end, drive.dolly),
        far_side=outside[-1] > 0,
        reversals=int((np.diff(moving) != 0).sum()),
        jerk=float(np.sqrt(np.mean(jerk**2))) if len(jerk) else 0.0,
    )


def _ratio(best: float, found: float) -> float:
    return best / max(found, best) if best > 0 else 1.0


def rates(endings: Sequence[Ending]) -> dict[str, float]:
    """Share of each ending, in [0, 1]."""
    counts = Counter(endings)
    return {name: counts[name] / len(endings) for name in ENDINGS}


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95% confidence interval of a rate (Wilson 1927), within [0, 1]."""
    rate, spread = successes / trials, Z95**2 / trials
    middle = (rate + spread / 2) / (1 + spread)
    half = Z95 * math.sqrt(rate * (1 - rate) / trials + spread / trials / 4) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def summarize(drives: Sequence[Measures]) -> dict[str, Any]:
    """Rates, the interval of success, SPL and SCT over all; of the rest means over successes, or None."""
    endings = [drive.ending for drive in drives]
    docked = [drive for drive in drives if drive.ending == "success"]

    def mean(values: Iterable[float]) -> float | None:
        found = list(values)
        return float(np.mean(found)) if found else None

    return {
        **rates(endings),
        "episodes": len(drives),
        "ci95": list(wilson_interval(len(docked), len(drives))),
        "spl": mean(d.spl for d in drives),
        "sct": mean(d.sct for d in drives),
        "time": mean(d.time for d in docked),
        "path_length": mean(d.path_length for d in docked),
        "lateral_error": mean(d.lateral_error for d in docked),
        "yaw_error_deg": mean(math.degrees(d.yaw_error) for d in docked),
        "far_side": mean(float(d.far_side) for d in docked),
        "reversals": mean(d.reversals for d in docked),
        "jerk": mean(d.jerk for d in docked),
    }


def conditional_value_at_risk(
    drives: Iterable[Measures], positions: Iterable[tuple[float, float]], worst: float = WORST
) -> float:
    """Mean success over the worst tenth of the start positions, at least one (CVaR; Rockafellar 2000)."""
    found: defaultdict[tuple[float, float], list[bool]] = defaultdict(list)
    for drive, position in zip(drives, positions, strict=True):
        found[position].append(drive.ending == "success")
    successes = sorted(float(np.mean(group)) for group in found.values())
    return float(np.mean(successes[: max(1, math.ceil(worst * len(successes)))]))


def paired_difference(ours: Sequence[Ending], theirs: Sequence[Ending]) -> dict[str, Any]:
    """Success of A less that of B on the same episodes, its 95% interval (Agresti and Min 2005), McNemar's p.

    The interval is Wald's after half an episode is added to each of the four cells.
    """
    a, b = ([ending == "success" for ending in endings] for endings in (ours, theirs))
    pairs = Counter(zip(a, b, strict=True))
    gained, lost, trials = pairs[True, False], pairs[False, True], len(a) + 2
    shift = (gained - lost) / trials
    spread = Z95 * math.sqrt((gained + lost + 1) / trials - shift**2) / math.sqrt(trials)
    return {
        "episodes": len(a),
        "difference": (gained - lost) / len(a),
        "ci95": [max(-1.0, shift - spread), min(1.0, shift + spread)],
        "only_ours": gained,
        "only_theirs": lost,
        "p_value": _binomial_two_sided(min(gained, lost), gained + lost),
    }


def _binomial_two_sided(fewer: int, trials: int) -> float:
    """Probability that a fair coin is at least as uneven: McNemar's exact test."""
    tail = sum(math.comb(trials, k) for k in range(fewer + 1))
    return float(min(1.0, 2 * tail / 2**trials))
