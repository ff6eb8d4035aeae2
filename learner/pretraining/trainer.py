"""Training an encoder on frames: epochs of Adam, checkpoints to resume from, curves and pictures."""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.tensorboard import SummaryWriter

from common.config import Config
from common.encoders import ENCODER, HEADS
from common.errors import UsageError
from common.frames import FrameTable, in_parts
from common.networks import load_state, make_encoder, state_of
from common.policy_files import CONFIG, finish_saving, load_tensors, save_folder
from learner.optimizers import load_moments, moments_of
from learner.pretraining.figure import reconstruction_figure
from learner.pretraining.objectives import Batch, Losses, Pretraining, Sampler

CODE_RMS = 0.5
"""Root mean square of an exported encoder's codes: about that of LiDAR readings."""
TRAINING = "training.safetensors"
SAMPLE = 2048
"""Rows on which codes are measured and held-out losses taken."""


class Progress(NamedTuple):
    """Where a training stands; losses are means since the last report."""

    epoch: int
    """Counted from 1."""
    samples: int
    samples_per_s: float
    losses: dict[str, float]


class Trainer:
    """Trains on the rows of a table that are not held out; resumes from `folder/checkpoint`."""

    def __init__(self, config: Config, table: FrameTable, held_out: NDArray[np.bool_], folder: Path) -> None:
        self.config, self.table, self.folder = config, table, folder
        self.train_rows, self.held_rows = np.flatnonzero(~held_out), np.flatnonzero(held_out)
        if not (len(self.train_rows) and len(self.held_rows)):
            raise UsageError(
                f"{len(table)} sequences are too few to train on some drives and hold others out; "
                "raise pretraining.sequences"
            )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = Pretraining(config, make_encoder(config))
        self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        own = config.pretraining
        self._optimizer = torch.optim.Adam(self.model.parameters(), lr=own.learning_rate)
        self._sampler = Sampler(table, config.encoder.frames_per_code)
        self._batches = math.ceil(len(self.train_rows) / own.batch_size)
        """Of an epoch."""
        self.done = 0
        """Batches so far."""
        self._restore()

    @property
    def finished(self) -> bool:
        """Whether all epochs are done."""
        return self.done >= self._batches * self.config.pretraining.epochs

    def run(self, report: Callable[[Progress], None]) -> None:
        """Trains to the end, telling `report` about once a second; keeps a checkpoint when interrupted."""
        board = SummaryWriter(str(self.folder / "tensorboard"))
        try:
            while not self.finished:
                self._epoch(report, board)
                self.save()
        except (SystemExit, KeyboardInterrupt):
            self.save()
            raise
        finally:
            board.close()

    def _epoch(self, report: Callable[[Progress], None], board: SummaryWriter) -> None:
        own, epoch = self.config.pretraining, self.done // self._batches
        order = np.random.default_rng([self.config.seed, 6, epoch]).permutation(self.train_rows)
        since, samples, sums = time.monotonic(), 0, np.zeros(len(Losses._fields))
        while self.done // self._batches == epoch:
            first = self.done % self._batches * own.batch_size
            rows = order[first : first + own.batch_size]
            sums += len(rows) * self._step(rows)
            samples += len(rows)
            self.done += 1
            now = time.monotonic()
            if now - since >= 1.0 or self.done % self._batches == 0:
                seen = epoch * len(order) + min(first + own.batch_size, len(order))
                losses = dict(zip(Losses._fields, (sums / samples).tolist(), strict=True))
                report(Progress(epoch + 1, seen, samples / (now - since), losses))
                for name, value in losses.items():
                    board.add_scalar(f"losses/{name}", value, seen)
                since, samples, sums = now, 0, np.zeros_like(sums)
        for name, value in self.held_out_losses().items():
            board.add_scalar(f"held_out/{name}", value, seen)
        board.add_image("reconstruction", self.figure(4, scale=1), seen, dataformats="HWC")

    def _step(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        own = self.config.pretraining
        part = self.done / (self._batches * own.epochs)
        span = own.learning_rate - own.final_learning_rate
        for group in self._optimizer.param_groups:
            group["lr"] = own.final_learning_rate + span * (1 + math.cos(math.pi * part)) / 2
        batch = self._sampler(rows)
        if own.mirror:
            coins = np.random.default_rng([self.config.seed, 9, self.done]).random(len(rows)) < 0.5
            batch = batch.mirrored(torch.from_numpy(coins))
        losses = self._losses(batch)
        if not math.isfinite(losses.total.item()):
            raise ArithmeticError(f"the loss is not finite at batch {self.done}")
        self._optimizer.zero_grad()
        losses.total.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return np.array([loss.item() for loss in losses])

    def _losses(self, batch: Batch) -> Losses:
        batch = batch._replace(images=batch.images.contiguous(memory_format=torch.channels_last))
        low = self.config.pretraining.precision == "bfloat16"
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            losses: Losses = self.model.losses(batch)
        return losses

    def held_out_losses(self) -> dict[str, float]:
        """Mean losses on held-out drives, in the precision of the training."""
        rows = self.held_rows[:: max(1, len(self.held_rows) // SAMPLE)]
        parts = in_parts(rows)
        with torch.inference_mode():
            table = [[loss.item() for loss in self._losses(self._sampler(part))] for part in parts]
        means = np.average(table, axis=0, weights=[len(part) for part in parts])
        return dict(zip(Losses._fields, means.tolist(), strict=True))

    def figure(self, sequences: int, scale: int = 2) -> NDArray[np.uint8]:
        """Held-out sequences, evenly spaced over those that show the dolly, and their reconstructions."""
        rows = self.held_rows[self.table.visible[self.held_rows]]
        rows = rows if len(rows) else self.held_rows
        chosen = rows[np.linspace(0, len(rows) - 1, sequences + 2).astype(int)[1:-1]]
        return reconstruction_figure(self.model, self.table, chosen, scale=scale)

    def exported(self) -> Pretraining:
        """A copy whose encoder is rescaled to codes of CODE_RMS, as it is used."""
        model: Pretraining = copy.deepcopy(self.model)
        model.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        rows = self.train_rows[:: max(1, len(self.train_rows) // SAMPLE)]
        with torch.inference_mode():
            codes = torch.cat([model.encoder(self._sampler(part).images) for part in in_parts(rows)])
        rms = math.sqrt(codes.square().mean().item())
        if rms > 0:
            model.encoder.scale_codes(CODE_RMS / rms)
            model.unit.fill_(rms / CODE_RMS)
        return model

    def save(self) -> None:
        """Writes the checkpoint, which is an encoder's folder with all that training needs to go on."""
        model = self.exported()
        whole = state_of(model=self.model) | moments_of(self._optimizer)
        save_folder(
            self.folder / "checkpoint",
            {CONFIG: self.config.to_toml(), "state.json": json.dumps({"batches": self.done})},
            {
                ENCODER: state_of(encoder=model.encoder),
                HEADS: heads_state(model),
                TRAINING: whole,
            },
        )

    def _restore(self) -> None:
        folder = self.folder / "checkpoint"
        finish_saving(self.folder)
        if not folder.exists():
            return
        try:
            self.done = int(json.loads((folder / "state.json").read_text("utf-8"))["batches"])
            tensors = load_tensors(folder / TRAINING)
            load_state(tensors, model=self.model)
            load_moments(self._optimizer, tensors)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise UsageError(f"checkpoint {folder} does not fit: {error}; remove it to begin anew") from None


def heads_state(model: Pretraining) -> dict[str, torch.Tensor]:
    """What belongs to a model but not to its encoder."""
    return {k: v for k, v in state_of(model=model).items() if not k.startswith("model.encoder.")}
