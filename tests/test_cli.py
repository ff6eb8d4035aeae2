"""The navaclq command: bad input gets one sentence and exit code 2, good input what programs read."""

import json
import subprocess
import sys

import pytest
from PIL import Image

from common.config import parse, resolve
from deploy.cli import options
from deploy.cli.main import run
from deploy.cli.options import parse_cells


def call(monkeypatch, capsys, *arguments):
    """Exit code, stdout and stderr of the command, run in this process."""
    monkeypatch.setattr(sys, "argv", ["navaclq", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        run()
    captured = capsys.readouterr()
    return ended.value.code, captured.out, captured.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["config", "show", "--set", "sac.gama=0.9"], "sac.gamma"),
        (["config", "show", "--set", "sac.gamma=2"], "sac.gamma"),
        (["config", "show", "--preset", "quick"], "fast, smoke|paper, fast, smoke"),
        (["config", "show", "--variant", "x"], "navacl-q"),
        (["config", "show", "--config", "missing.toml"], "missing.toml"),
        (["curriculum", "query", "--cell", "9"], "cells are 0 to 8"),
        (["curriculum", "query", "--cell", "3", "--count", "-1"], "--count"),
        (["curriculum", "serve", "--connect", "tcp/127.0.0.1:1", "--listen", "tcp/127.0.0.1:2"], "exclude"),
        (["actor", "--count", "-2"], "--count"),
        (["actor", "--cells", "3-x"], "0,3-5"),
        (["actor", "--cells", "7-9"], "cells are 0 to 8"),
        (["actor", "--connect", "localhost"], "tcp/HOST:PORT"),
        (["actor", "--connect", "tcp/10.0.0.5:7447"], "--insecure"),
        (["learner", "--run", "runs/x", "--listen", "tcp/0.0.0.0:7447"], "--insecure"),
        (["learner", "--run", "runs/x", "--listen", "tcp/127.0.0.1:99999"], "tcp/HOST:PORT"),
        (["train", "--minutes", "-1"], "--minutes"),
        (["train", "--eval", "grid"], "short, train"),
        (["evaluate", "nowhere"], "nowhere does not exist"),
        (["evaluate", ".", "--suite", "short"], "no policy"),
        (["world", "preview", "--out", "x.png", "--cell", "9"], "--cell '9' does not exist"),
        (["world", "preview", "--out", "nowhere/x.png"], "does not exist"),
        (["world", "preview", "--out", "x.gif"], ".png or .jpg"),
        (["nonsense"], "nonsense"),
        (["train", "--nonsense"], "--nonsense"),
    ],
)
def test_bad_input_gets_one_sentence_and_exit_code_2(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(monkeypatch, capsys, *arguments)
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    assert any(word in err for word in words.split("|"))
    assert list(tmp_path.iterdir()) == []  # nothing half-written


def test_run_directory_of_an_incompatible_version_is_refused(monkeypatch, capsys, tmp_path):
    run_folder = tmp_path / "old"
    run_folder.mkdir()
    (run_folder / "run.json").write_text('{"schema": 0, "epoch": 3}')
    (run_folder / "config.toml").write_text(resolve("smoke").to_toml())
    code, _, err = call(monkeypatch, capsys, "learner", "--run", run_folder)
    assert code == 2
    assert "incompatible version" in err
    code, _, err = call(monkeypatch, capsys, "train", "--run", run_folder, "--minutes", "1")
    assert code == 2
    assert "incompatible version" in err
    assert len(err.strip().splitlines()) == 1


def test_existing_run_refuses_a_setting_that_contradicts_it_and_names_it(monkeypatch, capsys, tmp_path):
    from learner.checkpoint import RunDirectory

    RunDirectory(tmp_path / "x", resolve("smoke"))
    code, _, err = call(
        monkeypatch, capsys, "learner", "--run", tmp_path / "x", "--preset", "smoke", "--set", "sac.gamma=0.5"
    )
    assert code == 2
    assert "sac.gamma = 0.98" in err
    assert "0.5" in err


def test_foreign_folder_is_not_taken_for_a_run(monkeypatch, capsys, tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    code, _, err = call(monkeypatch, capsys, "learner", "--run", tmp_path)
    assert code == 2
    assert "no run directory" in err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_shown_configuration_reads_back(monkeypatch, capsys):
    code, out, _ = call(monkeypatch, capsys, "config", "show", "--preset", "paper", "--set", "seed=4")
    assert code == 0
    assert parse(out) == resolve("paper", seed=4)
    code, out, _ = call(monkeypatch, capsys, "config", "show", "--json")
    assert json.loads(out)["sac"]["n_step"] == 3


def test_doctor_prints_one_json_object_last_on_stdout_even_with_pybullet_loaded():
    done = subprocess.run(
        [sys.executable, "-m", "deploy.cli", "doctor", "--json"], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 1
    found = json.loads(done.stdout)
    assert {"versions", "cores", "pybullet_numpy", "torch_threads", "hub", "free_disk_gb"} <= set(found)
    assert found["pybullet_numpy"] is True
    assert set(found["hub"]) >= {"endpoint", "answers"}


def test_doctor_says_that_a_hub_is_silent_with_exit_code_1(monkeypatch, capsys, endpoint):
    code, out, _ = call(monkeypatch, capsys, "doctor", "--json", "--connect", endpoint)
    assert code == 1
    assert json.loads(out)["hub"]["answers"] is False


def test_query_without_a_hub_fails_with_exit_code_1(monkeypatch, capsys, endpoint):
    code, _, err = call(
        monkeypatch, capsys, "curriculum", "query", "--cell", "1", "--connect", endpoint, "--timeout", "0.5"
    )
    assert code == 1
    assert err == f"error: no hub answers at {endpoint}\n"


def test_preview_draws_every_cell(monkeypatch, capsys, tmp_path):
    for cell in (0, 8):
        out = tmp_path / f"{cell}.png"
        code, *_ = call(monkeypatch, capsys, "world", "preview", "--cell", cell, "--seed", 7, "--out", out)
        assert code == 0
        picture = Image.open(out)
        assert picture.width > 900
        assert len(picture.getcolors(maxcolors=1 << 24) or []) > 200


def test_cells_are_read_from_lists_and_ranges():
    assert parse_cells("0,3-5") == [0, 3, 4, 5]
    assert parse_cells("8") == [8]


def test_every_command_has_help(monkeypatch, capsys):
    for command in (
        "train",
        "learner",
        "actor",
        "curriculum serve",
        "curriculum query",
        "evaluate",
        "doctor",
    ):
        code, out, _ = call(monkeypatch, capsys, *command.split(), "--help")
        assert code == 0
        assert "Usage" in out


def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(options, "LINE_SECONDS", 0.0)
    with options.progress("drives", 40) as report:
        report(10)
        report(10, "still")
        report(30, "epoch 2")
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["drives: 10 of 40", "drives: 10 of 40, still"]
    assert lines[2] == "drives: 30 of 40, 0.0 min left, epoch 2"
    monkeypatch.setattr(options, "LINE_SECONDS", 60.0)
    with options.progress("drives", 40) as report:
        report(10)
    assert capsys.readouterr().err == ""


def test_commands_that_compute_nothing_do_not_wait_for_torch():
    code = (
        "import sys, deploy.cli.main; "
        "assert not {'torch', 'pybullet', 'onnxruntime'} & set(sys.modules), 'slow to import'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
