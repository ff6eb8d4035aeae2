"""One episode of a rival that senses: look for the dolly, drive up to it, dock; again when it has moved.

Everything happens in the frame of odometry, whose origin is the start.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actor.baseline.detection import DollyFinder
from actor.baseline.docking import apart
from actor.baseline.occupancy import Occupancy, outside
from actor.baseline.odometry import Odometry
from actor.baseline.planning import plan, plan_to
from actor.baseline.scans import Scan, Scanner
from actor.baseline.searching import Coverage, ring
from actor.baseline.space import FreeSpace
from actor.baseline.tracking import Tracker, is_still
from common.geometry import SE2, Rectangle
from common.world_config import WorldConfig

NEWS_MARGIN = 0.03
"""A path is given up when something new leaves it less space than this, m."""
BESIDE = 0.10
"""Returns this near to the dolly's footprint are its own, m."""
FAR = 3.2
"""From farther than this from where the camera sees the dolly, the robot first drives nearer, m."""
VIEWS = 2.1, 2.6
"""Distances from the dolly's centre from which it looks for its legs, m."""
REVISIT = 0.8
"""Places to look from are this far from those where it has looked in vain, m."""
SETTLED = 0.004, math.radians(0.4)
"""A robot that stands plans anew when the estimate has moved by more, m and rad."""
DRIFT = 0.03, 0.03
"""A robot that drives does when it has moved by the first (m) and this for each metre to the dolly."""
PATIENCE = 12
"""Steps of an episode in which the last drive is put off for a better estimate."""
RETRY = 6
"""Steps until a search for a way that failed is repeated: failing takes long."""
WIGGLE = 0.4
"""Rate of turn meanwhile, rad/s: standing still, beams would only repeat themselves."""


class Map(Protocol):
    """What is known of the room before anything is sensed."""

    def update(self, motion: SE2, scan: Scan, odometry: SE2) -> None:
        """Takes in one step: the motion that led here, and a scan in the frame of odometry."""
        ...

    def solids(self) -> list[Rectangle]:
        """Footprints in the frame of odometry."""
        ...


class NoMap:
    """Nothing is known."""

    def update(self, motion: SE2, scan: Scan, odometry: SE2) -> None:
        """Learns nothing."""

    def solids(self) -> list[Rectangle]:
        """Nothing."""
        return []


class Pilot:
    """Chooses actions from the robot's own sensors and its odometry."""

    def __init__(self, world: WorldConfig, known: Map) -> None:
        self._world, self._map = world, known
        self._odometry, self._scanner = Odometry(world), Scanner(world)
        self._occupancy, self._coverage = Occupancy(), Coverage(world)
        self.finder = DollyFinder(world, self._occupancy)
        self._tracker = Tracker(world)
        self._target: SE2 | None = None
        """Where the dolly was estimated when the present path was planned; None for a path to a viewpoint."""
        self._end = SE2()
        """End of the docking path in the dolly's frame."""
        self._is_entering = False
        """Whether the last drive, under the dolly, has begun."""
        self._turned = 0.0
        """How far the robot has turned since it came here, rad."""
        self._looked: list[SE2] = []
        self._waited = self._rest = 0
        self._clockwise = False

    def act(
        self, frame: NDArray[np.uint8], lidar: NDArray[np.float16], last: NDArray[np.float32] | None
    ) -> tuple[float, float]:
        """The next action [v, w] in [-1, 1].

        `frame` (S, S, 3), `lidar` (2 * beams,) fractions of the range, `last` (2,) the action before; None at
        the start.
        """
        motion = SE2() if last is None else self._odometry.move(last)
        pose = self._odometry.pose
        scan = self._scanner.read(pose, lidar)
        self._map.update(motion, scan, pose)
        self._occupancy.add(scan)
        self._occupancy.suppose(self._scanner.bridges(scan))
        self.finder.update(pose, scan, frame)
        self._turned += abs(motion.yaw)
        self._tracker.finish_moves(pose, self._odometry.speeds)
        if self.finder.dolly is not None:
            return self._dock(self.finder.dolly)
        self._coverage.add(pose, scan)
        return self._look()

    def _dock(self, dolly: SE2) -> tuple[float, float]:
        pose, speeds, tracker = self._odometry.pose, self._odometry.speeds, self._tracker
        if self._is_entering and self._target is not None:
            end = dolly @ self._end  # the last drive follows the estimate
            tracker.path = [SE2(tracker.path[0].x, tracker.path[0].y, end.yaw), end]
            self._target = dolly
        if self._rest > 0:
            self._rest -= 1
            return self._spin()
        if self._must_plan(dolly):
            if not is_still(speeds):
                return tracker.steered(0.0, 0.0, speeds)
            self._is_entering = False
            tracker.path = self._way_in(dolly)
            self._target = dolly if tracker.path else None
            self._occupancy.news()
            if not tracker.path:
                self._rest = RETRY
                return self._spin()
            self._end = dolly.inverse() @ tracker.path[-1]
            tracker.finish_moves(pose, speeds)
        if not self._is_entering and len(tracker.path) == 2 and not tracker.is_turning:
            if not self.finder.is_sure and self._waited < PATIENCE:
                self._waited += 1
                return tracker.steered(0.0, WIGGLE if self._waited % 4 < 2 else -WIGGLE, speeds)
            if not is_still(speeds):
                return tracker.steered(0.0, 0.0, speeds)
            self._is_entering = True
        return tracker.command(pose, speeds)

    def _way_in(self, dolly: SE2) -> list[SE2]:
        for known in self._maps():
            solids = known + outside(self._occupancy.boxes(), dolly, *self._own())
            if path := plan(self._odometry.pose, dolly, solids, self._world):
                return path
        return []

    def _must_plan(self, dolly: SE2) -> bool:
        pose, tracker = self._odometry.pose, self._tracker
        if self._target is None or len(tracker.path) < 2 or tracker.is_off(pose):
            return True
        if is_still(self._odometry.speeds):
            limits = SETTLED
        else:
            limit = DRIFT[0] + DRIFT[1] * math.hypot(dolly.x - pose.x, dolly.y - pose.y)
            limits = limit, limit
        if self._is_blocked(dolly):
            self._target = None  # news comes once, stopping takes longer
        return self._target is None or apart(self._target, dolly, *limits)

    def _own(self) -> tuple[float, float]:
        """Half extents (m) of the rectangle about the dolly in which returns are its own."""
        dolly = self._world.dolly
        return dolly.width / 2 + BESIDE, dolly.length / 2 + BESIDE

    def _maps(self) -> list[list[Rectangle]]:
        """What is planned with besides the returns: the map, then nothing, as it may lie a little wrong."""
        known = self._map.solids()
        return [known, []] if known else [[]]

    def _is_blocked(self, dolly: SE2 | None) -> bool:
        """Whether new returns stand in the way of the path."""
        news, tracker, pose = self._occupancy.news(), self._tracker, self._odometry.pose
        if dolly is not None:
            news = outside(news, dolly, *self._own())
        if not news or len(tracker.path) < 2:
            return False
        target = tracker.path[1]
        if tracker.is_turning:
            start = SE2(target.x, target.y, pose.yaw)
        else:
            start = target @ SE2(0.0, (target.inverse() @ pose).y)
        space = FreeSpace(news, None, pose, self._world, NEWS_MARGIN)
        return not space.is_free([start, *tracker.path[1:]], docking=False)

    def _look(self) -> tuple[float, float]:
        """Turns about and drives to other viewpoints until the dolly is found."""
        pose, speeds, tracker = self._odometry.pose, self._odometry.speeds, self._tracker
        place = self.finder.place
        if self._target is not None:  # the dolly is not where it was: stop, maybe under its deck
            self._target, self._is_entering, tracker.path = None, False, []
            self._turned = 0.0
            return tracker.steered(0.0, 0.0, speeds)
        if len(tracker.path) >= 2:
            arrived = len(tracker.path) == 2 and tracker.is_done(pose, speeds)
            if not (arrived or tracker.is_off(pose, docking=False) or self._is_blocked(None)):
                return tracker.command(pose, speeds)
            tracker.path = []
            self._turned = 0.0
        away = math.inf if place is None else math.hypot(place[0] - pose.x, place[1] - pose.y)
        enough = math.tau if place is None else 0.0 if away > FAR else math.pi / 2
        if self._turned < enough and self._can_spin():
            return self._spin()
        if not is_still(speeds):
            return tracker.steered(0.0, 0.0, speeds)
        self._looked.append(pose)
        tracker.path = self._way_to_view(place)
        self._occupancy.news()
        if not tracker.path:
            self._turned = 0.0
            self._looked.clear()
            self._coverage.seen[:] = False
            return self._spin()
        tracker.finish_moves(pose, speeds)
        return tracker.command(pose, speeds)

    def _way_to_view(self, place: tuple[float, float] | None) -> list[SE2]:
        pose, boxes = self._odometry.pose, self._occupancy.boxes()
        if place is not None:
            boxes.append(Rectangle(SE2(*place), 0.5, 0.5))  # its rails are out of sight
        for known in self._maps():
            solids = known + boxes
            views = ring(*place, VIEWS, 12) if place else self._coverage.viewpoints(pose, solids)
            goals = [view for view in views if not self._has_looked_from(view)]
            if path := plan_to(pose, goals, solids, self._world):
                return path
        self.finder.place = None
        return []

    def _has_looked_from(self, view: SE2) -> bool:
        return any(math.hypot(view.x - old.x, view.y - old.y) < REVISIT for old in self._looked)

    def _can_spin(self) -> bool:
        pose = self._odometry.pose
        solids = self._map.solids() + self._occupancy.boxes()
        space = FreeSpace(solids, self.finder.dolly, pose, self._world, NEWS_MARGIN)
        ahead = -1.0 if self._clockwise else 1.0
        return space.can_turn(pose, pose.yaw + ahead)

    def _spin(self) -> tuple[float, float]:
        """Turns on the spot, or rests where it cannot."""
        if not self._can_spin():
            self._clockwise = not self._clockwise
            if not self._can_spin():
                return self._tracker.steered(0.0, 0.0, self._odometry.speeds)
        return self._tracker.steered(0.0, -1.0 if self._clockwise else 1.0, self._odometry.speeds)
