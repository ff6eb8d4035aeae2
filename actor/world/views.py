"""Pictures of a world for people: from above, from behind, previews, frames of a video."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from actor.world.sensors import Renderer
from actor.world.world import DockingWorld, Sensed
from common.cells import ROOMS
from common.geometry import Rectangle
from common.tasks import Task, geometric_properties

Picture = NDArray[np.uint8]
ABOVE = 40.0
"""Height of the bird's eye, m; high enough that walls hide little."""
HIT, MISS, GOAL = (230, 60, 60), (190, 190, 190), (60, 90, 220)
FAINT = 110
"""Opacity of a beam, of 255."""
LARGE, SMALL, MARGIN = 640, 314, 12


def birds_eye(world: DockingWorld, size: int) -> Picture:
    """(size, size, 3) view straight down on the whole room, +y upwards."""
    x, y, span = _extent(world)
    view = world.bullet.computeViewMatrix((x, y, ABOVE), (x, y, 0.0), (0, 1, 0))
    fov = 2 * math.degrees(math.atan(span / 2 / ABOVE))
    clip = world.config.camera.model_copy(update={"near": 10.0, "far": ABOVE + 5.0})
    return Renderer(world.bullet, size, clip, fov)(view, world.appearance.light)


def chase(world: DockingWorld, size: int) -> Picture:
    """(size, size, 3) view from behind and above the robot."""
    eye, ahead = world.pose.apply(0.0, -1.9), world.pose.apply(0.0, 2.0)
    view = world.bullet.computeViewMatrix((*eye, 1.7), (*ahead, 0.1), (0, 0, 1))
    return Renderer(world.bullet, size, world.config.camera, 70.0)(view, world.appearance.light)


VIEWS: dict[str, Callable[[DockingWorld, int], Picture]] = {"birds_eye": birds_eye, "chase": chase}


def preview(world: DockingWorld, sensed: Sensed) -> Image.Image:
    """All views of a world with what it senses, and its task in numbers; (772, 990) pixels."""
    now = replace(world.scene, robot=world.pose, dolly=world.dolly)
    facts = geometric_properties(world.task, now)
    angle, approach = math.degrees(facts.relative_angle), math.degrees(facts.approach_angle)
    return _sheet(
        world,
        sensed,
        [
            f"{_room(world)}   seed {world.task.seed}   obstacles {len(world.scene.obstacles)}",
            f"distance {facts.distance:.2f} m   lateral {facts.lateral_offset:.2f} m   "
            f"relative angle {angle:.1f} deg   approach {approach:.1f} deg",
            f"clearance of the robot {facts.agent_clearance:.2f} m, of the goal {facts.goal_clearance:.2f} m",
            "left: from above, with the beams of both LiDARs;  right: from behind, and the camera's view",
        ],
    )


def video_frame(
    world: DockingWorld,
    sensed: Sensed,
    action: NDArray[np.float32],
    rewards: list[float],
    trail: list[tuple[float, float]],
) -> Image.Image:
    """One frame of a recording: all views, the way so far, the action taken and the rewards up to now."""
    v, w = action.tolist()
    period = world.config.control_period
    sheet = _sheet(
        world,
        sensed,
        [
            f"{_room(world)}   seed {world.task.seed}   t = {world.steps * period:5.2f} s",
            f"action  v {v:+.2f} m/s   w {w:+.2f} rad/s   "
            f"wheels {world.speeds[0]:+.2f} and {world.speeds[1]:+.2f} m/s",
            f"reward {rewards[-1] if rewards else 0.0:+.2f}   return {sum(rewards):+.2f}",
        ],
        trail,
    )
    _draw_gauges(ImageDraw.Draw(sheet), v, w, rewards)
    return sheet


def gallery(world: DockingWorld, tasks: list[Task]) -> Image.Image:
    """Starts side by side, four in a row: from above, with what the camera sees in a corner."""
    columns, size, inset = 4, 320, 96
    rows = -(-len(tasks) // columns)
    sheet = Image.new("RGB", (columns * (size + 8) + 8, rows * (size + 30) + 8), "white")
    text, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for index, task in enumerate(tasks):
        sensed = world.reset(task)
        x, y = 8 + (size + 8) * (index % columns), 8 + (size + 30) * (index // columns)
        sheet.paste(Image.fromarray(birds_eye(world, size)), (x, y))
        camera = Image.fromarray(sensed.frame).resize((inset, inset), Image.Resampling.LANCZOS)
        sheet.paste(camera, (x + size - inset, y + size - inset))
        text.text((x, y + size + 3), _room(world), "black", font)
    return sheet


def _sheet(
    world: DockingWorld, sensed: Sensed, lines: list[str], trail: list[tuple[float, float]] | None = None
) -> Image.Image:
    """The three views and lines of text below."""
    sheet = Image.new("RGB", (LARGE + SMALL + 3 * MARGIN, LARGE + 2 * MARGIN + 108), "white")
    above = Image.fromarray(birds_eye(world, LARGE))
    draw = ImageDraw.Draw(above, "RGBA")
    _draw_beams(draw, world, sensed)
    if world.scene.shifted and world.dolly != world.scene.shifted:
        size = world.config.dolly
        ghost = Rectangle(world.scene.shifted, size.width / 2, size.length / 2).corners()
        draw.polygon([_pixel(world, x, y) for x, y in ghost], outline=GOAL, width=2)
    if trail and len(trail) > 1:
        draw.line([_pixel(world, x, y) for x, y in trail], fill=GOAL, width=2)
    right = LARGE + 2 * MARGIN
    camera = Image.fromarray(sensed.frame).resize((SMALL, SMALL), Image.Resampling.NEAREST)
    sheet.paste(above, (MARGIN, MARGIN))
    sheet.paste(Image.fromarray(chase(world, SMALL)), (right, MARGIN))
    sheet.paste(camera, (right, MARGIN + LARGE - SMALL))
    font, text = ImageFont.load_default(16), ImageDraw.Draw(sheet)
    for i, line in enumerate(lines):
        text.text((MARGIN, LARGE + 2 * MARGIN + 24 * i), line, "black", font)
    return sheet


def _room(world: DockingWorld) -> str:
    return f"cell {world.task.cell} ({ROOMS[world.task.cell].name})"


def _extent(world: DockingWorld) -> tuple[float, float, float]:
    """Centre and side (m) of the square that shows the whole room."""
    left, right, back, front = ROOMS[world.task.cell].extent
    return (left + right) / 2, (back + front) / 2, max(right - left, front - back) + 0.8


def _pixel(world: DockingWorld, x: float, y: float) -> tuple[float, float]:
    """Where a point at the height of the LiDAR's plane is in the large picture."""
    x0, y0, span = _extent(world)
    # the picture is scaled for the floor; the plane is a little nearer to the eye
    scale = LARGE / span * ABOVE / (ABOVE - world.config.robot.mounts.front_lidar.z)
    return LARGE / 2 + (x - x0) * scale, LARGE / 2 - (y - y0) * scale


def _draw_beams(draw: ImageDraw.ImageDraw, world: DockingWorld, sensed: Sensed) -> None:
    starts, ends = world.lidar.starts, world.lidar.ends
    reach = sensed.lidar.astype(np.float64)[:, None]
    hits = starts + reach * (ends - starts)
    for start, hit, fraction in zip(starts, hits, reach[:, 0], strict=True):
        line = [_pixel(world, *world.pose.apply(p[0], p[1])) for p in (start, hit)]
        draw.line(line, fill=(*(HIT if fraction < 1 else MISS), FAINT))
        if fraction < 1:
            x, y = line[1]
            draw.rectangle((x - 1, y - 1, x + 1, y + 1), fill=HIT)


def _draw_gauges(draw: ImageDraw.ImageDraw, v: float, w: float, rewards: list[float]) -> None:
    """Bars of the action, and the rewards as a curve from -1 to 1 (larger ones are cut off)."""
    left, top, half = LARGE + 2 * MARGIN, LARGE + 2 * MARGIN, 60
    font = ImageFont.load_default(13)
    for index, (name, value) in enumerate((("v", v), ("w", -w))):  # a turn to the left is a bar to the left
        y = top + 12 + 24 * index
        draw.text((left, y - 8), name, "black", font)
        draw.rectangle((left + 20, y - 6, left + 20 + 2 * half, y + 6), outline="black")
        middle, end = sorted((left + 20 + half, left + 20 + half * (1 + value)))
        draw.rectangle((middle, y - 5, end, y + 5), fill=GOAL)
    x0, x1, zero = left + 2 * half + 40, left + SMALL, top + 24
    draw.text((x0, top + 50), "reward, -1 to 1", "black", font)
    draw.line((x0, zero, x1, zero), fill=MISS)
    step = (x1 - x0) / max(100, len(rewards))
    points = [(x0 + i * step, zero - 20 * min(max(r, -1.0), 1.0)) for i, r in enumerate(rewards)]
    if len(points) > 1:
        draw.line(points, fill=HIT, width=2)
