import json
import logging
import resource
import signal
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from common.messages import Episode, Origin, decode, encode
from learner.log import EpisodeLog, Record
from tests.helpers import small_config, tiny_episode

CAPACITY = 1000


def origin(seq: int, boot: str = "b1") -> Origin:
    return Origin(actor="a1", boot=boot, seq=seq)


def opened(
    folder: Path, capacity: int = CAPACITY, segment_bytes: int = 2**20
) -> tuple[EpisodeLog, list[Record]]:
    log = EpisodeLog(folder, capacity, segment_bytes)
    return log, list(log.restore())


def filled(folder: Path, count: int = 3) -> Path:
    """The one segment of a log of `count` episodes of 1, 2, 3, ... transitions."""
    log, _ = opened(folder)
    for seq in range(count):
        log.append(origin(seq), seq + 1, f"episode {seq}".encode())
    log.close()
    return folder / "00000001.log"


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


def test_episodes_come_back_in_order_with_the_counts_after_each(tmp_path):
    log, records = opened(tmp_path / "log")
    assert records == []
    episodes = [tiny_episode(small_config(), steps, seed=steps) for steps in (3, 1, 7)]
    written = [log.append(origin(i), e.length, encode(e)) for i, e in enumerate(episodes)]
    assert (log.env_steps, log.episodes) == (11, 3)
    log.close()
    again, records = opened(tmp_path / "log")
    assert records == written
    assert [(r.origin.seq, r.env_steps, r.episodes, r.length) for r in records] == [
        (0, 3, 1, 3),
        (1, 4, 2, 1),
        (2, 11, 3, 7),
    ]
    assert (again.env_steps, again.episodes) == (11, 3)
    assert [encode(decode(Episode, r.payload)) for r in records] == [encode(e) for e in episodes]


def test_record_is_on_file_when_append_returns(tmp_path):
    log, _ = opened(tmp_path)
    log.append(origin(0), 3, b"payload")
    _, records = opened(tmp_path)  # while the first is still open, as after a SIGKILL
    assert [r.payload for r in records] == [b"payload"]


def test_counts_and_duplicates_go_on_after_a_restart(tmp_path):
    filled(tmp_path)
    log, _ = opened(tmp_path)
    assert [log.seen.seen(origin(seq)) for seq in range(4)] == [True, True, True, False]
    assert not log.seen.seen(origin(0, boot="b2"))
    record = log.append(origin(3), 10, b"more")
    assert (record.env_steps, record.episodes) == (16, 4)


def test_torn_tail_is_cut_and_reported_wherever_the_tear_is_and_appending_goes_on(tmp_path, caplog):
    segment = filled(tmp_path / "whole")
    whole = segment.read_bytes()
    end_of_second = filled(tmp_path / "two", 2).stat().st_size
    assert whole[:end_of_second] == (tmp_path / "two" / "00000001.log").read_bytes()
    for cut in range(end_of_second, len(whole)):
        torn = tmp_path / f"torn-{cut}"
        torn.mkdir()
        (torn / "00000001.log").write_bytes(whole[:cut])
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            log, records = opened(torn)
        assert [r.payload for r in records] == [b"episode 0", b"episode 1"]
        assert (log.env_steps, log.episodes) == (3, 2)
        assert not log.seen.seen(origin(2)), "the sender still has it, and may send it again"
        lost = cut - end_of_second
        if lost:
            assert f"cut a torn tail of {lost} bytes" in caplog.text
        else:
            assert caplog.text == ""
        log.append(origin(2), 3, b"episode 2")
        log.append(origin(3), 4, b"episode 3")
        log.close()
        caplog.clear()
        _, records = opened(torn)
        assert [r.payload for r in records] == [b"episode 0", b"episode 1", b"episode 2", b"episode 3"]
        assert caplog.text == ""


def test_flipped_bit_anywhere_in_a_record_is_noticed(tmp_path, caplog):
    segment = filled(tmp_path / "whole")
    whole, start = segment.read_bytes(), filled(tmp_path / "two", 2).stat().st_size
    for position in range(start, len(whole)):
        data = bytearray(whole)
        data[position] ^= 0x10
        segment.write_bytes(data)
        caplog.clear()
        log, records = opened(segment.parent)
        log.close()
        assert [r.payload for r in records] == [b"episode 0", b"episode 1"], f"byte {position}"
        assert f"cut a torn tail of {len(whole) - start} bytes" in caplog.text


def test_file_of_zeros_after_the_last_record_is_cut(tmp_path):
    segment = filled(tmp_path)
    size = segment.stat().st_size
    segment.write_bytes(segment.read_bytes() + bytes(100))
    _, records = opened(tmp_path)
    assert len(records) == 3
    assert segment.stat().st_size == size


def test_damage_in_an_older_segment_spares_the_newer_ones(tmp_path):
    log, _ = opened(tmp_path, segment_bytes=1)  # a segment per episode
    for seq in range(3):
        log.append(origin(seq), 1, bytes([seq]))
    log.close()
    middle = tmp_path / "00000002.log"
    middle.write_bytes(middle.read_bytes()[:-1] + b"x")
    log, records = opened(tmp_path, segment_bytes=1)
    assert [r.payload for r in records] == [b"\x00", b"\x02"]
    assert (log.env_steps, log.episodes) == (3, 3)


def test_segments_rotate_and_go_when_the_ring_no_longer_needs_them(tmp_path):
    log, _ = opened(tmp_path, capacity=20, segment_bytes=1000)
    for seq in range(200):
        log.append(origin(seq), 4, bytes(300))
        names = sorted(path.name for path in tmp_path.glob("*.log"))
        assert len(names) <= 4
        kept = sum(r.length for path in names for r in EpisodeLog(tmp_path, 20)._read(tmp_path / path))
        assert kept >= min(20, log.env_steps), "the ring still needs them"
    log.close()
    assert not (tmp_path / "00000001.log").exists()
    assert list(tmp_path.glob("*.part")) == []
    assert all(path.stat().st_size < 1000 + 400 for path in tmp_path.glob("*.log"))
    again, records = opened(tmp_path, capacity=20, segment_bytes=1000)
    sequence = [r.origin.seq for r in records]
    assert sequence == list(range(sequence[0], 200))
    assert (again.env_steps, again.episodes) == (800, 200)


def test_duplicates_of_dropped_episodes_stay_recognised_after_a_restart(tmp_path):
    log, _ = opened(tmp_path, capacity=5, segment_bytes=100)
    order = [0, 1, 2, 4, 5, *range(6, 60)]  # 3 never came
    for seq in order:
        log.append(origin(seq), 4, bytes(60))
    log.close()
    again, records = opened(tmp_path, capacity=5, segment_bytes=100)
    assert {0, 1, 2} & {r.origin.seq for r in records} == set()
    assert [seq for seq in range(70) if again.seen.seen(origin(seq))] == order


def test_rotation_goes_on_after_a_restart(tmp_path):
    for start in range(0, 60, 10):
        log, records = opened(tmp_path, capacity=20, segment_bytes=400)
        assert sum(r.length for r in records) >= min(20, 4 * start)
        for seq in range(start, start + 10):
            log.append(origin(seq), 4, bytes(100))
        log.close()
    numbers = sorted(int(path.stem) for path in tmp_path.glob("*.log"))
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert 2 <= len(numbers) <= 5
    assert json.loads((tmp_path / "seen.json").read_text())[0][:2] == ["a1", "b1"]


def test_append_that_fails_for_want_of_space_leaves_no_trace(tmp_path):
    segment = filled(tmp_path)
    log, _ = opened(tmp_path)
    size = segment.stat().st_size
    with largest_file(size + 40):
        for _ in range(3):  # the sender tries again
            with pytest.raises(OSError):
                log.append(origin(3), 4, bytes(100))
            assert segment.stat().st_size == size
    assert not log.seen.seen(origin(3))
    assert (log.env_steps, log.episodes) == (6, 3)
    log.append(origin(3), 4, bytes(100))
    log.close()
    _, records = opened(tmp_path)
    assert [r.origin.seq for r in records] == [0, 1, 2, 3]


def test_rotation_that_fails_for_want_of_space_is_made_up_for(tmp_path):
    log, _ = opened(tmp_path, capacity=5, segment_bytes=1)
    log.append(origin(0), 4, b"first")
    with largest_file(4):
        for _ in range(2):
            with pytest.raises(OSError):
                log.append(origin(1), 4, b"second")
    log.append(origin(1), 4, b"second")
    log.close()
    _, records = opened(tmp_path)
    assert [r.payload for r in records] == [b"first", b"second"]
    assert list(tmp_path.glob("*.part")) == []


def test_failed_append_after_a_torn_tail_leaves_no_hole(tmp_path):
    segment = filled(tmp_path)
    size = segment.stat().st_size
    segment.write_bytes(segment.read_bytes() + b"NVQ1torn" * 20)
    log, _ = opened(tmp_path)
    with largest_file(size + 10), pytest.raises(OSError):
        log.append(origin(3), 4, b"late")
    assert segment.stat().st_size == size
    log.append(origin(3), 4, b"late")
    _, records = opened(tmp_path)
    assert [r.payload for r in records][-1] == b"late"


def test_checksum_is_of_the_body(tmp_path):
    data = filled(tmp_path, 1).read_bytes()
    assert data[:4] == b"NVQ1"
    assert int.from_bytes(data[4:8], "little") == len(data) - 12
    assert int.from_bytes(data[8:12], "little") == zlib.crc32(data[12:])
