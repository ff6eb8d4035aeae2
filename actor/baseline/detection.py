"""Finds the dolly: pairs of leg-like LiDAR returns make hypotheses, all beams and the camera judge them.

Scans of the last places are accumulated in the frame of odometry, as single ones miss the thin legs.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from actor.baseline.legs import Fit, Legs
from actor.baseline.occupancy import Occupancy
from actor.baseline.scans import WINDOW, Scan, ScanMemory
from actor.baseline.vision import Sight, Sighting
from common.geometry import SE2, Array
from common.world_config import WorldConfig

TOGETHER = 0.08
"""Returns nearer than this to each other are of one leg, m."""
SPREAD = 0.10
"""A leg's returns scatter no farther than this, m."""
PAIRING = 0.07
"""Tolerance of the distance of two legs, m."""
CANDIDATES = 20
"""Most leg-like things that are paired."""
COARSE, MIDDLE, FINE = 0.05, 0.03, 0.015
"""Tolerances of a hypothesis, of an estimate against new scans, and of a refined one, m."""
BEAMS = 2500
"""Most beams that judge hypotheses."""
RECENT = 1, 4
"""Scans that can contradict an estimate: one when near, some when few beams meet a leg."""
BETTER = 3.0
"""By so much a hypothesis has to score higher than an unsure estimate: less than one leg."""
PALE = 2
"""Frames by which those that show no blue may outnumber the others."""
TRACKED = 30
"""Scans that an estimate is refined by."""


class DollyFinder:
    """An estimate of the dolly's pose in the frame of odometry, from both sensors."""

    def __init__(self, world: WorldConfig, occupancy: Occupancy) -> None:
        self.legs = Legs(world.dolly)
        self._sight, self._occupancy = Sight(world), occupancy
        self._scans = ScanMemory()
        self._sightings: deque[Sighting] = deque(maxlen=WINDOW)
        self.dolly: SE2 | None = None
        """The estimate; None while there is none."""
        self.place: tuple[float, float] | None = None
        """Roughly where the camera saw it last, m."""
        self._age = 0
        self.is_sure = False
        """Whether the estimate is good enough to drive under the dolly."""

    def update(self, pose: SE2, scan: Scan, frame: NDArray[np.uint8]) -> None:
        """Takes in what was sensed at `pose`: beams in the frame of odometry, image (S, S, 3)."""
        sighting = self._sight.look(pose, frame)
        self._scans.add(pose, scan)
        self._sightings.append(sighting)
        if sighting.place is not None:
            self.place = sighting.place
        if self.dolly is not None:
            self._track(self.dolly)
        if self.dolly is None or (not self.is_sure and self._age % 3 == 0):
            self._find()

    def _track(self, dolly: SE2) -> None:
        """Refines the estimate, or gives it up when the newest scans contradict it."""
        self._age += 1
        refined = dolly
        is_due = not self.is_sure or self._age % 3 == 0
        if is_due:
            near = self.legs.near(self._scans.latest(TRACKED), dolly.x, dolly.y)
            refined = self.legs.refine(dolly, near, gate=0.04)
        for count in RECENT:
            recent = self.legs.near(self._scans.latest(count), refined.x, refined.y)
            fit = self.legs.fit(_row(refined), recent, MIDDLE)
            if fit.against[0] >= 3 and fit.against[0] > fit.hits[0]:
                self._lose(dolly)
                self._sightings.clear()
                return
        yes, no = self._sight.agrees(list(self._sightings), refined.x, refined.y)
        if no > yes + PALE:
            self._lose(dolly)
            return
        self.dolly = refined
        if is_due:
            fit = self.legs.fit(_row(refined), near, FINE)
            self.is_sure = bool(
                fit.legs[0] >= 3 and fit.hits[0] >= 10 and fit.against[0] <= 0.1 * fit.hits[0]
            )

    def _lose(self, dolly: SE2) -> None:
        """Forgets the dolly and what was seen of it: it has been moved, or never stood there."""
        self.dolly, self.is_sure = None, False
        self._scans.forget(keep=1)
        self._occupancy.clear(dolly.x, dolly.y, self.legs.reach + 0.1)
        self.place = None

    def _find(self) -> None:
        scan = self._scans.latest(WINDOW)
        spots, weights = self._leg_like(scan)
        poses = hypotheses(spots, self.legs)
        if not len(poses):
            return
        gaps = np.hypot(*np.moveaxis(self.legs.centres(poses)[:, :, None] - spots, -1, 0))  # (P, 4, C)
        weight = (np.minimum(weights, 5) * (gaps < COARSE + 0.03)).max(axis=2)
        order = np.argsort(-((weight > 0) * 10 + weight).sum(axis=1))[:24]
        poses = poses[order]
        beams = self._about(scan, poses)
        coarse = self.legs.fit(poses, beams, COARSE)
        best, found = -math.inf, None
        if self.dolly is not None:  # only what is clearly better replaces it
            near = self.legs.near(scan, self.dolly.x, self.dolly.y)
            best = BETTER + float(self.legs.fit(_row(self.dolly), near, FINE).score[0])
        for index in np.argsort(-coarse.score)[:4]:
            pose = SE2(*poses[index].tolist())
            near = self.legs.near(scan, pose.x, pose.y)
            pose = self.legs.refine(self.legs.refine(pose, near, gate=0.08), near, gate=0.04)
            fit = self.legs.fit(_row(pose), near, FINE)
            if fit.score[0] > best and self._is_believable(pose, fit):
                best, found = float(fit.score[0]), pose
        if found is not None:
            self.dolly, self.is_sure = found, False

    def _is_believable(self, pose: SE2, fit: Fit) -> bool:
        hits, legs, against = int(fit.hits[0]), int(fit.legs[0]), int(fit.against[0])
        yes, no = self._sight.agrees(list(self._sightings), pose.x, pose.y)
        if no > yes:
            return False
        if legs >= 3:
            return hits >= 4 and against <= 0.15 * hits
        return legs == 2 and yes > 0 and hits >= 5 and against == 0

    def _about(self, scan: Scan, poses: Array) -> Scan:
        """Beams that pass any of the poses, at most `BEAMS`."""
        middle = poses[:, :2].mean(axis=0)
        radius = float(np.hypot(*(poses[:, :2] - middle).T).max()) + self.legs.reach
        to = middle - scan.origins
        across = np.abs(to[:, 0] * scan.directions[:, 1] - to[:, 1] * scan.directions[:, 0])
        along = (to * scan.directions).sum(axis=1)
        chosen = np.flatnonzero((across < radius) & (along > -radius) & (scan.ranges > along - radius))
        return scan.select(chosen[:: 1 + len(chosen) // BEAMS])

    def _leg_like(self, scan: Scan) -> tuple[Array, Array]:
        """Centres (C, 2) of narrow things that stand free, m, and how often each was hit (C,)."""
        narrow = scan.select(scan.narrow)
        points = narrow.points + self.legs.half * narrow.directions
        if len(points) < 2:
            return np.empty((0, 2)), np.empty(0)
        pairs = cKDTree(points).query_pairs(TOGETHER, output_type="ndarray")
        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
        count, labels = connected_components(links, directed=False)
        sizes = np.bincount(labels, minlength=count).astype(np.float64)
        sums = [np.bincount(labels, weights=points[:, k], minlength=count) for k in range(2)]
        centres = np.stack(sums, axis=1) / sizes[:, None]
        spread = np.zeros(count)
        np.maximum.at(spread, labels, np.hypot(*(points - centres[labels]).T))
        kept = np.flatnonzero((spread < SPREAD) & self._occupancy.are_alone(centres))
        kept = kept[np.argsort(-sizes[kept])[:CANDIDATES]]
        return centres[kept], sizes[kept]


def hypotheses(spots: Array, legs: Legs) -> Array:
    """(P, 3) poses of the dolly at which some two of the spots (C, 2) are legs."""
    first, second = np.triu_indices(len(spots), 1)
    between = spots[second] - spots[first]
    middle = (spots[second] + spots[first]) / 2
    length, angle = np.hypot(*between.T), np.arctan2(between[:, 1], between[:, 0])
    found = []
    for size, turns, across in (
        (2 * legs.x, (0.0,), legs.y),
        (2 * legs.y, (math.pi / 2,), legs.x),
        (2 * math.hypot(legs.x, legs.y), (math.atan2(legs.y, legs.x), math.atan2(legs.y, -legs.x)), 0.0),
    ):
        fits = np.abs(length - size) < PAIRING
        normal = np.stack([-np.sin(angle[fits]), np.cos(angle[fits])], axis=1)
        for turn in turns:
            for side in (-across, across) if across else (0.0,):
                found.append(np.column_stack([middle[fits] + side * normal, angle[fits] - turn]))
    return np.concatenate(found)


def _row(pose: SE2) -> Array:
    return np.array([[pose.x, pose.y, pose.yaw]])
