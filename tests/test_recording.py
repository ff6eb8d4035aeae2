"""Recording: frames of a drive by the scripted controller, and the video that they become."""

import math
import sys

import av
import numpy as np
import pytest
from PIL import Image

from actor.evaluation.examiner import Rival, Terms, load_driver
from actor.recording import drive, write_video
from common.config import resolve
from common.errors import UsageError
from common.tasks import PlacedStart, Task
from common.world_config import StartRanges

CONFIG = resolve()
PERIOD = CONFIG.world.control_period
NEAR = StartRanges(distance_min=1.6, distance_max=1.6, yaw=0, bearing=0, dolly_yaw=0)
SIZE = (990, 772)
LONG = 120
"""More frames than the encoder holds back before it begins the file."""


@pytest.fixture(scope="module")
def docking():
    """Frames and endings of a short drive, and the number of its steps."""
    rollout, actor = load_driver(Rival("b0", CONFIG), Terms(max_steps=200), 1)
    drawn = list(drive(rollout, actor, Task(cell=0, seed=1, start=NEAR)))
    yield [frame for frame, _ in drawn], [ending for _, ending in drawn], rollout.worlds[0].steps
    rollout.close()


def patterns(count: int):
    """Frames that are easy to tell apart."""
    for index in range(count):
        yield Image.new("RGB", (64, 48), (20 * (index % 10), 128, 10 * (index // 10)))


def decode(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_drive_draws_the_start_and_every_step_and_ends_with_the_ending(docking):
    frames, endings, steps = docking
    assert len(frames) == steps + 1
    assert endings == [None] * steps + ["success"]
    assert {frame.size for frame in frames} == {SIZE}
    pictures = [frame.tobytes() for frame in frames]
    assert len(set(pictures)) == len(pictures)  # each shows another moment


def test_frame_shows_what_the_camera_saw(docking):
    frames, *_ = docking
    camera = np.asarray(frames[0].crop((664, 338, 978, 652))).astype(float)
    assert camera.std() > 20
    blue = (camera[..., 2] > 1.5 * camera[..., 0]) & (camera[..., 2] > 1.5 * camera[..., 1])
    assert blue.mean() > 0.05  # the dolly straight ahead
    assert np.nonzero(blue)[1].mean() == pytest.approx(157, abs=25)


def test_drive_that_runs_out_of_time_says_so():
    rollout, actor = load_driver(Rival("b0", CONFIG), Terms(max_steps=2), 1)
    try:
        far = Task(cell=0, seed=1, start=PlacedStart(x=0.0, y=-4.0, yaw=0.0))
        assert [ending for _, ending in drive(rollout, actor, far)] == [None, None, "timeout"]
    finally:
        rollout.close()


def test_video_decodes_to_the_frames_at_their_size_and_in_real_time(docking, tmp_path):
    frames, *_ = docking
    path = tmp_path / "docking.mp4"
    assert write_video(path, iter(frames), PERIOD) == len(frames)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == SIZE
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"  # what browsers play
        assert float(stream.average_rate) == pytest.approx(1 / 0.18, rel=1e-6)
        assert float(stream.duration * stream.time_base) == pytest.approx(0.18 * len(frames), abs=0.01)
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([0.18 * index for index in range(len(frames))], abs=1e-3)
    for drawn, decoded in zip(frames, decode(path), strict=True):
        assert abs(np.asarray(drawn).astype(int) - decoded).mean() < 12


def test_only_the_complete_video_appears(tmp_path):
    path, seen = tmp_path / "x.mp4", []

    def watched():
        for frame in patterns(LONG):
            seen.append({entry.name for entry in tmp_path.iterdir()})
            yield frame

    assert write_video(path, watched(), PERIOD) == LONG
    assert set().union(*seen) == {"x.mp4.part"}
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.mp4"]
    colours = [picture.mean(axis=(0, 1)) for picture in decode(path)]
    expected = [np.asarray(frame).mean(axis=(0, 1)) for frame in patterns(LONG)]
    assert np.array(colours) == pytest.approx(np.array(expected), abs=8)  # in order


@pytest.mark.parametrize("good", [0, 3, LONG])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_writing_leaves_nothing(tmp_path, good, error):
    seen = set()

    def broken():
        yield from patterns(good)
        seen.update(entry.name for entry in tmp_path.iterdir())
        raise error("no more")

    with pytest.raises(error, match="no more"):
        write_video(tmp_path / "x.mp4", broken(), PERIOD)
    assert seen == ({"x.mp4.part"} if good == LONG else set())
    assert list(tmp_path.iterdir()) == []


def test_interrupted_writing_leaves_an_older_video_alone(tmp_path):
    path = tmp_path / "x.mp4"
    write_video(path, patterns(4), PERIOD)
    before = path.read_bytes()

    def broken():
        yield from patterns(LONG)
        raise RuntimeError

    with pytest.raises(RuntimeError):
        write_video(path, broken(), PERIOD)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.mp4"]


def test_without_pyav_one_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UsageError) as refused:
        write_video(tmp_path / "x.mp4", patterns(2), PERIOD)
    assert str(refused.value) == "recording needs PyAV: pip install 'navaclq[video]'"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("period", [0.18, 0.1, 1 / 3])
def test_rate_is_that_of_the_control_period(tmp_path, period):
    write_video(tmp_path / "x.mp4", patterns(3), period)
    with av.open(str(tmp_path / "x.mp4")) as container:
        rate = float(container.streams.video[0].average_rate)
    assert math.isclose(rate, 1 / period, rel_tol=1e-3)
