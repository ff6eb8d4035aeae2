"""Encoders on disk, their codes' scale, their compiled form, and whether memory and disk suffice."""

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from common import encoders
from common.config import Config, differing_keys, resolve
from common.encoders import (
    ENCODER,
    MADE_BY,
    RANDOM,
    SHIPPED,
    SHIPPED_FOLDER,
    encoder_folder,
    frozen_encoder,
    pack_encoder,
    read_encoder,
)
from common.errors import UsageError
from common.files import content_hash
from common.networks import Encoder, compile_encoder, export_onnx, make_encoder, state_of
from common.policy_files import CONFIG, save_folder
from common.resources import check_disk, check_memory
from tests.helpers import small_config

NAMES = ", ".join(SHIPPED)
KINDS = [("light", 1), ("light", 4), ("residual", 1), ("residual", 4)]


pytestmark = pytest.mark.usefixtures("one_thread")


def settings(kind: str = "light", frames_per_code: int = 1, *more: str) -> Config:
    return small_config(f"encoder.kind={kind}", f"encoder.frames_per_code={frames_per_code}", *more)


def trained(config: Config, seed: int = 1) -> Encoder:
    """An encoder like one that has learned: its biases are not zero."""
    encoder = make_encoder(config.model_copy(update={"seed": seed}))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in encoder.modules():
            if isinstance(module, nn.Conv2d):
                module.bias.copy_(0.2 * torch.randn(module.bias.shape, generator=generator) + 0.1)
    return encoder


def saved(folder: Path, config: Config, encoder: Encoder | None = None) -> Path:
    """An encoder's folder as `navaclq pretrain` writes it, without the heads that nothing here reads."""
    weights = state_of(encoder=encoder or trained(config))
    save_folder(folder, {CONFIG: config.to_toml()}, {ENCODER: weights})
    return folder


def named(config: Config, weights: object) -> Config:
    """The configuration with another `encoder.weights`."""
    return config.model_copy(update={"encoder": config.encoder.model_copy(update={"weights": str(weights)})})


def same(a: Encoder, b: Encoder) -> bool:
    ours, theirs = a.state_dict(), b.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS)
def test_encoder_is_read_back_to_the_bit_with_its_configuration(tmp_path, kind, frames_per_code):
    config = settings(kind, frames_per_code)
    encoder = trained(config)
    made_with, found = read_encoder(saved(tmp_path / "mine", config, encoder))
    assert not differing_keys(made_with, config, MADE_BY)
    assert same(found, encoder)
    assert not same(found, make_encoder(config))


def test_random_is_the_seeded_initialisation():
    config = named(settings(), "random")
    assert same(frozen_encoder(config), make_encoder(config))
    other = config.model_copy(update={"seed": 9})
    assert not same(frozen_encoder(config), frozen_encoder(other))


def test_encoder_of_a_folder_is_the_one_in_it_whatever_the_seed(tmp_path):
    config = settings()
    folder = saved(tmp_path / "mine", config)
    asked = named(config, folder).model_copy(update={"seed": 77})
    assert same(frozen_encoder(asked), trained(config))
    assert resolve("smoke", overrides=(f"encoder.weights={folder}",)).encoder.weights == str(folder)


def test_names_of_shipped_encoders_are_those_of_the_package_whatever_lies_here(tmp_path, monkeypatch):
    config = settings()
    monkeypatch.setattr(encoders, "SHIPPED_FOLDER", tmp_path / "package")
    saved(tmp_path / "package" / "fast", config, trained(config, 1))
    saved(tmp_path / "here" / "fast", config, trained(config, 2))
    saved(tmp_path / "here" / "mine", config, trained(config, 3))
    monkeypatch.chdir(tmp_path / "here")
    assert encoder_folder("fast") == tmp_path / "package" / "fast"
    assert encoder_folder("mine") == Path("mine")
    assert same(frozen_encoder(named(config, "fast")), trained(config, 1))
    assert same(frozen_encoder(named(config, "./fast")), trained(config, 2))
    assert same(frozen_encoder(named(config, "mine")), trained(config, 3))
    with pytest.raises(UsageError, match="encoder 'theirs' does not exist"):
        encoder_folder("theirs")


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_encoder_fits_its_preset_and_is_what_its_figures_are_of(name):
    config = resolve(name)
    assert config.encoder.weights == name
    made_with, _ = read_encoder(encoder_folder(name))
    assert made_with.pretraining.objective == config.pretraining.objective
    blob = pack_encoder(frozen_encoder(config))
    folder = SHIPPED_FOLDER / name
    assert (folder / ENCODER).read_bytes() == blob
    quality = json.loads((folder / "quality.json").read_text())
    assert quality["hash"] == content_hash(blob) == hashlib.sha256(blob).hexdigest()[:16]
    assert (quality["sequences"], quality["epochs"]) == (50_000, made_with.pretraining.epochs)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 3 * 2**20


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_onnx_file_gives_the_codes_of_its_weights(name):
    config, encoder = read_encoder(encoder_folder(name))
    images = np.random.default_rng(0).random((4, 3 * config.encoder.frames_per_code, 80, 80), np.float32)
    session = onnxruntime.InferenceSession(str(SHIPPED_FOLDER / name / "encoder.onnx"))
    codes = session.run(None, {"frames": images})[0]
    with torch.inference_mode():
        expected = encoder(torch.from_numpy(images)).numpy()
    assert np.abs(codes - expected).max() < 1e-4
    assert expected.std() > 0.05


def test_smoke_and_end_to_end_begin_with_random_weights():
    assert resolve("smoke").encoder.weights == RANDOM
    assert all(resolve(name, variant="e2e").encoder.weights == RANDOM for name in SHIPPED)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_the_figures_of_a_shipped_encoder_are_found_again(name):
    done = subprocess.run(
        [sys.executable, "-m", "deploy.cli", "pretrain", "--evaluate", name, "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    found, kept = (
        json.loads(text) for text in (done.stdout, (SHIPPED_FOLDER / name / "quality.json").read_text())
    )
    for features, places in kept["probes"].items():
        for place, figures in places.items():
            assert found["probes"][features][place] == pytest.approx(figures, rel=0.02), (features, place)
    if name == "fast":
        arena = found["probes"]["encoder"]["validation"]
        assert arena["bearing_mae_deg"] <= 2.5
        assert arena["distance_mae_m"] <= 0.25
        assert arena["visibility_accuracy"] >= 0.95


@pytest.mark.parametrize("gone", [None, CONFIG, ENCODER])
def test_folder_that_is_missing_or_lacks_a_file_is_no_encoder(tmp_path, gone):
    folder = tmp_path / "mine"
    if gone:
        (saved(folder, settings()) / gone).unlink()
    with pytest.raises(UsageError, match=rf"mine' does not exist; choose {NAMES}, random, or the folder"):
        encoder_folder(str(folder))
    with pytest.raises(UsageError, match="mine' does not exist"):
        frozen_encoder(named(settings(), folder))


@pytest.mark.parametrize(
    ("made", "key"),
    [
        (("encoder.channels=[8, 8, 8, 6]",), r"encoder\.channels = \(8, 8, 8, 6\)"),
        (("encoder.kind=residual",), r"encoder\.kind = residual"),
        (("encoder.frames_per_code=4",), r"encoder\.frames_per_code = 4"),
        (("world.camera.size=32",), r"world\.camera\.size = 32"),
        (("world.camera.fov=60",), r"world\.camera\.fov = 60\.0"),
    ],
)
def test_encoder_that_was_made_for_another_input_or_code_is_refused_by_the_setting(tmp_path, made, key):
    folder = saved(tmp_path / "mine", small_config(*made))
    with pytest.raises(UsageError, match=rf"mine' has {key}, the configuration asks for .*pre-train one"):
        frozen_encoder(named(small_config(), folder))


def test_encoder_may_differ_in_all_that_does_not_concern_it(tmp_path):
    config = settings()
    folder = saved(tmp_path / "mine", config)
    other = small_config("sac.gamma=0.5", "world.start.yaw=45", "pretraining.epochs=3", "world.lidar.beams=4")
    assert same(frozen_encoder(named(other, folder)), trained(config))


def test_weights_of_another_shape_than_their_configuration_are_refused_by_name(tmp_path):
    folder = saved(tmp_path / "mine", settings())
    (folder / CONFIG).write_text(small_config("encoder.channels=[8, 8, 8, 6]").to_toml())
    with pytest.raises(
        UsageError, match=r"encoder\.safetensors is of another shape than its config\.toml.*blocks"
    ):
        read_encoder(folder)
    lacking = dict(list(state_of(encoder=trained(settings())).items())[1:])
    save_folder(folder, {CONFIG: settings().to_toml()}, {ENCODER: lacking})
    with pytest.raises(UsageError, match=r"another shape than its config\.toml says: tensor .* is missing"):
        read_encoder(folder)


@pytest.mark.parametrize("damage", [b"", b"[]", "cut", "head"])
def test_damaged_weights_are_a_usage_error_and_stay_as_they_are(tmp_path, damage):
    folder = saved(tmp_path / "mine", settings())
    whole = (folder / ENCODER).read_bytes()
    cuts = {"cut": whole[:-4], "head": whole[:20]}
    (folder / ENCODER).write_bytes(cuts[damage] if isinstance(damage, str) else damage)
    before = snapshot(folder)
    with pytest.raises(UsageError, match=r"mine/encoder\.safetensors is damaged"):
        frozen_encoder(named(settings(), folder))
    assert snapshot(folder) == before


def test_encoder_of_another_version_says_so(tmp_path):
    folder = saved(tmp_path / "mine", settings())
    text = settings().to_toml()
    (folder / CONFIG).write_text(text.replace("[encoder]\n", "[encoder]\nunheard_of = 1\n"))
    with pytest.raises(UsageError, match=r"mine was made by another version of navaclq: .*unheard_of"):
        read_encoder(folder)


def test_encoder_outlives_changes_of_settings_that_it_was_not_made_by(tmp_path):
    folder = saved(tmp_path / "mine", settings())
    text = settings().to_toml().replace("[learner]\n", "[learner]\nunheard_of = 1\n")
    (folder / CONFIG).write_text(text + "\n[unheard_of]\nx = 1\n")
    assert read_encoder(folder)[0].encoder == settings().encoder


def test_packed_encoder_is_the_file_and_its_hash_tells_encoders_apart(tmp_path):
    config = settings()
    folder = saved(tmp_path / "mine", config)
    packed = pack_encoder(read_encoder(folder)[1])
    assert packed == (folder / ENCODER).read_bytes()
    assert content_hash(packed) == hashlib.sha256(packed).hexdigest()[:16]
    assert content_hash(packed) != content_hash(pack_encoder(trained(config, 2)))


@pytest.mark.parametrize("factor", [0.25, 3.0])
@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS)
def test_scaled_encoder_gives_its_codes_times_the_factor(kind, frames_per_code, factor):
    config = settings(kind, frames_per_code)
    shape, generator = (5, 3 * frames_per_code, 32, 32), torch.Generator().manual_seed(0)
    encoder, images = trained(config), torch.rand(shape, generator=generator)
    with torch.no_grad():
        before = encoder(images)
        encoder.scale_codes(factor)
        after = encoder(images)
    assert (before > 0).float().mean() > 0.2
    torch.testing.assert_close(after, factor * before, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS)
def test_onnx_in_float32_equals_torch_within_a_ten_thousandth(kind, frames_per_code):
    config = settings(kind, frames_per_code)
    encoder = trained(config)
    compiled = compile_encoder(encoder, 16, np.float32)
    frames = np.random.default_rng(0).integers(0, 256, (7, frames_per_code, 16, 16, 3), dtype=np.uint8)
    channels = [frames[:, f, :, :, c] for f in range(frames_per_code) for c in range(3)]
    with torch.no_grad():
        expected = encoder(torch.from_numpy(np.stack(channels, axis=1) / np.float32(255))).numpy()
    codes = compiled(frames)
    assert codes.dtype == np.float32
    assert np.abs(codes - expected).max() < 1e-4
    assert expected.std() > 0.05
    half = compile_encoder(encoder, 16)(frames)
    assert half.dtype == np.float16
    assert np.array_equal(half, codes.astype(np.float16))


def test_onnx_graph_names_its_ends_and_takes_any_batch(tmp_path):
    file = tmp_path / "encoder.onnx"
    file.write_bytes(export_onnx(trained(settings("residual", 4)), 16))
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    (given,), (code,) = session.get_inputs(), session.get_outputs()
    assert (given.name, given.shape, given.type) == ("frames", ["batch", 12, 16, 16], "tensor(float)")
    assert (code.name, code.shape[0], code.type) == ("code", "batch", "tensor(float)")
    for batch in (1, 6):
        assert session.run(None, {"frames": np.zeros((batch, 12, 16, 16), np.float32)})[0].shape == (batch, 4)


def test_memory_and_disk_that_suffice_are_not_mentioned_and_those_that_do_not_are(tmp_path):
    check_memory("a table", 1e6, "take fewer")
    check_disk(tmp_path, "a folder", 0.0, "lower it")
    with pytest.raises(
        UsageError, match=r"^a table needs 1000000000\.0 GB of memory, [\d.]+ GB are free; cure$"
    ):
        check_memory("a table", 1e18, "cure")
    deep = tmp_path / "not" / "there"
    free = shutil.disk_usage(tmp_path).free
    check_disk(deep, "frames", free / 2, "lower it")
    with pytest.raises(
        UsageError, match=r"^frames needs [\d.]+ GB on the disk of .*there, .* are free; cure$"
    ):
        check_disk(deep, "frames", 2.0 * free, "cure")
    assert list(tmp_path.iterdir()) == []
