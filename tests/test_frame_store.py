"""The frames on disk: read back to the bit, after every kind of end, and never silently damaged."""

import hashlib
import json
import logging
import shutil
from pathlib import Path

import msgpack
import numpy as np
import pytest

from common.config import Config
from common.delivery import Parcel
from common.errors import UsageError
from common.frames import Film
from common.messages import Frames, MessageError, Origin, decode, encode
from common.tasks import FIRST_SUITE_SEED, Task
from learner.log import EpisodeLog
from learner.pretraining import frame_store
from learner.pretraining.frame_store import FrameStore
from tests.helpers import small_config
from tests.test_episode_log import largest_file

LENGTHS = (3, 4, 1, 4, 2, 4, 4, 3, 2, 4, 4, 1)
"""Frames of the drives: 36 in all."""
SEEDS = (10, 3, 20, 7, 11, 30, 101, 5, 9, 40, 2, 6)
"""Of their tasks: every drive with a seed that ends in 0 is held out."""


def settings(sequences: int = 30, *more: str) -> Config:
    return small_config(f"pretraining.sequences={sequences}", "pretraining.drive_steps=3", *more)


def drive(index: int, seed: int | None = None, **changes: np.ndarray) -> Frames:
    """A drive of random numbers, the same for the same index."""
    rng, length = np.random.default_rng(index), LENGTHS[index % len(LENGTHS)]
    arrays: dict[str, np.ndarray] = {
        "frame": rng.integers(0, 256, (length, 16, 16, 3), dtype=np.uint8),
        "mask": rng.integers(0, 256, (length, 32), dtype=np.uint8),
        "goal": rng.normal(size=(length, 3)).astype(np.float32),
    }
    task = Task(
        cell=index % 9,
        seed=SEEDS[index % len(SEEDS)] if seed is None else seed,
        start=settings().world.start,
    )
    return Frames(digest={"protocol": "1"}, task=task, **(arrays | changes))


def origin(seq: int, boot: str = "b1") -> Origin:
    return Origin(actor="a1", boot=boot, seq=seq)


def add(store: FrameStore, index: int, boot: str = "b1") -> bool:
    """Adds a drive as the receiver of frames does; False when it was there before."""
    message = drive(index)
    if store.seen(origin(index, boot)):
        return False
    store.add(Parcel.of(origin(index, boot), encode(message)), message)
    assert store.seen(origin(index, boot))
    return True


def filled(folder: Path, count: int, config: Config | None = None) -> FrameStore:
    """A store of so many drives; sealed when that is enough of them, as `navaclq pretrain` does."""
    store = FrameStore(folder, config or settings())
    for index in range(count):
        assert add(store, index)
    store.close()
    if store.complete:
        store.seal()
    return store


def expected(indices: list[int], rows: int) -> Film:
    """All that these drives hold, one after the other, cut at `rows`."""
    drives = [drive(index) for index in indices]
    return Film(
        *(np.concatenate([getattr(d, name) for d in drives])[:rows] for name in ("frame", "mask", "goal"))
    )


def check(store: FrameStore, indices: list[int], rows: int) -> None:
    """The store holds exactly these drives, in this order."""
    table, held = store.load()
    for name, value in expected(indices, rows)._asdict().items():
        found = getattr(table, name)
        assert found.dtype == value.dtype
        assert np.array_equal(found, value), name
    lengths = [LENGTHS[index % len(LENGTHS)] for index in indices]
    assert table.start.tolist() == np.repeat(np.cumsum([0, *lengths[:-1]]), lengths).tolist()[:rows]
    on_hold = [str(SEEDS[index % len(SEEDS)]).endswith("0") for index in indices]
    assert held.tolist() == np.repeat(on_hold, lengths).tolist()[:rows]


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def small_shards(monkeypatch):
    """A shard for every one or two drives."""
    monkeypatch.setattr(frame_store, "SHARD_BYTES", 3000)


def shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.log"))


def test_what_was_added_is_read_back_to_the_bit_as_often_as_wanted(tmp_path):
    store = filled(tmp_path / "frames", 11)
    assert (store.sequences, store.drives, store.complete) == (35, 11, True)
    for _ in range(2):
        check(store, list(range(11)), 30)
    again = FrameStore(tmp_path / "frames", settings())
    assert (again.sequences, again.drives, again.complete) == (35, 11, True)
    check(again, list(range(11)), 30)


def test_all_frames_of_a_drive_are_on_one_side_and_one_drive_in_ten_is_held_out(tmp_path):
    store = FrameStore(tmp_path, settings(400))
    seeds = np.random.default_rng(0).permutation(200)
    for index, seed in enumerate(seeds.tolist()):
        message = drive(index, seed)
        store.add(Parcel.of(origin(index), encode(message)), message)
    table, held = store.load()
    for start in np.unique(table.start):
        assert len(set(held[table.start == start].tolist())) == 1
    ends = np.unique(table.start)
    assert held[ends].tolist() == [seed % 10 == 0 for seed in seeds[: len(ends)]]
    assert 0.03 < held.mean() < 0.2


def test_duplicates_are_recognised_also_after_reopening(tmp_path):
    store = FrameStore(tmp_path, settings())
    assert [add(store, index) for index in (0, 1, 1, 0, 3)] == [True, True, False, False, True]
    store.close()
    again = FrameStore(tmp_path, settings())
    assert (again.sequences, again.drives) == (11, 3)
    assert [add(again, index) for index in (3, 2, 2, 0)] == [False, True, False, False]
    assert add(again, 0, boot="b2"), "another incarnation's first drive is another drive"
    assert (again.sequences, again.drives) == (15, 5)
    check(FrameStore(tmp_path, settings(15)), [0, 1, 3, 2, 0], 15)


def test_store_is_complete_from_the_first_drive_on_that_suffices(tmp_path):
    store = FrameStore(tmp_path, settings(8))
    assert [(add(store, index), store.complete)[1] for index in range(3)] == [False, False, True]
    store.seal()
    check(store, [0, 1, 2], 8)


def test_manifest_lists_every_shard_with_its_checksum(tmp_path, small_shards):
    folder = tmp_path / "frames"
    filled(folder, 11)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["schema"], manifest["sequences"], manifest["drives"]) == (1, 35, 11)
    assert len(shards(folder)) > 3
    assert [shard["file"] for shard in manifest["shards"]] == [path.name for path in shards(folder)]
    for shard in manifest["shards"]:
        assert shard["sha256"] == hashlib.sha256((folder / shard["file"]).read_bytes()).hexdigest()


def test_incomplete_store_has_no_manifest_and_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "frames"
    filled(folder, 4)
    assert not (folder / "manifest.json").exists()
    store = FrameStore(folder, settings())
    assert (store.sequences, store.drives, store.complete) == (12, 4, False)
    for index in range(4, 11):
        add(store, index)
    store.seal()
    check(FrameStore(folder, settings()), list(range(11)), 30)


def test_drive_is_on_disk_when_add_returns(tmp_path):
    store = FrameStore(tmp_path, settings())
    add(store, 0)
    add(store, 1)
    killed = FrameStore(tmp_path, settings(7))  # while the first is still open, as after a SIGKILL
    check(killed, [0, 1], 7)


@pytest.mark.parametrize("cut", [1, 100, 2000])
def test_torn_tail_costs_the_last_drive_only_and_it_may_come_again(tmp_path, cut, caplog):
    folder = tmp_path / "frames"
    filled(folder, 4)
    (shard,) = shards(folder)
    shard.write_bytes(shard.read_bytes()[:-cut])
    with caplog.at_level(logging.WARNING):
        store = FrameStore(folder, settings())
    assert "cut a torn tail" in caplog.text
    assert (store.sequences, store.drives) == (8, 3)
    assert [add(store, index) for index in (2, 3, 4)] == [False, True, True]
    store.close()
    check(FrameStore(folder, settings(14)), [0, 1, 2, 3, 4], 14)


def test_enough_frames_without_a_seal_are_sealed_on_opening(tmp_path):
    folder = tmp_path / "frames"
    store = FrameStore(folder, settings())
    for index in range(11):
        add(store, index)
    assert not (folder / "manifest.json").exists()
    again = FrameStore(folder, settings())
    assert again.complete
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["sequences"], manifest["drives"]) == (35, 11)
    check(again, list(range(11)), 30)
    before = content(folder)
    FrameStore(folder, settings())
    assert content(folder) == before


@pytest.mark.parametrize("damage", ["flip", "cut", "longer", "empty"])
@pytest.mark.parametrize("which", [0, 1, -1])
def test_damaged_shard_of_a_complete_store_is_named_and_nothing_is_touched(
    tmp_path, small_shards, damage, which
):
    folder = tmp_path / "frames"
    filled(folder, 11)
    shard = shards(folder)[which]
    whole = bytearray(shard.read_bytes())
    flipped = whole.copy()
    flipped[len(whole) // 2] ^= 1
    damaged = {"flip": flipped, "cut": whole[:-7], "longer": whole + b"x", "empty": b""}[damage]
    shard.write_bytes(damaged)
    before = content(folder)
    for sequences in (30, 34, 100):
        with pytest.raises(UsageError, match=rf"shard .*{shard.name} is damaged: its sha256 differs"):
            FrameStore(folder, settings(sequences))
    assert content(folder) == before
    shard.write_bytes(whole)
    check(FrameStore(folder, settings()), list(range(11)), 30)


@pytest.mark.parametrize("which", [0, 1, -1])
def test_what_a_missing_shard_held_is_gathered_anew(tmp_path, small_shards, which, caplog):
    folder = tmp_path / "frames"
    filled(folder, 11, settings(35))
    gone = shards(folder)[which]
    held = [r.origin.seq for r in EpisodeLog(folder, 2**62)._read(gone)]
    gone.unlink()
    with caplog.at_level(logging.WARNING):
        store = FrameStore(folder, settings(35))
    assert "not the shards of its manifest; what they lack is gathered anew" in caplog.text
    kept = [index for index in range(11) if index not in held]
    assert 0 < len(kept) < 11
    assert store.sequences == sum(LENGTHS[index] for index in kept) < 35
    assert (store.drives, store.complete) == (len(kept), False)
    assert not (folder / "manifest.json").exists(), "it does not hold any longer"
    for index in held:
        assert add(store, index, boot="b2")
    assert store.complete
    store.close()
    store.seal()
    check(FrameStore(folder, settings(35)), kept + held, 35)


def test_a_shard_that_the_manifest_does_not_name_is_counted(tmp_path, small_shards, caplog):
    folder = tmp_path / "frames"
    filled(folder, 11)
    manifest = json.loads((folder / "manifest.json").read_text())
    for named in ({}, manifest["shards"][:1]):
        (folder / "manifest.json").write_text(json.dumps({**manifest, "sequences": 999, "shards": named}))
        store = FrameStore(folder, settings())
        assert "not the shards of its manifest" in caplog.text
        assert store.sequences == sum(LENGTHS[:11])
        store.close()


def test_shard_that_can_be_spared_is_forgotten(tmp_path, small_shards):
    folder = tmp_path / "frames"
    filled(folder, 11)
    gone = shards(folder)[-1]
    gone.unlink()
    store = FrameStore(folder, settings())
    assert store.complete
    assert 30 <= store.sequences < 35
    listed = json.loads((folder / "manifest.json").read_text())["shards"]
    assert [shard["file"] for shard in listed] == [path.name for path in shards(folder)]
    check(FrameStore(folder, settings()), list(range(10)), 30)


def test_all_shards_missing_is_an_empty_store(tmp_path):
    folder = tmp_path / "frames"
    filled(folder, 11)
    for shard in shards(folder):
        shard.unlink()
    store = FrameStore(folder, settings())
    assert (store.sequences, store.drives, store.complete) == (0, 0, False)
    assert add(store, 0, boot="b2")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("world.camera.fov=50", r"world\.camera\.fov = 47\.0, asked was 50\.0"),
        ("world.camera.size=32", r"world\.camera\.size = 16, asked was 32"),
        ("world.start.yaw=20", r"world\.start\.yaw = 90\.0, asked was 20\.0"),
        ("pretraining.near_share=0.25", r"pretraining\.near_share = 0\.5, asked was 0\.25"),
        ("pretraining.drive_steps=5", r"pretraining\.drive_steps = 3, asked was 5"),
        ("curriculum.gate.ranges.yaw=3", r"curriculum\.gate\.ranges\.yaw = 10\.0, asked was 3\.0"),
    ],
)
@pytest.mark.parametrize("drives", [4, 11])
def test_frames_of_another_world_are_refused_by_the_setting_and_left_alone(tmp_path, change, message, drives):
    folder = tmp_path / "frames"
    filled(folder, drives)
    before = content(folder)
    with pytest.raises(UsageError, match=rf"frames in .* were made with {message}; choose another --frames"):
        FrameStore(folder, settings(30, change))
    assert content(folder) == before


def test_frames_serve_every_objective_encoder_and_seed(tmp_path):
    filled(tmp_path, 11)
    other = settings(
        30,
        "pretraining.objective=reconstruction",
        "pretraining.epochs=7",
        "encoder.kind=residual",
        "seed=5",
        "curriculum.gate.threshold=0.1",
    )
    check(FrameStore(tmp_path, other), list(range(11)), 30)


@pytest.mark.parametrize(
    "damage",
    ["", "{", "[]", "{}", "3", '{"schema": 1, "sequences": 35, "drives": 11, "shards": [5]}', b"\xff"],
)
def test_damaged_manifest_is_named_and_the_shards_are_read_anew_without_it(tmp_path, damage):
    folder = tmp_path / "frames"
    filled(folder, 11)
    manifest = folder / "manifest.json"
    whole = manifest.read_bytes()
    manifest.write_bytes(damage if isinstance(damage, bytes) else damage.encode())
    before = content(folder)
    with pytest.raises(
        UsageError, match=r"manifest\.json is damaged: .*remove it and the shards are read anew"
    ):
        FrameStore(folder, settings())
    assert content(folder) == before
    manifest.unlink()
    check(FrameStore(folder, settings()), list(range(11)), 30)
    assert manifest.read_bytes() == whole


def test_manifest_of_another_schema_is_refused(tmp_path):
    filled(tmp_path, 11)
    manifest = tmp_path / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"schema": 1', '"schema": 2'))
    with pytest.raises(UsageError, match=r"manifest\.json has schema 2, this version has 1"):
        FrameStore(tmp_path, settings())


def test_foreign_folder_is_refused_and_left_alone_and_an_empty_one_is_taken(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("dear")
    with pytest.raises(UsageError, match="thesis is not empty and holds no frames; choose another --frames"):
        FrameStore(tmp_path / "thesis", settings())
    assert content(tmp_path / "thesis") == {"thesis.tex": b"dear"}
    (tmp_path / "empty").mkdir()
    assert add(FrameStore(tmp_path / "empty", settings()), 0)


def test_too_little_disk_is_said_in_a_sentence_before_a_folder_is_made(tmp_path):
    with pytest.raises(UsageError) as refusal:
        FrameStore(tmp_path / "runs" / "frames", settings(10**12))
    sentence = str(refusal.value)
    assert sentence.startswith("pretraining.sequences needs 800000.0 GB on the disk of ")
    assert sentence.endswith("GB are free; lower it or choose another --frames")
    assert "\n" not in sentence
    assert list(tmp_path.iterdir()) == []


def test_too_little_disk_leaves_an_existing_store_as_it_was(tmp_path):
    filled(tmp_path, 11)
    before = content(tmp_path)
    with pytest.raises(UsageError, match=r"pretraining\.sequences needs 800000\.0 GB"):
        FrameStore(tmp_path, settings(10**12))
    assert content(tmp_path) == before


def test_resumed_store_needs_disk_only_for_what_it_lacks(tmp_path):
    filled(tmp_path, 4)
    rows = 15 * 10**9  # 12 TB, most of which a file of holes stands for
    with pytest.raises(UsageError, match=r"pretraining\.sequences needs 12000\.0 GB"):
        FrameStore(tmp_path, settings(rows))
    with (tmp_path / "00000002.log").open("wb") as shard:
        shard.truncate(rows * 16 * 16 * 25 // 8)
    assert not FrameStore(tmp_path, settings(rows)).complete


def test_more_sequences_of_a_complete_store_reopen_it_and_fewer_do_not(tmp_path):
    folder = tmp_path / "frames"
    filled(folder, 10, settings(28))
    assert FrameStore(folder, settings(12)).complete
    check(FrameStore(folder, settings(12)), [0, 1, 2, 3, 4], 12)
    store = FrameStore(folder, settings(36))
    assert (store.sequences, store.drives, store.complete) == (31, 10, False)
    assert not (folder / "manifest.json").exists(), "it does not hold any longer"
    assert [add(store, index) for index in (9, 10, 11)] == [False, True, True]
    assert store.complete
    store.close()
    store.seal()
    check(FrameStore(folder, settings(36)), list(range(12)), 36)


def test_store_with_too_few_frames_cannot_be_loaded(tmp_path):
    with pytest.raises(UsageError, match="12 frames where 30 are needed"):
        filled(tmp_path, 4).load()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frame": np.zeros((5, 16, 16, 3), np.uint8)}, "drive of 5 frames; 1 to 4 are possible"),
        ({"frame": np.zeros((0, 16, 16, 3), np.uint8)}, "drive of 0 frames; 1 to 4 are possible"),
        ({"frame": np.zeros((3, 32, 32, 3), np.uint8)}, r"frame is uint8 \(3, 32, 32, 3\)"),
        ({"mask": np.zeros((3, 31), np.uint8)}, r"mask is uint8 \(3, 31\)"),
        ({"mask": np.zeros((2, 32), np.uint8)}, r"mask is uint8 \(2, 32\)"),
        ({"goal": np.zeros((3, 3), np.float64)}, "goal is float64"),
    ],
)
def test_drive_that_does_not_fit_leaves_no_trace(tmp_path, change, reason):
    store = FrameStore(tmp_path, settings())
    message = drive(0, **change)
    before = content(tmp_path)
    with pytest.raises(MessageError, match=reason):
        store.add(Parcel.of(origin(0), encode(message)), message)
    assert content(tmp_path) == before
    assert (store.sequences, store.drives) == (0, 0)
    assert add(store, 0)


def test_full_disk_is_an_error_that_leaves_no_trace_and_the_drive_may_come_again(tmp_path):
    store = filled(tmp_path / "frames", 2)
    store = FrameStore(tmp_path / "frames", settings())
    with largest_file(shards(tmp_path / "frames")[0].stat().st_size + 50), pytest.raises(OSError):
        add(store, 2)
    assert (store.sequences, store.drives) == (7, 2)
    assert add(store, 2)
    store.close()
    check(FrameStore(tmp_path / "frames", settings(8)), [0, 1, 2], 8)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"cell": 9}, "cell 9 is an arena, where nothing is trained"),
        ({"cell": 10}, "cell 10 is an arena"),
        ({"seed": FIRST_SUITE_SEED}, "is an examination's, from which nothing is learned"),
        ({"seed": 6 * FIRST_SUITE_SEED}, "is an examination's"),
    ],
)
def test_tasks_of_examinations_cannot_arrive(change, reason):
    version, name, fields = msgpack.unpackb(encode(drive(0)))
    assert decode(Frames, msgpack.packb([version, name, fields])).task == drive(0).task
    fields["task"] |= change
    with pytest.raises(MessageError, match=reason):
        decode(Frames, msgpack.packb([version, name, fields]))


def test_frames_may_be_moved_to_another_place(tmp_path):
    filled(tmp_path / "here", 11)
    shutil.move(tmp_path / "here", tmp_path / "there")
    check(FrameStore(tmp_path / "there", settings()), list(range(11)), 30)
