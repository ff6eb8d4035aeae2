"""A plane world without simulator for tests of the rivals: rays cast at rectangles, a dolly painted blue."""

import math

import numpy as np

from actor.baseline.scans import Scanner
from common.config import Config
from common.geometry import SE2, Rectangle, as_rows, separations
from common.tasks import dolly_sides

WORLD = Config().world
HALF = WORLD.robot.width / 2, WORLD.robot.length / 2


def legs(dolly):
    half = WORLD.dolly.leg / 2
    x, y = WORLD.dolly.width / 2 - half, WORLD.dolly.length / 2 - half
    return [Rectangle(dolly @ SE2(i * x, j * y), half, half) for i in (-1, 1) for j in (-1, 1)]


def cast(pose, solids, world=WORLD):
    """(2 * beams,) float16 readings of a robot at `pose`."""
    blank = np.ones(2 * world.lidar.beams, np.float16)
    scan = Scanner(world).read(pose, blank)
    nearest = np.full(len(blank), world.lidar.range)
    for x, y, yaw, half_x, half_y in as_rows(solids):
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        start, ray = (scan.origins - [x, y]) @ turn, scan.directions @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-np.array([half_x, half_y]) - start) / ray, (np.array([half_x, half_y]) - start) / ray
        enter, leave = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
        nearest = np.where((enter <= leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    return (nearest / world.lidar.range).astype(np.float16)


def shoot(pose, dolly, world=WORLD):
    """(S, S, 3) image of a grey room in which the dolly's deck is a blue block, as high as it is near."""
    size, camera = world.camera.size, pose @ SE2(0.0, world.robot.mounts.camera.y)
    frame = np.full((size, size, 3), 120, np.uint8)
    focal = size / 2 / math.tan(math.radians(world.camera.fov) / 2)
    x, y = world.dolly.width / 2, world.dolly.length / 2
    corners = [camera.inverse().apply(*dolly.apply(i * x, j * y)) for i in (-1, 1) for j in (-1, 1)]
    if min(ahead for _, ahead in corners) < 0.1:
        return frame
    columns = [size / 2 + focal * side / ahead for side, ahead in corners]
    rise, nearest = 0.40 - world.robot.mounts.camera.z, min(ahead for _, ahead in corners)
    left, right = max(0, round(min(columns))), min(size, round(max(columns)))
    top = max(0, round(size / 2 - focal * rise / nearest))
    if left < right:
        frame[top : size // 2, left:right] = 30, 40, 160
    return frame


def ending(pose, dolly, solids):
    """How the robot's pose ends an episode, if it does."""
    if math.hypot(pose.x - dolly.x, pose.y - dolly.y) < WORLD.reward.success_distance:
        return "docked"
    rows = as_rows([*solids, *dolly_sides(dolly, WORLD)])
    here = np.array([[pose.x, pose.y, pose.yaw]])
    return "contact" if separations(here, HALF, rows).min() <= 0 else None
