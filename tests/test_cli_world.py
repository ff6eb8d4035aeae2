"""`navaclq world`, `evaluate` and `bench`: pictures, tables and numbers, and what they say of bad input."""

import json
import math
import os
import subprocess
import sys

import av
import numpy as np
import pytest
from PIL import Image

from common.cells import CELLS, ROOMS
from common.config import resolve
from deploy.cli.evaluate import own_rules
from tests.test_cli import call

PLAIN = ("world.obstacles.count_min=0", "world.obstacles.count_max=0", 'world.randomization.fixed=["all"]')
QUIET = tuple(f"world.randomization.{place}.camera_noise=[0, 0]" for place in ("training", "test"))


def preview(monkeypatch, capsys, out, *arguments) -> np.ndarray:
    """The picture of `world preview` in an empty room that always looks alike."""
    settings = [word for text in (*PLAIN, *QUIET) for word in ("--set", text)]
    code, said, err = call(
        monkeypatch, capsys, "world", "preview", "--seed", 7, "--out", out, *arguments, *settings
    )
    assert (code, said) == (0, f"{out}\n"), err
    return np.asarray(Image.open(out)).astype(int)


def middle(mask: np.ndarray) -> tuple[float, float]:
    """Mean column and row of what is set."""
    rows, columns = np.nonzero(mask)
    assert len(rows) > 10
    return columns.mean(), rows.mean()


def find_dolly(picture: np.ndarray) -> tuple[float, float]:
    """Where the dolly is in the view from above, pixels from the upper left."""
    red, green, blue = picture[12:652, 12:652].transpose(2, 0, 1)
    drawn = blue > 210  # the outline of where it will be
    return middle((blue > 1.8 * red) & (blue > 1.8 * green) & (blue > 40) & ~drawn)


def find_robot(picture: np.ndarray, near: tuple[float, float]) -> tuple[float, float]:
    """Where the yellow arrow on the robot is there, within 60 pixels: machines are striped yellow too."""
    red, green, blue = picture[12:652, 12:652].transpose(2, 0, 1)
    rows, columns = np.indices(red.shape)
    around = np.hypot(columns - near[0], rows - near[1]) < 60
    return middle((red > 150) & (green > 0.6 * red) & (blue < 0.3 * red) & around)


def pixel(cell: int, x: float, y: float) -> tuple[float, float]:
    """Where a point of the floor is in the view from above, which shows 0.4 m around the room."""
    left, right, back, front = ROOMS[cell].extent
    scale = 640 / (max(right - left, front - back) + 0.8)
    return 320 + scale * (x - (left + right) / 2), 320 - scale * (y - (back + front) / 2)


@pytest.mark.parametrize(("name", "cell"), [("4", 4), ("validation", 9), ("test", 10)])
def test_preview_draws_a_placed_start_in_cells_and_arenas(monkeypatch, capsys, tmp_path, name, cell):
    picture = preview(monkeypatch, capsys, tmp_path / "x.png", "--cell", name, "--place", "-1.5,-3.5,-60")
    assert picture.shape == (772, 990, 3)
    dolly = ROOMS[cell].dolly
    assert find_dolly(picture) == pytest.approx(pixel(cell, dolly.x, dolly.y), abs=8)
    robot = pixel(cell, dolly.x - 1.5, dolly.y - 3.5)
    assert find_robot(picture, robot) == pytest.approx(robot, abs=8)
    hits = np.argwhere((picture[12:652, 12:652] == (230, 60, 60)).all(axis=2))
    scale = pixel(cell, 1.0, 0.0)[0] - pixel(cell, 0.0, 0.0)[0]
    metres = np.hypot(hits[:, 1] - robot[0], hits[:, 0] - robot[1]) / scale
    assert len(hits) > 20
    assert metres.min() > 0.7  # the sensors sit at the corners
    assert metres.max() < 6.0 + 0.71 + 0.1
    views = (picture[12:652, 12:652], picture[12:326, 664:978], picture[338:652, 664:978])
    assert all(view.std() > 15 for view in views)
    text = picture[664:, 12:652].min(axis=2) < 100
    assert [bool(text[24 * line : 24 * line + 20].any()) for line in range(4)] == [True] * 4


def test_preview_shows_the_dolly_shift_after_its_step_and_not_before(monkeypatch, capsys, tmp_path):
    start = ("--place", "0,-3,0")
    shift = (*start, "--shift", "2,1.0,0.5,30")
    for steps, moved in ((2, False), (3, True)):
        without, shifted = (
            preview(monkeypatch, capsys, tmp_path / "x.png", *words, "--steps", steps)
            for words in (start, shift)
        )
        behind_and_camera = slice(12, 652), slice(664, 978)
        assert np.array_equal(without[behind_and_camera], shifted[behind_and_camera]) is not moved
        expected = pixel(0, 1.0, 4.5) if moved else pixel(0, 0.0, 4.0)
        assert find_dolly(shifted) == pytest.approx(expected, abs=8)
        assert find_dolly(without) == pytest.approx(pixel(0, 0.0, 4.0), abs=8)


def test_preview_of_a_seed_is_the_same_every_time_and_of_another_is_not(monkeypatch, capsys, tmp_path):
    pictures = []
    for seed in (3, 3, 4):
        out = tmp_path / "x.png"
        code, *_ = call(monkeypatch, capsys, "world", "preview", "--cell", 2, "--seed", seed, "--out", out)
        assert code == 0
        pictures.append(np.asarray(Image.open(out)))
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


def test_preview_of_all_rooms_shows_each_of_them(monkeypatch, capsys, tmp_path):
    out = tmp_path / "x.jpg"
    code, said, err = call(monkeypatch, capsys, "world", "preview", "--cell", "all", "--out", out)
    assert (code, said) == (0, f"{out}\n"), err
    picture = Image.open(out)
    assert picture.format == "JPEG"
    assert picture.size == (8 + 4 * 328, 8 + 3 * 350)
    tiles = [
        np.asarray(picture.crop((8 + 328 * column, 8 + 350 * row, 328 + 328 * column, 328 + 350 * row)))
        for row in range(3)
        for column in range(4)
    ]
    assert len(ROOMS) == 11
    assert all(tile.std() > 20 for tile in tiles[:11])
    assert tiles[11].mean() > 254  # no twelfth room


PREVIEW = ("world", "preview", "--out", "x.png")
RECORD = ("world", "record", "--policy", "b0")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*PREVIEW, "--cell", "9"), "--cell '9' does not exist; choose one of 0, 1, 2"),
        ((*PREVIEW, "--cell", "nowhere"), "--cell 'nowhere' does not exist; choose one of 0, 1, 2"),
        ((*PREVIEW, "--cell=-1"), "'-1' does not exist"),
        ((*PREVIEW, "--cell", ""), "'' does not exist"),
        ((*PREVIEW, "--place", "1,2"), "--place '1,2' must be X,Y,YAW"),
        ((*PREVIEW, "--place", "1,2,x"), "--place '1,2,x' must be X,Y,YAW"),
        ((*PREVIEW, "--place", "1,2,3,4"), "--place '1,2,3,4' must be X,Y,YAW"),
        ((*PREVIEW, "--place", "30,0,0"), "--place '30,0,0' must be X,Y,YAW within 20 m"),
        ((*PREVIEW, "--place", "0,-2,181"), "within 20 m and 180 degrees"),
        ((*PREVIEW, "--place", "0,nan,0"), "--place '0,nan,0'"),
        ((*PREVIEW, "--place", "0,inf,0"), "--place '0,inf,0'"),
        ((*PREVIEW, "--place", "0,-19,0"), "no free start in cell 0 (hall): the robot stands in a wall"),
        ((*PREVIEW, "--shift", "1,2"), "--shift '1,2' must be STEP,X,Y,YAW"),
        ((*PREVIEW, "--shift", "a,0,0,0"), "--shift 'a,0,0,0' must be STEP,X,Y,YAW"),
        ((*PREVIEW, "--shift", "0,1,0,0"), "from step 1 on"),
        ((*PREVIEW, "--shift", "3,11,0,0"), "within 10 m and 180 degrees"),
        ((*PREVIEW, "--shift", "nan,0,0,0"), "--shift 'nan,0,0,0' must be"),
        ((*PREVIEW, "--shift", "inf,0,0,0"), "--shift 'inf,0,0,0' must be"),
        ((*PREVIEW, "--shift", "2.5,0,0,0"), "--shift '2.5,0,0,0' must be"),
        ((*PREVIEW, "--shift", "3,0,9,0", "--place", "0,-2,0"), "the shifted dolly stands in a wall"),
        (("world", "preview"), "--out"),
        (("world", "preview", "--out", "x.gif"), "--out x.gif must end in .png"),
        (("world", "preview", "--out", "nowhere/x.png"), "nowhere does not exist"),
        ((*PREVIEW, "--cell", "all", "--place", "0,-19,0"), "no free start in cell 0 (hall)"),
        ((*PREVIEW, "--steps", "-1"), "--steps"),
        ((*PREVIEW, "--seed", "-1"), "--seed"),
        ((*PREVIEW, "--set", "world.lidar.beans=3"), "world.lidar.beams"),
        ((*RECORD, "--out", "x.avi"), "--out x.avi must end in .mp4"),
        ((*RECORD, "--out", "nowhere/x.mp4"), "nowhere does not exist"),
        ((*RECORD, "--out", "x.mp4", "--still", "x.jpg"), "--still x.jpg must end in .png"),
        ((*RECORD, "--out", "x.mp4", "--still-at", "-2"), "--still-at"),
        ((*RECORD, "--out", "x.mp4", "--cell", "12"), "--cell '12' does not exist"),
        (("world", "record", "--policy", "nosuch", "--out", "x.mp4"), "policy nosuch does not exist"),
        (("world", "check", "--out", "x.txt"), "--out x.txt must end in .md"),
        (("world", "check", "--tasks", "0"), "--tasks"),
        (("evaluate", "nosuch"), "policy nosuch does not exist; give a run directory, a checkpoint"),
        (("evaluate", "b0", "--grid", "quick", "--suite", "short"), "--suite and --grid exclude each other"),
        (("world", "preview", "--out", "/proc/x.png"), "/proc/x.png"),
        (("world", "preview", "--out", "."), "must end in .png or .jpg"),
        (("evaluate", "b0", "--arena", "test"), "--arena says where a grid is; add --grid"),
        (
            ("world", "record", "--policy", ".", "--out", "x.mp4", "--set", "world.lidar.noise=1"),
            "go with a baseline",
        ),
        (
            ("world", "preview", "--out", "p.png", "--cell", "all", "--steps", "3"),
            "--steps does not go with --cell all",
        ),
        (("evaluate", "b0", "--grid", "quick", "--arena", "nowhere"), "arena 'nowhere' does not exist"),
        (("evaluate", "b0", "--grid", "long"), "'quick', 'paper'"),
        (
            ("evaluate", "b0", "--suite", "grid"),
            "suite 'grid' does not exist; choose one of short, train, moving-dolly",
        ),
        (
            ("evaluate", "b0", "--grid", "quick", "--nearest", "9.2"),
            "the grid does not fit the arena: at -2.5, -9.2 m from the dolly there is no free start",
        ),
        (("evaluate", "b0", "--grid", "quick", "--nearest", "0"), "there is no free start"),
        (("evaluate", "b0", "--grid", "quick", "--nearest", "nan"), "--nearest"),
        (("evaluate", "nosuch", "--out", "x"), "policy nosuch does not exist"),
        (("evaluate", "b0", "--compare", "nosuch"), "policy nosuch does not exist"),
        (("evaluate", "b0", "--nearest", "2"), "--nearest says where a grid is"),
        (("evaluate", "b0", "b0"), "the same policy is named twice"),
        (("evaluate", "b0", "b1", "--compare", "b2"), "--compare compares one policy with another"),
        (("evaluate", "b0", "--out", "/proc/x"), "--out /proc/x cannot be made"),
        (("bench", "sim", "--rounds", "0"), "--rounds"),
        (("bench", "sim", "--preset", "quick"), "paper, fast, smoke"),
    ],
)
def test_bad_input_is_named_in_one_sentence_and_nothing_is_written(
    monkeypatch, capsys, tmp_path, arguments, words
):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(monkeypatch, capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    assert words in err
    assert list(tmp_path.iterdir()) == []


def test_record_films_a_drive_and_keeps_one_frame(monkeypatch, capsys, tmp_path):
    video, still = tmp_path / "x.mp4", tmp_path / "x.png"
    code, out, err = call(
        *(monkeypatch, capsys, *RECORD, "--out", video, "--still", still, "--still-at", 100),
        *("--place", "0,-1.6,0", "--cell", 1),
    )
    assert code == 0, err
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert out == f"{video}: {len(frames)} frames, {0.18 * len(frames):.1f} s, success\n"
    last = np.asarray(Image.open(still)).astype(int)
    assert abs(last - frames[-1]).mean() < abs(last - frames[0]).mean() / 2
    assert {path.name for path in tmp_path.iterdir()} == {"x.mp4", "x.png"}


def run(*arguments) -> subprocess.CompletedProcess:
    """The command in a process of its own, as programs call it."""
    return subprocess.run(
        [sys.executable, "-m", "deploy.cli", *map(str, arguments)], capture_output=True, text=True
    )


def test_check_prints_properties_of_every_cell_and_how_the_scripted_controller_fares(tmp_path):
    table = tmp_path / "x.md"
    done = run("world", "check", "--tasks", 20, "--solve", 4, "--processes", 1, "--json", "--out", table)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    found = json.loads(done.stdout)
    assert set(found) == {"seed", "tasks_per_cell", "cells", "solved"}
    assert (found["seed"], found["tasks_per_cell"]) == (0, 20)
    assert found["solved"] == {
        "tasks": 4,
        "max_steps": 100,
        "success": 1.0,
        "dolly_contact": 0.0,
        "other_contact": 0.0,
        "timeout": 0.0,
    }
    assert [(row["cell"], row["name"]) for row in found["cells"]] == [
        (index, cell.name) for index, cell in enumerate(CELLS)
    ]
    for row in found["cells"]:
        properties = {name: quantiles for name, quantiles in row.items() if name not in ("cell", "name")}
        assert set(properties) == {
            "distance",
            "agent_clearance",
            "goal_clearance",
            "relative_angle",
            "lateral_offset",
            "approach_angle",
        }
        for quantiles in properties.values():
            assert len(quantiles) == 5
            assert quantiles == sorted(quantiles)
            assert quantiles[0] >= 0
        assert 1.5 <= properties["distance"][0] < properties["distance"][4] <= 5.0
        assert properties["relative_angle"][4] > 45  # degrees
    lines = table.read_text("utf-8").splitlines()
    assert lines[2].startswith("| 0 hall | ")
    assert len([line for line in lines if line.startswith("| ")]) == 1 + 9
    assert "success 100.0%" in lines[-1]


def test_check_draws_other_tasks_for_another_seed(monkeypatch, capsys):
    texts = [
        call(monkeypatch, capsys, "world", "check", "--tasks", 2, "--seed", seed)[:2] for seed in (1, 1, 2)
    ]
    assert {code for code, _ in texts} == {0}
    assert texts[0] == texts[1] != texts[2]
    assert texts[0][1].startswith("| cell | distance (m) | ")


def test_bench_sim_reports_rows_ratios_what_it_skipped_and_the_host():
    done = run("bench", "sim", "--rounds", 1, "--preset", "smoke", "--json")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    found = json.loads(done.stdout)
    assert set(found) == {"bench", "rows", "ratios", "quartiles", "skipped", "host"}
    assert found["bench"] == "sim"
    rows = {row["name"]: row for row in found["rows"]}
    assert len(rows) == len(found["rows"])
    assert {row: rows[row]["unit"] for row in ("environment", "raw_calls", "reset", "rss_with_4_worlds")} == {
        "environment": "steps/s",
        "raw_calls": "steps/s",
        "reset": "ms",
        "rss_with_4_worlds": "MB",
    }
    assert set(found["ratios"]) == set(found["quartiles"])
    assert {"env_over_raw", "gymnasium_over_raw", "actor_over_limit"} < set(found["ratios"])
    for value in (*(row["value"] for row in rows.values()), *found["ratios"].values()):
        assert math.isfinite(value)
        assert value > 0
    assert [reason for reason in found["skipped"] if "--soak" in reason] == found["skipped"]
    assert len(found["skipped"]) == 1
    assert set(found["host"]) == {"cores", "load_average", "machine", "python"}
    assert found["host"]["cores"] == os.cpu_count()


def test_what_is_special_in_a_policys_world_stands_beside_its_result():
    config = resolve("smoke", overrides=("world.reward.success_distance=3", "world.camera.size=32"))
    assert own_rules(config) == {
        "world.max_episode_steps": 20,
        "world.max_evaluation_steps": 20,
        "world.camera.size": 32,
        "world.reward.success_distance": 3.0,
    }
    assert own_rules(resolve()) == {}
