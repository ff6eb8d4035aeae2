"""The database under the curriculum, and the curriculum over it: leases, restarts, full disks, duplicates."""

import json
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from common.config import Config
from common.delivery import DuplicateFilter
from common.errors import UsageError
from common.messages import Candidate, Candidates, MessageError, Origin, Outcome, Proposal, decode
from common.observation import ObservationLayout
from common.tasks import Task
from curriculum.algorithms.base import Pick, Result
from curriculum.curriculum import Curriculum, Report
from curriculum.database import SCHEMA, Database
from curriculum.task_space import Entry, make_space
from tests.helpers import largest_file, small_config, wait_until

pytestmark = pytest.mark.usefixtures("one_thread")
OPEN = small_config("curriculum.gate.enabled=false")
SHORT = small_config("curriculum.gate.enabled=false", "curriculum.lease=0.02")
SECONDS = 600.0


def boxed(*overrides: str) -> Config:
    """Tasks of one number."""
    parameters = 'curriculum.parameters=[{name="x", low=0.0, high=8.0, easy=0.0}]'
    return small_config("curriculum.gate.enabled=false", parameters, *overrides)


BOX = boxed()


def make_candidate(config: Config, seed: int, cell: int = 0) -> Candidate:
    """One of random numbers, as an actor sends it."""
    layout, rng = ObservationLayout.of(config), np.random.default_rng(seed)
    visual = rng.uniform(0, 2, layout.row_shape).astype(np.float16)
    lidar = rng.uniform(0, 1, layout.lidar).astype(np.float16)
    return Candidate(task=Task(cell=cell, seed=seed, start=config.world.start), visual=visual, lidar=lidar)


def origin(seq: int, boot: str = "b1", actor: str = "local/a1") -> Origin:
    return Origin(actor=actor, boot=boot, seq=seq)


def observed(seed: int = 0) -> Entry:
    candidate = make_candidate(OPEN, seed)
    entry = make_space(OPEN).entry(candidate.task)
    entry.observed = candidate
    return entry


def proposal_of(name: str, entry: Entry) -> Proposal:
    empty = dict.fromkeys(("q", "q_version", "f", "mu", "sigma", "robot", "dolly"))
    return Proposal(
        id=name, task=entry.task, requested="random", category="random", why="a test", properties={},
        q_reason="", **empty,
    )  # fmt: skip


def lease(database: Database, name: str, entry: Entry, seconds: float = SECONDS, f: float = 0.25) -> None:
    database.lease(proposal_of(name, entry), Pick(entry, "frontier", "a test", f=f), seconds)


def result(entry: Entry, success: bool = True) -> Result:
    return Result(entry, "frontier", 0.25, success)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "run" / "curriculum.db"


# The database


def test_what_is_committed_survives_and_what_is_not_does_not(file):
    first = Database(file)
    kept, lost = observed(1), observed(2)
    first.add_candidate(kept, "e1")
    lease(first, "p1", kept)
    first.add_outcome("p0", "local/a1", result(observed(3)))
    first.save_state("s", {"a": 1.5}, b"tensors")
    first.save_network(200, {"b": 2}, b"more")
    first.commit()
    first.add_candidate(lost, "e1")
    lease(first, "p2", lost)
    first.add_outcome("p3", "local/a1", result(lost))
    first.save_state("s", {"a": 2.5}, b"other")
    first.close()
    second = Database(file)
    ((row, text),) = second.candidates("e1")
    ((known, blob),) = second.observed([row])
    found, start = Entry.read(text), decode(Candidate, blob)
    assert known == row
    assert (row, found.task, found.properties) == (kept.row, kept.task, kept.properties)
    assert (start.visual == kept.observed.visual).all()
    assert (start.lidar == kept.observed.lidar).all()
    assert second.leases() == {kept.row: kept.lease}
    assert [o.result.entry.task.seed for o in second.outcomes()] == [3]
    assert second.load_state("s") == ({"a": 1.5}, b"tensors")
    assert second.load_state("other") is None
    assert second.networks() == [(200, {"b": 2}, b"more")]


def test_outcome_is_read_as_it_was_written(file):
    database, entry = Database(file), observed()
    entry.q = -1 / 3
    before = time.time()
    database.add_outcome(None, "local/a1", Result(entry, "easy", 2 / 3, False))
    database.add_outcome("p", "local/a2", Result(entry, "gate", None, True))
    first, second = database.outcomes()
    assert first.result[1:] == ("easy", 2 / 3, False)
    assert second.result[1:] == ("gate", None, True)
    assert (first.result.entry.q, first.result.entry.properties) == (-1 / 3, entry.properties)
    assert before <= first.at <= second.at <= time.time()
    assert database.last_outcome() == second.id
    assert [o.id for o in database.outcomes(after=first.id)] == [second.id]


def test_outcome_is_known_by_its_proposal():
    database, entry = Database(None), observed()
    assert database.last_outcome() == 0
    database.add_outcome("p1", "local/a1", result(entry, True))
    assert database.has_outcome("p1")
    assert not database.has_outcome("p2")
    database.add_outcome("p2", "local/a1", result(entry, False))
    for _ in range(2):
        database.add_outcome(None, "local/a1", result(entry))
    assert [o.result.success for o in database.outcomes()] == [True, False, True, True]


def test_lease_is_ended_once():
    database, entry = Database(None), observed()
    database.add_candidate(entry, "e1")
    entry.q = -0.1
    lease(database, "p1", entry)
    assert entry.lease == pytest.approx(time.time() + SECONDS, abs=60)
    assert database.count_leases() == 1
    ended = database.end_lease("p1")
    assert (ended.candidate, ended.category, ended.f) == (entry.row, "frontier", 0.25)
    assert (ended.entry.task, ended.entry.q) == (entry.task, -0.1)
    assert database.end_lease("p1") is None
    assert database.end_lease("unknown") is None
    assert (database.count_leases(), database.leases()) == (0, {})


def test_lease_that_has_run_out_counts_no_longer_but_is_known_until_dropped():
    database = Database(None)
    entries = [observed(seed) for seed in range(3)]
    for entry in entries:
        database.add_candidate(entry, "e1")
    lease(database, "old", entries[0], -1.0)
    lease(database, "older", entries[1], -2.0)
    lease(database, "new", entries[2])
    assert database.count_leases() == 1
    assert database.end_lease("old").candidate == entries[0].row
    database.drop_leases(before=time.time() - 1.0)
    assert database.end_lease("older") is None
    assert database.end_lease("new") is not None


def test_longest_lease_of_a_candidate_counts():
    database, entry = Database(None), observed()
    database.add_candidate(entry, "e1")
    until = []
    for name, seconds in (("p1", 50.0), ("p2", 900.0), ("p3", 60.0)):
        lease(database, name, entry, seconds)
        until.append(entry.lease)
    assert database.leases() == {entry.row: until[1]}


def test_candidates_of_another_encoder_are_dropped():
    database = Database(None)
    ours, theirs = observed(1), observed(2)
    database.add_candidate(ours, "ours")
    database.add_candidate(theirs, "theirs")
    assert [row for row, _ in database.candidates("theirs")] == [theirs.row]
    database.drop_candidates_but("ours")
    assert [row for row, _ in database.candidates("ours")] == [ours.row]
    assert database.candidates("theirs") == []


def test_write_ahead_log_begins_again_after_a_checkpoint(file):
    database, wal = Database(file), file.with_name(f"{file.name}-wal")
    sizes = []
    for _ in range(3):
        for _ in range(20):
            database.add_outcome(None, "local/a1", result(observed()))
            database.commit()
        sizes.append(wal.stat().st_size)
        assert 0 < database.checkpoint() <= sizes[-1] / 4096
    assert sizes[0] > 0
    assert sizes[2] <= sizes[0] + 4 * 4096, "it is written over, not on"
    assert file.stat().st_size > 4 * 4096
    assert Database(file).last_outcome() == 60


def test_number_of_a_candidate_is_never_used_again():
    database = Database(None)
    first, second = observed(1), observed(2)
    database.add_candidate(first, "e1")
    database.drop_candidate(first.row)
    database.add_candidate(second, "e1")
    assert second.row != first.row, "a lease of the first would be one of the second"


def test_origins_restore_a_filter_with_its_gaps(file):
    database, seen = Database(file), DuplicateFilter()
    arrived = [origin(0), origin(4), origin(2), origin(7, "b2"), origin(1, "b1", "local/a2")]
    for one in arrived:
        seen.add(one)
        database.keep_origins(seen)
    database.commit()
    database.close()
    restored = Database(file).origins()
    assert sorted(restored.state()) == sorted(seen.state())
    assert all(restored.seen(one) for one in arrived)
    assert not any(restored.seen(origin(seq)) for seq in (1, 3, 5))
    restored.add(origin(3))
    assert restored.seen(origin(3))
    assert not restored.seen(origin(1))


def test_rolled_back_database_is_as_at_the_last_commit():
    database = Database(None)
    database.add_outcome("p1", "local/a1", result(observed()))
    database.commit()
    database.add_outcome("p2", "local/a1", result(observed()))
    database.roll_back()
    database.roll_back()
    assert len(list(database.outcomes())) == 1
    database.add_outcome("p2", "local/a1", result(observed()))


@pytest.mark.parametrize("sync", [False, True])
def test_setting_of_durability_reaches_sqlite(file, sync):
    database = Database(file, sync)
    (level,) = database._sql.execute("PRAGMA synchronous").fetchone()
    assert level == (2 if sync else 1)  # FULL, NORMAL


# Files that are none


def refused(path: Path) -> str:
    """Why a file is no database; one sentence with its name."""
    with pytest.raises(UsageError) as error:
        Database(path)
    words = str(error.value)
    assert str(path) in words
    assert len(words.splitlines()) == 1
    return words


@pytest.mark.parametrize("content", [b"not a database, but long enough for a header " * 9, b"\0" * 4096])
def test_foreign_file_is_refused_and_left_alone(tmp_path, content):
    path = tmp_path / "curriculum.db"
    path.write_bytes(content)
    assert "cannot open" in refused(path)
    assert path.read_bytes() == content


def test_database_of_another_program_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "curriculum.db"
    with sqlite3.connect(path) as other:
        other.execute("CREATE TABLE theirs (x)")
    other.close()
    content = path.read_bytes()
    assert f"is of version 0; this one reads {SCHEMA}" in refused(path)
    assert path.read_bytes() == content


def test_other_version_is_refused(file):
    Database(file).close()
    with sqlite3.connect(file) as other:
        other.execute("PRAGMA user_version=7")
    other.close()
    assert f"is of version 7; this one reads {SCHEMA}" in refused(file)


def test_damaged_database_is_refused(file):
    Database(file).close()
    file.write_bytes(b"junk" + file.read_bytes()[4:])
    assert "cannot open" in refused(file)


@pytest.mark.parametrize("path", ["/proc/curriculum.db", "/proc/nowhere/curriculum.db"])
def test_folder_in_which_nothing_can_be_made_is_refused(path):
    refused(Path(path))


def test_file_in_place_of_the_folder_and_folder_in_place_of_the_file_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file" / "curriculum.db")
    (tmp_path / "curriculum.db").mkdir()
    refused(tmp_path / "curriculum.db")


def test_database_that_another_process_is_writing_is_refused(file, monkeypatch):
    holder = Database(file)
    holder.add_outcome("p", "local/a1", result(observed()))  # and no commit
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *a, **k: connect(*a, timeout=0.05, **k))
    assert "locked" in refused(file)
    holder.commit()
    assert Database(file).last_outcome() == 1


# A full disk


def size_of(file: Path) -> int:
    """Of what SQLite appends to at a commit."""
    return file.with_name(f"{file.name}-wal").stat().st_size


def test_full_disk_is_an_os_error_and_the_database_goes_on_from_the_last_commit(file):
    database = Database(file)
    for name in ("p1", "p2"):
        database.add_outcome(name, "local/a1", result(observed()))
    database.commit()
    with largest_file(size_of(file)):
        for _ in range(3):
            database.add_outcome("p3", "local/a1", result(observed()))
            with pytest.raises(OSError, match=r"curriculum\.db"):
                database.commit()
            assert database.last_outcome() == 2
    database.add_outcome("p3", "local/a1", result(observed()))
    database.commit()
    database.close()
    assert Database(file).last_outcome() == 3


def test_full_disk_leaves_the_curriculum_as_it_was(file):
    curriculum = over(file, OPEN)
    deliver(curriculum, *(make_candidate(OPEN, seed) for seed in range(4)))
    report(curriculum, curriculum.propose(0, 0), seq=1)
    waiting = curriculum.propose(0, 0)
    before = state_of(curriculum)
    with largest_file(size_of(file)):
        for _ in range(2):
            with pytest.raises(OSError):
                report(curriculum, waiting, seq=2)
            with pytest.raises(OSError):
                curriculum.add(curriculum.check(message(make_candidate(OPEN, 9))), origin(3))
            assert state_of(curriculum) == before
            assert not any(curriculum.seen.seen(origin(seq)) for seq in (2, 3))
        unnoted = curriculum.propose(0, 0)
    report(curriculum, waiting, seq=2)
    report(curriculum, unnoted, seq=3)
    assert curriculum.outcomes == 3
    categories = [outcome.result.category for outcome in curriculum.database.outcomes()]
    assert categories == [*categories[:2], "unserved"]
    assert over(file, OPEN).outcomes == 3


def test_full_disk_while_saving_loses_nothing_that_was_committed(file):
    curriculum = over(file, BOX)
    live(curriculum, 30)
    before = state_of(curriculum)
    with largest_file(size_of(file)), pytest.raises(OSError):
        curriculum.save()
    assert state_of(curriculum) == before
    curriculum.save()
    assert state_of(curriculum) == before
    assert state_of(over(file, BOX)) == before


# The curriculum over it


def over(file: Path, config: Config = BOX, encoder: str | None = "e1") -> Curriculum:
    return Curriculum(config, Database(file), encoder)


def message(*candidates: Candidate) -> Candidates:
    return Candidates(digest={}, candidates=list(candidates))


def deliver(curriculum: Curriculum, *candidates: Candidate, seq: int = 0) -> None:
    curriculum.add(curriculum.check(message(*candidates)), origin(seq))


def outcome_of(proposal: Proposal, success: bool = True) -> Outcome:
    return Outcome(proposal=proposal.id, task=proposal.task, success=success)


def report(curriculum: Curriculum, proposal: Proposal, success: bool = True, seq: int = 1) -> None:
    curriculum.report([Report(outcome_of(proposal, success), origin(seq))])


def live(curriculum: Curriculum, tasks: int, first: int = 0) -> None:
    """Tasks that are proposed and reported, of which those with a small x succeed."""
    for seq in range(first, first + tasks):
        proposal = curriculum.propose(0, 100 * seq)
        report(curriculum, proposal, bool(proposal.task["x"] < 4), seq)


def state_of(curriculum: Curriculum) -> dict[str, object]:
    """What must be the same again, f_pi to the bit."""
    learned = curriculum.algorithm.snapshot()
    return {
        "outcomes": curriculum.outcomes,
        "judged": list(curriculum.judged),
        "gate": (curriculum.gate.open, list(curriculum.gate.outcomes)),
        "arrays": {name: value.tobytes() for name, value in learned.arrays.items()},
        "values": json.dumps(dict(learned.values)),
        "candidates": [(c.table.row.tolist(), c.table.lease.tolist()) for c in curriculum.cells],
        "leases": curriculum.database.leases(),
        "seen": sorted(curriculum.seen.state()),
    }


def held(curriculum: Curriculum) -> list[int]:
    """Seeds of the candidates of cell 0, oldest first."""
    cell = curriculum.cells[0]
    return [cell.entry(row).task.seed for row in cell.table.row.tolist()]


def seeds(curriculum: Curriculum, count: int) -> list[int]:
    return [curriculum.propose(0, 0).task.seed for _ in range(count)]


def test_candidate_in_somebodys_hands_is_not_proposed_again(file):
    curriculum = over(file, OPEN)
    deliver(curriculum, *(make_candidate(OPEN, seed) for seed in range(5)))
    assert sorted(seeds(curriculum, 5)) == [0, 1, 2, 3, 4]
    assert len(curriculum) == 5
    beyond = curriculum.propose(0, 0)
    assert beyond.task.seed > 4
    assert "geometry alone" in beyond.q_reason
    assert curriculum.snapshot().leases == 6


def test_standing_alone_it_takes_the_candidates_of_a_run_and_leaves_them_there(file):
    deliver(over(file, OPEN), make_candidate(OPEN, 0))
    alone = over(file, OPEN, encoder=None)
    deliver(alone, make_candidate(OPEN, 1), seq=1)
    assert held(over(file, OPEN, encoder=None)) == [0, 1]
    assert held(over(file, OPEN)) == [0], "the other may be of any encoder"


def test_reported_candidate_is_gone_for_good(file):
    curriculum = over(file, OPEN)
    deliver(curriculum, make_candidate(OPEN, 0), make_candidate(OPEN, 1))
    proposal = curriculum.propose(0, 0)
    report(curriculum, proposal)
    assert len(curriculum) == 1
    assert held(over(file, OPEN)) == [1 - proposal.task.seed]


def test_candidate_that_nobody_reports_is_proposed_again(file):
    curriculum = over(file, SHORT)
    deliver(curriculum, make_candidate(SHORT, 3))
    first = curriculum.propose(0, 0)
    assert first.task.seed == 3
    wait_until(lambda: curriculum.cells[0].table.lease.max() <= time.time(), what="the end of the lease")
    again = curriculum.propose(0, 0)
    assert again.task.seed == 3
    assert again.id != first.id


def test_outcome_after_its_lease_counts_as_any_other(file):
    curriculum = over(file, SHORT)
    deliver(curriculum, make_candidate(SHORT, 3))
    proposal = curriculum.propose(0, 0)
    wait_until(lambda: curriculum.cells[0].table.lease.max() <= time.time(), what="the end of the lease")
    report(curriculum, proposal)
    (outcome,) = curriculum.database.outcomes()
    assert (outcome.result.category, outcome.result.f) == (proposal.category, proposal.f)
    assert len(curriculum) == 0


def test_late_outcome_of_a_candidate_that_was_reported_before_drops_no_other(file):
    curriculum = over(file, SHORT)
    deliver(curriculum, make_candidate(SHORT, 3))
    first = curriculum.propose(0, 0)
    wait_until(lambda: curriculum.cells[0].table.lease.max() <= time.time(), what="the end of the lease")
    second = curriculum.propose(0, 0)
    report(curriculum, first, seq=1)
    deliver(curriculum, make_candidate(SHORT, 4), seq=2)
    report(curriculum, second, seq=3)
    assert held(curriculum) == [4]
    assert curriculum.outcomes == 2


def test_late_outcome_without_a_lease_is_learned_by_its_task(file):
    first = over(file, SHORT)
    deliver(first, make_candidate(SHORT, 3))
    proposal = first.propose(0, 0)
    first.database.drop_leases(before=time.time() + SECONDS)
    first.database.commit()
    first.database.close()
    second = over(file, SHORT)
    report(second, proposal, True)
    (outcome,) = second.database.outcomes()
    assert outcome.result.category == "unserved"
    assert outcome.result.f is None
    assert outcome.result.entry.properties == pytest.approx(proposal.properties)
    assert second.outcomes == 1
    report(second, proposal, True, seq=2)
    assert second.outcomes == 1, "once for each proposal"


def test_outcome_of_no_curriculum_is_learned_by_its_task():
    curriculum = Curriculum(BOX)
    for seq in range(3):
        curriculum.report([Report(Outcome(proposal=None, task={"x": 1.0}, success=True), origin(seq))])
    assert curriculum.outcomes == 3
    assert {o.result.category for o in curriculum.database.outcomes()} == {"unserved"}


def test_duplicate_report_counts_once(file):
    curriculum = over(file)
    proposal = curriculum.propose(0, 0)
    report(curriculum, proposal, True, seq=0)
    before = state_of(curriculum)
    curriculum.report([Report(outcome_of(proposal, False), origin(0, "b2"))])
    assert state_of(curriculum) | {"seen": 0} == before | {"seen": 0}
    assert curriculum.seen.seen(origin(0, "b2"))
    assert [o.result.success for o in curriculum.database.outcomes()] == [True]


@pytest.mark.parametrize("task", [{"x": 9.0}, {"y": 1.0}, Task(cell=0, seed=0, start=OPEN.world.start)])
def test_outcome_of_an_impossible_task_is_refused_and_changes_nothing(task):
    curriculum = Curriculum(BOX)
    before = state_of(curriculum)
    with pytest.raises(MessageError, match=r"^task: "):
        curriculum.report([Report(Outcome(proposal="p", task=task, success=True), origin(0))])
    assert state_of(curriculum) == before


def test_cell_that_does_not_exist_is_refused():
    curriculum = Curriculum(BOX)
    with pytest.raises(MessageError, match="cell: 1 does not exist here; 0 to 0 do"):
        curriculum.propose(1, 0)
    assert curriculum.database.count_leases() == 0


def test_oldest_candidate_of_a_full_cell_makes_room_on_disk_too(file):
    config = small_config("curriculum.gate.enabled=false", "curriculum.store_per_cell=3")
    curriculum = over(file, config)
    for seed in range(5):
        deliver(curriculum, make_candidate(config, seed), seq=seed)
    deliver(curriculum, make_candidate(config, 9, cell=1), seq=5)
    for found in (curriculum, over(file, config)):
        assert held(found) == [2, 3, 4]
        assert [len(cell) for cell in found.cells] == [3, 1, *[0] * 7]


# Restarts


def gated(*overrides: str) -> Config:
    return small_config(*overrides, "curriculum.gate.window=4", "curriculum.gate.threshold=0.5")


def test_restart_restores_candidates_and_leases(file):
    first = over(file, OPEN)
    deliver(first, *(make_candidate(OPEN, seed) for seed in range(4)))
    taken = seeds(first, 2)
    second = over(file, OPEN)
    assert state_of(second) == state_of(first)
    assert sorted(taken + seeds(second, 2)) == [0, 1, 2, 3]
    assert second.propose(0, 0).task.seed > 3


@pytest.mark.parametrize("saved", [0, 20, 47])
@pytest.mark.parametrize("algorithm", ["navacl-q+", "navacl-q", "schedule"])
def test_restart_restores_all_that_was_learned_to_the_bit_by_outcomes_after_the_last_save(
    file, algorithm, saved
):
    config = boxed(f"curriculum.algorithm='{algorithm}'", "curriculum.schedule.window=5")
    first = over(file, config)
    live(first, saved)
    first.save()
    live(first, 47 - saved, first=saved)
    assert state_of(over(file, config)) == state_of(first)


def test_saved_random_numbers_go_on():
    database = Database(None)
    first = Curriculum(BOX, database)
    live(first, 20)
    first.save()
    second = Curriculum(BOX.model_copy(update={"seed": 9}), database)
    assert [second.propose(0, 0).task for _ in range(5)] == [first.propose(0, 0).task for _ in range(5)]


def test_restart_restores_the_gate(file):
    config = gated()
    first = over(file, config)
    proposals = [first.propose(0, 0) for _ in range(4)]
    for seq, proposal in enumerate(proposals[:2]):
        report(first, proposal, True, seq)
    first.save()
    report(first, proposals[2], False, 2)
    second = over(file, config)
    assert list(second.gate.outcomes) == [True, True, False]
    assert not second.gate.open
    report(second, proposals[3], False, 3)
    assert second.gate.open, "two of four"
    assert over(file, config).gate.open


def test_proposed_tasks_are_counted_over_a_restart(file):
    first = over(file)
    live(first, 12)
    first.save()
    assert over(file).proposed == first.proposed
    assert sum(first.proposed.values()) == 12


def test_another_algorithm_learns_from_the_outcomes_there_are(file):
    first = over(file)
    live(first, 60)
    first.save()
    letter = boxed("curriculum.algorithm='navacl-q'")
    changed = over(file, letter)
    assert changed.outcomes == 60
    assert changed.algorithm.network.fits == 60 // letter.curriculum.batch_size
    fresh = Curriculum(letter)
    for seq, outcome in enumerate(first.database.outcomes()):
        message = Outcome(proposal=None, task=outcome.result.entry.task, success=outcome.result.success)
        fresh.report([Report(message, origin(seq))])
    assert state_of(changed)["arrays"] == state_of(fresh)["arrays"]


def test_candidates_of_another_encoder_are_gone_after_a_restart(file):
    first = over(file, OPEN, "e1")
    deliver(first, make_candidate(OPEN, 0))
    proposal = first.propose(0, 0)
    other = over(file, OPEN, "e2")
    assert len(other) == 0
    report(other, proposal, True, 5)  # of an actor that knew the old one
    assert other.outcomes == 1
    assert len(over(file, OPEN, "e1")) == 0


def test_messages_are_known_after_a_restart(file):
    first = over(file)
    live(first, 3)
    first.report([Report(Outcome(proposal=None, task={"x": 1.0}, success=True), origin(7))])
    second = over(file)
    assert [second.seen.seen(origin(seq)) for seq in range(9)] == [True] * 3 + [False] * 4 + [True, False]


@pytest.mark.parametrize(
    "other",
    ['curriculum.parameters=[{name="y", low=0.0, high=8.0, easy=0.0}]', "curriculum.gate.enabled=false"],
    ids=["other names", "docking"],
)
def test_database_of_other_tasks_is_refused(file, other):
    first = over(file)
    live(first, 20)
    first.save()
    with pytest.raises(UsageError, match=r"curriculum\.db"):
        over(file, small_config(other))


@pytest.mark.parametrize("damage", ['{"kind": 1}', "[]", '"x"'])
def test_damaged_state_is_refused_with_what_to_do(file, damage):
    first = over(file)
    live(first, 20)
    first.save()
    first.database.close()
    with sqlite3.connect(file) as other:
        other.execute("UPDATE states SET text = json_set(text, '$.algorithm', json(?))", (damage,))
    other.close()
    with pytest.raises(UsageError, match=r"curriculum\.db does not fit: .*; move it to start afresh"):
        over(file)


def test_history_of_f_pi_is_kept(file):
    curriculum = over(file)
    for _ in range(8):
        live(curriculum, 51)
        curriculum.save()
    found = over(file).database.networks()
    assert [outcomes for outcomes, _, _ in found] == [204, 408]
    assert found[0][2] != found[1][2]


def test_outcomes_that_are_taken_together_are_all_there_or_none(file):
    curriculum = over(file, OPEN)
    deliver(curriculum, *(make_candidate(OPEN, seed) for seed in range(4)))
    proposals = [curriculum.propose(0, 0) for _ in range(3)]
    reports = [Report(outcome_of(p), origin(seq)) for seq, p in enumerate(proposals, 1)]
    impossible = Outcome(proposal=None, task={"y": 1.0}, success=True)
    before = state_of(curriculum)
    with pytest.raises(MessageError, match=r"^task: "):
        curriculum.report([*reports, Report(impossible, origin(4))])
    assert state_of(curriculum) == before
    curriculum.report([*reports, Report(reports[0].outcome, origin(5))])
    assert (curriculum.outcomes, len(curriculum)) == (3, 1)
    for found in (curriculum, over(file, OPEN)):
        assert [found.seen.seen(origin(seq)) for seq in range(7)] == [True] * 4 + [False, True, False]


def test_q_is_known_after_a_restart_with_the_weights_it_is_from(file):
    first = over(file, OPEN)
    deliver(first, *(make_candidate(OPEN, seed, cell=seed % 2) for seed in range(5)))
    rows = first.cells[0].table.row.tolist()
    first.cells[0].value(rows[:2], np.array([-0.25, 1 / 3]), np.array([3, 7]))
    first.save()
    report(first, first.propose(0, 0))  # leaves after the save
    second = over(file, OPEN)
    left = {row: first.cells[0].entry(row).q for row in first.cells[0].table.row.tolist()}
    assert {row: second.cells[0].entry(row).q for row in left} == left
    assert len(left) == 2 and None in left.values()
    proposal = second.propose(0, 0)
    assert (proposal.q, proposal.q_version, proposal.q_reason) == (
        next(q for q in left.values() if q is not None), "3.7", "critic",
    )  # fmt: skip
    assert second.propose(1, 0).q_reason == "no critic yet"


def test_state_of_an_older_format_is_learned_again_from_the_outcomes(file, caplog):
    first = over(file)
    live(first, 40)
    first.save()
    first.database.close()
    with sqlite3.connect(file) as other:  # before there was a format, kinds ended with the scales
        other.execute("UPDATE states SET text = json_remove(text, '$.kind[4]') WHERE name = 'curriculum'")
        other.execute("UPDATE states SET tensors = zeroblob(9) WHERE name = 'curriculum'")
    other.close()
    second = over(file)
    assert "another algorithm or format than before" in caplog.text
    assert second.outcomes == 40
    assert second.algorithm.network.fits == 40 // BOX.curriculum.batch_size


def test_candidates_beyond_a_smaller_bound_leave_with_the_next_that_comes(file):
    first = over(file, OPEN)
    deliver(first, *(make_candidate(OPEN, seed) for seed in range(5)))
    smaller = small_config("curriculum.gate.enabled=false", "curriculum.store_per_cell=3")
    second = over(file, smaller)
    assert held(second) == [0, 1, 2, 3, 4]
    deliver(second, make_candidate(OPEN, 5), seq=1)
    for found in (second, over(file, smaller)):
        assert held(found) == [3, 4, 5]
