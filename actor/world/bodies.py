"""The pybullet bodies of a room: the only module that creates shapes.

Every shape is made once and every body as seldom as can be, since pybullet never gives back all of what a
removed one took: obstacles are moved about, and a room is three bodies.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from actor.world.appearance import Appearance
from actor.world.bullet import BulletClient
from actor.world.meshes import Mesh, slabs
from actor.world.sensors import RAY_GROUP, ROBOT_GROUP, SOLID_GROUP, pose_of
from actor.world.textures import ATLAS, PATTERNS, TILES
from common.cells import ROOMS, Box, Cell, Kind
from common.geometry import SE2
from common.tasks import Obstacle, obstacle_catalogue
from common.world_config import DollyConfig, RobotConfig, WorldConfig

Shapes = tuple[int, int]
"""Ids of a collision and a visual shape; -1 for none."""
PATTERN = 2.0
"""Side of the square that one tile of a pattern covers, m."""
RACK_BAY = 2.5
"""Width that one drawing of a rack covers, m."""


class Bodies:
    """Robot, dolly and obstacles live as long as the client; the room's bodies are replaced with the room."""

    def __init__(self, bullet: BulletClient, config: WorldConfig) -> None:
        self._bullet = bullet
        self.move = bullet.resetBasePositionAndOrientation  # looked up once: called 36 times a control step
        self._patterns, self._atlas = _load_textures(bullet)
        self.robot = self._body(self._robot_shapes(config.robot), ROBOT_GROUP)
        self.dolly = self._body(self._dolly_shapes(config.dolly))
        self._obstacles = [self._body(self._box_shapes(*box)) for box in obstacle_catalogue(config.obstacles)]
        self._room_shapes: dict[int, tuple[Shapes, Shapes, Shapes]] = {}
        self._room: tuple[int, int, int] | None = None
        self._cell = -1
        for body in (self.robot, self.dolly, *self._obstacles):
            self._paint(body, textureUniqueId=self._atlas)
        self.arrange(())

    def enter(self, cell: int) -> None:
        """Puts up a room by its index in ROOMS: floor, walls, and fixtures with doors."""
        if cell == self._cell:
            return
        if cell not in self._room_shapes:
            room = ROOMS[cell]
            self._room_shapes[cell] = (
                (-1, self._visual(_floor(room))),
                (self._boxes(room.walls), self._visual(_walls(room))),
                (self._boxes(room.fixtures), self._visual(_fixtures(room))),
            )
        for body in self._room or ():
            self._bullet.removeBody(body)
        floor, walls, fixtures = (self._body(shapes) for shapes in self._room_shapes[cell])
        self._paint(fixtures, textureUniqueId=self._atlas)
        self._room, self._cell = (floor, walls, fixtures), cell

    def arrange(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Moves the obstacles to their places and the rest of the catalogue out of sight."""
        for body in self._obstacles:
            self.hide(body)
        for obstacle in obstacles:
            self.place(self._obstacles[obstacle.index], obstacle.box.footprint.pose)

    def dress(self, look: Appearance) -> None:
        """Colours and patterns of the room, its contents and the dolly."""
        assert self._room is not None
        floor, walls, fixtures = self._room
        self._paint(floor, rgbaColor=look.floor, textureUniqueId=self._patterns[look.floor_pattern])
        self._paint(walls, rgbaColor=look.wall, textureUniqueId=self._patterns[look.wall_pattern])
        # the atlas stays: setting a texture copies it, 0.2 ms each
        self._paint(fixtures, rgbaColor=look.fixtures)
        self._paint(self.dolly, rgbaColor=look.dolly)
        for body, color in zip(self._obstacles, look.obstacles, strict=True):
            self._paint(body, rgbaColor=color)

    def hide(self, body: int) -> None:
        """Moves a body out of sight and reach, each to a place of its own."""
        self.move(body, (20.0 * body, 0.0, -1000.0), (0.0, 0.0, 0.0, 1.0))

    def place(self, body: int, pose: SE2) -> None:
        """Moves a body whose origin lies on the floor."""
        turn = (0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))
        self.move(body, (pose.x, pose.y, 0.0), turn)

    def _paint(self, body: int, **look: Any) -> None:
        self._bullet.changeVisualShape(body, -1, **look)

    def _body(self, shapes: Shapes, group: int = SOLID_GROUP) -> int:
        body: int = self._bullet.createMultiBody(
            baseMass=1.0 if group == ROBOT_GROUP else 0.0,  # two bodies without mass never collide
            baseCollisionShapeIndex=shapes[0],
            baseVisualShapeIndex=shapes[1],
        )
        meets = SOLID_GROUP if group == ROBOT_GROUP else ROBOT_GROUP | RAY_GROUP
        self._bullet.setCollisionFilterGroupMask(body, -1, group, meets)
        return body

    def _visual(self, mesh: Mesh) -> int:
        shape: int = self._bullet.createVisualShape(
            self._bullet.GEOM_MESH, rgbaColor=(1, 1, 1, 1), **mesh.arguments()
        )
        return shape

    def _solid(self, boxes: list[tuple[SE2, tuple[float, float], tuple[float, float]]]) -> int:
        """One collision shape of boxes: pose, half extents in the plane, lower and upper end (m)."""
        b = self._bullet
        halves = [[*half, (high - low) / 2] for _, half, (low, high) in boxes]
        centres = [[pose.x, pose.y, (high + low) / 2] for pose, _, (low, high) in boxes]
        turns = [b.getQuaternionFromEuler([0.0, 0.0, pose.yaw]) for pose, _, _ in boxes]
        if len(boxes) == 1:
            shape: int = b.createCollisionShape(
                b.GEOM_BOX,
                halfExtents=halves[0],
                collisionFramePosition=centres[0],
                collisionFrameOrientation=turns[0],
            )
        else:
            shape = b.createCollisionShapeArray(
                shapeTypes=[b.GEOM_BOX] * len(boxes),
                halfExtents=halves,
                collisionFramePositions=centres,
                collisionFrameOrientations=turns,
            )
        return shape

    def _boxes(self, boxes: tuple[Box, ...]) -> int:
        if not boxes:
            return -1
        footprints = [(box.footprint, box.height) for box in boxes]
        return self._solid([(f.pose, (f.half_x, f.half_y), (0.0, height)) for f, height in footprints])

    def _box_shapes(self, half_x: float, half_y: float, height: float, kind: Kind) -> Shapes:
        mesh = Mesh()
        mesh.box(SE2(), (half_x, half_y), (0.0, height), kind, top="top")
        return self._solid([(SE2(), (half_x, half_y), (0.0, height))]), self._visual(mesh)

    def _robot_shapes(self, robot: RobotConfig) -> Shapes:
        half, z = (robot.width / 2, robot.length / 2), (robot.floor_gap, robot.height)
        mesh = Mesh()
        mesh.box(SE2(), half, z, "robot_side", top="robot_top")
        for mount in (robot.mounts.front_lidar, robot.mounts.rear_lidar):
            mesh.box(pose_of(mount), (0.05, 0.05), (mount.z - 0.04, mount.z + 0.04), "plain")
        return self._solid([(SE2(), half, z)]), self._visual(mesh)

    def _dolly_shapes(self, dolly: DollyConfig) -> Shapes:
        """Deck, four legs flush with the footprint, a rail along each long side (facts: decided)."""
        leg = dolly.leg / 2
        x, y = dolly.width / 2 - leg, dolly.length / 2 - leg
        rail = (dolly.rail_height - leg, dolly.rail_height + leg)
        parts = [
            (SE2(sx * x, sy * y), (leg, leg), (0.0, dolly.underside)) for sx in (-1, 1) for sy in (-1, 1)
        ]
        parts += [(SE2(sx * x, 0.0), (leg, y - leg), rail) for sx in (-1, 1)]
        deck = (SE2(), (dolly.width / 2, dolly.length / 2), (dolly.underside, dolly.underside + dolly.deck))
        mesh = Mesh()
        for part in parts:
            mesh.box(*part, "plain")
        mesh.box(*deck, "plain", top="deck")
        low, (hx, hy) = dolly.underside, deck[1]
        mesh.quad([(-hx, hy, low), (hx, hy, low), (hx, -hy, low), (-hx, -hy, low)], TILES["plain"])
        return self._solid([*parts, deck]), self._visual(mesh)


def _floor(room: Cell) -> Mesh:
    mesh = Mesh()
    left, _, _, front = room.extent
    for x0, x1, y0, y1 in slabs(room.outline):
        tile = ((x0 - left) / PATTERN, (front - y1) / PATTERN, (x1 - left) / PATTERN, (front - y0) / PATTERN)
        mesh.quad([(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], tile)
    return mesh


def _walls(room: Cell) -> Mesh:
    """Inner faces, and the tops for those who look from above."""
    mesh, h = Mesh(), room.wall_height
    for ((x0, y0), (x1, y1)), wall in zip(room.edges, room.walls, strict=True):
        length = abs(x1 - x0) + abs(y1 - y0)
        # seen from inside, a wall runs from right to left
        mesh.quad(
            [(x1, y1, 0), (x0, y0, 0), (x0, y0, h), (x1, y1, h)], (0.0, 0.0, length / PATTERN, h / PATTERN)
        )
        pose, hx, hy = wall.footprint.pose, wall.footprint.half_x, wall.footprint.half_y
        a, b = (pose.x - hx, pose.y - hy), (pose.x + hx, pose.y + hy)
        mesh.quad([(*a, h), (b[0], a[1], h), (*b, h), (a[0], b[1], h)], (0.0, 0.0, 0.1, 0.1))
    return mesh


def _fixtures(room: Cell) -> Mesh:
    """What stands in the room, and the doors, which are painted 2 cm before their walls."""
    mesh = Mesh()
    for box in room.fixtures:
        shape = box.footprint
        half, pose = (shape.half_x, shape.half_y), shape.pose
        if box.kind != "rack":
            mesh.box(pose, half, (0.0, box.height), box.kind, top="top")
            continue
        if shape.half_x > shape.half_y:  # the bays are on the long faces
            half, pose = (shape.half_y, shape.half_x), pose @ SE2(0.0, 0.0, math.pi / 2)
        columns = max(1, round(2 * half[1] / RACK_BAY))
        mesh.box(pose, half, (0.0, box.height), "rack", "rack_end", "top", columns)
    for door in room.doors:
        (x0, y0), (x1, y1) = room.edges[door.wall]
        length = abs(x1 - x0) + abs(y1 - y0)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        ends = [
            (x0 + ux * s - 0.02 * uy, y0 + uy * s + 0.02 * ux)
            for s in (door.along + door.width / 2, door.along - door.width / 2)
        ]
        top = min(2.8, room.wall_height)
        mesh.quad([(*ends[0], 0), (*ends[1], 0), (*ends[1], top), (*ends[0], top)], TILES["door"])
    return mesh


def _load_textures(bullet: Any) -> tuple[dict[str, int], int]:
    """Loads all pictures into a client: ids of the patterns by name, and of the atlas."""
    with tempfile.TemporaryDirectory() as folder:

        def load(name: str, picture: Any) -> int:
            path = Path(folder) / f"{name}.png"
            Image.fromarray(picture).save(path)
            texture: int = bullet.loadTexture(str(path))
            return texture

        return {name: load(name, picture) for name, picture in PATTERNS.items()}, load("atlas", ATLAS)
