"""Small things that several tests need: free ports, waiting, deliveries, episodes, shapely's polygons."""

from __future__ import annotations

import math
import resource
import signal
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh
from shapely import Polygon

from common.bus import ask_bytes
from common.config import Config, resolve
from common.delivery import Parcel, pack_bundle
from common.geometry import SE2, Rectangle
from common.messages import Ending, Episode, Message, Origin, Receipt, Version, decode, encode
from common.observation import ACTION_SIZE, ObservationLayout
from common.tasks import Task
from deploy.launcher import free_port

PATIENCE = 3.0
"""Times as long as on a quiet machine that tests wait for what must happen."""


def free_endpoint() -> str:
    """A Zenoh endpoint on loopback that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port()}"


def heed_ctrl_c() -> None:
    """Tests that run in the background of a script ignore it, and so would what they start."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_until(condition: Callable[[], Any], timeout: float = 10.0, what: str = "the condition") -> Any:
    """The first true value of `condition`, polled every 5 ms; fails after `timeout` s of a quiet machine."""
    timeout *= PATIENCE
    deadline = time.monotonic() + timeout
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"{what} did not come true within {timeout} s")
        time.sleep(0.005)
    return value


STORED = Receipt(answers=[""])
"""What is said of one message that the receiver has, now or from before."""


def parcel(
    payload: bytes | Message, seq: int, boot: str = "b1", address: str = "local/a1", crc: int | None = None
) -> Parcel:
    """A message as an actor sends it; with another checksum than its own when told so."""
    content = payload if isinstance(payload, bytes) else encode(payload)
    origin = Origin(actor=address, boot=boot, seq=seq)
    return Parcel(origin, zlib.crc32(content) if crc is None else crc, content)


def deliver_all(
    session: zenoh.Session, channel: str, parcels: list[Parcel], address: str = "local/a1"
) -> Receipt:
    """Sends messages in one delivery; raises what `ask_bytes` raises."""
    payload, attachment = pack_bundle(parcels)
    return decode(Receipt, ask_bytes(session, f"{channel}/{address}", payload, attachment, timeout=30.0))


def deliver(
    session: zenoh.Session,
    channel: str,
    message: Message | bytes,
    seq: int,
    boot: str = "b1",
    address: str = "local/a1",
) -> Receipt:
    """Sends one message as an actor does, and again under the same number if called again."""
    return deliver_all(session, channel, [parcel(message, seq, boot, address)], address)


def reason(receipt: Receipt) -> str:
    """Why the one message was refused, which it must have been."""
    (found,) = receipt.answers
    assert found, "it was not refused"
    return found


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Lets no file of this process grow beyond `size`, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, ignored)


def tiny_episode(
    config: Config,
    steps: int = 3,
    seed: int = 0,
    ending: Ending = "timeout",
    digest: dict[str, str] | None = None,
    cell: int = 0,
    version: Version | None = None,
) -> Episode:
    """A well-formed episode of `steps` random transitions in the layout of `config`."""
    layout, rng, rows = ObservationLayout.of(config), np.random.default_rng(seed), steps + 1
    shape = (rows, *layout.row_shape)
    if layout.row_dtype == "uint8":
        visual: np.ndarray = rng.integers(0, 256, shape, dtype=np.uint8)
    else:
        visual = rng.uniform(0, 2, shape).astype(np.float16)
    action = rng.uniform(-1, 1, (rows, ACTION_SIZE)).astype(np.float32)
    reward = rng.uniform(-1, 0, rows).astype(np.float32)
    action[-1], reward[-1] = 0, 0
    version = version or Version(epoch=1, counter=seed)
    return Episode(
        digest=digest if digest is not None else {"protocol": "1"},
        task=Task(cell=cell, seed=seed, start=config.world.start),
        visual=visual,
        lidar=rng.uniform(0, 1, (rows, layout.lidar)).astype(np.float16),
        action=action,
        reward=reward,
        ending=ending,
        first_version=version,
        last_version=version,
        category="random",
    )


def small_config(*overrides: str) -> Config:
    """Preset `smoke` with an observation of 32 numbers: everything is real, a row is a few bytes."""
    small = (
        "world.camera.size=16",
        "world.lidar.beams=2",
        "network.hidden=[16, 16]",
        "replay.warmup_steps=1",
    )
    return resolve("smoke", overrides=(*small, *overrides))


def in_frame(pose: SE2, right: float, ahead: float) -> tuple[float, float]:
    """The point that lies so far to the right of and ahead of a pose: yaw counts from +y to the left."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    return pose.x + right * c - ahead * s, pose.y + right * s + ahead * c


def strip(pose: SE2, left: float, right: float, back: float, front: float) -> Polygon:
    """What lies within those bounds in the frame of a pose, for shapely."""
    corners = ((left, back), (right, back), (right, front), (left, front))
    return Polygon([in_frame(pose, *corner) for corner in corners])


def polygon(rectangle: Rectangle) -> Polygon:
    """A rectangle for shapely, which then judges in place of the functions under test."""
    x, y = rectangle.half_x, rectangle.half_y
    return strip(rectangle.pose, -x, x, -y, y)
