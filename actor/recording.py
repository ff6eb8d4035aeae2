"""Recording: one episode of a policy as a video with camera, bird's eye, LiDAR, action and reward."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from actor.inference import Actor
from actor.rollout import Rollout
from actor.world.views import video_frame
from common.errors import UsageError
from common.messages import Ending
from common.tasks import Task


def drive(rollout: Rollout, actor: Actor, task: Task) -> Iterator[tuple[Image.Image, Ending | None]]:
    """Frames of an episode in slot 0 of a rollout; the last one comes with the ending."""
    world, ending = rollout.worlds[0], None
    rollout.reset(0, task)
    rewards, trail = list[float](), [(world.pose.x, world.pose.y)]
    sensed, action, _ = rollout.newest(0)
    yield video_frame(world, sensed, action, rewards, trail), None
    while ending is None:
        finished = rollout.step(actor)
        sensed, action, reward = rollout.newest(0)
        rewards.append(reward)
        trail.append((world.pose.x, world.pose.y))
        ending = finished[0].ending if finished else None
        yield video_frame(world, sensed, action, rewards, trail), ending


def write_video(path: Path, frames: Iterator[Image.Image], period: float) -> int:
    """Writes H.264 in MP4 at one frame each `period` s; returns the number of frames.

    The file appears when it is complete. Raises UsageError when PyAV is not installed or the file cannot be
    written.
    """
    try:
        import av
    except ImportError:
        raise UsageError("recording needs PyAV: pip install 'navaclq[video]'") from None
    part, count = path.with_name(path.name + ".part"), 0
    try:
        with av.open(str(part), "w", format="mp4") as container:
            stream = None
            for frame in frames:
                if stream is None:
                    stream = container.add_stream(
                        "libx264", rate=Fraction(1 / period).limit_denominator(1000)
                    )
                    stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, "yuv420p"
                    stream.options = {"crf": "28"}
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(frame), format="rgb24")))
                count += 1
            if stream is not None:
                container.mux(stream.encode())
        part.replace(path)
    except OSError as error:  # PyAV's errors are among them
        raise UsageError(f"cannot write {path}: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)
    return count
