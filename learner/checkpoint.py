"""The run directory: its identity, and checkpoints that are whole or absent."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Literal

from torch import Tensor

from common.config import Config, differing_keys, parse
from common.encoders import ENCODER, frozen_encoder, pack_encoder
from common.errors import UsageError
from common.files import write_atomically
from common.policy_files import CONFIG, NETWORKS, load_tensors, save_folder
from learner.sac import SAC

RUN_SCHEMA = 2
"""Version of the run directory's layout."""


class RunDirectory:
    """`runs/NAME`: config.toml, run.json, encoder.safetensors, log/, checkpoints/, snapshots/, tensorboard/.

    A training keeps the encoder that it began with, whatever becomes of the one that its configuration names.
    """

    def __init__(
        self, folder: Path, config: Config | None = None, job: Literal["training", "pretraining"] = "training"
    ) -> None:
        """Opens a run, or with `config` starts one; raises UsageError when the folder is something else."""
        self.folder, self.name = folder, folder.resolve().name
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", self.name):
            raise UsageError(f"run name {self.name!r} may hold letters, digits, _, . and - only, at most 64")
        identity = folder / "run.json"
        self._job = job
        if identity.exists():
            self.config = self._open(identity, config)
        elif config is None:
            raise UsageError(f"{folder} is no run directory: it has no run.json")
        elif folder.exists() and any(p.name not in ("logs", "spool") for p in folder.iterdir()):
            raise UsageError(f"{folder} is not empty and no run directory; choose another --run")
        else:
            self.config = config
            encoder = pack_encoder(frozen_encoder(config)) if job == "training" else None
            folder.mkdir(parents=True, exist_ok=True)
            (folder / CONFIG).write_text(config.to_toml(), "utf-8")
            if encoder is not None:
                (folder / ENCODER).write_bytes(encoder)
            write_atomically(identity, json.dumps({"schema": RUN_SCHEMA, "job": job, "epoch": 0}).encode())

    @property
    def encoder(self) -> bytes:
        """Weights of the frozen encoder; raises UsageError when they are missing."""
        try:
            return (self.folder / ENCODER).read_bytes()
        except OSError as error:
            raise UsageError(f"cannot read {self.folder / ENCODER}: {error.strerror}") from None

    def _open(self, identity: Path, wanted: Config | None) -> Config:
        try:
            values = json.loads(identity.read_text("utf-8"))
            schema, job, _ = values["schema"], values.get("job"), int(values["epoch"])
            text = (self.folder / CONFIG).read_text("utf-8")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"run directory {self.folder} is damaged: {error!r}") from None
        if schema != RUN_SCHEMA:
            raise UsageError(
                f"{self.folder} was made by an incompatible version: "
                f"its run schema is {schema}, this version has {RUN_SCHEMA}"
            )
        if job != self._job:
            raise UsageError(f"{self.folder} is the folder of a {job}; choose another --run")
        config = parse(text)
        if wanted is not None and (found := differing_keys(wanted, config)):
            key, asked, has = found[0]
            raise UsageError(
                f"{self.folder} exists with {key} = {has}, asked was {asked}; "
                "resume it without that setting or choose another --run"
            )
        return config

    def next_epoch(self) -> int:
        """Counts one more start of the learner and remembers it; never runs backwards."""
        identity = self.folder / "run.json"
        values = json.loads(identity.read_text("utf-8"))
        values["epoch"] += 1
        write_atomically(identity, json.dumps(values).encode())
        return int(values["epoch"])

    def save(self, sac: SAC, frozen: dict[str, Tensor], env_steps: int) -> None:
        """A checkpoint of all that learns and of what is frozen; keeps the newest few."""
        networks, moments = sac.state()
        networks |= frozen
        state = {"updates": sac.updates, "env_steps": env_steps}
        folder = self.folder / "checkpoints" / f"{sac.updates:09d}"
        self._write(folder, {NETWORKS: networks, "optimizers.safetensors": moments}, state)
        for old in self.checkpoints()[: -self.config.learner.keep_checkpoints]:
            shutil.rmtree(old)

    def snapshot(self, name: str, networks: dict[str, Tensor], state: dict[str, int]) -> Path:
        """Keeps a policy for evaluation."""
        folder = self.folder / "snapshots" / name
        self._write(folder, {NETWORKS: networks}, state)
        return folder

    def checkpoints(self) -> list[Path]:
        """Whole checkpoints, oldest first."""
        return sorted(p for p in (self.folder / "checkpoints").glob("*") if p.suffix != ".part")

    def restore(self, sac: SAC) -> int:
        """Loads the newest checkpoint, if there is one; returns its update count, else 0."""
        checkpoints = self.checkpoints()
        if not checkpoints:
            return 0
        newest = checkpoints[-1]
        try:
            updates = int(json.loads((newest / "state.json").read_text("utf-8"))["updates"])
            sac.load(
                load_tensors(newest / NETWORKS), load_tensors(newest / "optimizers.safetensors"), updates
            )
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise UsageError(
                f"checkpoint {newest} does not fit: {error}; remove it to use an older one"
            ) from None
        return updates

    def _write(self, folder: Path, tensors: dict[str, dict[str, Tensor]], state: dict[str, int]) -> None:
        texts = {CONFIG: self.config.to_toml(), "state.json": json.dumps(state)}
        save_folder(folder, texts, tensors)
