"""Pre-training an encoder on this machine: gather frames, train, export, examine."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from actor.frames import PROBE_SETS, film_all, probe_tasks
from common.config import Config
from common.encoders import ENCODER, HEADS, pack_encoder, read_encoder
from common.errors import UsageError
from common.files import content_hash
from common.frames import FrameTable
from common.link import Link, open_hub
from common.networks import compile_encoder, export_onnx, load_state, make_encoder, state_of
from common.policy_files import CONFIG, load_tensors, save_folder
from common.signals import signals_held
from deploy.launcher import Child, Supervisor
from learner.pretraining.frame_store import FrameStore
from learner.pretraining.objectives import Pretraining
from learner.pretraining.probe import LinearProbe, code_features, decoder_quality, pixel_features
from learner.pretraining.receiver import FrameReceiver
from learner.pretraining.trainer import Trainer, heads_state

ONNX, QUALITY, FIGURE = "encoder.onnx", "quality.json", "reconstruction.jpg"
ONNX_GAP = 1e-4
"""Largest difference of a code by ONNX Runtime from the same by torch."""
PIXEL_SIDE = 16
"""Raw pictures are averaged down to so many pixels a side: 768 features, the paper's code has 800."""
FIGURE_SEQUENCES = 6
Report = Callable[[int], None]


def gather(
    store: FrameStore,
    folder: Path,
    name: str,
    actors: int,
    link: Link,
    progress: Report,
    say: Callable[[str], None],
) -> None:
    """Fills a store from actors on this machine, and any others that connect to `link`.

    Raises UsageError when the store cannot be written to; what it holds stays.
    """
    supervisor = Supervisor(say)
    spool = folder / "spool"
    here = str(link).replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
    try:
        for i in range(actors):
            actor = ["actor", "--connect", here, "--name", f"local-{i}", "--spool", str(spool), "--insecure"]
            supervisor.add(Child(f"local-{i}", lambda a=actor: a, folder / "logs" / f"local-{i}.log"))  # type: ignore[misc]
        with open_hub(link) as session:
            receiver = FrameReceiver(session, name, store)
            try:
                while not store.complete:
                    if receiver.failure:
                        raise UsageError(
                            f"cannot write frames to {store.folder}: {receiver.failure}; "
                            "what is there stays, so make room and repeat the command"
                        )
                    supervisor.check()
                    progress(store.sequences)
                    time.sleep(0.1)
            finally:
                receiver.close()
    finally:
        with signals_held():
            supervisor.stop()
        store.close()
    store.seal()
    shutil.rmtree(spool, ignore_errors=True)


def check_out(folder: Path) -> None:
    """Raises UsageError when exporting to `folder` would replace something else than an encoder."""
    if folder.exists() and not (folder / ENCODER).exists() and (folder.is_file() or any(folder.iterdir())):
        raise UsageError(f"--out {folder} exists and is no encoder's folder; choose another one")


def export(trainer: Trainer, out: Path, progress: Report) -> dict[str, Any]:
    """Writes a trained encoder with its figures to `out`, whole or not at all; returns the figures."""
    model, config = trainer.exported(), trainer.config
    onnx = export_onnx(model.encoder, config.world.camera.size)
    check_onnx(model, trainer.table)
    quality = examine(config, model, progress)
    picture = BytesIO()
    Image.fromarray(trainer.figure(FIGURE_SEQUENCES)).save(picture, "JPEG", quality=85)
    save_folder(
        out,
        {
            CONFIG: config.to_toml(),
            ONNX: onnx,
            QUALITY: json.dumps(quality, indent=1) + "\n",
            FIGURE: picture.getvalue(),
        },
        {ENCODER: state_of(encoder=model.encoder), HEADS: heads_state(model)},
    )
    return quality


def check_onnx(model: Pretraining, table: FrameTable) -> None:
    """Raises ArithmeticError when the compiled encoder gives other codes than the trained one."""
    rows = np.linspace(0, len(table) - 1, 64).astype(int)
    stacks = table.stacks(rows, model.encoder.frames_per_code)
    compiled = compile_encoder(model.encoder, table.frame.shape[1], np.float32)(stacks)
    with torch.inference_mode():
        gap = float(np.abs(compiled - model.encoder.encode_groups(torch.from_numpy(stacks)).numpy()).max())
    if gap > ONNX_GAP:
        raise ArithmeticError(f"the ONNX encoder's codes are off by {gap:.2g}; at most {ONNX_GAP} is allowed")


def read_model(folder: Path) -> tuple[Config, Pretraining]:
    """An exported encoder with its decoder and heads; raises UsageError when the files do not fit."""
    config, encoder = read_encoder(folder)
    model = Pretraining(config, encoder)
    try:
        load_state(state_of(**{"model.encoder": encoder}) | load_tensors(folder / HEADS), model=model)
    except ValueError as error:
        raise UsageError(f"{folder / HEADS} is of another shape than its {CONFIG} says: {error}") from None
    return config, model


def film_probes(config: Config, progress: Report) -> dict[str, FrameTable]:
    """The probe sets, filmed on all cores; `progress` hears the number of drives done."""
    tasks = {name: probe_tasks(name, config) for name in PROBE_SETS}
    films = iter(film_all([task for part in tasks.values() for task in part], config, progress))
    tables = {}
    for name, part in tasks.items():
        own = [next(films) for _ in part]
        tables[name] = FrameTable.of(own, sum(len(film.frame) for film in own), config.world.camera.size)
    return tables


def examine(config: Config, model: Pretraining, progress: Report) -> dict[str, Any]:
    """Linear probes of an encoder, of random weights and of raw pixels, and the quality of its decoder.

    On frames of fixed drives: fitted in the training cells, examined in other drives there and in the
    validation arena.
    """
    size, count = config.world.camera.size, config.encoder.frames_per_code
    tables = film_probes(config, progress)
    features = {
        "encoder": code_features(compile_encoder(model.encoder, size), count),
        "random": code_features(compile_encoder(make_encoder(config), size), count),
        "pixels": pixel_features(PIXEL_SIDE),
    }
    probes = {}
    for name, function in features.items():
        probe = LinearProbe(function, tables["fit"])
        probes[name] = {place: probe.examine(tables[place]) for place in ("training", "validation")}
    own = config.pretraining
    return {
        "hash": content_hash(pack_encoder(model.encoder)),
        "objective": own.objective,
        "sequences": own.sequences,
        "epochs": own.epochs,
        "frames": {name: len(table) for name, table in tables.items()},
        "visible": {name: float(table.visible.mean()) for name, table in tables.items()},
        "probes": probes,
        "decoder": {name: decoder_quality(model, tables[name]) for name in ("training", "validation")},
    }
