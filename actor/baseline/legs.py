"""How well LiDAR beams fit a dolly at a pose: hits on the faces of its legs, and beams through them.

The dolly looks the same turned by 180 degrees, and a robot may dock from either short side, so that poses
are meant up to that turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from actor.baseline.scans import Scan
from common.geometry import SE2, Array, wrap
from common.world_config import DollyConfig

PASSED = 0.05
"""A beam that ends this far behind a leg's centre has passed it, m."""
INSIDE = 0.05
"""A hit under the deck that is farther than this from every leg is none of the dolly's, m."""
DEEP = 0.018
"""A beam that goes deeper than this through a leg speaks against it whatever the tolerance, m."""
STEP = 1e-5
"""For the derivatives of a refinement, m and rad."""
HOLD = 0.02
"""Weight of the initial pose in a refinement, per m or rad: it decides only what the beams leave open."""


class Fit(NamedTuple):
    """What N beams say of P poses, (P,) each: hits on legs, legs hit, beams that say no, and a score."""

    hits: NDArray[np.int64]
    legs: NDArray[np.int64]
    against: NDArray[np.int64]
    score: Array


class Legs:
    """The four legs of a dolly: squares at the corners of its footprint."""

    def __init__(self, config: DollyConfig) -> None:
        self.half = config.leg / 2
        self.x, self.y = (config.width - config.leg) / 2, (config.length - config.leg) / 2
        """Of the centre of a leg in the dolly's frame, m, up to the sign."""
        self._footprint = np.array([config.width / 2, config.length / 2])
        self.reach = float(np.hypot(*self._footprint))
        """Of the dolly about its centre, m."""

    def centres(self, poses: Array) -> Array:
        """(P, 4, 2) centres of the legs of dollies at `poses` (P, 3), m."""
        corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * [self.x, self.y]
        c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        x = poses[:, :1] + c * corners[:, 0] - s * corners[:, 1]
        y = poses[:, 1:2] + s * corners[:, 0] + c * corners[:, 1]
        return np.stack([x, y], axis=2)

    def near(self, scan: Scan, x: float, y: float) -> Scan:
        """The beams that cross the circle around a dolly at x, y."""
        to = np.array([x, y]) - scan.origins
        along = (to * scan.directions).sum(axis=1)
        across = to[:, 0] * scan.directions[:, 1] - to[:, 1] * scan.directions[:, 0]
        crossing = (np.abs(across) < self.reach) & (along > -self.reach)
        return scan.select(crossing & (scan.ranges > along - self.reach))

    def faces(self, poses: Array, scan: Scan) -> tuple[Array, Array, Array]:
        """How far the ends of beams lie from where these would meet the nearest leg's visible faces.

        Two components (P, N) in m: across the nearer of both faces, and along it beyond its end; and
        (P, N, 2) the ends in the dolly's frame.
        """
        c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        dx, dy = (scan.points[:, k] - poses[:, k : k + 1] for k in range(2))
        qx, qy = c * dx + s * dy, c * dy - s * dx
        towards_x = (c * scan.directions[:, 0] + s * scan.directions[:, 1]) * np.sign(qx)
        towards_y = (c * scan.directions[:, 1] - s * scan.directions[:, 0]) * np.sign(qy)
        u, v = np.abs(qx) - self.x, np.abs(qy) - self.y  # folded onto one leg
        from_x, from_y = u + np.sign(towards_x) * self.half, v + np.sign(towards_y) * self.half
        past_u = u - np.clip(u, -self.half, self.half)
        past_v = v - np.clip(v, -self.half, self.half)
        on_x = from_x**2 + past_v**2 < from_y**2 + past_u**2
        across, along = np.where(on_x, from_x, from_y), np.where(on_x, past_v, past_u)
        return across, along, np.stack([qx, qy], axis=2)

    def depths(self, poses: Array, scan: Scan, grown: float = 0.0) -> Array:
        """(P, N) how deep beams have gone through legs where they should have ended, m; 0 for none.

        `grown` (m) makes the legs thicker on every side.
        """
        to = self.centres(poses)[:, :, None] - scan.origins
        ex, ey = scan.directions.T
        along = to[..., 0] * ex + to[..., 1] * ey
        across = np.abs(to[..., 0] * ey - to[..., 1] * ex)
        c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
        width = (self.half + grown) * (np.abs(c * ex + s * ey) + np.abs(c * ey - s * ex))
        depth = np.where((along > 0) & (scan.ranges > along + PASSED), width[:, None] - across, 0.0)
        return np.asarray(np.maximum(depth.max(axis=1), 0.0))

    def fit(self, poses: Array, scan: Scan, tolerance: float) -> Fit:
        """Weighs the beams for and against each pose (P, 3), which may be wrong by `tolerance` (m)."""
        across, along, ends = self.faces(poses, scan)
        off = np.hypot(across, along)
        on_leg = scan.hits & (off < tolerance)
        side = (ends[..., 0] > 0) + 2 * (ends[..., 1] > 0)
        each = np.stack([(on_leg & (side == leg)).sum(axis=1) for leg in range(4)], axis=1)
        inside = (np.abs(ends) < self._footprint).all(axis=2) & (off > max(INSIDE, tolerance))
        through = self.depths(poses, scan) > min(0.7 * tolerance, DEEP)
        against = (through | (inside & scan.hits)).sum(axis=1)
        hits, legs = each.sum(axis=1), (each > 0).sum(axis=1)
        score = np.minimum(each, 6).sum(axis=1) + 4.0 * legs - 2.0 * against
        return Fit(hits, legs, against, score)

    def refine(self, pose: SE2, scan: Scan, gate: float) -> SE2:
        """The pose that the beams near it fit best, by least squares.

        Hits within `gate` (m) of a leg are drawn onto its faces, and legs out of the way of beams that pass.
        """
        start = np.array([pose.x, pose.y, pose.yaw])
        row = start[None]
        across, along, _ = self.faces(row, scan)
        hits = scan.select(scan.hits & (np.hypot(across, along)[0] < gate))
        passing = scan.select(self.depths(row, scan, gate)[0] > 0)

        def residuals(poses: Array) -> Array:
            across, along, _ = self.faces(poses, hits)
            return np.hstack([across, along, self.depths(poses, passing), HOLD * (poses - start)])

        def slopes(values: Array) -> Array:  # all at once, which is quicker than one after the other
            at = residuals(values + np.vstack([np.zeros(3), STEP * np.eye(3)]))
            return np.asarray((at[1:] - at[0]).T / STEP)

        found = least_squares(
            lambda values: residuals(values[None])[0],
            start,
            slopes,
            method="lm",
            x_scale=(0.01,) * 3,
            max_nfev=15,
        ).x
        return SE2(float(found[0]), float(found[1]), wrap(float(found[2])))
