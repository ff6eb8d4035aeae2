import errno
import json
import logging
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from common.delivery import Parcel
from common.errors import UsageError
from common.messages import Episode, Origin, decode, encode
from learner.learner import Learner
from learner.log import EpisodeLog, Record
from tests.helpers import largest_file, small_config, tiny_episode

CAPACITY = 1000


def origin(seq: int, boot: str = "b1") -> Origin:
    return Origin(actor="a1", boot=boot, seq=seq)


def opened(
    folder: Path, capacity: int = CAPACITY, segment_bytes: int = 2**20
) -> tuple[EpisodeLog, list[Record]]:
    log = EpisodeLog(folder, capacity, segment_bytes)
    return log, list(log.restore())


class Syncs:
    """os.fdatasync with its calls counted: (file, size) each. `fail` makes the next so many raise."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []
        self.fail = 0
        self.before: Callable[[], None] = lambda: None
        self._real = os.fdatasync

    def __call__(self, descriptor: int) -> None:
        self.before()
        path = Path(f"/proc/self/fd/{descriptor}").resolve()
        self.calls.append((path.name, os.fstat(descriptor).st_size))
        if self.fail:
            self.fail -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._real(descriptor)


@pytest.fixture
def syncs(monkeypatch) -> Syncs:
    found = Syncs()
    monkeypatch.setattr(os, "fdatasync", found)
    return found


def filled(folder: Path, count: int = 3) -> Path:
    """The one segment of a log of `count` episodes of 1, 2, 3, ... transitions."""
    log, _ = opened(folder)
    for seq in range(count):
        log.append(Parcel.of(origin(seq), f"episode {seq}".encode()), seq + 1)
    log.close()
    return folder / "00000001.log"


def test_episodes_come_back_in_order_with_the_counts_after_each(tmp_path):
    log, records = opened(tmp_path / "log")
    assert records == []
    episodes = [tiny_episode(small_config(), steps, seed=steps) for steps in (3, 1, 7)]
    written = [log.append(Parcel.of(origin(i), encode(e)), e.length) for i, e in enumerate(episodes)]
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
    log.append(Parcel.of(origin(0), b"payload"), 3)
    _, records = opened(tmp_path)  # while the first is still open, as after a SIGKILL
    assert [r.payload for r in records] == [b"payload"]


def test_counts_and_duplicates_go_on_after_a_restart(tmp_path):
    filled(tmp_path)
    log, _ = opened(tmp_path)
    assert [log.seen.seen(origin(seq)) for seq in range(4)] == [True, True, True, False]
    assert not log.seen.seen(origin(0, boot="b2"))
    record = log.append(Parcel.of(origin(3), b"more"), 10)
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
        log.append(Parcel.of(origin(2), b"episode 2"), 3)
        log.append(Parcel.of(origin(3), b"episode 3"), 4)
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


def spans(folder: Path) -> tuple[bytes, int, int]:
    """A log of five episodes, and where its third record begins and ends."""
    whole = filled(folder / "whole", 5).read_bytes()
    begin, end = (filled(folder / str(count), count).stat().st_size for count in (2, 3))
    return whole, begin, end


def assert_only_the_third_is_missing(folder: Path, caplog, skipped: int, where: str) -> None:
    caplog.clear()
    log, records = opened(folder)
    log.close()
    assert [r.origin.seq for r in records] == [0, 1, 3, 4], where
    assert [r.payload for r in records] == [f"episode {seq}".encode() for seq in (0, 1, 3, 4)]
    # the counts after each are those of the run, in which the lost episode did take place
    assert [(r.env_steps, r.episodes) for r in records] == [(1, 1), (3, 2), (10, 4), (15, 5)]
    assert (log.env_steps, log.episodes) == (15, 5)
    assert [log.seen.seen(origin(seq)) for seq in range(6)] == [True, True, False, True, True, False]
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert warnings == [
        f"{folder / '00000001.log'}: skipped {skipped} damaged bytes before a whole record"
    ], where


def test_flipped_bit_anywhere_in_the_middle_costs_only_the_record_it_hits(tmp_path, caplog):
    whole, begin, end = spans(tmp_path)
    for position in range(begin, end):
        for bit in (0x01, 0x80):
            data = bytearray(whole)
            data[position] ^= bit
            (tmp_path / "whole" / "00000001.log").write_bytes(data)
            assert_only_the_third_is_missing(
                tmp_path / "whole", caplog, end - begin, f"byte {position}, bit {bit}"
            )
    # reading changed nothing: the same file, repaired, is whole again
    assert (tmp_path / "whole" / "00000001.log").stat().st_size == len(whole)


@pytest.mark.parametrize("pattern", [b"\x00", b"\xff", b"NVQ2", b"NVQ2\x05\x00\x00\x00\x00\x00\x00\x00"])
def test_overwritten_bytes_anywhere_in_the_middle_cost_only_the_record_they_hit(tmp_path, caplog, pattern):
    whole, begin, end = spans(tmp_path)
    for first in range(begin, end):
        for last in {min(first + 4, end), min(first + 16, end), end}:
            damage = (pattern * (last - first))[: last - first]
            if damage == whole[first:last]:
                continue
            (tmp_path / "whole" / "00000001.log").write_bytes(whole[:first] + damage + whole[last:])
            assert_only_the_third_is_missing(
                tmp_path / "whole", caplog, end - begin, f"bytes {first} to {last}"
            )


def test_bytes_that_vanish_from_the_middle_cost_only_the_record_they_belonged_to(tmp_path, caplog):
    whole, begin, end = spans(tmp_path)
    for gone in range(begin, end):
        (tmp_path / "whole" / "00000001.log").write_bytes(whole[:gone] + whole[gone + 1 :])
        assert_only_the_third_is_missing(tmp_path / "whole", caplog, end - begin - 1, f"byte {gone}")


def test_damage_over_the_border_of_two_records_costs_both_and_no_third(tmp_path, caplog):
    whole, begin, end = spans(tmp_path)
    segment = tmp_path / "whole" / "00000001.log"
    segment.write_bytes(whole[: begin - 1] + b"xx" + whole[begin + 1 :])
    log, records = opened(segment.parent)
    log.close()
    assert [r.origin.seq for r in records] == [0, 3, 4]
    assert (log.env_steps, log.episodes) == (15, 5)
    second = filled(tmp_path / "one", 1).stat().st_size
    assert f"skipped {end - second} damaged bytes before a whole record" in caplog.text


def test_appending_goes_on_behind_damage_in_the_middle(tmp_path):
    whole, begin, _ = spans(tmp_path)
    segment = tmp_path / "whole" / "00000001.log"
    segment.write_bytes(whole[:begin] + b"oops" + whole[begin + 4 :])
    log, _ = opened(segment.parent)
    record = log.append(Parcel.of(origin(5), b"episode 5"), 6)
    assert (record.env_steps, record.episodes) == (21, 6)
    again = log.append(Parcel.of(origin(2), b"episode 2, which its sender still had"), 3)
    assert (again.env_steps, again.episodes) == (24, 7)
    log.close()
    _, records = opened(segment.parent)
    assert [r.origin.seq for r in records] == [0, 1, 3, 4, 5, 2]


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
        log.append(Parcel.of(origin(seq), bytes([seq])), 1)
    log.close()
    middle = tmp_path / "00000002.log"
    middle.write_bytes(middle.read_bytes()[:-1] + b"x")
    log, records = opened(tmp_path, segment_bytes=1)
    assert [r.payload for r in records] == [b"\x00", b"\x02"]
    assert (log.env_steps, log.episodes) == (3, 3)


def test_segments_rotate_and_go_when_the_ring_no_longer_needs_them(tmp_path):
    log, _ = opened(tmp_path, capacity=20, segment_bytes=1000)
    for seq in range(200):
        log.append(Parcel.of(origin(seq), bytes(300)), 4)
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
        log.append(Parcel.of(origin(seq), bytes(60)), 4)
    log.close()
    again, records = opened(tmp_path, capacity=5, segment_bytes=100)
    assert {0, 1, 2} & {r.origin.seq for r in records} == set()
    assert [seq for seq in range(70) if again.seen.seen(origin(seq))] == order


def test_rotation_goes_on_after_a_restart(tmp_path):
    for start in range(0, 60, 10):
        log, records = opened(tmp_path, capacity=20, segment_bytes=400)
        assert sum(r.length for r in records) >= min(20, 4 * start)
        for seq in range(start, start + 10):
            log.append(Parcel.of(origin(seq), bytes(100)), 4)
        log.close()
    numbers = sorted(int(path.stem) for path in tmp_path.glob("*.log"))
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert 2 <= len(numbers) <= 5
    assert json.loads((tmp_path / "seen.json").read_text())[0][:2] == ["a1", "b1"]


def test_replay_after_any_number_of_kills_holds_exactly_the_newest_episodes_once(tmp_path):
    """The ring wraps around, segments are dropped, and no life ends in an orderly way."""
    config = small_config("replay.capacity=200")
    rng, number, expected = np.random.default_rng(3), 0, []
    for life in range(8):
        log, learner = EpisodeLog(tmp_path, 200, segment_bytes=4000), Learner(config)
        for record in log.restore():
            episode = decode(Episode, record.payload)
            learner.insert(episode, record.env_steps - record.length, restored=True)
        steps = learner.replay.priorities()[0].tolist()
        assert len(steps) == len(set(steps)) == learner.replay.transitions
        kept: list[range] = []
        for span in reversed(expected):  # the newest that fit
            if sum(map(len, kept)) + len(span) > 200:
                break
            kept.append(span)
        assert sorted(steps) == [step for span in reversed(kept) for step in span], f"life {life}"
        for _ in range(int(rng.integers(1, 40))):
            episode = tiny_episode(config, int(rng.integers(1, 21)), seed=number)
            record = log.append(Parcel.of(origin(number), encode(episode)), episode.length)
            learner.insert(episode, record.env_steps - record.length)
            expected.append(range(record.env_steps - record.length, record.env_steps))
            number += 1
    assert len(list(tmp_path.glob("*.log"))) < number / 5, "segments were dropped"


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", '[["a", "b", "c", []]]'])
def test_damaged_memory_of_duplicates_is_named(tmp_path, content):
    filled(tmp_path)
    (tmp_path / "seen.json").write_text(content)
    with pytest.raises(UsageError, match=r"seen.json is damaged .*; without it the run goes on, but"):
        opened(tmp_path)


def test_files_that_are_no_segments_are_left_alone(tmp_path):
    filled(tmp_path)
    (tmp_path / "notes.log").write_text("mine")
    log, records = opened(tmp_path)
    log.append(Parcel.of(origin(3), b"more"), 1)
    assert len(records) == 3
    assert (tmp_path / "notes.log").read_text() == "mine"


def test_segment_that_cannot_be_read_is_named(tmp_path):
    filled(tmp_path)
    (tmp_path / "00000000.log").mkdir()
    with pytest.raises(UsageError, match=r"cannot read .*00000000.log: Is a directory"):
        opened(tmp_path)


def test_what_was_appended_before_a_kill_is_committed_before_a_duplicate_is_confirmed(tmp_path, syncs):
    log, _ = opened(tmp_path)
    log.append(Parcel.of(origin(0), b"never committed"), 1)
    again = EpisodeLog(tmp_path, CAPACITY, sync=True)
    assert len(list(again.restore())) == 1
    assert again.seen.seen(origin(0))
    again.commit()
    assert [name for name, _ in syncs.calls] == ["00000001.log"]


def test_append_that_fails_for_want_of_space_leaves_no_trace(tmp_path):
    segment = filled(tmp_path)
    log, _ = opened(tmp_path)
    size = segment.stat().st_size
    with largest_file(size + 40):
        for _ in range(3):  # the sender tries again
            with pytest.raises(OSError):
                log.append(Parcel.of(origin(3), bytes(100)), 4)
            assert segment.stat().st_size == size
    assert not log.seen.seen(origin(3))
    assert (log.env_steps, log.episodes) == (6, 3)
    log.append(Parcel.of(origin(3), bytes(100)), 4)
    log.close()
    _, records = opened(tmp_path)
    assert [r.origin.seq for r in records] == [0, 1, 2, 3]


def test_rotation_that_fails_for_want_of_space_is_made_up_for(tmp_path):
    log, _ = opened(tmp_path, capacity=5, segment_bytes=1)
    log.append(Parcel.of(origin(0), b"first"), 4)
    with largest_file(4):
        for _ in range(2):
            with pytest.raises(OSError):
                log.append(Parcel.of(origin(1), b"second"), 4)
    log.append(Parcel.of(origin(1), b"second"), 4)
    log.close()
    _, records = opened(tmp_path)
    assert [r.payload for r in records] == [b"first", b"second"]
    assert list(tmp_path.glob("*.part")) == []


def test_failed_append_after_a_torn_tail_leaves_no_hole(tmp_path):
    segment = filled(tmp_path)
    size = segment.stat().st_size
    segment.write_bytes(segment.read_bytes() + b"NVQ2torn" * 20)
    log, _ = opened(tmp_path)
    with largest_file(size + 10), pytest.raises(OSError):
        log.append(Parcel.of(origin(3), b"late"), 4)
    assert segment.stat().st_size == size
    log.append(Parcel.of(origin(3), b"late"), 4)
    _, records = opened(tmp_path)
    assert [r.payload for r in records][-1] == b"late"


def test_checksums_are_of_the_counts_and_the_payload(tmp_path):
    data = filled(tmp_path, 1).read_bytes()
    assert data[:4] == b"NVQ2"
    size, crc, payload_size, payload_crc = struct.unpack_from("<4I", data, 4)
    assert 20 + size + payload_size == len(data)
    assert crc == zlib.crc32(data[20 : 20 + size])
    assert payload_crc == zlib.crc32(data[20 + size :])


def test_log_of_an_earlier_version_is_refused_and_left_alone(tmp_path):
    segment = filled(tmp_path)
    earlier = segment.read_bytes().replace(b"NVQ2", b"NVQ1")
    segment.write_bytes(earlier)
    with pytest.raises(UsageError, match="earlier version"):
        opened(tmp_path)
    assert segment.read_bytes() == earlier


def synced(folder: Path, segment_bytes: int = 2**20) -> EpisodeLog:
    """A log whose commits reach the disk, with nothing in it yet."""
    log = EpisodeLog(folder, CAPACITY, segment_bytes, sync=True)
    assert list(log.restore()) == []
    return log


def test_one_commit_brings_many_appends_to_the_disk_with_one_wait(tmp_path, syncs):
    log = synced(tmp_path)
    log.commit()
    assert syncs.calls == [], "there was nothing to wait for"
    for group in (range(0, 50), range(50, 51), range(51, 60)):
        syncs.calls.clear()
        for seq in group:
            log.append(Parcel.of(origin(seq), bytes(100)), 1)
        assert syncs.calls == [], "an append does not wait"
        log.commit()
        # of the right file, when all of it was written
        assert syncs.calls == [("00000001.log", (tmp_path / "00000001.log").stat().st_size)]
        log.commit()
        assert len(syncs.calls) == 1, "what is on the disk is not waited for again"
    log.close()
    assert len(opened(tmp_path)[1]) == 60


def test_a_segment_is_on_the_disk_before_the_next_one_begins(tmp_path, syncs):
    log = synced(tmp_path, segment_bytes=300)
    for seq in range(6):  # two episodes fill a segment
        log.append(Parcel.of(origin(seq), bytes(150)), 1)
    sizes = {path.name: path.stat().st_size for path in sorted(tmp_path.glob("*.log"))}
    assert list(sizes) == ["00000001.log", "00000002.log", "00000003.log"]
    assert syncs.calls == [(name, sizes[name]) for name in ("00000001.log", "00000002.log")]
    log.commit()
    assert syncs.calls[2:] == [("00000003.log", sizes["00000003.log"])]


def test_without_sync_no_episode_waits_for_the_disk(tmp_path, syncs):
    log, _ = opened(tmp_path, segment_bytes=300)
    for seq in range(6):
        log.append(Parcel.of(origin(seq), bytes(150)), 1)
        log.commit()
    log.close()
    assert syncs.calls == []


def test_names_of_new_segments_are_brought_to_the_disk_with_sync(tmp_path, monkeypatch):
    folders, real = [], os.fsync

    def fsync(descriptor: int) -> None:
        folders.append(Path(f"/proc/self/fd/{descriptor}").resolve())
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    log = synced(tmp_path, segment_bytes=300)
    for seq in range(6):
        log.append(Parcel.of(origin(seq), bytes(150)), 1)
    assert folders.count(tmp_path.resolve()) >= 3


def test_commit_that_failed_never_says_later_that_all_is_well(tmp_path, syncs):
    log = synced(tmp_path)
    log.append(Parcel.of(origin(0), b"lost"), 1)
    syncs.fail = 1
    with pytest.raises(OSError, match="Input/output"):
        log.commit()
    # Linux tells of a failed write once: the next fdatasync of the file succeeds, with the data still lost
    with pytest.raises(OSError):
        log.commit()
    with pytest.raises(OSError):
        log.append(Parcel.of(origin(1), b"new"), 1)
        log.commit()


def test_rotation_whose_wait_for_the_disk_fails_makes_every_later_commit_fail(tmp_path, syncs):
    log = synced(tmp_path, segment_bytes=1)
    log.append(Parcel.of(origin(0), b"lost"), 1)
    syncs.fail = 1
    with pytest.raises(OSError, match="Input/output"):
        log.append(Parcel.of(origin(1), b"next segment"), 1)
    with pytest.raises(OSError):  # it would acknowledge what the disk has lost
        log.commit()


def test_duplicates_that_a_rotation_writes_down_are_on_the_disk_before(tmp_path, syncs):
    log = synced(tmp_path / "log", segment_bytes=1)
    copies: list[Path] = []

    def lose_power() -> None:
        """The folder as it is found when power fails now: without what was never waited for."""
        copy = tmp_path / f"copy-{len(copies)}"
        shutil.copytree(tmp_path / "log", copy)
        os.truncate(copy / f"{len(copies) + 1:08d}.log", 0)
        copies.append(copy)

    syncs.before = lose_power
    for seq in range(4):
        log.append(Parcel.of(origin(seq), b"episode"), 1)
    log.close()
    assert len(copies) == 3
    for seq, copy in enumerate(copies):
        found, records = opened(copy)
        assert [r.origin.seq for r in records] == list(range(seq))
        assert not found.seen.seen(origin(seq)), "its sender, never told, would be told `duplicate`"
