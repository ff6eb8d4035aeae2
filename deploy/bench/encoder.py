"""`bench encoder`: what a size of encoder can tell of a scene against what it costs.

Every size is pre-trained alike on the same frames and probed alike; the times of all are taken in the same
rounds, on one core, a batch of nine frames as an actor's worlds give.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from common.config import Config, override
from common.frames import FrameTable
from common.networks import compile_encoder
from common.observation import ObservationLayout
from deploy.bench.report import Report
from learner.pretraining.frame_store import FrameStore
from learner.pretraining.probe import LinearProbe, code_features
from learner.pretraining.trainer import Trainer

SIZES = (
    (8, 8, 16, 4),
    (16, 16, 32, 4),
    (16, 32, 32, 4),
    (16, 32, 64, 4),
    (16, 32, 64, 8),
    (24, 48, 96, 8),
)
"""Channels; the kind of blocks is the configuration's."""
ROUNDS = 200
COLUMNS = {"bearing_mae_deg": "deg", "distance_mae_m": "m", "yaw_mae_deg": "deg", "visibility_accuracy": "1"}


def bench_encoder(
    config: Config, store: FrameStore, tables: dict[str, FrameTable], progress: Callable[[int, str], None]
) -> Report:
    """Trains and measures each of SIZES; `tables` are the probe sets. `progress` hears how many are done."""
    table, held_out = store.load()
    report, encoders = Report("encoder"), {}
    for index, channels in enumerate(SIZES):
        name = " ".join(map(str, channels))
        sized = override(config.model_dump(mode="json"), (f"encoder.channels={list(channels)}",))
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(sized, table, held_out, Path(folder))
            trainer.run(lambda p, i=index, n=name: progress(i, f"{n}, epoch {p.epoch}"))  # type: ignore[misc]
        encoder = trainer.exported().encoder
        count = sized.encoder.frames_per_code
        encoders[name] = compile_encoder(encoder, sized.world.camera.size)
        probe = LinearProbe(code_features(encoders[name], count), tables["fit"]).examine(tables["validation"])
        report.add(f"{name}: code", ObservationLayout.of(sized).row_shape[0], "features")
        for key, unit in COLUMNS.items():
            report.add(f"{name}: {key.removesuffix(f'_{unit}')}", probe[key], unit)
    nine = table.stacks(np.arange(config.actor.worlds), config.encoder.frames_per_code)
    times: dict[str, list[float]] = {name: [] for name in encoders}
    for _ in range(ROUNDS):
        for name, encode in encoders.items():
            began = time.perf_counter()
            encode(nine)
            times[name].append((time.perf_counter() - began) / len(nine))
    for name, taken in times.items():
        report.add(f"{name}: per frame", 1000 * median(taken), "ms")
    progress(len(SIZES), "")
    return report
