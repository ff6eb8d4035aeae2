import json
import math
import sqlite3
from collections import Counter
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from common.config import GEOMETRIC, Config, resolve
from common.errors import UsageError
from common.messages import Candidate, Candidates, MessageError, Origin, Outcome, Proposal, Version
from common.networks import Perception, Policy, TwinCritic, state_of
from common.observation import ObservationLayout
from common.tasks import Task, build_scene, geometric_properties
from curriculum.algorithms.adaptive_filtering import task_type_probabilities
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.critic import CriticView
from curriculum.curriculum import Curriculum, Gate, Report
from curriculum.database import Database
from curriculum.success_network import SuccessNetwork
from curriculum.task_space import Entry
from tests.helpers import small_config

pytestmark = pytest.mark.usefixtures("one_thread")
OPEN = "curriculum.gate.enabled=false"
PLUS = small_config(OPEN)
LETTER = small_config(OPEN, "curriculum.algorithm='navacl-q'", f"curriculum.inputs={[*GEOMETRIC[:4], 'q']}")
RND = small_config(OPEN, "curriculum.algorithm='rnd'")
FEW, FEW_LETTER = (
    config.model_copy(
        update={"curriculum": config.curriculum.model_copy(update={"filter_samples": 8, "max_draws": 8})}
    )
    for config in (PLUS, LETTER)
)
"""An empty database is soon made up for."""


def make_candidate(config: Config, seed: int, cell: int = 0) -> Candidate:
    layout, rng = ObservationLayout.of(config), np.random.default_rng(seed)
    if layout.row_dtype == "uint8":
        visual: np.ndarray = rng.integers(0, 256, layout.row_shape, dtype=np.uint8)
    else:
        visual = rng.uniform(0, 2, layout.row_shape).astype(np.float16)
    lidar = rng.uniform(0, 1, layout.lidar).astype(np.float16)
    return Candidate(task=Task(cell=cell, seed=seed, start=config.world.start), visual=visual, lidar=lidar)


class Learner:
    """Random networks such as a learner would publish, and Q(s0, a0) computed from them step by step."""

    def __init__(self, config: Config, seed: int = 0) -> None:
        torch.manual_seed(seed)
        layout = ObservationLayout.of(config)
        self.policy, self.critic = Policy(layout, config.network), TwinCritic(layout, config.network)
        self.perception, self.layout = Perception(config), layout
        torch.nn.init.normal_(self.critic.net.output.weights[0])  # so that starts differ in value

    def tensors(self) -> dict[str, torch.Tensor]:
        return state_of(policy=self.policy, critic=self.critic, perception=self.perception)

    def q(self, candidate: Candidate) -> float:
        visual = np.concatenate([candidate.visual] * self.layout.stack).astype(np.float32)
        flat = np.concatenate([visual, candidate.lidar.astype(np.float32), np.zeros(12, np.float32)])
        x = torch.from_numpy(flat)[None]
        with torch.no_grad():
            action = torch.tanh(self.policy.net(x)[0, :, :2])
            first, second = self.critic.net(x, action).flatten().tolist()
        assert first != second
        return min(first, second)


def origin(seq: int) -> Origin:
    return Origin(actor="local/a1", boot="b1", seq=seq)


def add(curriculum: Curriculum, *candidates: Candidate, seq: int = 0) -> None:
    """Takes candidates in as the service does."""
    curriculum.add(curriculum.check(Candidates(digest={}, candidates=list(candidates))), origin(seq))


def with_candidates(
    config: Config, count: int, cell: int = 0, database: Database | None = None
) -> tuple[Curriculum, dict[int, Candidate]]:
    """A curriculum with candidates in one cell, by their seeds."""
    curriculum = Curriculum(config, database)
    candidates = {seed: make_candidate(config, seed, cell) for seed in range(count)}
    add(curriculum, *candidates.values())
    return curriculum, candidates


def value(curriculum: Curriculum, learner: Learner, version: Version | None = None) -> None:
    """Gives every candidate its Q under the weights of a learner."""
    curriculum.load_critic(version or Version(epoch=1), learner.tensors())
    for cell, rows in curriculum.stale(5):
        curriculum.refresh(cell, rows, nullcontext())


def outcome_of(proposal: Proposal, success: bool) -> Outcome:
    return Outcome(proposal=proposal.id, task=proposal.task, success=success)


def task_of(proposal: Proposal) -> Task:
    assert isinstance(proposal.task, Task)
    return proposal.task


def seeds_in(curriculum: Curriculum, cell: int = 0) -> list[int]:
    """Of a cell's candidates, oldest first."""
    return [task.seed for task in tasks_in(curriculum, cell)]


def tasks_in(curriculum: Curriculum, cell: int = 0) -> list[Task]:
    held = curriculum.cells[cell]
    return [held.entry(row).task for row in held.table.row.tolist()]


def network_of(curriculum: Curriculum) -> SuccessNetwork:
    assert isinstance(curriculum.algorithm, NavaclQ)
    return curriculum.algorithm.network


def predictions(curriculum: Curriculum) -> list[float]:
    """Of some tasks, without Q."""
    tasks = [Task(cell=i, seed=i, start=PLUS.world.start) for i in range(9)]
    return network_of(curriculum).predict([geometry(task) for task in tasks], [None] * 9).tolist()


def geometry(task: Task) -> Mapping[str, float]:
    return geometric_properties(task, build_scene(task, PLUS.world)).model_dump()


def train(curriculum: Curriculum, outcomes: int) -> None:
    """Lets f_pi learn that success is a matter of distance; f rises through 0.5 at 3 m."""
    rng = np.random.default_rng(0)
    for _ in range(outcomes):
        values = rng.uniform((1.5, 1, 1, 0, 0, 0), (5, 5, 5, 1.5, 1.5, 0.5)).tolist()
        properties = dict(zip(GEOMETRIC, values, strict=True))
        network_of(curriculum).add(properties, None, bool(values[0] + rng.normal() < 3))


# The gate


def gated(window: int = 4, threshold: float = 0.5) -> Config:
    return small_config(f"curriculum.gate.window={window}", f"curriculum.gate.threshold={threshold}")


def test_gate_opens_when_enough_of_the_last_outcomes_are_successes_and_stays_open():
    gate = Gate(gated(window=4, threshold=0.5))
    for success in (True, True, True):  # three of three, but four are judged
        gate.add(success)
        assert not gate.open
    gate.add(False)
    assert gate.open
    for _ in range(10):
        gate.add(False)
    assert gate.open


def test_gate_stays_shut_just_below_the_threshold_and_judges_the_last_outcomes_only():
    gate = Gate(gated(window=4, threshold=0.75))
    for success in (True, True, False, False, True, False, True, False, True):
        gate.add(success)
        assert not gate.open
    gate.add(True)  # the last four: True, False, True, True
    assert gate.open


def test_gate_that_is_disabled_is_open():
    assert Gate(PLUS).open


def test_tasks_before_the_gate_are_near_and_straight_and_carry_its_name():
    curriculum = Curriculum(gated())
    ranges = curriculum.config.curriculum.gate.ranges
    for cell in range(9):
        proposal = curriculum.propose(cell, 0)
        assert (proposal.category, proposal.requested) == ("gate", "random")
        assert "favourable starts" in proposal.why
        assert task_of(proposal).cell == cell
        assert task_of(proposal).start.model_dump() == ranges.model_dump()
        assert proposal.properties["distance"] <= ranges.distance_max
        assert (proposal.q, proposal.f, proposal.mu, proposal.sigma) == (None, None, None, None)
        assert proposal.q_reason == "not used by gate"


def test_only_outcomes_of_favourable_starts_open_the_gate():
    curriculum = Curriculum(gated(window=4))
    favourable = curriculum.propose(0, 0)
    for seq in range(8):  # of nobody's proposal, and of one that is not known here
        unserved = outcome_of(favourable, True).model_copy(update={"proposal": (None, f"p-{seq}")[seq % 2]})
        curriculum.report([Report(unserved, origin(seq))])
    assert list(curriculum.gate.outcomes) == []
    for seq in range(4):
        proposal = favourable if seq == 0 else curriculum.propose(0, 0)
        assert proposal.category == "gate"
        assert not curriculum.gate.open
        curriculum.report([Report(outcome_of(proposal, True), origin(8 + seq))])
    assert curriculum.gate.open
    after = curriculum.propose(0, 0)
    assert after.category in ("easy", "frontier", "random")
    curriculum.report([Report(outcome_of(after, True), origin(12))])
    assert len(curriculum.gate.outcomes) == 4
    assert curriculum.outcomes == 13
    on_record = [outcome.result.category for outcome in curriculum.database.outcomes()]
    assert on_record == ["unserved"] * 8 + ["gate"] * 4 + [after.category]


def test_outcome_counts_once_for_each_proposal():
    curriculum = Curriculum(gated(window=4))
    proposal = curriculum.propose(0, 0)
    for seq in range(3):
        curriculum.report([Report(outcome_of(proposal, True), origin(seq))])
    assert (curriculum.outcomes, list(curriculum.gate.outcomes)) == (1, [True])


def test_outcome_is_learned_with_what_the_proposal_was_made_of():
    curriculum, candidates = with_candidates(PLUS, 3)
    old, new = Learner(PLUS, 1), Learner(PLUS, 2)
    value(curriculum, old, Version(epoch=1))
    proposal = curriculum.propose(0, 0)
    value(curriculum, new, Version(epoch=2))
    assert new.q(candidates[task_of(proposal).seed]) != proposal.q
    curriculum.report([Report(outcome_of(proposal, True), origin(1))])
    unserved = Task(cell=3, seed=8, start=PLUS.world.start)
    curriculum.report([Report(Outcome(proposal=None, task=unserved, success=False), origin(2))])
    first, second = (outcome.result for outcome in curriculum.database.outcomes())
    assert (first.entry.properties, first.entry.q) == (proposal.properties, proposal.q)
    assert (first.category, first.f, first.success) == (proposal.category, proposal.f, True)
    assert (second.entry.task, second.entry.properties) == (unserved, geometry(unserved))
    assert (second.category, second.entry.q, second.f, second.success) == ("unserved", None, None, False)
    assert list(curriculum.judged) == [(proposal.f, True)]


# Random starts


def test_rnd_proposes_the_full_distribution_and_uses_neither_f_nor_q():
    curriculum, candidates = with_candidates(RND, 5)
    value(curriculum, Learner(RND))
    seeds = set()
    for seq in range(40):
        proposal = curriculum.propose(0, 10**9)
        assert (proposal.requested, proposal.category) == ("random", "rnd")
        assert task_of(proposal).start == RND.world.start
        assert (proposal.q, proposal.f, proposal.mu, proposal.sigma) == (None, None, None, None)
        assert (proposal.q_reason, proposal.q_version) == ("not used by rnd", None)
        curriculum.report([Report(outcome_of(proposal, True), origin(seq + 1))])
        seeds.add(task_of(proposal).seed)
    assert len(seeds) == 40
    assert not seeds & set(candidates)
    assert len(curriculum) == 5
    assert curriculum.outcomes == 40
    assert curriculum.proposed == {"rnd": 40}


# Adaptive filtering over the database


def test_empty_database_is_made_up_for_by_geometry_alone_and_the_proposal_says_so():
    curriculum = Curriculum(PLUS)
    value(curriculum, Learner(PLUS))
    proposal = curriculum.propose(4, 0)
    assert task_of(proposal).cell == 4
    assert proposal.q is None
    assert proposal.q_reason == "no candidate in the database; by geometry alone"
    assert proposal.f is not None
    assert 0 < proposal.f < 1
    assert proposal.sigma is not None
    assert proposal.sigma > 0


def test_candidates_without_a_critic_have_no_q_and_the_proposal_says_so():
    curriculum, candidates = with_candidates(PLUS, 5)
    proposal = curriculum.propose(0, 0)
    assert task_of(proposal).seed in candidates
    assert (proposal.q, proposal.q_version, proposal.q_reason) == (None, None, "no critic yet")


@pytest.mark.parametrize("config", [PLUS, LETTER])
def test_q_is_the_minimum_of_the_twin_critics_at_the_greedy_action(config):
    curriculum, candidates = with_candidates(config, 6)
    learner = Learner(config)
    value(curriculum, learner, Version(epoch=1, counter=3))
    found = set()
    for _ in range(6):
        proposal = curriculum.propose(0, 0)
        assert (proposal.q_reason, proposal.q_version) == ("critic", "1.3")
        assert proposal.q == pytest.approx(learner.q(candidates[task_of(proposal).seed]), abs=1e-5)
        found.add(round(proposal.q, 4))
    assert len(found) == 6


def test_q_end_to_end_is_that_of_the_encoded_frame():
    config = small_config(OPEN, "encoder.end_to_end=true")
    learner, view = Learner(config), CriticView(config)
    candidate = make_candidate(config, 3)
    view.load(learner.tensors())
    (q,) = view.value([candidate])
    assert learner.perception.encoder is not None
    frames = torch.from_numpy(np.stack([candidate.visual] * 4))[None]
    with torch.no_grad():
        code = learner.perception.encoder.encode_stacks(frames)[0].numpy()
        encoded = candidate.model_copy(update={"visual": code[: len(code) // learner.layout.stack]})
    assert np.array_equal(code, np.tile(encoded.visual, 4))
    assert q == pytest.approx(learner.q(encoded), abs=1e-4)


def q_of(curriculum: Curriculum) -> list[float | None]:
    """Of the candidates of cell 0, oldest first."""
    cell = curriculum.cells[0]
    return [cell.entry(row).q for row in cell.table.row.tolist()]


def test_q_is_kept_until_weights_of_another_version_come():
    curriculum, candidates = with_candidates(PLUS, 2)
    assert q_of(curriculum) == [None, None]
    assert curriculum.stale(5) == [], "nothing could be newer without weights"
    old, new = Learner(PLUS, 1), Learner(PLUS, 2)
    value(curriculum, old, Version(epoch=1, counter=9))
    first = [old.q(c) for c in candidates.values()]
    assert q_of(curriculum) == pytest.approx(first, abs=1e-5)
    later = [make_candidate(PLUS, seed) for seed in (2, 3)]
    add(curriculum, *later, seq=1)
    value(curriculum, new, Version(epoch=1, counter=9))  # the same version: what is known stays
    assert q_of(curriculum) == pytest.approx([*first, *map(new.q, later)], abs=1e-5)
    value(curriculum, new, Version(epoch=2, counter=0))
    assert q_of(curriculum) == pytest.approx([new.q(c) for c in (*candidates.values(), *later)], abs=1e-5)
    assert curriculum.propose(0, 0).q_version == "2.0"


def test_oldest_q_is_renewed_first_in_whatever_cell_it_is():
    curriculum, _ = with_candidates(PLUS, 2)
    add(curriculum, *(make_candidate(PLUS, seed, 5) for seed in (2, 3)), seq=1)
    learner = Learner(PLUS)
    value(curriculum, learner, Version(epoch=1, counter=1))
    curriculum.load_critic(Version(epoch=1, counter=2), learner.tensors())
    curriculum.refresh(curriculum.cells[0], curriculum.stale(5)[0][1], nullcontext())
    add(curriculum, make_candidate(PLUS, 4, 8), seq=2)
    curriculum.load_critic(Version(epoch=1, counter=3), learner.tensors())
    order = [curriculum.cells.index(cell) for cell, _ in curriculum.stale(5)]
    assert order == [8, 5, 0], "none, then of the first weights, then of the second"


@pytest.mark.parametrize("moment", [1, 2, 3])
def test_candidate_that_leaves_while_its_q_is_computed_takes_no_others_place(file, moment):
    config, learner = PLUS, Learner(PLUS)
    candidates = {seed: make_candidate(config, seed) for seed in range(4)}
    add(Curriculum(config, Database(file)), *candidates.values())
    curriculum = Curriculum(config, Database(file))  # whose start observations are still to be read
    curriculum.load_critic(Version(epoch=1), learner.tensors())
    ((cell, rows),) = curriculum.stale(5)
    proposal, times = curriculum.propose(0, 0), []

    class Lock(nullcontext):
        def __enter__(self):
            times.append(1)
            if len(times) == moment:
                curriculum.report([Report(outcome_of(proposal, True), origin(1))])

    curriculum.refresh(cell, rows, Lock())
    assert len(times) == 3
    left = [learner.q(c) for seed, c in candidates.items() if seed != task_of(proposal).seed]
    assert q_of(curriculum) == pytest.approx(left, abs=1e-5)


def test_weights_that_do_not_fit_are_refused_naming_the_tensor():
    other = small_config("network.hidden=[24, 16]")
    with pytest.raises(ValueError, match=r"tensor policy\.net\.fusion\.bias is of shape \(1, 1, 24\)"):
        Curriculum(PLUS).load_critic(Version(), Learner(other).tensors())


@pytest.mark.parametrize("config", [PLUS, LETTER])
def test_mu_and_sigma_are_fitted_to_the_predictions_over_the_database(config):
    curriculum, candidates = with_candidates(config, 12)
    learner = Learner(config)
    value(curriculum, learner)
    properties = {seed: geometry(c.task) for seed, c in candidates.items()}
    q: list[float | None] = [learner.q(c) for c in candidates.values()]
    f = network_of(curriculum).predict(list(properties.values()), q)
    proposal = curriculum.propose(0, 0)
    assert proposal.properties == properties[task_of(proposal).seed]
    assert proposal.mu == pytest.approx(f.mean(), abs=1e-5)
    assert proposal.sigma == pytest.approx(f.std(), abs=1e-5)
    assert proposal.f == pytest.approx(f[task_of(proposal).seed], abs=1e-5)


def test_proposals_to_the_letter_meet_algorithm_1():
    curriculum, _ = with_candidates(LETTER, 100)
    train(curriculum, 800)
    categories: Counter[str] = Counter()
    for _ in range(30):
        p = curriculum.propose(0, 0)
        assert p.f is not None
        assert p.mu is not None
        assert p.sigma is not None
        categories[p.category] += 1
        if p.category == "easy":
            assert p.f > p.mu + p.sigma or p.f > 0.95 or (p.mu + p.sigma >= 1 and p.f > p.mu)
        elif p.category == "frontier":
            assert p.mu - 0.1 * p.sigma < p.f < p.mu + 0.1 * p.sigma
        else:
            assert p.category == "random"
            assert p.requested != "random", "at t = 0 only draws in vain lead to a random task"
        assert p.category in (p.requested, "random")
    assert min(categories["easy"], categories["frontier"], categories["random"]) > 1


def test_frontier_of_plus_lies_near_one_half_when_f_spreads():
    curriculum, _ = with_candidates(small_config(OPEN, "curriculum.easy_share=0"), 100)
    train(curriculum, 640)
    proposals = [curriculum.propose(0, 0) for _ in range(5)]
    assert {p.category for p in proposals} == {"frontier"}
    assert all(abs(p.f - 0.5) < 0.25 for p in proposals if p.f is not None)
    assert all(2 < p.properties["distance"] < 4 for p in proposals), "success ends at 3 m"
    assert all(p.sigma is not None and p.sigma > 0.2 for p in proposals)


def test_requests_follow_the_asking_agents_steps():
    curriculum, _ = with_candidates(LETTER, 100)
    t = 10**6
    assert task_type_probabilities(t, LETTER.curriculum)["random"] == 0.15
    requested = Counter(curriculum.propose(0, 0 if i < 50 else t).requested for i in range(100))
    assert 0 < requested["random"] < 20
    early = Curriculum(RND)
    assert early.propose(0, 0).requested == "random"


def test_proposed_candidates_are_in_nobody_elses_hands_and_leave_the_database_when_reported():
    curriculum, candidates = with_candidates(PLUS, 30)
    proposals = [curriculum.propose(0, 0) for _ in range(30)]
    assert sorted(task_of(p).seed for p in proposals) == sorted(candidates)
    assert len(curriculum) == curriculum.snapshot().leases == 30
    assert task_of(curriculum.propose(0, 0)).seed not in candidates
    curriculum.report([Report(outcome_of(proposals[3], True), origin(1))])
    assert seeds_in(curriculum) == [seed for seed in range(30) if seed != task_of(proposals[3]).seed]
    assert curriculum.snapshot().leases == 30, "one of them of a task made up by geometry"


def test_proposed_candidate_that_nobody_reports_is_proposed_again():
    config = small_config(OPEN, "curriculum.lease=1e-9")
    curriculum, _ = with_candidates(config, 2)
    proposals = [curriculum.propose(0, 0) for _ in range(20)]
    assert Counter(task_of(p).seed for p in proposals).keys() == {0, 1}
    last = task_of(proposals[-1]).seed
    curriculum.report([Report(outcome_of(proposals[-1], True), origin(1))])
    assert seeds_in(curriculum) == [1 - last]


def test_candidates_are_proposed_in_their_own_cell_only():
    curriculum = Curriculum(PLUS)
    add(curriculum, *(make_candidate(PLUS, seed, cell=seed % 2) for seed in range(6)))
    assert curriculum.snapshot().candidates == [3, 3, *[0] * 7]
    assert {task_of(curriculum.propose(1, 0)).seed for _ in range(3)} == {1, 3, 5}


# The candidates


def test_database_holds_a_bounded_number_per_cell_and_the_oldest_make_room():
    config = small_config(OPEN, "curriculum.store_per_cell=5")
    curriculum, _ = with_candidates(config, 8)
    add(curriculum, make_candidate(config, 100, cell=1), seq=1)
    assert len(curriculum) == 6
    assert (seeds_in(curriculum, 0), seeds_in(curriculum, 1)) == ([3, 4, 5, 6, 7], [100])
    kept = [Entry.read(text).task for _, text in curriculum.database.candidates("")]
    assert [task.seed for task in kept if isinstance(task, Task)] == [3, 4, 5, 6, 7, 100]


def test_draws_are_different_candidates_in_random_order():
    curriculum, _ = with_candidates(PLUS, 20)
    first: Counter[int] = Counter()
    for _ in range(400):
        drawn = curriculum.cells[0].draw(5)
        seeds = [drawn.entry(i).task.seed for i in range(5)]
        assert len(set(seeds)) == 5
        first[seeds[0]] += 1
    assert sum((first[seed] - 20) ** 2 / 20 for seed in range(20)) < 36.19  # 19 degrees of freedom, 1%


def test_candidates_without_q_wait_while_others_have_one():
    curriculum, _ = with_candidates(PLUS, 3)
    value(curriculum, Learner(PLUS))
    add(curriculum, *(make_candidate(PLUS, seed) for seed in range(3, 9)), seq=1)
    proposals = [curriculum.propose(0, 0) for _ in range(9)]
    assert {task_of(p).seed for p in proposals[:3]} == {0, 1, 2}
    assert [p.q is None for p in proposals] == [False] * 3 + [True] * 6


def test_candidate_of_another_layout_is_refused_naming_the_field():
    curriculum, good = Curriculum(PLUS), make_candidate(PLUS, 0)
    wrong = {
        "visual": (good.visual[:-1], good.visual.astype(np.float32), good.visual[None]),
        "lidar": (good.lidar[:-1], good.lidar.astype(np.float64), np.zeros(256, np.float16)),
    }
    for name, arrays in wrong.items():
        for array in arrays:
            with pytest.raises(
                MessageError, match=rf"candidate {name} is .*, expected \(4,\)|expected float16"
            ):
                add(curriculum, good, good.model_copy(update={name: array}))
    assert len(curriculum) == 0, "all or none"
    add(curriculum, good)
    assert len(curriculum) == 1


# On disk


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "run" / "curriculum.db"


def played(config: Config, file: Path, outcomes: int, successes: int) -> Curriculum:
    """A curriculum that has proposed and heard so much, the successes first."""
    curriculum = Curriculum(config, Database(file))
    for i in range(outcomes):
        curriculum.report([Report(outcome_of(curriculum.propose(i % 9, 0), i < successes), origin(i))])
    return curriculum


def test_restored_curriculum_goes_on_where_the_saved_one_was(file):
    config = gated(window=6, threshold=0.9)
    saved = played(config, file, outcomes=20, successes=5)
    saved.save()
    saved.save()
    following = [task_of(saved.propose(7, 0)) for _ in range(3)]  # counts from the next save on
    proposed = saved.proposed - Counter(gate=3)
    saved.database.close()
    assert [path.name for path in file.parent.iterdir()] == ["curriculum.db"]
    restored = Curriculum(config.model_copy(update={"seed": 5}), Database(file))
    assert restored.outcomes == 20
    assert restored.proposed == proposed == {"gate": 20}
    assert not restored.gate.open
    assert list(restored.gate.outcomes) == [False] * 6
    assert predictions(restored) == predictions(saved)
    assert network_of(restored).fits == 1
    assert [task_of(restored.propose(7, 0)) for _ in range(3)] == following


@pytest.mark.parametrize("config", [FEW, FEW_LETTER])
def test_what_came_after_the_last_save_is_learned_again_from_the_outcomes(file, config):
    killed = played(config, file, outcomes=40, successes=15)
    killed.database.close()
    restored = Curriculum(config, Database(file))
    assert restored.outcomes == 40
    assert restored.judged == killed.judged
    assert network_of(restored).fits == 2
    assert predictions(restored) == predictions(killed) != predictions(Curriculum(config))
    assert all(restored.seen.seen(origin(seq)) for seq in range(40))
    assert not restored.seen.seen(origin(40))


def test_restored_candidates_keep_their_observations_and_leases_but_not_those_of_another_encoder(file):
    killed, candidates = with_candidates(PLUS, 4, database=Database(file))
    taken = killed.propose(0, 0)
    killed.database.close()
    restored = Curriculum(PLUS, Database(file))
    assert seeds_in(restored) == [0, 1, 2, 3]
    learner = Learner(PLUS)
    value(restored, learner)
    free = sorted(set(candidates) - {task_of(taken).seed})
    found = {task_of(p).seed: p.q for p in (restored.propose(0, 0) for _ in range(3))}
    assert sorted(found) == free
    assert [found[seed] for seed in free] == pytest.approx([learner.q(candidates[s]) for s in free], abs=1e-5)
    restored.report([Report(outcome_of(taken, True), origin(1))])
    assert seeds_in(restored) == free
    restored.database.close()
    assert len(Curriculum(PLUS, Database(file), encoder="another")) == 0


def test_gate_that_has_opened_stays_open_after_a_restart(file):
    config = gated(window=2)
    saved = played(config, file, outcomes=2, successes=2)
    saved.save()
    for i in range(10):
        assert saved.propose(0, 0).category != "gate"
        saved.report(
            [Report(Outcome(proposal=None, task=make_candidate(config, i).task, success=False), origin(i))]
        )
    saved.database.close()
    restored = Curriculum(config, Database(file))
    assert restored.gate.open
    assert restored.propose(0, 0).category != "gate"


def test_file_that_is_not_there_is_a_beginning(file):
    curriculum = Curriculum(PLUS, Database(file))
    assert (curriculum.outcomes, len(curriculum)) == (0, 0)
    assert file.exists()


def test_state_of_another_algorithm_is_learned_again_from_the_outcomes_on_record(file, caplog):
    saved = played(FEW_LETTER, file, outcomes=40, successes=15)
    results = [outcome.result for outcome in saved.database.outcomes()]
    saved.save()
    saved.database.close()
    other = Curriculum(PLUS, Database(file))
    assert "another algorithm or format than before" in caplog.text
    expected = Curriculum(PLUS)
    for result in results:
        network_of(expected).add(result.entry.properties, result.entry.q, result.success)
    assert other.outcomes == 40
    assert network_of(other).fits == 2
    assert predictions(other) == predictions(expected)
    other.save()
    other.database.close()
    rnd = Curriculum(RND, Database(file))
    assert (rnd.outcomes, rnd.propose(0, 0).category) == (40, "rnd")


def test_another_reservoir_is_filled_from_the_outcomes_on_record(file):
    saved = played(PLUS, file, outcomes=40, successes=15)
    saved.save()
    saved.database.close()
    settings = PLUS.curriculum.model_copy(update={"reservoir": 20})
    smaller = Curriculum(PLUS.model_copy(update={"curriculum": settings}), Database(file))
    assert (smaller.outcomes, network_of(smaller).fits) == (40, 2)


@pytest.mark.parametrize("damage", ["{", "{}", "[]", "3", "null", '{"numbers": 3}'])
def test_damaged_state_is_a_usage_error(file, damage):
    saved = played(FEW, file, outcomes=1, successes=1)
    saved.save()
    saved.database.close()
    with sqlite3.connect(file) as sql:
        sql.execute("UPDATE states SET text = ?", (damage,))
    sql.close()
    with pytest.raises(UsageError, match=r"curriculum\.db"):
        Curriculum(PLUS, Database(file))


@pytest.mark.parametrize(
    "field",
    ["kind", "rng", "algorithm", "gate_open", "gate_outcomes", "proposed", "judged", "outcomes", "last"],
)
def test_state_that_lacks_something_is_a_usage_error(file, field):
    saved = played(gated(), file, outcomes=1, successes=1)
    saved.save()
    saved.database.close()
    with sqlite3.connect(file) as sql:
        sql.execute("UPDATE states SET text = json_remove(text, ?)", (f"$.{field}",))
    sql.close()
    with pytest.raises(UsageError, match=r"curriculum\.db does not fit: .*; move it to start afresh"):
        Curriculum(gated(), Database(file))


@pytest.mark.parametrize(
    "where",
    [
        "tensors cut",
        "tensors gone",
        "outcome cut",
        "another schema",
        "file cut",
        "pages overwritten",
        "no database",
    ],
)
def test_damaged_database_is_a_usage_error(file, where):
    saved = played(FEW, file, outcomes=30, successes=1)
    saved.save()
    saved.database.close()
    content = file.read_bytes()
    if where == "file cut":
        file.write_bytes(content[:5000])
    elif where == "pages overwritten":
        file.write_bytes(content[:4096] + b"x" * (len(content) - 4096))
    elif where == "no database":
        file.write_bytes(b"x" * 5000)
    else:
        change = {
            "tensors cut": "UPDATE states SET tensors = substr(tensors, 1, 99)",
            "tensors gone": "UPDATE states SET tensors = NULL",
            "outcome cut": "UPDATE outcomes SET entry = substr(entry, 1, 9), id = id + 99",
            "another schema": "PRAGMA user_version=99",
        }
        with sqlite3.connect(file) as sql:
            sql.execute(change[where])
        sql.close()
    with pytest.raises(UsageError, match=r"curriculum\.db"):
        Curriculum(PLUS, Database(file))


# What the command prints


def test_proposal_has_the_keys_that_programs_read():
    curriculum, _ = with_candidates(PLUS, 3)
    value(curriculum, Learner(PLUS))
    proposal = curriculum.propose(0, 0)
    fields = json.loads(proposal.model_dump_json())
    keys = {"id", "requested", "category", "why", "q", "q_version", "q_reason", "f", "mu", "sigma"}
    assert keys <= fields.keys()
    assert {"cell", "seed", "start", "shift"} == fields["task"].keys()
    assert fields["task"]["shift"] is None
    assert {"distance", "agent_clearance", "goal_clearance", "relative_angle"} <= fields["properties"].keys()
    for name in ("robot", "dolly"):
        x, y, yaw = fields[name]
        assert all(math.isfinite(value) for value in (x, y, yaw))
    gap = math.dist(fields["robot"][:2], fields["dolly"][:2])
    assert gap == pytest.approx(fields["properties"]["distance"])
    assert curriculum.propose(0, 0).id != proposal.id


def test_proposals_follow_the_seed():
    def run(seed: int) -> list[int]:
        curriculum = Curriculum(PLUS.model_copy(update={"seed": seed}))
        return [task_of(curriculum.propose(2, 0)).seed for _ in range(2)]

    assert run(1) == run(1) != run(2)


def test_paper_preset_proposes_by_the_letter_without_a_gate():
    curriculum = Curriculum(resolve("paper"))
    assert curriculum.gate.open
    assert curriculum.config.curriculum.algorithm == "navacl-q"
    assert network_of(curriculum).inputs == (*GEOMETRIC[:4], "q")
    proposal = curriculum.propose(0, 0)
    assert proposal.category in ("easy", "frontier", "random")
    assert task_of(proposal).start == resolve("paper").world.start, "no narrowed candidates"
