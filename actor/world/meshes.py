"""Textured triangle meshes of boxes and quads, as arrays for pybullet; rectangular rooms cut into quads."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from actor.world.textures import TILES
from common.geometry import SE2

Tile = tuple[float, float, float, float]
"""A rectangle of a texture: left, top, right, bottom, as shares of its size; beyond 1 it repeats."""


class Mesh:
    """Quads, two triangles each, collected into one mesh with one texture."""

    def __init__(self) -> None:
        self._corners: list[NDArray[np.float64]] = []
        self._uvs: list[NDArray[np.float64]] = []

    def quad(self, corners: ArrayLike, tile: Tile) -> None:
        """Adds a quad: corners (4, 3) counter-clockwise seen from its front, from its lower left, m."""
        left, top, right, bottom = tile
        self._corners.append(np.asarray(corners, np.float64))
        low, high = (math.ceil(bottom) - row for row in (bottom, top))  # v counts upwards, from 0
        self._uvs.append(np.array([[left, low], [right, low], [right, high], [left, high]]))

    def box(
        self,
        pose: SE2,
        half: tuple[float, float],
        z: tuple[float, float],
        side: str,
        end: str | None = None,
        top: str | None = None,
        columns: int = 1,
    ) -> None:
        """Adds an upright box between two heights, without its bottom; tiles by name.

        `end` covers its faces along x, by default like `side`, which is repeated `columns` times on the
        faces along y.
        """
        hx, hy = half
        z0, z1 = z
        right, front = (hx, hy), (hx, -hy)
        back, left = (-hx, hy), (-hx, -hy)
        faces = (
            (front, right, side, columns),
            (back, left, side, columns),
            (left, front, end or side, 1),
            (right, back, end or side, 1),
        )
        for (ax, ay), (bx, by), name, parts in faces:
            for k in range(parts):
                s, t = k / parts, (k + 1) / parts
                a = pose.apply(ax + s * (bx - ax), ay + s * (by - ay))
                b = pose.apply(ax + t * (bx - ax), ay + t * (by - ay))
                self.quad([(*a, z0), (*b, z0), (*b, z1), (*a, z1)], TILES[name])
        ring = [(*pose.apply(*corner), z1) for corner in (left, front, right, back)]
        self.quad(ring, TILES[top or side])

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of pybullet's createVisualShape."""
        corners = np.concatenate(self._corners)
        quads = corners.reshape(-1, 4, 3)
        normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        indices = 4 * np.arange(len(quads))[:, None] + np.array([0, 1, 2, 0, 2, 3])
        return {
            "vertices": corners.tolist(),
            "indices": indices.ravel().tolist(),
            "uvs": np.concatenate(self._uvs).tolist(),
            "normals": np.repeat(normals, 4, axis=0).tolist(),
        }


def slabs(outline: tuple[tuple[float, float], ...]) -> list[tuple[float, float, float, float]]:
    """A room with walls along x and y, cut into rectangles (x0, x1, y0, y1)."""
    rows = sorted({y for _, y in outline})
    found = []
    for low, high in pairwise(rows):
        middle = (low + high) / 2
        edges = zip(outline, (*outline[1:], outline[0]), strict=True)
        crossings = sorted(ax for (ax, ay), (_, by) in edges if (ay > middle) != (by > middle))
        found += [(x0, x1, low, high) for x0, x1 in zip(crossings[::2], crossings[1::2], strict=True)]
    return found
