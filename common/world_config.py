"""The docking world in numbers: bodies, sensors, reward, starts, and what is random with its range."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from common.settings import Count, Fraction, Levels, NotNegative, Positive, Range, Section, Shares

Degrees = Annotated[float, Field(ge=0, le=180)]


class StartRanges(Section):
    """Where an episode may start (appendix B, table of randomisation)."""

    jitter: Annotated[float, Field(ge=0, le=5)] = 0.5
    """Robot x and y are uniform in +- this around the cell's start point, m."""
    distance_min: Positive = 1.5
    """Smallest centre-to-centre distance of robot and dolly, m; below 1.25 the robot starts half under it."""
    distance_max: Annotated[float, Field(gt=0, le=20)] = 5.0
    """Largest one, m; uniform in between (the paper's RND histogram is flat)."""
    yaw: Degrees = 90.0
    """Robot yaw is uniform in +- this, degrees."""
    bearing: Degrees = 15.0
    """Half the central angle of the dolly's circle segment about the cell's +y, degrees."""
    dolly_yaw: Degrees = 15.0
    """Dolly yaw is uniform in +- this, degrees."""

    @model_validator(mode="after")
    def _ordered(self) -> StartRanges:
        if self.distance_min > self.distance_max:
            raise ValueError("distance_min <= distance_max must hold")
        return self

    def towards(self, other: StartRanges, share: float) -> StartRanges:
        """Ranges between these and others: share 0 is these, 1 the others."""
        values = {}
        for key, ours in self.model_dump().items():
            theirs = getattr(other, key)
            between = (1 - share) * ours + share * theirs
            values[key] = min(max(between, min(ours, theirs)), max(ours, theirs))  # rounding may leave them
        return StartRanges(**values)


class MountConfig(Section):
    """Where a sensor sits on the robot: x to its right, y ahead, z above the floor (m), yaw (degrees)."""

    x: float
    y: float
    z: Positive
    yaw: float


class MountsConfig(Section):
    """All sensors: camera in the middle of the front face, LiDARs on diagonal corners (table 1)."""

    camera: MountConfig = MountConfig(x=0.0, y=0.6365, z=0.165, yaw=0.0)
    front_lidar: MountConfig = MountConfig(x=-0.315, y=0.6365, z=0.200, yaw=45.0)
    rear_lidar: MountConfig = MountConfig(x=0.315, y=-0.6365, z=0.200, yaw=-135.0)


class RobotConfig(Section):
    """The vehicle (appendix C); drive limits decided."""

    length: Positive = 1.273
    width: Positive = 0.630
    height: Positive = 0.300
    """Top of the chassis above the floor, m."""
    floor_gap: Positive = 0.030
    max_speed: Positive = 1.2
    """Largest speed of either wheel, m/s."""
    track: Positive = 0.500
    """Distance of the two driven wheels, m."""
    wheel_acceleration: Positive = 3.0
    """Largest change of a wheel's speed, m/s^2."""
    mounts: MountsConfig = MountsConfig()


class DollyConfig(Section):
    """The dolly (appendix C); heights, legs and rails decided."""

    length: Positive = 1.230
    width: Positive = 0.820
    underside: Positive = 0.340
    deck: Positive = 0.060
    """Thickness of the deck, m."""
    leg: Positive = 0.040
    """Side of the square section of a leg and of a rail, m."""
    rail_height: Positive = 0.100
    """Centre line of the side rails above the floor, m."""


class CameraConfig(Section):
    """The front camera (table 1, appendix C)."""

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 80
    """Width and height, pixels."""
    fov: Annotated[float, Field(gt=1, lt=170)] = 47.0
    """Field of view, degrees."""
    near: Positive = 0.02
    far: Positive = 40.0


class LidarConfig(Section):
    """Two scanners alike, each sweeping about the yaw of its mount (table 1, appendix C)."""

    beams: Annotated[int, Field(ge=2, le=4096)] = 128
    """Beams of each sensor."""
    fov: Annotated[float, Field(gt=0, le=270)] = 225.0
    """Degrees."""
    range: Positive = 6.0
    """Largest distance, m; readings are scaled by it to [0, 1]."""
    noise: NotNegative = 0.0
    """Standard deviation of a distance, m."""
    dropout: Fraction = 0.0
    """Probability that a beam returns nothing and reads 1."""


class RewardConfig(Section):
    """The reward's terms (section 3.3)."""

    step: float = -0.1
    slow: float = -0.05
    slow_speed: float = 0.3
    """Forward speed at the end of the step below which `slow` applies, m/s."""
    dolly_contact: float = -0.1
    other_contact: float = -10.0
    success: float = 10.0
    success_distance: Positive = 0.3
    """Distance of the centres that counts as docked, m."""

    @property
    def largest(self) -> float:
        """No step's reward is farther from 0."""
        endings = self.dolly_contact, self.other_contact, self.success
        return abs(self.step) + abs(self.slow) + max(map(abs, endings))


class ObstacleConfig(Section):
    """Boxes left and right of the dolly (appendix B: number and distance; the rest decided)."""

    count_min: Annotated[int, Field(ge=0)] = 1
    count_max: Annotated[int, Field(ge=0, le=12)] = 4
    distance_min: Positive = 2.0
    distance_max: Positive = 5.0
    """From the centre of the dolly, m."""
    spread: Annotated[float, Field(ge=0, le=90)] = 30.0
    """Largest angle to the left or right of the dolly, degrees."""
    size: Range = (0.3, 1.2)
    """Length and width, m."""
    height: Range = (0.4, 1.8)
    clearance: NotNegative = 0.4
    """Free space that an obstacle leaves around robot and dolly, m."""

    @model_validator(mode="after")
    def _ordered(self) -> ObstacleConfig:
        if self.count_min > self.count_max or self.distance_min > self.distance_max:
            raise ValueError("count_min <= count_max and distance_min <= distance_max must hold")
        if self.size[0] <= 0 or self.height[0] <= 0:
            raise ValueError("size and height must be positive")
        return self


Pattern = Literal[
    "plain",
    "concrete",
    "slabs",
    "checkers",
    "planks",
    "lanes",
    "terrazzo",
    "stains",
    "bricks",
    "panels",
    "stripes",
    "band",
    "blocks",
    "diagonal",
    "louvres",
    "herringbone",
    "cladding",
]
"""Seamless textures, drawn by actor/world/textures.py; the last four are seen in the arenas only."""
TRAINING_FLOORS: tuple[Pattern, ...] = (
    "concrete",
    "slabs",
    "checkers",
    "planks",
    "lanes",
    "terrazzo",
    "stains",
)
TRAINING_WALLS: tuple[Pattern, ...] = ("plain", "bricks", "panels", "stripes", "band", "blocks", "stains")
Quantity = Literal[
    "floor_pattern",
    "wall_pattern",
    "floor_tone",
    "wall_tone",
    "box_tone",
    "dolly_hue",
    "dolly_saturation",
    "dolly_value",
    "light_azimuth",
    "light_elevation",
    "light_color",
    "light_ambient",
    "light_diffuse",
    "camera_noise",
    "camera_exposure",
]


class LookRanges(Section):
    """How a place may look (section 3.3 names light, shape and patterns; ranges decided)."""

    floor_pattern: Annotated[tuple[Pattern, ...], Field(min_length=1)] = TRAINING_FLOORS
    wall_pattern: Annotated[tuple[Pattern, ...], Field(min_length=1)] = TRAINING_WALLS
    floor_tone: Shares = (0.5, 1.0)
    """Each of red, green and blue, as a share; no floor, wall or box is as blue as the dolly."""
    wall_tone: Shares = (0.5, 1.0)
    box_tone: Shares = (0.6, 1.0)
    dolly_hue: Range = (205.0, 245.0)
    """Degrees on the colour wheel; 225 is blue."""
    dolly_saturation: Shares = (0.7, 1.0)
    dolly_value: Shares = (0.5, 0.95)
    light_azimuth: Range = (-180.0, 180.0)
    """Direction of the lamp in the plane, degrees from +y."""
    light_elevation: Range = (30.0, 80.0)
    """Degrees above the floor. The renderer knows directions of light, not distances."""
    light_color: Shares = (0.85, 1.0)
    """Each of red, green and blue."""
    light_ambient: Shares = (0.45, 0.7)
    light_diffuse: Shares = (0.3, 0.6)
    camera_noise: Levels = (0.0, 3.0)
    """Standard deviation of a pixel, grey levels of 255."""
    camera_exposure: Range = (0.8, 1.2)
    """Factor on the light; the white beyond the walls stays as it is."""


class RandomizationConfig(Section):
    """Domain randomisation: ranges for the training cells and, apart from them, for the two arenas."""

    fixed: tuple[Literal["all", Quantity], ...] = ()
    """Quantities that are held at the middle of their range, or at their first pattern; `all` of these.

    Starts and obstacles are not among them: narrow their ranges instead.
    """
    training: LookRanges = LookRanges()
    validation: LookRanges = LookRanges(
        floor_pattern=("diagonal",),
        wall_pattern=("louvres",),
        light_elevation=(40.0, 65.0),
        light_color=(0.8, 0.95),
    )
    test: LookRanges = LookRanges(
        floor_pattern=("herringbone",),
        wall_pattern=("cladding",),
        light_elevation=(35.0, 75.0),
        light_color=(0.75, 0.95),
        light_ambient=(0.4, 0.6),
    )


class WorldConfig(Section):
    """The docking task, the same in every preset."""

    version: Literal[2] = 2
    """To be counted up by who changes how a scene is drawn, how the robot drives or what ends an episode."""
    control_period: Positive = 0.180
    """Seconds for which an action is held (section 3.3)."""
    substeps: Count = 36
    """Physics steps per control period; contact and success are checked at each."""
    max_episode_steps: Count = 100
    """Training; a truncation, never a terminal (decided)."""
    max_evaluation_steps: Count = 200
    robot: RobotConfig = RobotConfig()
    dolly: DollyConfig = DollyConfig()
    camera: CameraConfig = CameraConfig()
    lidar: LidarConfig = LidarConfig()
    reward: RewardConfig = RewardConfig()
    start: StartRanges = StartRanges()
    obstacles: ObstacleConfig = ObstacleConfig()
    randomization: RandomizationConfig = RandomizationConfig()

    @model_validator(mode="after")
    def _can_dock(self) -> WorldConfig:
        robot, dolly = self.robot, self.dolly
        if not robot.floor_gap < robot.height < dolly.underside:
            raise ValueError("robot.floor_gap < robot.height < dolly.underside must hold")
        if dolly.width - 2 * dolly.leg <= robot.width or dolly.length <= 2 * dolly.leg:
            raise ValueError("the robot must fit between the dolly's legs")
        if self.camera.near >= self.camera.far:
            raise ValueError("camera.near < camera.far must hold")
        for name, mount in robot.mounts:
            if abs(mount.x) > robot.width / 2 + 0.01 or abs(mount.y) > robot.length / 2 + 0.01:
                raise ValueError(f"robot.mounts.{name} lies outside the chassis; move it with x and y")
        return self
