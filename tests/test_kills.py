"""Processes that are killed."""

import json
import random
import time
from collections.abc import Callable
from typing import get_args

import pytest

from common.access import LOCAL
from common.bus import Keys, Member, ask
from common.config import parse
from common.delivery import Sender, Spool
from common.messages import Category, Episode, Nothing, Snapshot, decode
from curriculum.curriculum import Curriculum
from curriculum.database import Database
from curriculum.service import DATABASE
from tests.crew import RESUMED, Crew, assert_nothing_is_lost_and_nothing_there_twice, ids, losses_of
from tests.helpers import wait_until


def kill_the_learner_and_look(crew: Crew, moment: float) -> None:
    """SIGKILL after so many seconds; then the same command must find all that was acknowledged."""
    time.sleep(moment)
    crew.kill("learner")
    before = losses_of([report for life in crew.reports.values() for report in life])[-8:]
    acknowledged = sum(crew.of_actors("acknowledged"))
    epoch = max(version.epoch for version in crew.versions)
    records, newest = crew.log(), crew.newest_checkpoint()
    assert len(set(ids(records))) == len(records) >= acknowledged
    said = len(RESUMED.findall(crew.words("learner")))

    new = crew.start_learner()
    crew.wait_for_training()
    episodes, steps, transitions, updates = map(int, RESUMED.findall(crew.words("learner"))[said])
    assert episodes == len(records)
    assert steps == transitions == sum(r.length for r in records)
    assert newest is not None
    assert updates == int(newest.name.partition("-")[2]) > 0
    # weights: the new life's are newer than all before, and the actors drive with them
    assert max(version.epoch for version in crew.versions) > epoch
    wait_until(
        lambda: (
            set(crew.of_actors("weights"))
            <= {
                f"{v.epoch}.{v.counter}"
                for v in list(crew.versions)
                if v.epoch > epoch and v.counter >= updates
            }
        ),
        20,
        "the new weights at both actors",
    )
    # The reported loss is a mean of the last 200 updates, on prioritised batches of 16 from a replay that
    # grows: from one report to the next it moves by a factor of up to three. Ten on both sides leaves room
    # for that, and for a mean of 20. Critics that do not fit their targets or moments, rewards that are read
    # wrongly or weights of zero leave it; whether weights are the saved ones, the counts above say better.
    wait_until(lambda: crew.figure("updates") >= updates + 20, 20, "twenty updates")
    first = next(losses_of([r])[0] for r in crew.reports[new] if r["updates"] >= updates + 20)
    assert min(before) / 10 <= first <= 10 * max(before), f"{first} after {before}"


def learner_is_killed(crew: Crew, times: int, seed: int) -> None:
    dice = random.Random(seed)
    # the actors stop when so much waits, and leave the learner the processors for its start
    crew.settings = ("--set", "actor.spool_megabytes=0.2")
    crew.start_learner()
    for name in ("curriculum", "a", "b"):
        crew.start_other(name)
    with crew.listening():
        wait_until(lambda: crew.figure("updates") > 400, 90, "losses that have settled")
        for _ in range(times):
            kill_the_learner_and_look(crew, dice.uniform(0.5, 4.0))
        wait_until(lambda: max(crew.of_actors("spool")) <= 2, 30, "delivery of what had waited")
        for name in "ab":
            assert crew.stop(name) == 0, crew.words(name)
        wait_until(lambda: crew.figure("replay") == crew.figure("env_steps"), 10, "all in the replay")
        assert crew.figure("refused") == 0
        told = sum(crew.of_actors("acknowledged"))
        for name in ("curriculum", "learner"):
            assert crew.stop(name) == 0, crew.words(name)
        records = assert_nothing_is_lost_and_nothing_there_twice(crew)
        assert len(records) >= told > 0
        assert json.loads((crew.run / "summary.json").read_text())["episodes"] == len(records)
        assert crew.figure("replay") <= sum(r.length for r in records)
    in_order = zip(crew.versions, crew.versions[1:], strict=False)
    assert not any(later < earlier for earlier, later in in_order), "weights ran backwards"
    driven = {decode(Episode, r.payload).first_version.epoch for r in records}
    assert driven >= set(range(1, times + 2)), "episodes were driven with the weights of every life"
    assert "Traceback" not in crew.words("learner")
    assert not list(crew.run.rglob("*.part"))


@pytest.mark.timeout(480)
def test_learner_that_is_killed_three_times_loses_nothing_and_learns_on(crew):
    learner_is_killed(crew, 3, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_learner_that_is_killed_twenty_times_loses_nothing_and_learns_on(crew):
    learner_is_killed(crew, 20, seed=2)


@pytest.mark.slow
def test_curriculum_that_is_killed_knows_what_it_knew_and_no_actor_stops(crew):
    keys = Keys("run")
    crew.settings = ("--set", "curriculum.gate.enabled=false")
    crew.start_learner()
    for name in ("curriculum", "a", "b"):
        crew.start_other(name)

    def grown(figure: Callable[[dict], int], least: int, what: str) -> None:
        """Waits until each actor's figure is larger by so much."""
        for name, values in crew.monitor.of("actor").items():
            enough = figure(values) + least

            def reached(name: str = name, enough: int = enough) -> bool:
                return figure(crew.monitor.of("actor").get(name, {})) >= enough

            wait_until(reached, 60, f"{what} of {name}")

    def served(values: dict) -> int:
        return sum(values.get(f"task_{name}", 0) for name in get_args(Category) if name != "unserved")

    with crew.listening() as session:
        wait_until(lambda: crew.monitor.curriculum.get("fits", 0) >= 4, 90, "an f_pi that has learned")
        grown(served, 3, "tasks")
        before = ask(session, keys.snapshot, Nothing(), Snapshot, timeout=5)
        crew.kill("curriculum")
        grown(lambda values: values.get("task_unserved", 0), 3, "tasks of their own")
        grown(lambda values: values.get("env_steps", 0), 100, "steps without a curriculum")
        crew.start_other("curriculum")
        after = ask(session, keys.snapshot, Nothing(), Snapshot, timeout=5, patience=60)
        assert after.outcomes >= before.outcomes > 0
        assert all(after.proposed[name] >= count / 2 for name, count in before.proposed.items())
        grown(served, 3, "tasks after its return")
        wait_until(lambda: max(crew.of_actors("reports")) <= 2, 30, "delivery of what had waited")
        assert sum(crew.of_actors("reports_refused")) == 0
        for name in ("a", "b", "curriculum", "learner"):
            assert crew.stop(name) == 0, crew.words(name)
    config = parse((crew.run / "config.toml").read_text())
    left = Curriculum(config, Database(crew.run / DATABASE))
    assert left.outcomes >= after.outcomes
    assert left.algorithm.network.fits == left.outcomes // config.curriculum.batch_size, "none forgotten"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_whoever_is_killed_whenever_in_the_end_everything_is_acknowledged(crew):
    dice = random.Random(3)
    others = ("curriculum", "a", "b")
    crew.start_learner()
    for name in others:
        crew.start_other(name)
    with crew.listening() as session:
        wait_until(lambda: crew.figure("updates") > 20, 90, "training")
        for victim in dice.sample((*others, "learner") * 4, 16):
            time.sleep(dice.uniform(0.1, 4.0))  # also while it or another one is still starting
            crew.kill(victim)
            if victim == "learner":
                crew.start_learner()
            else:
                crew.start_other(victim)
        crew.wait_for_training()
        for name in "ab":
            wait_until(lambda n=name: crew.monitor.of("actor").get(n, {}).get("acknowledged", 0), 60, name)
        wait_until(lambda: max(crew.of_actors("spool")) <= 2, 60, "delivery of what had waited")
        wait_until(lambda: crew.monitor.curriculum.get("outcomes", 0) > 0, 30, "outcomes at the curriculum")
        for name in "ab":
            assert crew.stop(name) == 0, crew.words(name)
        # what an actor had no time for any more goes out in its next life; here one without worlds
        left = [
            Spool(folder, 1e9)
            for name in "ab"
            for folder in sorted((crew.spool / LOCAL / name).iterdir())
            if folder.is_dir()
        ]
        assert len(left) == 4
        for spool in left:
            member = Member("actor", LOCAL, spool.folder.parent.name)
            assert Sender(session, spool, member, "last").close(patience=20) == 0
        assert list(crew.spool.rglob("*.msg")) == list(crew.spool.rglob("*.bad")) == []
        for name in ("curriculum", "learner"):
            assert crew.stop(name) == 0, crew.words(name)
        records = assert_nothing_is_lost_and_nothing_there_twice(crew)
        assert crew.monitor.curriculum["refused"] == 0
    boots = {(actor, boot) for actor, boot, _ in ids(records)}
    assert len(boots) >= 4, "episodes of several lives of both actors"
    for name in ("learner", *others):
        assert "Traceback" not in crew.words(name), crew.words(name)
