from collections.abc import Callable
from typing import get_args

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from actor.evaluation.suites import suite
from common import messages as m
from common.config import GEOMETRIC, resolve
from common.messages import MessageError, _to_array, decode, encode
from common.observation import ObservationLayout
from common.tasks import (
    FIRST_SUITE_SEED,
    DollyShift,
    PlacedStart,
    Task,
)
from common.world_config import StartRanges
from tests.helpers import tiny_episode

CONFIG = resolve("smoke")
LAYOUT = ObservationLayout.of(CONFIG)

names = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
addresses = st.tuples(names, names).map("/".join)
texts = st.text(max_size=32)
categories = st.sampled_from(get_args(m.Category))
counts = st.integers(0, 2**63)
numbers = st.floats(allow_nan=False, allow_infinity=False)
digests = st.dictionaries(texts, texts, max_size=16)
tasks = st.builds(
    Task,
    cell=st.integers(0, 8),
    seed=st.integers(0, FIRST_SUITE_SEED - 1),
    start=st.builds(StartRanges, yaw=st.floats(0, 180), bearing=st.floats(0, 15))
    | st.builds(PlacedStart, x=st.floats(-20, 20), y=st.floats(-20, 20), yaw=st.floats(-180, 180)),
    shift=st.none() | st.builds(DollyShift, step=st.integers(1, 10_000), x=st.floats(-10, 10)),
)
properties = st.dictionaries(names, numbers, max_size=32)
any_tasks = tasks | st.dictionaries(names, numbers, min_size=1, max_size=32)
arrays = st.sampled_from([np.float16, np.float32, np.float64, np.uint8]).flatmap(
    lambda dtype: hnp.arrays(
        dtype,
        hnp.array_shapes(max_dims=5, min_side=0, max_side=3),
        elements=None if dtype is np.uint8 else {"allow_nan": False, "allow_infinity": False},
    )
)
poses = st.tuples(numbers, numbers, numbers)
versions = st.builds(m.Version, epoch=counts, counter=counts)
proposals = st.builds(
    m.Proposal,
    id=names,
    task=any_tasks,
    requested=st.sampled_from(["easy", "frontier", "random"]),
    category=categories,
    why=texts,
    properties=properties,
    q=st.none() | numbers,
    q_version=st.none() | texts,
    q_reason=texts,
    f=st.none() | numbers,
    mu=st.none() | numbers,
    sigma=st.none() | numbers,
    robot=st.none() | poses,
    dolly=st.none() | poses,
)
scored = st.builds(
    m.Scored, task=st.none() | any_tasks, properties=st.none() | properties, q=st.none() | numbers
)
candidates = st.builds(m.Candidate, task=tasks, visual=arrays, lidar=arrays)
MESSAGES: dict[type[m.Message], st.SearchStrategy] = {
    m.Origin: st.builds(m.Origin, actor=names | addresses, boot=names, seq=counts),
    m.Version: versions,
    m.Episode: st.builds(
        m.Episode,
        digest=digests,
        task=tasks,
        visual=arrays,
        lidar=arrays,
        action=arrays,
        reward=arrays,
        ending=st.sampled_from(m.ENDINGS),
        first_version=versions,
        last_version=versions,
        category=categories,
    ),
    m.Frames: st.builds(m.Frames, digest=digests, task=tasks, frame=arrays, mask=arrays, goal=arrays),
    m.TaskQuery: st.builds(m.TaskQuery, cell=st.integers(0, 8), t=counts, count=st.integers(1, 1000)),
    m.Proposal: proposals,
    m.Proposals: st.builds(m.Proposals, tasks=st.lists(proposals, max_size=3)),
    m.Outcome: st.builds(
        m.Outcome,
        digest=digests,
        proposal=st.none() | names,
        task=any_tasks,
        success=st.booleans(),
    ),
    m.Scored: scored,
    m.ScoreQuery: st.builds(m.ScoreQuery, tasks=st.lists(scored, min_size=1, max_size=3)),
    m.Scores: st.builds(
        m.Scores, f=st.lists(numbers), properties=st.lists(properties, max_size=3), outcomes=counts
    ),
    m.Snapshot: st.builds(
        m.Snapshot,
        algorithm=texts,
        outcomes=counts,
        candidates=st.lists(counts, max_size=9),
        leases=counts,
        gate_open=st.booleans(),
        proposed=st.dictionaries(texts, counts),
        inputs=st.lists(texts),
        brier=st.none() | numbers,
        reliability=st.lists(st.tuples(numbers, numbers, counts), max_size=10),
        network=st.binary(),
    ),
    m.Candidate: candidates,
    m.Candidates: st.builds(m.Candidates, digest=digests, candidates=st.lists(candidates, max_size=3)),
    m.WeightsBlob: st.builds(m.WeightsBlob, version=versions, sha256=texts, blob=st.binary()),
    m.ContractReply: st.builds(
        m.ContractReply,
        run=names,
        config=st.text(),
        encoder=st.binary(),
        digest=digests,
        job=st.sampled_from(["training", "pretraining"]),
    ),
    m.Stat: st.builds(
        m.Stat,
        role=names,
        group=names,
        name=names,
        host=texts,
        pid=counts,
        since=numbers,
        code=texts,
        protocol=counts,
        values=st.dictionaries(texts, st.integers(-(2**63), 2**63) | numbers | texts, max_size=9),
    ),
    m.Receipt: st.builds(m.Receipt, answers=st.lists(texts, max_size=m.BUNDLE)),
    m.Nothing: st.builds(m.Nothing),
}
KINDS = list(MESSAGES)
STAT: dict = {
    **{"role": "r", "group": "g", "name": "n", "host": "h", "pid": 1},
    **{"since": 1.7e9, "code": "1.0+ab", "protocol": m.PROTOCOL, "values": {}},
}


def assert_same(a: object, b: object) -> None:
    """Equality in depth, types and dtypes included."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif hasattr(a, "model_fields_set"):
        for name in type(a).model_fields:
            assert_same(getattr(a, name), getattr(b, name))
    else:
        assert a == b


def fields_of(message: m.Message) -> dict:
    return msgpack.unpackb(encode(message))[2]


def packed(kind: type[m.Message], fields: object, version: object = m.SCHEMA_VERSION) -> bytes:
    return msgpack.packb([version, kind.__name__, fields])


def episode_with(**fields: object) -> bytes:
    return packed(m.Episode, {**fields_of(tiny_episode(CONFIG)), **fields})


def test_the_round_trip_covers_every_message_class():
    defined = {
        value for value in vars(m).values() if isinstance(value, type) and issubclass(value, m.Message)
    }
    assert defined == {m.Message, *KINDS}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_message_survives_the_wire_unchanged(kind):
    @settings(max_examples=25)
    @given(MESSAGES[kind])
    def check(message: m.Message) -> None:
        data = encode(message)
        found = decode(kind, data)
        assert_same(found, message)
        assert encode(found) == data

    check()


def test_an_array_that_is_not_contiguous_arrives_by_value():
    array = np.arange(12, dtype=np.float32).reshape(3, 4).T
    sent = m.Candidate(task=Task(cell=0, seed=0, start=StartRanges()), visual=array, lidar=array[::2])
    found = decode(m.Candidate, encode(sent))
    np.testing.assert_array_equal(found.visual, array)
    np.testing.assert_array_equal(found.lidar, array[::2])


def test_messages_hold_no_pickle_and_name_version_and_type():
    outer = msgpack.unpackb(encode(m.TaskQuery(cell=3, t=5, count=2)))
    assert outer == [1, "TaskQuery", {"cell": 3, "t": 5, "count": 2}]


@pytest.mark.parametrize("kind", [m.TaskQuery, m.Proposals, m.Episode], ids=lambda kind: kind.__name__)
def test_every_truncation_is_refused(kind):
    data = encode(MESSAGE_SAMPLES[kind]())
    for size in {*range(min(len(data), 300)), *range(0, len(data), 97), len(data) - 1}:
        with pytest.raises(MessageError):
            decode(kind, data[:size])


def test_trailing_bytes_are_refused():
    with pytest.raises(MessageError, match="not msgpack: ExtraData"):
        decode(m.Nothing, encode(m.Nothing()) + b"\x00")


@pytest.mark.parametrize("version", [0, 2, "1", None, [1], b"\x00" * 5000])
def test_wrong_version_is_refused_in_a_short_sentence(version):
    with pytest.raises(MessageError, match=r"schema version: .*, this side speaks 1") as caught:
        decode(m.Nothing, packed(m.Nothing, {}, version))
    assert len(str(caught.value)) < 120


@pytest.mark.parametrize("name", ["Episode", "", 7, None, {"a": 1}, ["x" * 5000]])
def test_wrong_type_is_refused_in_a_short_sentence(name):
    with pytest.raises(MessageError, match="where Nothing is expected") as caught:
        decode(m.Nothing, msgpack.packb([1, name, {}]))
    assert len(str(caught.value)) < 120


@pytest.mark.parametrize("outer", [None, 1, "x", {}, [], [1, "Nothing"], [1, "Nothing", {}, 4]])
def test_anything_but_version_type_fields_is_refused(outer):
    with pytest.raises(MessageError, match=r"a message is \[version, type, fields\]"):
        decode(m.Nothing, msgpack.packb(outer))


BOX = {"proposal": None, "task": {"mass": 1.0}, "success": True}
"""An outcome of somebody else's environment."""


@pytest.mark.parametrize("fields", [None, 1, "x", [], [1, 2], b"", True])
def test_fields_that_are_no_mapping_are_refused(fields):
    with pytest.raises(MessageError, match=r"^TaskQuery\.: "):
        decode(m.TaskQuery, packed(m.TaskQuery, fields))


@pytest.mark.parametrize(
    ("kind", "fields", "said"),
    [
        (m.Nothing, {"x": 1}, r"Nothing\.x: Extra inputs are not permitted"),
        (m.Nothing, {b"x": 1}, r"Nothing\."),
        (m.TaskQuery, {}, r"TaskQuery\.cell: Field required"),
        (m.TaskQuery, {"cell": 9}, r"TaskQuery\.cell: Input should be less than 9"),
        (m.TaskQuery, {"cell": 10}, r"TaskQuery\.cell: Input should be less than 9"),
        (m.TaskQuery, {"cell": -1}, r"TaskQuery\.cell: "),
        (m.TaskQuery, {"cell": 0, "t": -1}, r"TaskQuery\.t: "),
        (m.TaskQuery, {"cell": 0, "count": 0}, r"TaskQuery\.count: "),
        (m.TaskQuery, {"cell": 0, "count": 1001}, r"TaskQuery\.count: "),
        (m.Origin, {"actor": "a/b/c", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a/", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "/b", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a/*", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a/b\n", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a/" + "b" * 65, "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a", "boot": "b/c", "seq": 0}, r"Origin\.boot: "),
        (m.Origin, {"actor": "a\n", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "", "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a" * 65, "boot": "b", "seq": 0}, r"Origin\.actor: "),
        (m.Origin, {"actor": "a", "boot": "**", "seq": 0}, r"Origin\.boot: "),
        (m.Stat, STAT | {"values": {"x": float("nan")}}, "values"),
        (m.Stat, STAT | {"values": {"x": [1]}}, "values"),
        (m.Stat, STAT | {"values": {str(i): i for i in range(97)}}, r"Stat\.values"),
        (m.Stat, STAT | {"since": float("inf")}, r"Stat\.since"),
        (m.Stat, STAT | {"host": "h" * 129}, r"Stat\.host"),
        (m.Stat, STAT | {"code": "c" * 65}, r"Stat\.code"),
        (m.Stat, STAT | {"group": "a/b"}, r"Stat\.group"),
        (m.Stat, STAT | {"name": "**"}, r"Stat\.name"),
        (m.Stat, STAT | {"role": ""}, r"Stat\.role"),
        (m.Stat, {key: value for key, value in STAT.items() if key != "protocol"}, r"Stat\.protocol"),
        (m.Receipt, {"answers": [""] * (m.BUNDLE + 1)}, r"Receipt\.answers"),
        (m.Receipt, {"answers": ["x" * 401]}, r"Receipt\.answers\.0"),
        (m.Receipt, {"answers": [None]}, r"Receipt\.answers\.0"),
        (m.Outcome, {"proposal": None, "success": True}, r"Outcome\.task: Field required"),
        (m.Outcome, BOX | {"task": {}}, r"Outcome\.task"),
        (m.Outcome, BOX | {"task": {f"p{i}": 0.0 for i in range(33)}}, r"Outcome\.task"),
        (m.Outcome, BOX | {"task": {"mass": float("nan")}}, r"Outcome\.task"),
        (m.Outcome, BOX | {"task": {"mass": "heavy"}}, r"Outcome\.task"),
        (m.Outcome, BOX | {"task": {"m/s": 1.0}}, r"Outcome\.task"),
        (m.Outcome, BOX | {"proposal": ""}, r"Outcome\.proposal"),
        (m.Outcome, BOX | {"q": 0.5}, r"Outcome\.q: Extra inputs are not permitted"),
        (m.ScoreQuery, {"tasks": []}, r"ScoreQuery\.tasks: "),
        (m.ScoreQuery, {"tasks": [{}] * 1001}, r"ScoreQuery\.tasks: "),
        (m.ScoreQuery, {"tasks": [{"q": float("inf")}]}, r"ScoreQuery\.tasks\.0\.q: "),
        (
            m.ScoreQuery,
            {"tasks": [{"properties": {"mass": None}}]},
            r"ScoreQuery\.tasks\.0\.properties\.mass: ",
        ),
        (m.Candidates, {"digest": {str(i): "" for i in range(17)}, "candidates": []}, r"Candidates\.digest"),
    ],
)
def test_unknown_missing_and_impossible_fields_are_refused_by_name(kind, fields, said):
    with pytest.raises(MessageError, match=said):
        decode(kind, packed(kind, fields))


@pytest.mark.parametrize("cell", [9, 10])
def test_task_in_an_arena_is_refused_wherever_a_message_holds_one(cell):
    proposal, episode = sample_proposals().tasks[0], fields_of(tiny_episode(CONFIG))
    arena = Task(cell=cell, seed=77, start=StartRanges()).model_dump()
    candidate = {"task": arena, "visual": episode["visual"], "lidar": episode["lidar"]}
    outcome = m.Outcome(proposal="p-1", task=proposal.task, success=True)
    said = f"cell {cell} is an arena, where nothing is trained"
    for kind, fields, place in (
        (m.Episode, {**episode, "task": arena}, "Episode.task"),
        (m.Outcome, {**fields_of(outcome), "task": arena}, "Outcome.task"),
        (m.Candidate, candidate, "Candidate.task"),
        (m.Candidates, {"digest": {}, "candidates": [candidate]}, "Candidates.candidates.0.task"),
        (m.Proposals, {"tasks": [{**fields_of(proposal), "task": arena}]}, "Proposals.tasks.0.task"),
    ):
        with pytest.raises(MessageError, match=said) as caught:
            decode(kind, packed(kind, fields))
        assert str(caught.value).startswith(f"{place}: ")


def test_task_in_an_arena_does_not_even_leave():
    arena = Task(cell=9, seed=0, start=StartRanges())
    with pytest.raises(ValueError, match="cell 9 is an arena"):
        m.Candidate(task=arena, visual=np.zeros(1), lidar=np.zeros(1))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cell": 11}, r"Outcome\.task\.cell: Input should be less than 11"),
        ({"cell": "0x"}, r"Outcome\.task\.cell: "),
        ({"seed": 2**53}, r"Outcome\.task\.seed: "),
        ({"seed": suite("train").tasks[7].seed}, r"Outcome\.task: .*examination's, from which nothing"),
        ({"start": {"x": 1.0, "y": 2.0, "yaw": 3.0, "jitter": 0.5}}, r"Outcome\.task\.start"),
        ({"start": {"x": 1.0, "y": 2.0}}, r"Outcome\.task\.start"),
        ({"shift": {"step": 0}}, r"Outcome\.task\.shift\.step: "),
        ({"shift": {"step": 1, "x": 11.0}}, r"Outcome\.task\.shift\.x: "),
    ],
)
def test_impossible_task_is_refused_by_its_field(change, said):
    proposal = sample_proposals().tasks[0]
    task = {**proposal.task.model_dump(), **change}
    with pytest.raises(MessageError, match=said):
        decode(m.Outcome, packed(m.Outcome, {"proposal": "p", "task": task, "success": True}))


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (["float32", [1], np.float32([np.nan]).tobytes()], "NaN or infinity"),
        (["float16", [2], np.float16([0, np.inf]).tobytes()], "NaN or infinity"),
        (["float64", [1], np.float64([-np.inf]).tobytes()], "NaN or infinity"),
        (["object", [1], bytes(8)], "dtype 'object' is not allowed"),
        (["O", [1], bytes(8)], "dtype 'O' is not allowed"),
        (["int64", [1], bytes(8)], "dtype 'int64' is not allowed"),
        ([">f4", [1], bytes(4)], "dtype '>f4' is not allowed"),
        ([["float32"], [1], bytes(4)], "is not allowed"),
        (["float32", [-1], bytes(4)], "non-negative integers"),
        (["float32", [-1, -1], bytes(4)], "non-negative integers"),
        (["float32", [1.0], bytes(4)], "non-negative integers"),
        (["float32", [True], bytes(4)], "non-negative integers"),
        (["float32", 1, bytes(4)], "non-negative integers"),
        (["float32", [], bytes(4)], "one to five"),
        (["float32", [1] * 6, bytes(4)], "one to five"),
        (["float32", [2], bytes(4)], r"4 bytes do not hold float32 of shape \[2\]"),
        (["float32", [1], bytes(5)], "5 bytes do not hold"),
        (["float32", [2**62, 2**62], bytes(4)], "shape"),
        (["float32", [0, 2**63], b""], "shape"),
        (["float32", [0, 2**63], b""], "visual"),
        (["float32", [0, 2**64 - 1], b""], "visual"),
        (["float32", [2**62, 0, 2**62], b""], "visual"),
        (["float32", [1]], r"an array is \[dtype, shape, bytes\]"),
        (["float32", [1], "abcd"], r"an array is \[dtype, shape, bytes\]"),
        (None, r"an array is \[dtype, shape, bytes\]"),
        (b"abc", r"an array is \[dtype, shape, bytes\]"),
        ({"dtype": "float32"}, r"an array is \[dtype, shape, bytes\]"),
    ],
)
def test_malformed_arrays_are_refused_with_the_reason(array, said):
    with pytest.raises(MessageError, match=said) as caught:
        decode(m.Episode, episode_with(visual=array))
    assert str(caught.value).startswith("Episode.visual: ")


def test_oversize_is_refused_before_sending_and_after_receiving():
    big = m.Stat(**STAT | {"values": {"x": "a" * m.Stat.max_bytes}})
    with pytest.raises(MessageError, match=r"Stat of \d+ bytes; at most 16384 are allowed"):
        encode(big)
    with pytest.raises(MessageError, match="Nothing of 1048577 bytes; at most 1048576 are allowed"):
        decode(m.Nothing, b"\x00" * (m.Nothing.max_bytes + 1))


def test_a_full_answer_to_the_largest_question_fits():
    proposal = m.Proposal(
        id="x" * 64,
        task=Task(
            cell=8,
            seed=FIRST_SUITE_SEED - 1,
            start=StartRanges(),
            shift=DollyShift(step=10_000, x=0.1, y=0.1, yaw=0.1),
        ),
        requested="frontier",
        category="unserved",
        why="frontier: among the ten of 1000 whose outcome is least certain; predicted success 0.50",
        properties=dict.fromkeys(GEOMETRIC, 0.1),
        q=0.1,
        q_version="1234567890.1234567890",
        q_reason="no candidate in the database; by geometry alone",
        f=0.1,
        mu=0.1,
        sigma=0.1,
        robot=(0.1, 0.1, 0.1),
        dolly=(0.1, 0.1, 0.1),
    )
    assert len(encode(m.Proposals(tasks=[proposal] * 1000))) <= m.Proposals.max_bytes


def test_versions_compare_by_epoch_first():
    old, new = m.Version(epoch=1, counter=900), m.Version(epoch=2, counter=3)
    assert old < new
    assert new > old
    assert max(old, new) == new
    assert not old < m.Version(epoch=1, counter=900)


@pytest.mark.parametrize("preset", ["smoke", "paper", "fast"])
@pytest.mark.parametrize("variant", ["navacl-q", "e2e"])
def test_well_formed_episode_fits_its_layout(preset, variant):
    config = resolve(preset, variant=variant)
    episode = decode(m.Episode, encode(tiny_episode(config, steps=20)))
    episode.check_layout(ObservationLayout.of(config), config.world.max_episode_steps, 10.15)
    assert episode.length == 20
    columns = episode.columns()
    assert all(len(part) == 21 for part in columns.parts())
    assert columns.visual is episode.visual


def test_only_a_timeout_is_a_truncation():
    assert {e: tiny_episode(CONFIG, ending=e).truncated for e in m.ENDINGS} == {
        "success": False,
        "dolly_contact": False,
        "other_contact": False,
        "timeout": True,
    }


def changed(name: str, number: float) -> Callable[[m.Episode], dict]:
    """One number of a column replaced."""

    def change(episode: m.Episode) -> dict:
        column = getattr(episode, name).copy()
        column.flat[1] = number
        return {name: column}

    return change


def test_numbers_at_their_limits_are_taken():
    for name, number in (
        ("action", -1.0),
        ("lidar", 0.0),
        ("lidar", 1.0),
        ("reward", 10.15),
        ("reward", -10.15),
    ):
        episode = tiny_episode(CONFIG)
        at_limit = episode.model_copy(update=changed(name, number)(episode))
        at_limit.check_layout(LAYOUT, 20, CONFIG.world.reward.largest)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda e: {"visual": e.visual[:-1]}, r"visual is float16 \(3, \d+\), expected float16 \(4, \d+\)"),
        (lambda e: {"visual": e.visual.astype(np.float32)}, "visual is float32"),
        (lambda e: {"visual": e.visual[..., :-1]}, r"visual is float16 \(4, \d+\)"),
        (lambda e: {"lidar": e.lidar.astype(np.float64)}, "lidar is float64"),
        (lambda e: {"lidar": e.lidar[:, :255]}, r"lidar is float16 \(4, 255\)"),
        (lambda e: {"action": e.action[:, :1]}, r"action is float32 \(4, 1\)"),
        (lambda e: {"reward": e.reward[:, None]}, r"reward is float32 \(4, 1\)"),
        (lambda e: {"reward": e.reward[:1]}, "episode of 0 steps; 1 to 20 are possible"),
        (lambda e: {"reward": e.reward[:0]}, "1 to 20 are possible"),
        (lambda e: {"reward": np.zeros(22, np.float32)}, "episode of 21 steps; 1 to 20 are possible"),
        (changed("action", 1.0001), r"action outside \[-1, 1\]"),
        (changed("lidar", 1.01), r"lidar outside \[0, 1\]"),
        (changed("lidar", -0.01), r"lidar outside \[0, 1\]"),
        (changed("reward", 10.3), "reward larger than 10.15"),
        (changed("reward", -3e38), "reward larger than 10.15"),
    ],
)
def test_episode_that_does_not_fit_the_layout_is_refused(change: Callable, said):
    episode = tiny_episode(CONFIG)
    broken = decode(m.Episode, encode(episode.model_copy(update=change(episode))))
    with pytest.raises(MessageError, match=said):
        broken.check_layout(LAYOUT, 20, 10.15)


def sample_proposals() -> m.Proposals:
    proposal = m.Proposal(
        id="p-1",
        task=Task(cell=2, seed=77, start=StartRanges()),
        requested="easy",
        category="easy",
        why="easy: the first of 100 that is likely enough; predicted success 0.25",
        properties=dict.fromkeys(GEOMETRIC, 0.5),
        q=1.5,
        q_version="1.7",
        q_reason="",
        f=0.25,
        mu=None,
        sigma=None,
        robot=(0.0, 1.0, 2.0),
        dolly=(3.0, 4.0, 5.0),
    )
    return m.Proposals(tasks=[proposal, proposal.model_copy(update={"id": "p-2", "q": None})])


MESSAGE_SAMPLES: dict[type[m.Message], Callable[[], m.Message]] = {
    m.TaskQuery: lambda: m.TaskQuery(cell=3, t=10**9, count=7),
    m.Proposals: sample_proposals,
    m.Episode: lambda: tiny_episode(CONFIG),
}


def survives(kind: type[m.Message], data: bytes) -> bool:
    """Decodes; True for a valid message, False for a refusal; anything else fails the test."""
    try:
        message = decode(kind, data)
        if isinstance(message, m.Episode):
            message.check_layout(LAYOUT, 20, 10.15)
    except MessageError as error:
        assert 0 < len(str(error)) < 400
        str(error).encode()
        return False
    encode(message)
    return True


@pytest.mark.parametrize("kind", [m.Proposals, m.Episode], ids=lambda kind: kind.__name__)
def test_random_damage_gives_a_valid_message_or_a_refusal_and_nothing_else(kind):
    data, rng = encode(MESSAGE_SAMPLES[kind]()), np.random.default_rng(11)
    # half of the damage goes where the names and lengths of fields are, few among an episode's numbers
    structure = [i for i in range(len(data)) if i < 400 or i > len(data) - 400]
    valid = 0
    for attempt in range(4000):
        damaged = bytearray(data)
        for position in rng.choice(structure if attempt % 2 else len(data), rng.integers(1, 5)):
            damaged[position] = rng.integers(256)
        valid += survives(kind, bytes(damaged))
    assert 10 < valid < 3000


@pytest.mark.parametrize("kind", [m.Proposals, m.Episode], ids=lambda kind: kind.__name__)
def test_spliced_and_shortened_data_give_a_valid_message_or_a_refusal(kind):
    data, rng = encode(MESSAGE_SAMPLES[kind]()), np.random.default_rng(12)
    valid = 0
    for _ in range(1000):
        a, b = sorted(rng.integers(0, len(data), 2))
        valid += survives(kind, data[:a] + data[b + 1 :])
        survives(kind, data[:a] + rng.bytes(int(rng.integers(0, 9))) + data[b:])
    assert valid < 50


@settings(max_examples=300)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused(data):
    for kind in KINDS:
        assert not survives(kind, data)


nested = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=300)
@given(st.sampled_from(list(m.Episode.model_fields)), nested)
def test_any_value_in_place_of_an_episodes_field_gives_a_valid_message_or_a_refusal(name, value):
    survives(m.Episode, episode_with(**{name: value}))


def test_deep_nesting_is_refused():
    for depth in (100, 500, 5000):
        with pytest.raises(MessageError):
            decode(m.TaskQuery, b"\x93\x01\xa9TaskQuery" + b"\x91" * depth + b"\xc0")


def test_every_float16_that_is_nan_or_infinite_is_refused_and_no_other():
    for start in range(0, 65536, 256):
        values = np.arange(start, start + 256, dtype=np.uint16).view(np.float16)
        for value in values[~np.isfinite(values)]:
            with pytest.raises(ValueError, match="NaN"):
                _to_array(["float16", [2], np.array([0, value], np.float16).tobytes()])
        finite = values[np.isfinite(values)]
        assert len(_to_array(["float16", [len(finite)], finite.tobytes()])) == len(finite)
