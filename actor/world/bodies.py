"""The pybullet bodies of a cell: room, robot, dolly and boxes. The only module that creates shapes."""

from __future__ import annotations

import math
from typing import Any

from actor.world.appearance import Appearance, load_textures
from actor.world.bullet import BulletClient
from actor.world.sensors import RAY_GROUP, ROBOT_GROUP, SOLID_GROUP
from common.config import WorldConfig
from common.geometry import SE2
from common.tasks import CELLS, Box, Cell

DOLLY_COLOR = (0.1, 0.25, 0.8, 1.0)
ROBOT_COLOR = (0.9, 0.5, 0.1, 1.0)


class Bodies:
    """Robot and dolly live as long as the client; room and boxes are rebuilt when cell or episode change."""

    def __init__(self, bullet: BulletClient, config: WorldConfig) -> None:
        self.bullet = bullet
        self.move = bullet.resetBasePositionAndOrientation  # looked up once: called 36 times a control step
        self.textures = load_textures(bullet)
        self.robot = self._make_robot(config)
        self.dolly = self._make_dolly(config)
        self._room: list[int] = []
        self._boxes: list[int] = []
        self._floor = -1
        self._walls: list[int] = []

    def build_room(self, cell: int) -> None:
        """Replaces floor, walls and their collision shapes by those of a cell."""
        self._remove(self._room)
        room = CELLS[cell]
        self._floor, self._walls = self._make_surfaces(room)
        self._room = [self._floor, *self._walls]

    def build_boxes(self, boxes: tuple[Box, ...], appearance: Appearance) -> None:
        """Replaces fixtures and obstacles, and dresses the room."""
        self._remove(self._boxes)
        colors = appearance.boxes
        self._boxes = [self._make_box(box, colors[i % len(colors)]) for i, box in enumerate(boxes)]
        dress = self.bullet.changeVisualShape
        floor, wall = self.textures[appearance.floor_texture], self.textures[appearance.wall_texture]
        dress(self._floor, -1, textureUniqueId=floor, rgbaColor=appearance.floor)
        for body in self._walls:
            dress(body, -1, textureUniqueId=wall, rgbaColor=appearance.wall)

    def place(self, body: int, pose: SE2) -> None:
        """Moves robot or dolly; their origins lie on the floor."""
        turn = (0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))
        self.move(body, (pose.x, pose.y, 0.0), turn)

    def _remove(self, bodies: list[int]) -> None:
        for body in bodies:
            self.bullet.removeBody(body)
        bodies.clear()

    def _body(self, mass: float, group: int, **shapes: Any) -> int:
        body: int = self.bullet.createMultiBody(baseMass=mass, **shapes)
        meets = ROBOT_GROUP | RAY_GROUP if group == SOLID_GROUP else SOLID_GROUP
        self.bullet.setCollisionFilterGroupMask(body, -1, group, meets)
        return body

    def _make_robot(self, config: WorldConfig) -> int:
        b, robot = self.bullet, config.robot
        half = [robot.width / 2, robot.length / 2, (robot.height - robot.floor_gap) / 2]
        centre = [0.0, 0.0, (robot.height + robot.floor_gap) / 2]
        return self._body(
            1.0,  # two bodies without mass never collide
            ROBOT_GROUP,
            baseCollisionShapeIndex=b.createCollisionShape(
                b.GEOM_BOX, halfExtents=half, collisionFramePosition=centre
            ),
            baseVisualShapeIndex=b.createVisualShape(
                b.GEOM_BOX, halfExtents=half, visualFramePosition=centre, rgbaColor=ROBOT_COLOR
            ),
        )

    def _make_dolly(self, config: WorldConfig) -> int:
        """Deck, four legs flush with the footprint, a rail along each long side (facts: decided)."""
        b, d = self.bullet, config.dolly
        x, y, top = d.width / 2 - d.leg / 2, d.length / 2 - d.leg / 2, d.underside + d.deck
        halves = [[d.leg / 2, d.leg / 2, d.underside / 2]] * 4
        centres = [[sx * x, sy * y, d.underside / 2] for sx in (-1, 1) for sy in (-1, 1)]
        halves += [[d.leg / 2, y - d.leg / 2, d.leg / 2]] * 2
        centres += [[sx * x, 0.0, d.rail_height] for sx in (-1, 1)]
        halves += [[d.width / 2, d.length / 2, d.deck / 2]]
        centres += [[0.0, 0.0, (d.underside + top) / 2]]
        kinds = [b.GEOM_BOX] * len(halves)
        return self._body(
            0.0,
            SOLID_GROUP,
            baseCollisionShapeIndex=b.createCollisionShapeArray(
                shapeTypes=kinds, halfExtents=halves, collisionFramePositions=centres
            ),
            baseVisualShapeIndex=b.createVisualShapeArray(
                shapeTypes=kinds,
                halfExtents=halves,
                visualFramePositions=centres,
                rgbaColors=[DOLLY_COLOR] * len(kinds),
            ),
        )

    def _make_box(self, box: Box, color: tuple[float, ...]) -> int:
        b, pose = self.bullet, box.footprint.pose
        half = [box.footprint.half_x, box.footprint.half_y, box.height / 2]
        return self._body(
            0.0,
            SOLID_GROUP,
            baseCollisionShapeIndex=b.createCollisionShape(b.GEOM_BOX, halfExtents=half),
            baseVisualShapeIndex=b.createVisualShape(b.GEOM_BOX, halfExtents=half, rgbaColor=color),
            basePosition=[pose.x, pose.y, box.height / 2],
            baseOrientation=b.getQuaternionFromEuler([0.0, 0.0, pose.yaw]),
        )

    def _make_surfaces(self, cell: Cell) -> tuple[int, list[int]]:
        """The floor, drawn only, and the walls, drawn as their inner faces; one texture per m."""
        x0, x1, y0, y1, h = cell.left, cell.right, cell.back, cell.front, cell.wall_height
        width, depth = x1 - x0, y1 - y0
        floor = self._quad(
            [[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]], width, depth, [0, 0, 1], None
        )
        left, right, back, front = cell.walls()
        walls = [
            self._quad([[x0, y0, 0], [x0, y1, 0], [x0, y1, h], [x0, y0, h]], depth, h, [1, 0, 0], left),
            self._quad([[x1, y1, 0], [x1, y0, 0], [x1, y0, h], [x1, y1, h]], depth, h, [-1, 0, 0], right),
            self._quad([[x1, y0, 0], [x0, y0, 0], [x0, y0, h], [x1, y0, h]], width, h, [0, 1, 0], back),
            self._quad([[x0, y1, 0], [x1, y1, 0], [x1, y1, h], [x0, y1, h]], width, h, [0, -1, 0], front),
        ]
        return floor, walls

    def _quad(
        self, corners: list[list[float]], u: float, v: float, normal: list[int], solid: Box | None
    ) -> int:
        """A textured quad; `solid` stands behind it, undrawn (Bullet draws any shape that has no visual)."""
        b, collision = self.bullet, -1
        if solid is not None:
            shape, height = solid.footprint, solid.height
            collision = b.createCollisionShape(
                b.GEOM_BOX,
                halfExtents=[shape.half_x, shape.half_y, height / 2],
                collisionFramePosition=[shape.pose.x, shape.pose.y, height / 2],
            )
        visual = b.createVisualShape(
            b.GEOM_MESH,
            vertices=corners,
            indices=[0, 1, 2, 0, 2, 3],
            uvs=[[0, 0], [u, 0], [u, v], [0, v]],
            normals=[normal] * 4,
            rgbaColor=(1, 1, 1, 1),
        )
        return self._body(0.0, SOLID_GROUP, baseCollisionShapeIndex=collision, baseVisualShapeIndex=visual)
