"""The algorithms behind their interface, on boxes of numbers: what they propose, learn, and keep."""

import json
from collections import Counter
from copy import copy

import numpy as np
import pytest
import safetensors.numpy

from common.config import VARIANTS, Config, resolve
from common.messages import Category
from curriculum.algorithms import make_algorithm
from curriculum.algorithms.base import Algorithm, Drawn, Pick, Result, State
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.algorithms.rnd import Rnd
from curriculum.algorithms.schedule import Schedule
from curriculum.algorithms.sfl import Sfl
from curriculum.curriculum import Curriculum
from curriculum.task_space import NARROWEST, Entry, Scaling, TaskSpace, make_space
from tests.helpers import small_config

pytestmark = pytest.mark.usefixtures("one_thread")
X, Y = '{name="x", low=0.0, high=8.0, easy=0.0}', '{name="y", low=0.0, high=1.0, easy=1.0}'
BOX = ("curriculum.gate.enabled=false", f"curriculum.parameters=[{X}, {Y}]")
SCHEDULE = (
    "curriculum.algorithm='schedule'",
    "curriculum.schedule.first_level=0.2",
    "curriculum.schedule.step=0.3",
    "curriculum.schedule.window=4",
    "curriculum.schedule.threshold=0.75",
)
SFL = (
    "curriculum.algorithm='sfl'",
    "curriculum.sfl.levels=5",
    "curriculum.sfl.trials=6",
    "curriculum.sfl.kept=2",
    "curriculum.sfl.pause=30",
)
LETTER = ("curriculum.algorithm='navacl-q'",)
EASY = ("curriculum.random_limit=0.0", "curriculum.easy_share=1.0")
FRONTIER = ("curriculum.random_limit=0.0", "curriculum.easy_share=0.0")
RANDOM = ("curriculum.random_limit=1.0", "curriculum.random_steps=1.0")
T = 1000
"""Steps of the asking agent, enough for any share of random tasks."""


class Pool:
    """Tasks drawn by geometry alone."""

    def __init__(self, space: TaskSpace, cell: int = 0, seed: int = 1) -> None:
        self.cell, self._space, self.rng = cell, space, np.random.default_rng(seed)

    def draw(self, count: int) -> Drawn:
        return Drawn.of(self.entries(count), Scaling(self._space.inputs, self._space.scales))

    def entries(self, count: int) -> list[Entry]:
        return [self.new() for _ in range(min(count, 100))]

    def new(self, level: float = 1.0) -> Entry:
        return self._space.draw(self.cell, level, self.rng)


class Setting:
    """An algorithm with a pool and random numbers."""

    def __init__(self, *overrides: str) -> None:
        self.config = small_config(*BOX, *overrides)
        self.space = make_space(self.config)
        self.algorithm = make_algorithm(self.config, self.space)
        self.pool, self.rng = Pool(self.space), np.random.default_rng(2)

    def propose(self, t: int = T) -> Pick:
        return self.algorithm.propose(t, self.pool, self.rng)

    def report(self, pick: Pick, success: bool) -> None:
        self.algorithm.report(Result(pick.entry, pick.category, pick.f, success))

    def live(self, tasks: int) -> list[tuple[Category, dict[str, float]]]:
        """Tasks that are proposed, each of which succeeds when x is small."""
        found = []
        for _ in range(tasks):
            pick = self.propose()
            self.report(pick, bool(self.rng.random() < 1 - pick.entry.task["x"] / 8))
            found.append((pick.category, pick.entry.task))
        return found

    def twin(self) -> "Setting":
        """Another one with the same random numbers, whose algorithm was restored from a file."""
        other = copy(self)
        other.algorithm = make_algorithm(self.config, self.space)
        other.algorithm.restore(through_files(self.algorithm))
        other.pool, other.rng = Pool(self.space), np.random.default_rng()
        other.pool.rng.bit_generator.state = self.pool.rng.bit_generator.state
        other.rng.bit_generator.state = self.rng.bit_generator.state
        return other


def through_files(algorithm: Algorithm) -> State:
    """A snapshot as the database gives it back."""
    state = algorithm.snapshot()
    arrays = safetensors.numpy.load(safetensors.numpy.save(state.arrays))
    return State(arrays, json.loads(json.dumps(dict(state.values))))


# All of them


ALL = {
    "navacl-q+": (),
    "calibrated": (
        "curriculum.calibrate=true",
        "curriculum.balanced=true",
        "curriculum.calibration_window=40",
    ),
    "navacl-q": LETTER,
    "rnd": ("curriculum.algorithm='rnd'",),
    "schedule": SCHEDULE,
    "sfl": SFL,
}


@pytest.mark.parametrize("overrides", ALL.values(), ids=ALL)
@pytest.mark.parametrize("before", [0, 1, 37, 100])
def test_restored_algorithm_goes_on_to_the_same_proposals(overrides, before):
    first = Setting(*overrides)
    first.live(before)
    second = first.twin()
    assert second.live(80) == first.live(80)


@pytest.mark.parametrize("overrides", ALL.values(), ids=ALL)
def test_restored_algorithm_has_the_same_snapshot(overrides):
    setting = Setting(*overrides)
    setting.live(50)
    one, two = through_files(setting.algorithm), through_files(setting.twin().algorithm)
    assert one.values == two.values
    assert one.arrays.keys() == two.arrays.keys()
    assert all((one.arrays[name] == two.arrays[name]).all() for name in one.arrays)


@pytest.mark.parametrize("overrides", ALL.values(), ids=ALL)
def test_predictions_are_shares_or_none(overrides):
    setting = Setting(*overrides)
    setting.live(60)
    f = setting.algorithm.score([{"x": x, "y": 0.5} for x in (0.0, 4.0, 8.0)], [None] * 3)
    if isinstance(setting.algorithm, NavaclQ):
        assert f.shape == (3,)
        assert ((f >= 0) & (f <= 1)).all()
    else:
        assert f is None


@pytest.mark.parametrize(
    ("name", "kind", "inputs"),
    [
        ("navacl-q-letter", NavaclQ, 5),
        ("navacl", NavaclQ, 4),
        ("q-only", NavaclQ, 1),
        ("schedule", Schedule, 7),
        ("sfl", Sfl, 7),
        ("rnd", Rnd, 7),
        ("navacl-q", NavaclQ, 7),
    ],
)
def test_variant_resolves_and_proposes_tasks_of_the_docking_world(name, kind, inputs):
    config = resolve("smoke", variant=name)
    curriculum = Curriculum(Config.model_validate(config.model_dump() | {"seed": 3}))
    assert type(curriculum.algorithm) is kind
    assert len(config.curriculum.inputs) == inputs
    assert config.curriculum.gate.enabled is (name in ("navacl-q", "navacl", "q-only"))
    proposals = [curriculum.propose(cell, T) for cell in (0, 8)]
    assert [p.task.cell for p in proposals] == [0, 8]
    curriculum.gate.open = True
    proposal = curriculum.propose(1, T)
    assert proposal.why
    assert (proposal.f is not None) is (kind is NavaclQ)


def test_every_variant_is_tried_here_but_the_one_of_the_encoder():
    assert set(VARIANTS) == {
        "navacl-q",
        "navacl-q-letter",
        "navacl",
        "q-only",
        "schedule",
        "sfl",
        "rnd",
        "e2e",
    }


def test_variants_ask_for_encoded_starts_only_when_they_use_q():
    used = {name: resolve("smoke", variant=name).curriculum.uses_q for name in VARIANTS}
    assert {name for name, uses in used.items() if uses} == {"navacl-q", "navacl-q-letter", "q-only", "e2e"}


# RND


def test_rnd_draws_from_all_of_the_distribution_and_learns_nothing():
    setting = Setting("curriculum.algorithm='rnd'")
    found = setting.live(400)
    assert {category for category, _ in found} == {"rnd"}
    counts, _ = np.histogram([task["x"] for _, task in found], 8, (0, 8))
    assert ((counts - 50) ** 2 / 50).sum() < 18.48  # 7 degrees of freedom, 1%
    state = setting.algorithm.snapshot()
    assert (state.arrays, dict(state.values)) == ({}, {})


# The schedule


def schedule() -> Setting:
    return Setting(*SCHEDULE)


def feed(setting: Setting, outcomes: list[bool], category: Category = "schedule") -> float:
    """The level after some outcomes."""
    for success in outcomes:
        entry = setting.pool.new()
        setting.algorithm.report(Result(entry, category, None, success))
    return setting.algorithm.level


def test_schedule_proposes_tasks_of_its_level():
    setting = schedule()
    picks = [setting.propose() for _ in range(200)]
    reach = 8 * (NARROWEST + (1 - NARROWEST) * 0.2)
    assert 0.9 * reach < max(p.entry.task["x"] for p in picks) <= reach
    assert {(p.category, p.why) for p in picks} == {("schedule", "drawn at level 0.20 of the schedule")}


def test_level_grows_after_full_windows_of_which_enough_succeeded():
    setting = schedule()
    assert feed(setting, [True] * 3) == 0.2, "a window is four"
    assert feed(setting, [True]) == pytest.approx(0.5)
    assert feed(setting, [True] * 3) == pytest.approx(0.5), "a new window has begun"
    assert feed(setting, [False]) == pytest.approx(0.8)


def test_level_stays_just_below_the_threshold_and_a_window_slides():
    setting = schedule()
    assert feed(setting, [True, False, False, True, True, False]) == 0.2
    assert feed(setting, [True]) == pytest.approx(0.5), "three of the last four"


def test_level_never_exceeds_one_nor_falls():
    setting = schedule()
    assert feed(setting, [True] * 40) == 1.0
    assert feed(setting, [False] * 40) == 1.0
    assert setting.propose().entry.task["x"] <= 8.0


@pytest.mark.parametrize("category", ["unserved", "gate", "random", "rnd", "sfl"])
def test_schedule_learns_from_its_own_tasks_only(category):
    setting = schedule()
    assert feed(setting, [True] * 20, category) == 0.2
    feed(setting, [True] * 3)
    assert feed(setting, [False] * 20, category) == 0.2
    assert feed(setting, [True]) == pytest.approx(0.5)


# Sampling for learnability


def survey(setting: Setting, shares: list[float]) -> list[dict[str, float]]:
    """Goes through a survey whose tasks succeed in those shares of their trials; the tasks in that order."""
    config = setting.config.curriculum.sfl
    asked: Counter[float] = Counter()
    tasks: dict[float, dict[str, float]] = {}
    for _ in range(config.levels * config.trials):
        pick = setting.propose()
        x = pick.entry.task["x"]
        tasks.setdefault(x, pick.entry.task)
        asked[x] += 1
        assert (pick.category, pick.why) == ("sfl", f"trial {asked[x]} of {config.trials} of a survey")
        share = shares[list(tasks).index(x) % len(shares)]
        setting.report(pick, asked[x] <= round(share * config.trials))
    assert list(asked.values()) == [config.trials] * config.levels
    return list(tasks.values())


def proposed(setting: Setting, tasks: int) -> list[Pick]:
    return [setting.propose() for _ in range(tasks)]


def test_survey_tries_each_task_and_the_most_learnable_are_kept():
    setting = Setting(*SFL)
    tried = survey(setting, [1 / 6, 1 / 2, 1, 1 / 3, 0])
    kept = [p for p in proposed(setting, 30) if p.category == "sfl"]
    # p (1 - p): 0.14, 0.25, 0, 0.22, 0
    assert {p.entry.task["x"] for p in kept} == {tried[1]["x"], tried[3]["x"]}
    assert {p.why for p in kept} == {f"p (1 - p) was {v} in the last survey" for v in ("0.25", "0.22")}


def test_share_of_kept_tasks_and_the_pause_between_two_surveys():
    setting = Setting(*SFL, "curriculum.sfl.pause=600", "curriculum.sfl.share=0.3")
    survey(setting, [0.5])
    picks = proposed(setting, 600)
    share = sum(p.category == "sfl" for p in picks) / 600
    assert share == pytest.approx(0.3, abs=0.06)
    others = {p.why for p in picks if p.category == "random"}
    assert others == {"drawn from the full distribution"}
    assert setting.propose().why == "trial 1 of 6 of a survey"


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_when_nothing_is_learnable_all_is_random(share):
    setting = Setting(*SFL, "curriculum.sfl.share=1.0")
    survey(setting, [share])
    assert {p.category for p in proposed(setting, 30)} == {"random"}


def test_trials_that_are_never_reported_do_not_hold_a_survey_up():
    setting = Setting(*SFL)
    config = setting.config.curriculum.sfl
    picks = proposed(setting, config.levels * config.trials)
    assert {p.category for p in picks} == {"sfl"}
    setting.report(picks[0], True)
    assert {p.category for p in proposed(setting, config.pause)} == {"random"}
    assert setting.propose().category == "sfl"


def test_reports_of_other_tasks_and_late_ones_count_for_no_survey():
    setting = Setting(*SFL, "curriculum.sfl.share=1.0")
    picks = proposed(setting, 30)
    for _ in range(10):
        setting.algorithm.report(Result(setting.space.entry({"x": 1.0, "y": 0.0}), "unserved", None, True))
    for pick in picks:
        setting.report(pick, False)
    first = setting.propose()  # the survey has ended
    assert first.category == "random"
    for pick in picks[:10]:
        setting.report(pick, True)
    assert {p.category for p in proposed(setting, 29)} == {"random"}


def test_cells_are_surveyed_apart():
    config = small_config("curriculum.algorithm='sfl'", "curriculum.sfl.levels=2", "curriculum.sfl.trials=1")
    space, rng = make_space(config), np.random.default_rng(0)
    algorithm = make_algorithm(config, space)
    pools = {cell: Pool(space, cell) for cell in (0, 5)}
    for _ in range(2):
        pick = algorithm.propose(0, pools[0], rng)
        assert (pick.entry.cell, pick.why) == (0, "trial 1 of 1 of a survey")
        algorithm.report(Result(pick.entry, pick.category, None, True))
    assert algorithm.propose(0, pools[0], rng).category == "random"
    pick = algorithm.propose(0, pools[5], rng)
    assert (pick.entry.cell, pick.why) == (5, "trial 1 of 1 of a survey")


# NavACL-Q


def trained(*overrides: str) -> Setting:
    """One whose f_pi has learned that small x succeed, and x = 4 half of the time."""
    setting = Setting(*overrides)
    for _ in range(400):
        entry = setting.pool.new()
        success = setting.rng.random() < 1 / (1 + np.exp(entry.task["x"] - 4))
        setting.algorithm.report(Result(entry, "random", None, bool(success)))
    return setting


def test_f_pi_learns_from_whatever_is_reported():
    setting = trained()
    f = setting.algorithm.score([{"x": x, "y": 0.5} for x in (0.5, 4.0, 7.5)], [None] * 3)
    assert f[0] > 0.8
    assert f[0] > f[1] > f[2]
    assert f[2] < 0.2


@pytest.mark.parametrize("letter", [LETTER, ()], ids=["navacl-q", "navacl-q+"])
def test_random_request_takes_the_first_that_was_drawn(letter):
    setting = trained(*letter, *RANDOM)
    for _ in range(5):
        pick = setting.propose()
        assert (pick.category, pick.requested) == ("random", "random")
        assert pick.why == f"random: the first that was drawn; predicted success {pick.f:.2f}"


@pytest.mark.parametrize("letter", [LETTER, ()], ids=["navacl-q", "navacl-q+"])
def test_easy_request_takes_a_task_that_is_likely_enough(letter):
    setting = trained(*letter, *EASY, "curriculum.beta=0.5")
    for _ in range(10):
        pick = setting.propose()
        assert (pick.category, pick.requested) == ("easy", "easy")
        assert pick.why == (f"easy: the first of 100 that is likely enough; predicted success {pick.f:.2f}")
        bound = pick.mu + 0.5 * pick.sigma
        assert pick.f > (bound if bound < 1 else pick.mu) or pick.f > 0.95


def test_frontier_of_the_letter_lies_about_the_mean():
    setting = trained(*LETTER, *FRONTIER, "curriculum.gamma=0.4")
    for _ in range(10):
        pick = setting.propose()
        assert pick.category == pick.requested == "frontier"
        assert pick.why == (
            f"frontier: the first of 100 that is about as likely as most; predicted success {pick.f:.2f}"
        )
        assert abs(pick.f - pick.mu) < 0.4 * pick.sigma


def test_frontier_of_the_extension_lies_where_the_outcome_is_least_certain():
    setting = trained(*FRONTIER)
    picks = [setting.propose() for _ in range(30)]
    for pick in picks:
        assert pick.category == pick.requested == "frontier"
        assert pick.why == (
            f"frontier: among the ten of 100 whose outcome is least certain; predicted success {pick.f:.2f}"
        )
    assert np.median([abs(p.entry.task["x"] - 4) for p in picks]) < 1.0
    assert np.median([abs(p.f - 0.5) for p in picks]) < 0.25


@pytest.mark.parametrize(
    ("overrides", "requested"),
    [
        ((*LETTER, *FRONTIER, "curriculum.gamma=0.0"), "frontier"),
        ((*LETTER, *EASY, "curriculum.beta=20.0", "curriculum.chi=1.0"), "easy"),
        ((*EASY, "curriculum.beta=20.0", "curriculum.chi=1.0"), "easy"),
    ],
)
def test_request_that_nothing_meets_becomes_a_random_task(overrides, requested):
    setting = Setting(*overrides)  # untrained, so f is about the same everywhere
    picks = [setting.propose() for _ in range(20)]
    assert {(p.category, p.requested) for p in picks} == {("random", requested)}
    assert {p.why for p in picks} == {f"no task of 100 was {requested}, so a random one"}
    f = setting.algorithm.score([p.entry.properties for p in picks], [None] * 20)
    assert [p.f for p in picks] == pytest.approx(f.tolist(), abs=1e-6)


def test_number_of_draws_is_the_configured_one():
    setting = trained(*EASY, "curriculum.filter_samples=7", "curriculum.max_draws=7")
    assert "the first of 7 that" in setting.propose().why


def test_mu_and_sigma_are_those_of_the_tasks_that_were_drawn():
    setting = trained(*RANDOM)
    twin = setting.twin()
    sample = twin.pool.entries(setting.config.curriculum.filter_samples)
    f = setting.algorithm.score([e.properties for e in sample], [None] * len(sample))
    pick = setting.propose()
    assert (pick.mu, pick.sigma) == pytest.approx((f.mean(), f.std()))


def test_calibration_corrects_what_is_proposed_and_scored():
    setting = trained("curriculum.calibrate=true", *RANDOM)
    entry = setting.space.entry({"x": 4.0, "y": 0.5})
    for _ in range(8):  # too few for f_pi to fit to, but not for its correction
        setting.algorithm.report(Result(entry, "random", None, False))
    raw = setting.algorithm.network.predict([entry.properties], [None])
    corrected = setting.algorithm.score([entry.properties], [None])
    assert corrected[0] != raw[0]
    assert (corrected == setting.algorithm.calibration.correct(raw)).all()
    pick = setting.propose()
    assert pick.f == pytest.approx(setting.algorithm.score([pick.entry.properties], [None])[0], abs=1e-6)


@pytest.mark.parametrize("damage", ["array", "value", "shape"])
def test_state_that_does_not_fit_is_refused(damage):
    setting = trained()
    state = through_files(setting.algorithm)
    arrays, values = dict(state.arrays), dict(state.values)
    if damage == "array":
        del arrays["reservoir"]
    elif damage == "value":
        del values["fits"]
    else:
        arrays["net.0.weight"] = arrays["net.0.weight"][:, :1]
    with pytest.raises((KeyError, ValueError)):
        make_algorithm(setting.config, setting.space).restore(State(arrays, values))
