"""The examination: measures of hand-made drives, repetition to the bit, and a killed one that goes on."""

import json
import math
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from actor.evaluation.examiner import Examiner, Rival, Terms, Trained, examine
from actor.evaluation.measures import (
    Drive,
    axis_angle,
    conditional_value_at_risk,
    fastest_time,
    measure,
    paired_difference,
    rates,
    shortest_length,
    summarize,
    wilson_interval,
    yaw_tolerance,
)
from actor.evaluation.report import PAPER, as_rows, groups, labelled, over_policies, success_table
from actor.evaluation.suites import GRID_HEADINGS, grid, suite
from actor.evaluation.work_list import WorkList
from common.config import Config, resolve
from common.errors import RunError, UsageError
from common.geometry import SE2
from common.messages import ENDINGS
from common.tasks import PlacedStart, Task
from common.world_config import StartRanges
from deploy.cli.evaluate import check_pairs, find_subject
from tests.helpers import wait_until
from tests.test_cli import call
from tests.test_rollout import SMOKE, networks, save

CONFIG = Config()
WORLD = CONFIG.world
PERIOD = WORLD.control_period


ORIGIN = SE2()


def made(rows, ending="success", dolly=ORIGIN) -> Drive:
    return Drive(ending, np.array(rows, np.float32), dolly)


def straight(steps: int, first=-3.0, speed=1.0, x=0.0) -> list[tuple[float, ...]]:
    """Along +y at a constant speed."""
    return [(x, first + speed * PERIOD * k, 0.0, speed) for k in range(steps + 1)]


# Measures


def test_a_straight_drive_is_measured_by_hand():
    found = measure(made(straight(15)), WORLD)
    assert found.time == pytest.approx(15 * 0.18)
    assert found.path_length == pytest.approx(2.7, abs=1e-5)
    assert found.spl == pytest.approx(1.0, abs=1e-5)  # 3 m less the 0.3 m that count as docked
    # 1 m/s after 1/3 s and 1/6 m, then 2.533 m at 1 m/s
    assert fastest_time(SE2(0, -3), SE2(), WORLD) == pytest.approx(1 / 3 + 2.7 - 1 / 6)
    assert found.sct == 1.0, "no drive from standstill is as fast as this one, which begins at 1 m/s"
    assert (found.lateral_error, found.yaw_error, found.reversals, found.jerk) == (0, 0, 0, 0)
    assert not found.far_side


def test_a_detour_weighs_success_by_its_length_and_time_and_a_failure_counts_nothing():
    there_and_back = [*straight(5, speed=-1.0), *straight(20, first=-3.9)[1:]]
    found = measure(made(there_and_back), WORLD)
    assert found.path_length == pytest.approx(0.9 + 3.6, abs=1e-5)
    assert found.spl == pytest.approx(2.7 / 4.5, abs=1e-5)
    assert found.sct == pytest.approx((1 / 3 + 2.7 - 1 / 6) / (25 * 0.18), abs=1e-5)
    assert found.reversals == 1
    failed = measure(made(there_and_back, "dolly_contact"), WORLD)
    assert (failed.spl, failed.sct) == (0.0, 0.0)
    assert failed.path_length == found.path_length


def test_errors_are_those_in_the_frame_of_a_turned_dolly_whichever_way_the_robot_stands():
    dolly = SE2(1.0, 2.0, math.radians(30))
    end = dolly @ SE2(0.04, -0.2, math.radians(177))
    start = dolly @ SE2(0.5, -3.0)
    found = measure(made([(p.x, p.y, p.yaw, 0.5) for p in (start, end)], dolly=dolly), WORLD)
    assert found.lateral_error == pytest.approx(0.04, abs=1e-6)
    assert math.degrees(found.yaw_error) == pytest.approx(3, abs=1e-4)
    assert not found.far_side
    for yaw, angle in ((0, 0), (90, 90), (-90, 90), (135, 45), (180, 0), (-178, 2)):
        seen = axis_angle(dolly @ SE2(0, 0, math.radians(yaw)), dolly)
        assert math.degrees(seen) == pytest.approx(angle, abs=1e-6)


def test_side_of_entry_is_where_it_was_last_clear_of_the_dolly():
    round_it = [
        (0, -3, 0, 1),
        (2, 0, 0, 1),
        (0, 2.5, math.pi, 1),
        (0, 1.0, math.pi, 1),
        (0, 0.25, math.pi, 1),
    ]
    assert measure(made(round_it), WORLD).far_side
    over_and_out = [(0, 3, 0, -1), (0, -2, 0, 1), (0, -1.3, 0, 1), (0, -0.2, 0, 1)]
    assert not measure(made(over_and_out), WORLD).far_side
    under = [(0, 0.6, 0, -1), (0, 0.2, 0, -1)]
    assert measure(made(under), WORLD).far_side, "one that starts half under it comes from its side"


def test_standing_still_in_between_is_no_reversal_and_jerk_is_the_second_difference_of_speed():
    speeds = [0.5, 0.5, 0.01, -0.04, 0.5, -0.2, -0.3, 0.3]
    rows = [(0.0, -3.0, 0.0, speed) for speed in speeds]
    assert measure(made(rows, "timeout"), WORLD).reversals == 2
    steady = [(0.0, 0.0, 0.0, 0.1 * k) for k in range(6)]
    assert measure(made(steady, "timeout"), WORLD).jerk == pytest.approx(0, abs=1e-4)
    square = [(0.0, 0.0, 0.0, 0.5 * k * k * PERIOD**2) for k in range(6)]
    assert measure(made(square, "timeout"), WORLD).jerk == pytest.approx(1.0, abs=1e-3)
    assert measure(made(rows[:2], "timeout"), WORLD).jerk == 0.0


def test_the_lower_bound_of_time_counts_turning_where_that_takes_longer():
    near = SE2(0, -0.35, math.radians(90))
    turn = math.radians(90) - yaw_tolerance(WORLD)
    assert fastest_time(near, SE2(), WORLD) == pytest.approx(1 / 12 + turn - 1 / 24)
    assert fastest_time(SE2(0, -0.2, 0.0), SE2(), WORLD) == 0.0
    assert shortest_length(SE2(0, -0.2), SE2(), WORLD) == 0.0
    assert measure(made([(0, -0.2, 0, 0), (0, -0.2, 0, 0)]), WORLD).spl == 1.0


def test_yaw_tolerance_is_where_the_rectangle_no_longer_fits():
    """Docked as far out as counts, over the length that overlaps, at most the width between the legs."""
    angle = yaw_tolerance(WORLD)
    overlap = (1.230 + 1.273) / 2 - 0.3
    wide = overlap * math.tan(angle) + 0.630 * math.cos(angle)
    assert wide == pytest.approx(0.820 - 2 * 0.040, abs=2e-3)


def test_no_real_drive_beats_the_lower_bounds():
    tasks = grid("quick", "validation").tasks[3::44]
    for drive in examine(Rival("b0", CONFIG), tasks, 1):
        start = SE2(*drive.track[0, :3].tolist())
        found = measure(drive, WORLD)
        assert drive.ending == "success"
        assert found.time > fastest_time(start, drive.dolly, WORLD)
        assert found.path_length >= shortest_length(start, drive.dolly, WORLD) - 1e-3
        assert 0 < found.sct < 1
        assert found.yaw_error < yaw_tolerance(WORLD)
        assert found.lateral_error < 0.055


def test_wilson_interval_agrees_with_scipy():
    for successes, trials in ((0, 20), (1, 1), (81, 263), (15, 148), (29, 29), (8000, 8712)):
        theirs = stats.binomtest(successes, trials).proportion_ci(0.95, "wilson")
        assert wilson_interval(successes, trials) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_summary_takes_means_over_successes_where_failures_have_no_meaning():
    drives = [measure(made(straight(15, x=x)), WORLD) for x in (0.0, 0.02)]
    drives += [measure(made(straight(3), kind), WORLD) for kind in ("dolly_contact", "timeout")]
    found = summarize(drives)
    assert {kind: found[kind] for kind in ENDINGS} == {
        "success": 0.5,
        "dolly_contact": 0.25,
        "other_contact": 0.0,
        "timeout": 0.25,
    }
    assert found["ci95"] == pytest.approx(wilson_interval(2, 4))
    assert found["time"] == pytest.approx(2.7)
    assert found["lateral_error"] == pytest.approx(0.01)
    assert found["spl"] == pytest.approx(0.5, abs=1e-3)
    nothing = summarize(drives[2:])
    assert (nothing["time"], nothing["jerk"], nothing["spl"]) == (None, None, 0.0)


def test_cvar_is_the_mean_of_the_worst_tenth_of_positions():
    docked, failed = (measure(made(straight(3), kind), WORLD) for kind in ("success", "timeout"))
    drives, positions = [], []
    for place in range(20):  # place k docks k times of 19
        drives += [docked] * place + [failed] * (19 - place)
        positions += [(float(place), 0.0)] * 19
    assert conditional_value_at_risk(drives, positions) == pytest.approx((0 + 1 / 19) / 2)
    assert conditional_value_at_risk(drives, positions, 0.5) == pytest.approx(4.5 / 19)
    assert conditional_value_at_risk([failed], [(0, 0)]) == 0.0


def test_paired_difference_covers_the_truth_and_its_p_value_is_mcnemars():
    rng, inside = np.random.default_rng(3), 0
    for _ in range(400):
        hard = rng.random(120)
        a, b = rng.random(120) < 0.9 - 0.5 * hard, rng.random(120) < 0.8 - 0.6 * hard
        found = paired_difference(*(["success" if s else "timeout" for s in x] for x in (a, b)))
        inside += found["ci95"][0] <= 0.15 <= found["ci95"][1]
        n = found["only_ours"] + found["only_theirs"]
        if n:
            theirs = stats.binomtest(found["only_ours"], n).pvalue
            assert found["p_value"] == pytest.approx(theirs, rel=1e-9)
        assert found["difference"] == pytest.approx(a.mean() - b.mean())
    assert 0.92 < inside / 400 < 0.98
    same = paired_difference(["success"] * 5, ["success"] * 5)
    assert (same["difference"], same["p_value"]) == (0.0, 1.0)
    assert same["ci95"][0] < 0 < same["ci95"][1]


# Groups and tables


def graded(docks):
    """A quick grid in which so many of each heading's starts dock, the first ones."""
    examination, left, drives = grid("quick", "validation"), dict(docks), []
    for task in examination.tasks:
        heading = round(task.start.yaw)
        drives.append(measure(made(straight(3), "success" if left[heading] > 0 else "timeout"), WORLD))
        left[heading] -= 1
    return examination, drives


DOCKS = {0: 121, 45: 60, -45: 0, 90: 30, -90: 0, 135: 121, -135: 0, 180: 1}


def test_grid_is_summed_up_by_heading_and_by_whether_training_has_seen_it():
    examination, drives = graded(DOCKS)
    found = groups(examination, drives, WORLD.start)
    assert list(found["headings"]) == [str(heading) for heading in GRID_HEADINGS]
    for heading, count in DOCKS.items():
        row = found["headings"][str(heading)]
        assert row["success"] == pytest.approx(count / 121)
        assert row["episodes"] == 121
    assert found["inside"]["success"] == pytest.approx((121 + 60 + 30) / (5 * 121))
    assert found["outside"]["success"] == pytest.approx((121 + 1) / (3 * 121))
    assert found["all"]["success"] == pytest.approx(sum(DOCKS.values()) / 968)
    assert found["all"]["cvar10"] == pytest.approx(2 / 8), "the rows that dock least do so at 0 and 135 deg"
    low, high = found["outside"]["ci95"]
    assert high - low < 0.11  # of all 363, not of a heading's 121
    assert 0 < found["support"]["episodes"] < found["inside"]["episodes"]
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert set(groups(suite("far"), drives[:200], StartRanges())) == {"all"}


def test_table_stands_beside_the_papers_numbers_and_sums_up_several_policies():
    results = []
    for zero in (121, 0):
        examination, drives = graded({**DOCKS, 0: zero})
        results.append(groups(examination, drives, WORLD.start))
    lines = success_table({"a": results[0], "b": results[1]}).splitlines()
    assert lines[0].startswith("| heading | a | b | paper NavACL-Q p.t. |")
    assert lines[2].startswith(
        "| 0 | 100.0% (96.9 to 100.0%) | 0.0% (0.0 to 3.1%) | 86.6% | 58.5% | 50.3% | 16.5% |"
    )
    assert len({line.count("|") for line in lines}) == 1
    assert [line.split(" | ")[0][2:] for line in lines[2:]][8:] == [
        "inside the training range",
        "outside it",
        "starts that training can draw",
        "all",
    ]
    over = over_policies(results)
    assert over["0"] == {"mean": 0.5, "sd": pytest.approx(math.sqrt(0.5)), "min": 0.0, "max": 1.0}
    assert set(over) == set(labelled(results[0]))


def test_papers_means_are_those_of_its_headings():
    """The published means follow from the published rows to the rounding, as far as the paper keeps to it."""
    for column in range(4):
        rows = {int(k): v[column] for k, v in PAPER.items() if k.lstrip("-").isdecimal()}
        inside = np.mean([v for k, v in rows.items() if abs(k) <= 90])
        outside = np.mean([v for k, v in rows.items() if abs(k) > 90])
        assert PAPER["inside"][column] == pytest.approx(inside, abs=0.11)
        assert PAPER["outside"][column] == pytest.approx(outside, abs=0.11)
        assert PAPER["all"][column] == pytest.approx(np.mean(list(rows.values())), abs=0.11)


def test_rows_are_one_for_each_episode():
    examination, drives = graded(DOCKS)
    tasks = examination.tasks
    lines = as_rows(tasks[:3], drives[:3]).splitlines()
    assert lines[0].startswith("number,cell,seed,x,y,heading_deg,ending,time,path_length,spl,sct")
    assert len(lines) == 4
    assert lines[3].startswith(f"2,9,{tasks[2].seed},-1.5,-1.5,0.0,success,0.54,")


# Driving and the work list


def same(a: Drive, b: Drive) -> bool:
    return a.ending == b.ending and a.dolly == b.dolly and np.array_equal(a.track, b.track)


@pytest.mark.parametrize("greedy", [True, False])
def test_drives_are_the_same_to_the_bit_on_one_worker_or_two_and_after_an_interruption(tmp_path, greedy):
    policy, tasks = Trained.read(save(SMOKE, tmp_path / "policy")), suite("short").tasks[:30]
    terms = Terms(greedy=greedy, seed=7)
    alone = examine(policy, tasks, 1, terms)
    assert all(map(same, alone, examine(policy, tasks, 2, terms)))
    assert sum(rates([drive.ending for drive in alone]).values()) == pytest.approx(1.0)
    work = WorkList(tmp_path / "w.db", {"who": "test"})
    work.add(0, alone[:22])  # the other piece is driven by a worker that has driven nothing before
    heard = []
    again = examine(policy, tasks, 2, terms, heard.append, work)
    assert heard == [30]
    assert all(map(same, alone, again))
    assert all(map(same, alone, (work.load()[i] for i in range(30))))
    known = examine(policy, tasks, 2, terms, heard.append, work)
    assert all(map(same, alone, known))
    if not greedy:
        assert not all(map(same, alone, examine(policy, tasks, 1, Terms(greedy=False, seed=8))))


def test_track_begins_at_the_start_and_follows_the_robot():
    tasks = suite("short").tasks[:3]
    drives = Examiner(Rival("b0", CONFIG), Terms()).run(tasks, np.random.default_rng(0))
    for drive in drives:
        distance = math.hypot(drive.dolly.x - drive.track[-1, 0], drive.dolly.y - drive.track[-1, 1])
        assert drive.ending == "success"
        assert distance < WORLD.reward.success_distance
        assert drive.track[0, 3] == 0.0
        ways = np.hypot(*np.diff(drive.track[:, :2], axis=0).T)
        assert 0.05 < ways.max() <= 0.181


def test_a_worker_that_dies_ends_the_evaluation_and_keeps_what_was_driven(tmp_path):
    """As by the kernel for want of memory: nobody waits for its piece for ever."""
    work, tasks = WorkList(tmp_path / "w.db", {}), suite("train").tasks[:220]

    def kill(done):
        if done == 22:
            for child in multiprocessing.active_children():
                os.kill(child.pid, signal.SIGKILL)

    with pytest.raises(RunError, match="a worker process of the evaluation died; what was driven is kept"):
        examine(Rival("b0", CONFIG), tasks, 1, Terms(max_steps=5), kill, work)
    assert list(work.load()) == list(range(22))


def test_a_worker_that_dies_while_it_still_loads_ends_the_evaluation_too():
    """Its networks are more than a pipe holds."""

    def kill():
        child = wait_until(multiprocessing.active_children)[0]
        os.kill(child.pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(RunError, match="a worker process of the evaluation died"):
        examine(find_subject("shipped", CONFIG), suite("short").tasks[:22], 1)
    killer.join()


def test_an_impossible_task_is_one_sentence_also_from_a_worker():
    away = Task(cell=9, seed=1, start=PlacedStart(x=0.0, y=-19.0, yaw=0.0))
    with pytest.raises(UsageError, match="no free start in cell 9"):
        examine(Rival("b0", CONFIG), [away], 1)


def test_policies_in_worlds_that_differ_are_no_pairs():
    other = resolve(overrides=("world.obstacles.count_max=8",)).world
    with pytest.raises(UsageError, match=r"theirs differ in world\.obstacles\.count_max"):
        check_pairs(WORLD, other)
    check_pairs(WORLD, resolve(overrides=("world.lidar.beams=64", "world.reward.dolly_contact=-10")).world)


def test_newest_snapshot_of_a_run_is_that_of_most_steps(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    for name, steps in (("final", 900), ("best", 500), ("initial", 0)):
        folder = save(SMOKE, tmp_path / "snapshots" / name)
        (folder / "state.json").write_text(json.dumps({"env_steps": steps}))
    (tmp_path / "snapshots" / "stray.txt").write_text("")
    assert find_subject(str(tmp_path), CONFIG).name == str(tmp_path / "snapshots" / "final")


def test_shipped_policy_docks_from_near_starts():
    drives = examine(find_subject("shipped", CONFIG), suite("short").tasks[:22], 1)
    assert [drive.ending for drive in drives].count("success") >= 15


def test_networks_that_do_not_fit_their_configuration_are_refused(tmp_path):
    other = resolve("smoke", overrides=("network.hidden=[16,16]",))
    policy = Trained.read(save(SMOKE, tmp_path / "policy", networks(other)))
    with pytest.raises(UsageError, match="holds other networks than its configuration says"):
        examine(policy, suite("short").tasks[:1], 1)


def test_networks_that_were_replaced_while_they_were_read_are_refused(tmp_path):
    whole = Trained.read(save(SMOKE, tmp_path / "policy"))
    with pytest.raises(UsageError, match="policy holds other networks than"):
        examine(replace(whole, networks=whole.networks[:-40]), suite("short").tasks[:1], 1)


def test_identity_is_that_of_the_content(tmp_path):
    one, two = (Trained.read(save(SMOKE, tmp_path / name)) for name in "ab")
    other = Trained.read(save(SMOKE, tmp_path / "c", networks(SMOKE, seed=1)))
    assert one.identity == two.identity != other.identity
    assert Rival("b0", CONFIG).identity != Rival("b0", SMOKE).identity


def test_what_depends_on_other_things_is_not_mixed_up(tmp_path):
    drive = made(straight(3))
    one, two = (WorkList(tmp_path / "w.db", {"terms": i}) for i in (1, 2))
    one.add(0, [drive])
    one.add(0, [made(straight(5), "timeout")])  # what is there stays
    assert two.load() == {}
    (found,) = WorkList(tmp_path / "w.db", {"terms": 1}).load().values()
    assert same(found, drive)
    one.forget()
    assert one.load() == {}


def test_damaged_work_list_is_refused_in_a_sentence(tmp_path):
    file = tmp_path / "w.db"
    file.write_bytes(b"not a database at all, but long enough to be taken for one" * 20)
    with pytest.raises(UsageError, match=r"cannot use .*w.db as a work list"):
        WorkList(file, {})
    other = tmp_path / "o.db"
    with sqlite3.connect(other) as sql:
        sql.execute("CREATE TABLE somebody (x)")
    with pytest.raises(UsageError, match="is no work list of this version"):
        WorkList(other, {})
    kept = WorkList(tmp_path / "k.db", {})
    for column, value in (
        ("track", b"\0" * 15),
        ("track", b"\xff" * 64),
        ("ending", "flew"),
        ("dolly", "[1]"),
        ("dolly", "[NaN, 0, 0]"),
        ("dolly", "[" * 9999),
    ):
        kept.forget()
        kept.add(0, [made(straight(3))])
        with sqlite3.connect(tmp_path / "k.db") as sql:
            sql.execute(f"UPDATE episodes SET {column} = ?", (value,))
        with pytest.raises(UsageError, match=r"is damaged: .*; remove it to drive again"):
            kept.load()


# The command


def test_a_killed_evaluation_goes_on_and_counts_every_episode_once(tmp_path):
    def command(work):
        words = ("evaluate", "b0", "--suite", "short", "--work", str(work), "--json", "--processes", "2")
        return [sys.executable, "-m", "deploy.cli", *words]

    killed = tmp_path / "killed.db"
    process = subprocess.Popen(command(killed), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    count = 0
    while count == 0:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
        if killed.exists():
            with sqlite3.connect(killed) as sql:
                if sql.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                    count = sql.execute("SELECT count(*) FROM episodes").fetchone()[0]
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 0 < count < 100
    texts = [
        subprocess.run(command(work), capture_output=True, text=True, check=True).stdout
        for work in (killed, tmp_path / "whole.db")
    ]
    assert texts[0] == texts[1]
    found = json.loads(texts[0])
    assert (found["policy"], found["suite"], found["episodes"]) == ("b0", "short", 100)
    assert found["all"]["success"] == 1.0
    with sqlite3.connect(killed) as sql:
        assert sql.execute("SELECT count(*), count(DISTINCT number) FROM episodes").fetchone() == (100, 100)


def test_two_policies_are_compared_in_pairs_with_tables_rows_and_figures(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    policies = [save(SMOKE, tmp_path / name, networks(SMOKE, seed)) for seed, name in enumerate("ab")]
    words = ("evaluate", policies[0], "--compare", policies[1], "--suite", "short", "--out", "out")
    code, out, err = call(monkeypatch, capsys, *words, "--json", "--processes", 1)
    assert code == 0, err
    found = json.loads(out)
    assert found["policy"] == str(policies[0])
    compared = found["compared"]
    assert compared["policy"] == str(policies[1])
    assert compared["difference"] == pytest.approx(found["all"]["success"] - compared["all"]["success"])
    assert compared["ci95"][0] <= compared["difference"] <= compared["ci95"][1]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "short-greedy-seed0.md",
        "short-greedy-seed0-0-a.csv",
        "short-greedy-seed0-1-b.csv",
        "short-greedy-seed0-drives-0-a.png",
        "short-greedy-seed0-drives-1-b.png",
        "short-greedy-seed0-trajectories.png",
    }
    assert len((tmp_path / "out" / "short-greedy-seed0-1-b.csv").read_text().splitlines()) == 101
    assert "in pairs: " in (tmp_path / "out" / "short-greedy-seed0.md").read_text()
    assert (tmp_path / "runs" / "evaluation" / "episodes.db").exists()


ONE = ("--suite", "short", "--processes", 1)


def test_several_policies_are_summed_up_and_a_run_keeps_its_own_work_list(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for seed in range(2):
        (tmp_path / f"run{seed}").mkdir()
        (tmp_path / f"run{seed}" / "run.json").write_text("{}")
        save(SMOKE, tmp_path / f"run{seed}" / "snapshots" / "final", networks(SMOKE, seed))
    code, out, err = call(monkeypatch, capsys, "evaluate", "run0", "run1", *ONE, "--json")
    assert code == 0, err
    found = json.loads(out)
    successes = [one["all"]["success"] for one in found["policies"]]
    assert found["over_policies"]["all"]["mean"] == pytest.approx(np.mean(successes))
    assert [(tmp_path / f"run{i}" / "evaluation" / "episodes.db").exists() for i in (0, 1)] == [True, True]
    assert not (tmp_path / "runs").exists()
    code, text, _ = call(monkeypatch, capsys, "evaluate", "run0", *ONE)
    assert code == 0
    assert text.startswith(f"run0{os.sep}snapshots{os.sep}final on short, 100 episodes, greedy")
