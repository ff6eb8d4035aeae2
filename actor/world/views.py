"""Pictures of a world for people: from above, from behind, and a preview that shows all that is known."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from actor.world.sensors import render
from actor.world.world import DockingWorld
from common.tasks import CELLS, geometric_properties

Picture = NDArray[np.uint8]
ABOVE = 40.0
"""Height of the bird's eye, m; high enough that walls hide little."""


def birds_eye(world: DockingWorld, size: int) -> Picture:
    """(size, size, 3) view straight down on the whole cell, +y upwards."""
    x, y, span = _extent(world)
    view = world.bullet.computeViewMatrix((x, y, ABOVE), (x, y, 0.0), (0, 1, 0))
    fov = 2 * math.degrees(math.atan(span / 2 / ABOVE))
    clip = world.config.camera.model_copy(update={"near": 10.0, "far": ABOVE + 5.0})
    return render(world.bullet, view, size, fov, clip, world.appearance.light)


def chase(world: DockingWorld, size: int) -> Picture:
    """(size, size, 3) view from behind and above the robot."""
    eye, ahead = world.pose.apply(0.0, -1.9), world.pose.apply(0.0, 2.0)
    view = world.bullet.computeViewMatrix((*eye, 1.7), (*ahead, 0.1), (0, 0, 1))
    return render(world.bullet, view, size, 70.0, world.config.camera, world.appearance.light)


def preview(world: DockingWorld) -> Image.Image:
    """The world from above with the LiDAR's beams, from behind, through the camera, and the numbers."""
    if world.task is None or world.scene is None:
        raise ValueError("reset the world before drawing it")
    large, small, margin = 640, 320, 12
    sheet = Image.new("RGB", (large + small + 3 * margin, large + 2 * margin + 108), "white")
    above = Image.fromarray(birds_eye(world, large))
    _draw_beams(ImageDraw.Draw(above), world, large)
    sensed = world.camera.sense(world.bullet, world.pose, world.appearance.light)
    sheet.paste(above, (margin, margin))
    sheet.paste(Image.fromarray(chase(world, small)), (large + 2 * margin, margin))
    camera = Image.fromarray(sensed).resize((small - 6, small - 6), Image.Resampling.NEAREST)
    sheet.paste(camera, (large + 2 * margin, margin + small + 6))
    facts = geometric_properties(world.task, world.scene)
    lines = [
        f"cell {world.task.cell}   seed {world.task.seed}   obstacles {len(world.scene.obstacles)}",
        f"distance {facts.distance:.2f} m   relative angle {math.degrees(facts.relative_angle):.1f} deg   "
        f"lateral {facts.lateral_offset:.2f} m   approach {math.degrees(facts.approach_angle):.1f} deg",
        f"clearance of the robot {facts.agent_clearance:.2f} m, of the goal {facts.goal_clearance:.2f} m",
        "left: from above, with the beams of both LiDARs;  right: from behind, and the camera's view",
    ]
    font = ImageFont.load_default(16)
    for i, line in enumerate(lines):
        ImageDraw.Draw(sheet).text((margin, large + 2 * margin + 24 * i), line, "black", font)
    return sheet


def _extent(world: DockingWorld) -> tuple[float, float, float]:
    """Centre and side (m) of the square that shows the whole cell."""
    if world.task is None:
        raise ValueError("reset the world before drawing it")
    cell = CELLS[world.task.cell]
    span = max(cell.right - cell.left, cell.front - cell.back) + 0.6
    return (cell.left + cell.right) / 2, (cell.back + cell.front) / 2, span


def _draw_beams(draw: ImageDraw.ImageDraw, world: DockingWorld, size: int) -> None:
    x0, y0, span = _extent(world)
    # the picture is scaled for the floor; the LiDAR's plane is a little nearer to the eye
    scale = size / span * ABOVE / (ABOVE - world.config.lidar.height)
    starts, ends = world.lidar.rays(world.pose)
    reach = world.lidar.sense(world.bullet, world.pose).astype(np.float64)[:, None]
    hits = starts + reach * (ends - starts)

    def pixel(point: NDArray[np.float64]) -> tuple[float, float]:
        return size / 2 + (point[0] - x0) * scale, size / 2 - (point[1] - y0) * scale

    for start, hit, fraction in zip(starts, hits, reach[:, 0], strict=True):
        draw.line([pixel(start), pixel(hit)], fill=(230, 60, 60) if fraction < 1 else (190, 190, 190))
