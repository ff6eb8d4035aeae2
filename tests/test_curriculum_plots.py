"""Pictures of a curriculum: what is drawn is what happened, what is not drawn is said."""

import json
import math
import sqlite3
import sys
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from common.config import Config, parse
from common.messages import Origin, Outcome
from curriculum.algorithms.base import Result
from curriculum.calibration import brier_score
from curriculum.curriculum import Curriculum, Report
from curriculum.database import Database
from curriculum.plots import (
    GRID,
    History,
    LeftOutError,
    bin_edges,
    choose,
    draw,
    draw_mix,
    draw_reliability,
    draw_tasks,
    f_pi_axes,
    interval,
    judged,
    met,
    moving_sum,
    nearby,
    proposed,
    read,
    shares,
    stages,
    success_of,
    surface,
    task_mix,
    window,
)
from tests.helpers import small_config
from tests.test_cli import call

pytestmark = pytest.mark.usefixtures("one_thread")
OPEN = "curriculum.gate.enabled=false"
RND = "curriculum.algorithm='rnd'"
FEW_DRAWS = "curriculum.filter_samples=8"
BOX = (
    FEW_DRAWS,
    "curriculum.gate.window=40",
    "curriculum.gate.threshold=0.2",
    "curriculum.parameters=[{name='gravity',low=1,high=20,easy=2},{name='wind',low=-5,high=5,easy=0},"
    "{name='size',low=0.1,high=2,easy=2}]",
)
NUMBERS = 500
"""Outcomes of the longest run here."""
SAVED = 200
"""Outcomes after which it is saved, and f_pi kept."""


class Driven(NamedTuple):
    """A run, and what its curriculum was like."""

    folder: Path
    outcomes: list[tuple[str, dict[str, float], float | None, bool]]
    """Category, properties, prediction, success."""


def start(folder: Path, config: Config) -> Curriculum:
    folder.mkdir()
    (folder / "config.toml").write_text(config.to_toml())
    return Curriculum(config, Database(folder / "curriculum.db"))


def step(curriculum: Curriculum, n: int, rng: np.random.Generator, unserved: bool = False):
    """One task that is proposed and reported; the n-th."""
    p = curriculum.propose(n % len(curriculum.cells), 1000 * n)
    first = next(iter(p.properties.values()))
    done = bool(rng.random() < 1 / (1 + math.exp(first / 3 - 2 - n / 200)))
    message = Outcome(proposal=None if unserved else p.id, task=p.task, success=done)
    curriculum.report([Report(message, Origin(actor="local/a1", boot="b1", seq=n))])
    return ("unserved", p.properties, None, done) if unserved else (p.category, p.properties, p.f, done)


def drive(folder: Path, count: int, *settings: str) -> Driven:
    """A real curriculum whose tasks are solved the likelier the smaller their first property."""
    curriculum = start(folder, small_config(*settings))
    rng, outcomes = np.random.default_rng(0), []
    for n in range(count):
        outcomes.append(step(curriculum, n, rng, unserved=n % 20 == 7))
        if (n + 1) % SAVED == 0:
            curriculum.save()
    curriculum.save()
    curriculum.database.close()
    return Driven(folder, outcomes)


@pytest.fixture(scope="module")
def box(tmp_path_factory, one_thread) -> Driven:
    return drive(tmp_path_factory.mktemp("runs") / "box", NUMBERS, *BOX)


@pytest.fixture(scope="module")
def box_rnd(tmp_path_factory, one_thread) -> Driven:
    return drive(tmp_path_factory.mktemp("runs") / "uniform", 300, *BOX, RND, OPEN)


def plot(monkeypatch, capsys, *arguments):
    return call(monkeypatch, capsys, "curriculum", "plot", *arguments)


def made_up(category: list[str], success: list[bool], requested: list[str] | None = None) -> History:
    n = len(success)
    return History(
        "made-up",
        Config(),
        {"distance": np.arange(n, dtype=float)},
        np.array(requested or [""] * n),
        np.array(category),
        np.full(n, np.nan),
        np.array(success),
        [],
    )


# What is drawn


def test_a_history_is_what_was_reported(box):
    history = read(box.folder)
    category, properties, f, success = zip(*box.outcomes, strict=True)
    assert len(history) == NUMBERS
    assert list(history.category) == list(category)
    assert {"gate", "easy", "frontier", "random", "unserved"} == set(category)
    assert list(history.properties) == ["gravity", "wind", "size"]
    for name, values in history.properties.items():
        assert list(values) == [p[name] for p in properties]
    np.testing.assert_array_equal(history.f, [math.nan if value is None else value for value in f])
    assert list(history.success) == list(success)
    assert [network.outcomes for network in history.networks] == [200, 400, 500]


def test_stages_cover_all_outcomes_once():
    for total in (0, 3, 20, 1001):
        assert np.concatenate([np.arange(total)[stage] for stage in stages(total)]).tolist() == list(
            range(total)
        )
    assert [s.stop - s.start for s in stages(1000)] == [250] * 4


def test_f_pi_is_chosen_at_the_ends_of_the_stages():
    assert choose(range(200, 4001, 200), 4000) == [1000, 2000, 3000, 4000]
    assert choose([200, 400, 500], 500) == [200, 400, 500]
    assert choose([30], 30) == [30]
    assert choose([], 100) == []


def test_outcomes_nearby_lie_around_and_within_the_run():
    assert nearby(1000, 4000) == slice(500, 1500)
    assert nearby(4000, 4000) == slice(3000, 4000)
    assert nearby(0, 4000) == slice(0, 1000)
    assert nearby(7, 10) == slice(0, 10)


def test_moving_sum_counts_the_last_ones():
    flags = np.random.default_rng(1).random(50) < 0.4
    expected = [int(flags[max(0, i - 6) : i + 1].sum()) for i in range(50)]
    assert moving_sum(flags, 7).tolist() == expected


def test_mix_and_success_are_those_of_the_last_outcomes(box):
    history = read(box.folder)
    mix, size, at = task_mix(history), window(NUMBERS), 430
    last = box.outcomes[at + 1 - size : at + 1]
    for name, values in mix.items():
        of = [success for category, _, _, success in last if category == name]
        assert values[at] == pytest.approx(len(of) / size)
        found = success_of(history, name)[at]
        assert math.isnan(found) if len(of) < 10 else found == pytest.approx(np.mean(of))
    assert success_of(history)[at] == pytest.approx(np.mean([success for *_, success in last]))
    np.testing.assert_allclose(sum(mix.values()), 1.0)


def test_requests_met_are_those_that_got_what_was_asked_for():
    requested = ["easy", "frontier", "random", "frontier"] * 200
    category = ["random", "frontier", "random", "random"] * 200
    history = made_up(category, [True] * 800, requested)
    assert met(history, "easy")[-1] == 0
    assert met(history, "frontier")[-1] == pytest.approx(0.5, abs=0.1)
    assert np.isnan(met(history, "gate")).all()
    assert len(draw_mix(history).axes) == 3


def test_success_of_a_category_that_hardly_occurs_is_not_drawn():
    history = made_up(["easy"] * 9 + ["frontier"] * 41, [True] * 50)
    assert np.isnan(success_of(history, "easy")).all()
    assert success_of(history, "frontier")[-1] == 1


def test_histograms_hold_every_proposed_task_once(box):
    history = read(box.folder)
    edges = bin_edges([proposed(history, "gravity", slice(None))])
    counts = np.zeros(len(edges) - 1)
    for stage in stages(NUMBERS):
        expected = [p["gravity"] for c, p, _, _ in box.outcomes[stage] if c != "unserved"]
        values = proposed(history, "gravity", stage)
        assert values.tolist() == expected
        counts += shares(values, edges) * len(values)
    assert counts.sum() == pytest.approx(sum(c != "unserved" for c, *_ in box.outcomes))
    assert shares(np.array([]), edges).sum() == 0


def test_bins_of_tasks_that_are_all_alike_have_a_width():
    assert shares(np.full(4, 3.0), bin_edges([np.full(4, 3.0)])).max() == 1


def test_interval_agrees_with_published_values():
    assert interval(81 / 263, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)  # Newcombe 1998, table I


@pytest.mark.parametrize(
    "settings", [(), ("curriculum.calibrate=true",), ("curriculum.algorithm='navacl-q'",)]
)
def test_f_pi_is_drawn_as_it_was(tmp_path, settings):
    driven = drive(tmp_path / "run", 420, *BOX, OPEN, *settings)
    history = read(driven.folder)
    assert [network.outcomes for network in history.networks] == [200, 400, 420]
    for network in history.networks:
        found, around = surface(history, network), nearby(network.outcomes, 420)
        assert found.f.shape == (GRID, GRID)
        gravity, wind = history.properties["gravity"], history.properties["wind"]
        assert (found.x[0], found.x[-1], found.y[0], found.y[-1]) == (
            gravity.min(),
            gravity.max(),
            wind.min(),
            wind.max(),
        )
        size = float(np.median(history.properties["size"][around]))
        corner = {"gravity": float(found.x[3]), "wind": float(found.y[50]), "size": size}
        said = ask_again(driven, network.outcomes, corner)
        assert found.f[50, 3] == pytest.approx(said, abs=1e-6)


def ask_again(driven: Driven, outcomes: int, task: dict[str, float]) -> float:
    """What a curriculum says of a task when it has learned from only so many of those outcomes."""
    config = parse((driven.folder / "config.toml").read_text())
    curriculum = Curriculum(config)
    for n, (_, properties, _, success) in enumerate(driven.outcomes[:outcomes]):
        message = Outcome(proposal=None, task=properties, success=success)
        curriculum.report([Report(message, Origin(actor="local/a1", boot="b1", seq=n))])
    return float(curriculum.algorithm.score([task], [None])[0])


def test_dots_are_the_outcomes_nearby(box):
    history = read(box.folder)
    figures, left_out = draw(history)
    assert left_out == {}
    panels = [axes for axes in figures["f_pi"].axes if axes.get_title()]
    assert [axes.get_title() for axes in panels] == [
        f"after {n} outcomes ({share}%)" for n, share in ((200, 40), (400, 80), (500, 100))
    ]
    for axes, network in zip(panels, history.networks, strict=True):
        around = nearby(network.outcomes, NUMBERS)
        drawn = {
            c.get_label(): c.get_offsets()
            for c in axes.collections
            if c.get_label() in ("success", "failure")
        }
        for name, flag in (("success", True), ("failure", False)):
            chosen = history.success[around] == flag
            expected = [history.properties[key][around][chosen] for key in ("gravity", "wind")]
            assert sorted(map(tuple, drawn[name])) == sorted(zip(*expected, strict=True))


def test_bars_are_the_shares_of_each_stage_of_both_runs(box, box_rnd):
    histories = [read(box.folder), read(box_rnd.folder)]
    axes = draw_tasks(histories).axes
    assert len(axes) == 8
    for panel, (history, stage) in zip(
        axes, [(h, stage) for h in histories for stage in stages(len(h))], strict=True
    ):
        values, edges, _ = panel.patches[0].get_data()
        found = proposed(history, "gravity", stage)
        np.testing.assert_allclose(values, 100 * np.histogram(found, edges)[0] / len(found))
        assert values.sum() == pytest.approx(100)


def test_reliability_tells_the_halves_of_the_run_apart(box):
    f, success = judged(read(box.folder))
    expected = [(f, s) for _, _, f, s in box.outcomes if f is not None]
    assert list(zip(f, success, strict=True)) == expected
    curve, counts, _ = draw_reliability(read(box.folder)).axes
    half = round(len(f) / 2)
    scores = [brier_score(f[part], success[part]) for part in (slice(half), slice(half, None))]
    labels = curve.get_legend_handles_labels()[1]
    assert [
        f"{name} half: Brier score {s:.3f}" for name, s in zip(("first", "second"), scores, strict=True)
    ] == [label for label in labels if "half" in label]
    assert sum(bar.get_height() for bar in counts.patches) == len(f)


def test_a_single_category_needs_no_picture_of_its_share():
    assert len(draw_mix(made_up(["rnd"] * 60, [True, False] * 30)).axes) == 1


def test_docking_runs_are_drawn_over_distance_and_angle_in_degrees(tmp_path):
    driven = drive(tmp_path / "dock", 60, FEW_DRAWS, OPEN)
    history = read(driven.folder)
    assert f_pi_axes(history, history.networks[0]) == ("distance", "relative_angle")
    figures, _ = draw(history)
    axes = figures["f_pi"].axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("distance, m", "relative angle, degrees")
    angle = np.degrees(history.properties["relative_angle"])
    assert axes.get_ylim() == pytest.approx((angle.min(), angle.max()))
    assert figures["tasks"].axes[0].get_xlabel() == "distance, m"


# The command


def test_command_writes_all_pictures(monkeypatch, capsys, tmp_path, box, box_rnd):
    code, out, err = plot(monkeypatch, capsys, box.folder, "--rival", box_rnd.folder, "--out", tmp_path / "p")
    assert (code, err) == (0, "")
    names = [f"{name}.{kind}" for name in ("f_pi", "tasks", "mix", "reliability") for kind in ("png", "svg")]
    assert out.splitlines() == [str(tmp_path / "p" / name) for name in names]
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == sorted(names)
    for path in (tmp_path / "p").glob("*.png"):
        with Image.open(path) as picture:
            assert picture.width == 1200
            assert len(picture.convert("RGB").getcolors(maxcolors=1_000_000) or []) > 50
    for path in (tmp_path / "p").glob("*.svg"):
        root = ElementTree.fromstring(path.read_text())
        assert root.get("width") == "864pt"  # 12 inches


def test_pictures_go_beside_the_run_in_the_formats_asked_for(monkeypatch, capsys, box_rnd):
    code, _, err = plot(monkeypatch, capsys, box_rnd.folder, "--format", "svg")
    assert code == 0
    assert {path.name for path in (box_rnd.folder / "plots").iterdir()} == {"tasks.svg", "mix.svg"}
    assert err.splitlines() == [
        "left out f_pi: rnd has no f_pi",
        "left out reliability: no success was predicted before an outcome",
    ]


def test_a_run_without_outcomes_has_no_pictures(monkeypatch, capsys, tmp_path, box):
    empty = drive(tmp_path / "empty", 0, *BOX)
    code, out, err = plot(monkeypatch, capsys, empty.folder)
    assert (code, out) == (0, "")
    assert [line.partition(":")[0] for line in err.splitlines()] == [
        f"left out {name}" for name in ("f_pi", "tasks", "mix", "reliability")
    ]
    assert not (empty.folder / "plots").exists()
    _, left_out = draw(read(box.folder), read(empty.folder))
    assert left_out == {"tasks of empty": "0 outcomes; it takes 20"}


def test_f_pi_of_q_alone_has_no_plane(tmp_path):
    history = read(drive(tmp_path / "run", 30, FEW_DRAWS, OPEN, "curriculum.inputs=['q']").folder)
    assert draw(history)[1] == {"f_pi": "f_pi sees q alone; a plane needs two"}


@pytest.mark.parametrize("config", ["", (OPEN, *BOX[:-1], BOX[-1].replace("high=20", "high=21"))])
def test_without_its_config_toml_only_f_pi_of_a_box_is_lost(box, tmp_path, config):
    (tmp_path / "curriculum.db").write_bytes((box.folder / "curriculum.db").read_bytes())
    if config:
        (tmp_path / "config.toml").write_text(small_config(*config).to_toml())
    figures, left_out = draw(read(tmp_path))
    assert set(figures) == {"tasks", "mix", "reliability"}
    assert "config.toml" in left_out["f_pi"]


def test_after_a_change_of_f_pi_the_old_one_is_not_drawn(box, tmp_path):
    (tmp_path / "curriculum.db").write_bytes((box.folder / "curriculum.db").read_bytes())
    config = small_config(*BOX, "curriculum.hidden=[8]")
    (tmp_path / "config.toml").write_text(config.to_toml())
    curriculum = Curriculum(config, Database(tmp_path / "curriculum.db"))
    curriculum.save()
    assert {200, 400} <= {n for n, values, _ in curriculum.database.networks() if values["kind"][2] != [8]}
    curriculum.database.close()
    history = read(tmp_path)
    assert [(network.outcomes, network.values["kind"][2]) for network in history.networks] == [(NUMBERS, [8])]
    surface(history, history.networks[0])


def test_a_run_that_goes_on_is_drawn_as_committed(tmp_path, monkeypatch, capsys):
    curriculum, rng = start(tmp_path / "run", small_config(*BOX, RND, OPEN)), np.random.default_rng(0)
    for n in range(30):
        step(curriculum, n, rng)
    database = curriculum.database
    database.commit()
    result = Result(curriculum.space.draw(0, 1.0, rng), "unserved", None, True)
    database.add_outcome(None, "local/a1", result)  # in a transaction that is open
    assert len(read(tmp_path / "run")) == 30
    assert plot(monkeypatch, capsys, tmp_path / "run", "--format", "png")[0] == 0
    database.commit()
    assert len(read(tmp_path / "run")) == 31


def damage_file(run: Path) -> None:
    (run / "curriculum.db").write_bytes(b"no database" * 1000)


def damage_version(run: Path) -> None:
    with sqlite3.connect(run / "curriculum.db") as sql:
        sql.execute("PRAGMA user_version=99")
    sql.close()


def damage_config(run: Path) -> None:
    (run / "config.toml").write_text("[curriculum]\nbetta = 1\n")


def damage_tasks(run: Path) -> None:
    with sqlite3.connect(run / "curriculum.db") as sql:
        sql.execute(
            "UPDATE outcomes SET entry = ? WHERE id = 1", (json.dumps([0, {"x": 1}, {"x": 1}, None]),)
        )
    sql.close()


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (damage_file, "curriculum.db: file is not a database"),
        (damage_version, "version 99"),
        (damage_config, "config.toml: config key 'curriculum.betta'"),
        (damage_tasks, "several worlds"),
        (lambda run: (run / "curriculum.db").unlink(), "no curriculum.db"),
    ],
)
def test_a_bad_run_is_one_sentence(monkeypatch, capsys, tmp_path, damage, word):
    run = drive(tmp_path / "run", 2, *BOX, RND, OPEN).folder
    damage(run)
    code, out, err = plot(monkeypatch, capsys, run)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith("error: ")
    assert word in err
    assert not (run / "plots").exists()


def test_bad_options_are_one_sentence(monkeypatch, capsys, tmp_path, box):
    dock = drive(tmp_path / "dock", 20, RND, OPEN).folder
    (tmp_path / "file").touch()
    for arguments, word in (
        ((tmp_path / "nowhere",), "no curriculum.db"),
        ((box.folder, "--format", "png,gif"), "png, svg"),
        ((box.folder, "--rival", tmp_path / "nowhere"), "no curriculum.db"),
        ((box.folder, "--rival", dock), "no gravity in its tasks"),
        ((box.folder, "--out", tmp_path / "file"), "cannot make"),
    ):
        code, out, err = plot(monkeypatch, capsys, *arguments)
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert word in err


def test_without_matplotlib_the_command_says_what_to_install(monkeypatch, capsys, box_rnd):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, out, err = plot(monkeypatch, capsys, box_rnd.folder)
    assert (code, out) == (2, "")
    assert err == "error: pictures need Matplotlib: pip install 'navaclq[plots]'\n"


def test_no_f_pi_before_the_first_is_kept(tmp_path):
    curriculum, rng = start(tmp_path / "run", small_config(*BOX, OPEN)), np.random.default_rng(0)
    for n in range(25):
        step(curriculum, n, rng)
    curriculum.database.commit()  # a state is saved every few seconds only
    assert draw(read(tmp_path / "run"))[1] == {"f_pi": "no f_pi has been kept yet"}


def test_a_network_that_does_not_fit_is_left_out(box):
    history = read(box.folder)
    network = history.networks[0]._replace(tensors=history.networks[0].tensors[:-40])
    with pytest.raises(LeftOutError, match="after 200 outcomes cannot be read"):
        surface(history, network)


def test_a_network_of_another_version_is_left_out_with_that_word(box):
    history = read(box.folder)
    network = history.networks[0]
    older = network._replace(values={**network.values, "kind": network.values["kind"][:4]})
    with pytest.raises(LeftOutError, match="after 200 outcomes was saved by another version of navaclq"):
        surface(history, older)
