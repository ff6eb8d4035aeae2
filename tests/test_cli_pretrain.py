"""`navaclq pretrain` from the command line: real actors, bus, shards, training, export and examination."""

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from PIL import Image

from common.bus import Keys
from common.config import resolve
from common.contract import digest, fetch_contract
from common.encoders import frozen_encoder, read_encoder
from common.link import make_link, open_client, open_hub
from common.messages import Frames
from common.tasks import Task
from deploy.bench.encoder import SIZES
from learner.checkpoint import RunDirectory
from learner.pretraining.frame_store import FrameStore
from learner.pretraining.receiver import FrameReceiver
from tests.helpers import STORED, deliver, free_endpoint, reason, wait_until
from tests.test_cli import call

COMMAND = [sys.executable, "-m", "deploy.cli"]
SMOKE = resolve("smoke")
PROBED = {
    "visibility_accuracy",
    "bearing_mae_deg",
    "distance_mae_m",
    "yaw_mae_deg",
    "reconstruction_mse",
    "mask_iou",
}


def navaclq(*arguments: object, **options: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=170, **options
    )


def said(done: subprocess.CompletedProcess) -> str:
    """The one sentence of wrong use."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr.strip().splitlines()[-1]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of preset smoke from nothing, and what it printed."""
    run = tmp_path_factory.mktemp("eyes") / "run"
    done = navaclq("pretrain", "--preset", "smoke", "--seed", 4, "--run", run, "--json")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    return run, json.loads(done.stdout)


@pytest.mark.timeout(180)
def test_whole_path_from_actors_to_an_examined_encoder(trained):
    run, result = trained
    manifest = json.loads((run / "frames" / "manifest.json").read_text())
    assert manifest["sequences"] >= 1000
    for shard in manifest["shards"]:
        content = (run / "frames" / shard["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == shard["sha256"]
    assert not (run / "spool").exists()
    assert not list(run.rglob("*.part"))
    assert (run / "tensorboard").is_dir()

    encoder = run / "encoder"
    assert result["encoder"] == str(encoder)
    assert files(encoder) == [
        "config.toml",
        "encoder.onnx",
        "encoder.safetensors",
        "heads.safetensors",
        "quality.json",
        "reconstruction.jpg",
    ]
    blob = (encoder / "encoder.safetensors").read_bytes()
    assert result["hash"] == hashlib.sha256(blob).hexdigest()[:16]
    assert json.loads((encoder / "quality.json").read_text()) == {
        key: value for key, value in result.items() if key != "encoder"
    }
    assert (result["objective"], result["sequences"], result["epochs"]) == ("semantic", 1000, 2)
    for name in ("encoder", "random", "pixels"):
        for place in ("training", "validation"):
            assert set(result["probes"][name][place]) == PROBED
    # sixteen times sixteen pixels tell more of the picture than the few features of a code
    pixels, codes = (result["probes"][name]["validation"] for name in ("pixels", "encoder"))
    assert pixels["reconstruction_mse"] < codes["reconstruction_mse"]
    assert set(result["decoder"]["validation"]) == {"reconstruction_mse", "mask_iou"}

    # a column of frames, reconstructions and masks for each of six sequences, two of them side by side
    picture = Image.open(encoder / "reconstruction.jpg")
    assert picture.size == (2 * (2 * 4 * 80 + 6), 2 * (9 * 80 + 2 * 6))


@pytest.mark.timeout(180)
def test_the_onnx_file_gives_the_codes_of_the_weights(trained):
    run, _ = trained
    _, encoder = read_encoder(run / "encoder")
    images = np.random.default_rng(0).random((5, 3, 80, 80), np.float32)
    session = onnxruntime.InferenceSession(str(run / "encoder" / "encoder.onnx"))
    codes = session.run(None, {"frames": images})[0]
    with torch.inference_mode():
        assert np.abs(codes - encoder(torch.from_numpy(images)).numpy()).max() < 1e-4
    assert codes.std() > 0


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_an_encoder_is_examined_to_the_same_figures_again(trained):
    run, result = trained
    done = navaclq("pretrain", "--evaluate", run / "encoder", "--json")
    assert done.returncode == 0, done.stderr
    again = json.loads(done.stdout)
    assert again["hash"] == result["hash"]
    for name, places in result["probes"].items():
        for place, figures in places.items():
            assert again["probes"][name][place] == pytest.approx(figures, rel=1e-3), (name, place)


@pytest.mark.timeout(180)
def test_training_drives_with_the_named_encoder_and_keeps_it(trained, tmp_path):
    run, result = trained
    named = tmp_path / "mine"
    shutil.copytree(run / "encoder", named)
    own = tmp_path / "trained"
    weights = ("--set", f"encoder.weights={named}", "--set", "actor.worlds=2")
    done = navaclq("train", "--preset", "smoke", "--run", own, "--minutes", "0.1", "--json", *weights)
    assert done.returncode == 0, done.stderr
    assert f"frozen encoder {named} ({result['hash']})" in done.stderr
    assert json.loads(done.stdout)["encoder"] == str(named)
    kept = (named / "encoder.safetensors").read_bytes()
    assert (own / "encoder.safetensors").read_bytes() == kept
    shutil.rmtree(named)  # the run does not need it any more
    assert RunDirectory(own).encoder == kept


@pytest.mark.timeout(180)
def test_an_encoder_of_another_shape_is_refused_before_anything_is_written(trained, tmp_path):
    run, _ = trained
    sentence = said(
        navaclq(
            *("train", "--preset", "smoke", "--run", tmp_path / "x", "--set", "encoder.channels=[4,4,4,4]"),
            *("--set", f"encoder.weights={run / 'encoder'}"),
        )
    )
    assert "encoder.channels = (8, 8, 8, 4)" in sentence
    assert "(4, 4, 4, 4)" in sentence
    assert not (tmp_path / "x" / "run.json").exists()
    with_other_camera = resolve(
        "smoke", overrides=(f"encoder.weights={run / 'encoder'}", "world.camera.fov=60")
    )
    with pytest.raises(Exception, match=r"world\.camera\.fov = 47"):
        frozen_encoder(with_other_camera)


@pytest.mark.timeout(180)
def test_a_damaged_shard_is_named_and_nothing_is_trained(trained, tmp_path):
    run, _ = trained
    frames = tmp_path / "frames"
    shutil.copytree(run / "frames", frames)
    shard = frames / "00000001.log"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    before = {path.name: path.read_bytes() for path in frames.iterdir()}
    sentence = said(navaclq("pretrain", "--preset", "smoke", "--run", tmp_path / "x", "--frames", frames))
    assert f"shard {shard} is damaged" in sentence
    assert {path.name: path.read_bytes() for path in frames.iterdir()} == before
    assert not (tmp_path / "x" / "encoder").exists()
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.timeout(180)
def test_a_full_disk_ends_it_with_one_sentence_and_keeps_what_is_there(tmp_path):
    run = tmp_path / "run"
    command = ("pretrain", "--preset", "smoke", "--run", run, "--actors", 1, "--sequences", 200)

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))

    sentence = said(navaclq(*command, preexec_fn=small_files))
    assert f"cannot write frames to {run / 'frames'}" in sentence
    assert "make room" in sentence
    assert not (run / "frames" / "manifest.json").exists()
    kept = FrameStore(run / "frames", resolve("smoke", overrides=("pretraining.sequences=200",)))
    assert 0 < kept.sequences < 60
    kept.close()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_sizes_of_encoders_are_compared_on_the_same_frames(trained):
    run, _ = trained
    done = navaclq(
        "bench", "encoder", "--preset", "smoke", "--frames", run / "frames", "--epochs", 1, "--json"
    )
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads(done.stdout)["rows"]}
    measures = ("code", "bearing_mae", "distance_mae", "yaw_mae", "visibility_accuracy", "per frame")
    sizes = [" ".join(map(str, channels)) for channels in SIZES]
    assert set(rows) == {f"{size}: {measure}" for size in sizes for measure in measures}
    assert [rows[f"{size}: code"]["value"] for size in sizes] == [25 * channels[-1] for channels in SIZES]
    assert rows[f"{sizes[0]}: per frame"]["value"] < rows[f"{sizes[-1]}: per frame"]["value"]


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_interrupted_training_leaves_an_encoder_and_goes_on(trained, tmp_path):
    run, _ = trained
    own = tmp_path / "own"
    command = ["pretrain", "--preset", "smoke", "--run", own, "--frames", run / "frames", "--epochs", "16"]
    first = subprocess.Popen(
        [*COMMAND, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_until((own / "checkpoint").exists, 60, "an epoch")
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=30)
    assert f"interrupted; {own / 'checkpoint'} is an encoder that can be used" in err
    assert "Traceback" not in err
    assert not (own / "encoder").exists()
    assert not list(own.rglob("*.part"))
    config, encoder = read_encoder(own / "checkpoint")
    assert config.pretraining.epochs == 16
    codes = encoder(torch.rand(2, 3, 80, 80))
    assert torch.isfinite(codes).all()
    done = json.loads((own / "checkpoint" / "state.json").read_text())["batches"]

    again = navaclq("pretrain", "--run", own, "--frames", run / "frames", "--json")
    assert again.returncode == 0, again.stderr
    table, held_out = FrameStore(run / "frames", SMOKE).load()
    batches = -(-int((~held_out).sum()) // SMOKE.pretraining.batch_size)
    total = json.loads((own / "checkpoint" / "state.json").read_text())["batches"]
    assert 0 < done < total == 16 * batches
    assert len(table) == 1000


def test_wrong_use_is_one_sentence(trained, tmp_path, monkeypatch, capsys):
    run, _ = trained
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("dear")
    smoke = ("pretrain", "--preset", "smoke", "--seed", 4)
    of_another_camera = ("--frames", run / "frames", "--set", "world.camera.fov=50")
    for arguments, words in (
        ((*smoke, "--run", tmp_path / "a", "--out", tmp_path / "home"), "exists and is no encoder's folder"),
        ((*smoke, "--run", tmp_path / "b", "--frames", tmp_path / "home"), "holds no frames"),
        ((*smoke, "--run", tmp_path / "c", *of_another_camera), "camera.fov"),
        (
            (*smoke, "--run", tmp_path / "d", "--sequences", 10**11),
            "sequences needs 2000000.0 GB",
        ),
        ((*smoke, "--run", tmp_path / "home"), "is not empty and no run directory"),
        ((*smoke, "--run", run, "--epochs", 3), "pretraining.epochs = 2, asked was 3"),
        (("pretrain", "--evaluate", tmp_path / "home"), "does not exist; choose"),
        (("bench", "encoder", "--frames", tmp_path / "e"), "e is no folder; `navaclq pretrain` makes one"),
        (("learner", "--run", run), f"{run} is the folder of a pretraining"),
    ):
        code, out, err = call(monkeypatch, capsys, *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert words in err
    assert files(tmp_path / "home") == ["thesis.tex"]
    assert not (tmp_path / "d" / "frames").exists()
    assert not (tmp_path / "e").exists()


def test_only_whole_drives_of_this_run_from_training_cells_are_taken(tmp_path):
    config = resolve("smoke", overrides=("pretraining.sequences=1000",))
    link, rng = make_link(free_endpoint()), np.random.default_rng(0)
    frame = rng.integers(0, 256, (2, 80, 80, 3), dtype=np.uint8)
    mask, goal = np.zeros((2, 800), np.uint8), np.ones((2, 3), np.float32)
    store = FrameStore(tmp_path / "frames", config)
    with open_hub(link) as hub, open_client(link) as session:
        receiver = FrameReceiver(hub, "eyes", store)
        contract = fetch_contract(session)
        assert (contract.job, contract.digest) == ("pretraining", digest(config, b""))
        good = Frames(
            digest=contract.digest,
            task=Task(cell=3, seed=1, start=config.world.start),
            frame=frame,
            mask=mask,
            goal=goal,
        )
        channel = Keys("eyes").frames
        assert deliver(session, channel, good, 0) == STORED
        assert (store.sequences, receiver._servers[0].duplicates) == (2, 0)
        assert deliver(session, channel, good, 0) == STORED
        assert (store.sequences, receiver._servers[0].duplicates) == (2, 1)
        arena = good.model_copy(update={"task": Task(cell=9, seed=1, start=config.world.start)})
        for message, words in (
            (arena, "cell 9 is an arena"),
            (good.model_copy(update={"digest": {**contract.digest, "dynamics": "x"}}), "'dynamics'"),
            (good.model_copy(update={"frame": frame[:, :40]}), "frame is uint8"),
            (good.model_copy(update={"frame": frame[:0], "mask": mask[:0], "goal": goal[:0]}), "drive of 0"),
        ):
            assert words in reason(deliver(session, channel, message, 1))
        receiver.close()
    assert (store.sequences, store.drives) == (2, 1)
    store.close()
    assert os.listdir(tmp_path / "frames")  # noqa: PTH208
