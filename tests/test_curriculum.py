import json
import math
from collections import Counter

import numpy as np
import pytest
import torch

from common.config import Config, resolve
from common.errors import UsageError
from common.messages import Candidate, MessageError, Outcome, Proposal, Version
from common.networks import Perception, Policy, TwinCritic, state_of
from common.observation import ObservationLayout
from common.tasks import GeometricProperties, Task, build_scene, geometric_properties
from curriculum.adaptive_filtering import task_type_probabilities
from curriculum.curriculum import Curriculum, Gate
from curriculum.task_store import CriticView, Entry, TaskStore
from tests.helpers import small_config

OPEN = "curriculum.gate.enabled=false"
PLUS = small_config(OPEN)
LETTER = small_config(OPEN, "curriculum.algorithm='navacl-q'")
RND = small_config(OPEN, "curriculum.algorithm='rnd'")


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


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


def with_candidates(config: Config, count: int, cell: int = 0) -> tuple[Curriculum, dict[int, Candidate]]:
    """A curriculum with candidates in one cell, by their seeds."""
    curriculum = Curriculum(config)
    candidates = {seed: make_candidate(config, seed, cell) for seed in range(count)}
    for candidate in candidates.values():
        curriculum.store.add([candidate])
    return curriculum, candidates


def outcome_of(proposal: Proposal, success: bool) -> Outcome:
    return Outcome(
        digest={},
        proposal=proposal.id,
        task=proposal.task,
        properties=proposal.properties,
        q=proposal.q,
        success=success,
        category=proposal.category,
    )


def train(curriculum: Curriculum, outcomes: int) -> None:
    """Lets f_pi learn that success is a matter of distance; f rises through 0.5 at 3 m."""
    rng = np.random.default_rng(0)
    for _ in range(outcomes):
        distance, a, b, c, d, e = rng.uniform((1.5, 1, 1, 0, 0, 0), (5, 5, 5, 1.5, 1.5, 0.5))
        properties = GeometricProperties(
            distance=distance,
            agent_clearance=a,
            goal_clearance=b,
            relative_angle=c,
            lateral_offset=d,
            approach_angle=e,
        )
        curriculum.network.add(properties, None, bool(distance + rng.normal() < 3))


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
    for cell in range(9):
        proposal = curriculum.propose(cell, 0)
        assert proposal.category == "gate"
        assert proposal.task.cell == cell
        assert proposal.task.start.model_dump() == curriculum.config.curriculum.gate.ranges.model_dump()
        assert proposal.properties.distance <= proposal.task.start.distance_max
        assert (proposal.q, proposal.f, proposal.mu, proposal.sigma) == (None, None, None, None)
        assert proposal.q_reason == "not used by gate"


def test_only_outcomes_of_favourable_starts_open_the_gate():
    curriculum = Curriculum(gated(window=4))
    inside = curriculum.propose(0, 0)
    for category in ("random", "easy", "frontier", "unserved", "rnd"):
        for _ in range(4):
            curriculum.report(outcome_of(inside, True).model_copy(update={"category": category}))
    assert not curriculum.gate.open
    for _ in range(4):
        assert curriculum.propose(0, 0).category == "gate"
        curriculum.report(outcome_of(inside, True))
    assert curriculum.gate.open
    assert curriculum.propose(0, 0).category in ("easy", "frontier", "random")
    assert curriculum.outcomes == 24


# Random starts


def test_rnd_proposes_the_full_distribution_and_uses_neither_f_nor_q():
    curriculum, candidates = with_candidates(RND, 5)
    curriculum.critic.load(Version(epoch=1), Learner(RND).tensors())
    before = [p.clone() for p in curriculum.network.net.parameters()]
    seeds = set()
    for _ in range(40):
        proposal = curriculum.propose(0, 10**9)
        assert (proposal.requested, proposal.category) == ("random", "rnd")
        assert proposal.task.start == RND.world.start
        assert (proposal.q, proposal.f, proposal.mu, proposal.sigma) == (None, None, None, None)
        assert proposal.q_reason == "not used by rnd"
        curriculum.report(outcome_of(proposal, True))
        seeds.add(proposal.task.seed)
    assert len(seeds) == 40
    assert not seeds & set(candidates)
    assert len(curriculum.store) == 5
    assert curriculum.network.fits == 0
    assert all(torch.equal(a, b) for a, b in zip(before, curriculum.network.net.parameters(), strict=True))
    assert curriculum.proposed == {"rnd": 40}


# Adaptive filtering over the database


def test_empty_database_is_made_up_for_by_geometry_alone_and_the_proposal_says_so():
    curriculum = Curriculum(PLUS)
    curriculum.critic.load(Version(epoch=1), Learner(PLUS).tensors())
    proposal = curriculum.propose(4, 0)
    assert proposal.task.cell == 4
    assert proposal.q is None
    assert proposal.q_reason == "no candidate in the database; by geometry alone"
    assert proposal.f is not None
    assert 0 < proposal.f < 1
    assert proposal.sigma is not None
    assert proposal.sigma > 0


def test_candidates_without_a_critic_have_no_q_and_the_proposal_says_so():
    curriculum, candidates = with_candidates(PLUS, 5)
    proposal = curriculum.propose(0, 0)
    assert proposal.task.seed in candidates
    assert (proposal.q, proposal.q_reason) == (None, "no critic yet")


@pytest.mark.parametrize("config", [PLUS, LETTER])
def test_q_is_the_minimum_of_the_twin_critics_at_the_greedy_action(config):
    curriculum, candidates = with_candidates(config, 6)
    learner = Learner(config)
    curriculum.critic.load(Version(epoch=1, counter=3), learner.tensors())
    found = set()
    for _ in range(6):
        proposal = curriculum.propose(0, 0)
        assert proposal.q_reason == "critic"
        assert proposal.q == pytest.approx(learner.q(candidates[proposal.task.seed]), abs=1e-5)
        found.add(round(proposal.q, 4))
    assert len(found) == 6


def test_q_end_to_end_is_that_of_the_encoded_frame():
    config = small_config(OPEN, "encoder.end_to_end=true")
    learner, view, store = Learner(config), CriticView(config), TaskStore(config)
    candidate = make_candidate(config, 3)
    entry = store.make_entry(candidate.task, candidate)
    view.load(Version(epoch=1), learner.tensors())
    view.refresh([entry])
    assert learner.perception.encoder is not None
    frames = torch.from_numpy(np.stack([candidate.visual] * 4))[None]
    with torch.no_grad():
        code = learner.perception.encoder.encode_stacks(frames)[0].numpy()
        encoded = candidate.model_copy(update={"visual": code[: len(code) // learner.layout.stack]})
    assert np.array_equal(code, np.tile(encoded.visual, 4))
    assert entry.q == pytest.approx(learner.q(encoded), abs=1e-4)


def valued(view: CriticView, entries: list[Entry]) -> list[float | None]:
    view.refresh(entries)
    return [entry.q for entry in entries]


def test_q_is_cached_until_weights_of_another_version_come():
    store, view = TaskStore(PLUS), CriticView(PLUS)
    candidates = [make_candidate(PLUS, seed) for seed in range(4)]
    entries = [store.make_entry(c.task, c) for c in candidates]
    bare = store.make_entry(candidates[0].task)
    assert valued(view, [*entries, bare]) == [None] * 5
    old, new = Learner(PLUS, 1), Learner(PLUS, 2)
    view.load(Version(epoch=1, counter=9), old.tensors())
    first = valued(view, entries[:2])
    assert first == pytest.approx([old.q(c) for c in candidates[:2]], abs=1e-5)
    view.load(Version(epoch=1, counter=9), new.tensors())  # the same version: what is known stays
    mixed = [*first, *(new.q(c) for c in candidates[2:])]
    assert valued(view, entries) == pytest.approx(mixed, abs=1e-5)
    view.load(Version(epoch=2, counter=0), new.tensors())
    assert valued(view, [*entries, bare]) == [*(pytest.approx(new.q(c), abs=1e-5) for c in candidates), None]
    assert entries[0].q_version == Version(epoch=2, counter=0)


def test_weights_that_do_not_fit_are_refused_naming_the_tensor():
    other = small_config("network.hidden=[24, 16]")
    with pytest.raises(ValueError, match=r"tensor policy\.net\.fusion\.bias is of shape \(1, 1, 24\)"):
        CriticView(PLUS).load(Version(), Learner(other).tensors())


@pytest.mark.parametrize("config", [PLUS, LETTER])
def test_mu_and_sigma_are_fitted_to_the_predictions_over_the_database(config):
    curriculum, candidates = with_candidates(config, 12)
    learner = Learner(config)
    curriculum.critic.load(Version(epoch=1), learner.tensors())
    properties = {
        seed: geometric_properties(c.task, build_scene(c.task, config.world))
        for seed, c in candidates.items()
    }
    f = curriculum.network.predict(list(properties.values()), [learner.q(c) for c in candidates.values()])
    proposal = curriculum.propose(0, 0)
    assert proposal.properties == properties[proposal.task.seed]
    assert proposal.mu == pytest.approx(f.mean(), abs=1e-5)
    assert proposal.sigma == pytest.approx(f.std(), abs=1e-5)
    assert proposal.f == pytest.approx(f[proposal.task.seed], abs=1e-5)


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
    curriculum = Curriculum(small_config(OPEN, "curriculum.easy_share=0"))
    for seed in range(100):
        curriculum.store.add([make_candidate(PLUS, seed)])
    train(curriculum, 640)
    proposals = [curriculum.propose(0, 0) for _ in range(5)]
    assert {p.category for p in proposals} == {"frontier"}
    assert all(abs(p.f - 0.5) < 0.25 for p in proposals if p.f is not None)
    assert all(2 < p.properties.distance < 4 for p in proposals), "success ends at 3 m"
    assert all(p.sigma is not None and p.sigma > 0.2 for p in proposals)


def test_requests_follow_the_asking_agents_steps():
    curriculum, _ = with_candidates(LETTER, 100)
    t = 10**6
    assert task_type_probabilities(t, LETTER.curriculum)["random"] == 0.15
    requested = Counter(curriculum.propose(0, 0 if i < 50 else t).requested for i in range(100))
    assert 0 < requested["random"] < 20
    early = Curriculum(RND)
    assert early.propose(0, 0).requested == "random"


def test_proposed_candidates_leave_the_database():
    curriculum, candidates = with_candidates(PLUS, 30)
    seeds = [curriculum.propose(0, 0).task.seed for _ in range(30)]
    assert sorted(seeds) == sorted(candidates)
    assert len(curriculum.store) == 0
    assert curriculum.propose(0, 0).task.seed not in candidates


def test_candidates_are_proposed_in_their_own_cell_only():
    curriculum = Curriculum(PLUS)
    for seed in range(6):
        curriculum.store.add([make_candidate(PLUS, seed, cell=seed % 2)])
    assert [curriculum.store.count(cell) for cell in range(3)] == [3, 3, 0]
    assert {curriculum.propose(1, 0).task.seed for _ in range(3)} == {1, 3, 5}


# The database


def test_database_holds_a_bounded_number_per_cell_and_the_oldest_make_room():
    config = small_config(OPEN, "curriculum.store_per_cell=5")
    store = TaskStore(config)
    for seed in range(8):
        store.add([make_candidate(config, seed)])
    store.add([make_candidate(config, 100, cell=1)])
    assert (len(store), store.count(0), store.count(1)) == (6, 5, 1)
    kept = store.sample(0, 100, np.random.default_rng(0))
    assert sorted(entry.task.seed for entry in kept) == [3, 4, 5, 6, 7]


def test_samples_are_different_candidates_in_random_order():
    store, rng = TaskStore(PLUS), np.random.default_rng(0)
    for seed in range(20):
        store.add([make_candidate(PLUS, seed)])
    first: Counter[int] = Counter()
    for _ in range(400):
        seeds = [entry.task.seed for entry in store.sample(0, 5, rng)]
        assert len(set(seeds)) == 5
        first[seeds[0]] += 1
    assert sum((first[seed] - 20) ** 2 / 20 for seed in range(20)) < 36.19  # 19 degrees of freedom, 1%


def test_candidate_of_another_layout_is_refused_naming_the_field():
    store, good = TaskStore(PLUS), make_candidate(PLUS, 0)
    wrong = {
        "visual": (good.visual[:-1], good.visual.astype(np.float32), good.visual[None]),
        "lidar": (good.lidar[:-1], good.lidar.astype(np.float64), np.zeros(256, np.float16)),
    }
    for name, arrays in wrong.items():
        for array in arrays:
            with pytest.raises(
                MessageError, match=rf"candidate {name} is .*, expected \(4,\)|expected float16"
            ):
                store.add([good, good.model_copy(update={name: array})])
    assert len(store) == 0
    assert len(store) == 0  # all or none
    store.add([good])
    assert len(store) == 1


# On disk


def test_restored_curriculum_goes_on_where_the_saved_one_was(tmp_path):
    config = gated(window=6, threshold=0.5)
    saved = Curriculum(config)
    for i in range(20):
        saved.report(outcome_of(saved.propose(i % 9, 0), i < 5))
    saved.gate.add(True)
    saved.save(tmp_path / "curriculum")
    saved.save(tmp_path / "curriculum")
    assert [path.name for path in tmp_path.iterdir()] == ["curriculum"]
    restored = Curriculum(config.model_copy(update={"seed": 5}))
    restored.restore(tmp_path / "curriculum")
    assert restored.outcomes == 20
    assert restored.proposed == saved.proposed
    assert restored.gate.open is saved.gate.open
    assert list(restored.gate.outcomes) == list(saved.gate.outcomes)
    rows = [
        geometric_properties(t, build_scene(t, config.world))
        for t in (Task(cell=c, seed=c, start=config.world.start) for c in range(9))
    ]
    q: list[float | None] = [None] * 9
    assert restored.network.predict(rows, q).tolist() == saved.network.predict(rows, q).tolist()


def test_gate_that_has_opened_stays_open_after_a_restart(tmp_path):
    config = gated(window=2)
    saved = Curriculum(config)
    for _ in range(2):
        saved.report(outcome_of(saved.propose(0, 0), True))
    saved.save(tmp_path)
    restored = Curriculum(config)
    restored.restore(tmp_path)
    assert restored.gate.open
    assert restored.propose(0, 0).category != "gate"


def test_folder_without_a_state_is_a_beginning(tmp_path):
    curriculum = Curriculum(PLUS)
    curriculum.restore(tmp_path / "absent")
    assert curriculum.outcomes == 0


def test_state_of_another_algorithm_or_damaged_is_a_usage_error(tmp_path):
    Curriculum(PLUS).save(tmp_path / "plus")
    with pytest.raises(UsageError, match="plus"):
        Curriculum(LETTER).restore(tmp_path / "plus")
    for damage in ("{", "{}", "[]", '{"numbers": 3}'):
        (tmp_path / "plus" / "state.json").write_text(damage)
        with pytest.raises(UsageError, match="plus"):
            Curriculum(PLUS).restore(tmp_path / "plus")


# What the command prints


def test_proposal_has_the_keys_that_programs_read():
    curriculum, _ = with_candidates(PLUS, 3)
    curriculum.critic.load(Version(epoch=1), Learner(PLUS).tensors())
    proposal = curriculum.propose(0, 0)
    fields = json.loads(proposal.model_dump_json())
    assert {"id", "requested", "category", "q", "q_reason", "f", "mu", "sigma"} <= fields.keys()
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
        return [curriculum.propose(2, 0).task.seed for _ in range(2)]

    assert run(1) == run(1) != run(2)


def test_paper_preset_proposes_by_the_letter_without_a_gate():
    curriculum = Curriculum(resolve("paper"))
    assert curriculum.gate.open
    assert not curriculum.network.plus
    proposal = curriculum.propose(0, 0)
    assert proposal.category in ("easy", "frontier", "random")
    assert proposal.task.start == resolve("paper").world.start, "no narrowed candidates"
