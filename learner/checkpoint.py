"""The run directory: its identity, and checkpoints that are whole or absent."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

import torch
from torch import Tensor

from common.config import Config, differing_keys, parse
from common.encoders import ENCODER, frozen_encoder, pack_encoder
from common.errors import UsageError
from common.files import lock, sync, write_atomically
from common.messages import Version
from common.networks import Encoder, state_of
from common.policy_files import CONFIG, NETWORKS, finish_saving, load_tensors, save_folder
from learner.learner import Learner
from learner.sac import SAC

RUN_SCHEMA = 4
"""Version of the run directory's layout."""
OPTIMIZERS, PRIORITIES, STATE = "optimizers.safetensors", "priorities.safetensors", "state.json"
STARTING = "run.json.part"
"""There from the beginning of a start to its end: without run.json, that of a start which was interrupted."""
FROM_LAUNCHER = {"logs", "spool"}
FROM_START = {STARTING, CONFIG, ENCODER, "checkpoints"}
FIRST = Version()
"""Of the checkpoint with which a run begins that takes its weights from another."""


class RunDirectory:
    """`runs/NAME`: config.toml, run.json, encoder.safetensors, log/, checkpoints/, snapshots/, tensorboard/.

    A training keeps the encoder that it began with, whatever becomes of the one that its configuration names.
    """

    def __init__(
        self,
        folder: Path,
        config: Config | None = None,
        job: Literal["training", "pretraining"] = "training",
        source: Path | None = None,
    ) -> None:
        """Opens a run, or with `config` starts one, with the weights of the checkpoint `source` if given.

        Raises UsageError when the folder is something else, when there is nothing to start, or when the
        weights do not fit.
        """
        self.folder, self.name = folder, folder.resolve().name
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", self.name):
            raise UsageError(f"run name {self.name!r} may hold letters, digits, _, . and - only, at most 64")
        identity = folder / "run.json"
        self._job = job
        self._lock: IO[bytes] | None = None
        if identity.exists():
            if source is not None:
                raise UsageError(f"{folder} exists; to begin from {source} choose another --run")
            self.config = self._open(identity, config)
        elif config is None:
            raise UsageError(f"{folder} is no run directory: it has no run.json")
        elif not self._may_start():
            raise UsageError(f"{folder} is not empty and no run directory; choose another --run")
        else:
            self.config = config
            encoder = frozen_encoder(config) if job == "training" else None
            weights = _weights_for(config, encoder, source) if encoder and source else None
            with self._writing():
                folder.mkdir(parents=True, exist_ok=True)
                (folder / STARTING).touch()
                (folder / CONFIG).write_text(config.to_toml(), "utf-8")
                sync(folder / CONFIG)
                if encoder is not None:
                    (folder / ENCODER).write_bytes(pack_encoder(encoder))
                    sync(folder / ENCODER)
                shutil.rmtree(folder / "checkpoints", ignore_errors=True)  # of a start that was interrupted
                if weights is not None:
                    self._write(self._checkpoint(FIRST), {NETWORKS: weights}, {"from": str(source)})
                identity_values = {"schema": RUN_SCHEMA, "job": job, "epoch": 0}
                write_atomically(identity, json.dumps(identity_values).encode())

    def _may_start(self) -> bool:
        """Whether nothing of anybody else's is there."""
        names = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
        return names <= FROM_LAUNCHER | (FROM_START if STARTING in names else set())

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns an error of the disk, at the start, into wrong use."""
        try:
            yield
        except OSError as error:
            raise UsageError(f"cannot write to the run directory {self.folder}: {error.strerror}") from None

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

    @property
    def best_score(self) -> float:
        """Success of the best policy kept so far; -inf when there is none."""
        try:
            state = json.loads((self.folder / "snapshots" / "best" / STATE).read_text("utf-8"))
            score = float(state["success_random"])
        except (OSError, ValueError, KeyError, TypeError):
            return -math.inf
        return score if math.isfinite(score) else -math.inf

    def next_epoch(self) -> int:
        """Counts one more start of the learner, which may write from now on; never runs backwards.

        Raises UsageError when another learner has the folder.
        """
        identity = self.folder / "run.json"
        values = json.loads(identity.read_text("utf-8"))
        values["epoch"] += 1
        with self._writing():
            try:
                self._lock = self._lock or lock(self.folder / "lock")
            except BlockingIOError:
                raise UsageError(
                    f"another learner trains in {self.folder}; stop it first, or choose another --run"
                ) from None
            for name in ("checkpoints", "snapshots"):
                finish_saving(self.folder / name)
            write_atomically(identity, json.dumps(values).encode())
        return int(values["epoch"])

    def release(self) -> None:
        """Lets another learner have the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def save(self, learner: Learner, frozen: dict[str, Tensor], epoch: int, env_steps: int) -> None:
        """A checkpoint of all that learns and of what is frozen; keeps the newest few.

        Raises OSError when it cannot be written; those that were there stay whole.
        """
        tensors, state = learner.save()
        files = {
            NETWORKS: tensors["networks"] | frozen,
            OPTIMIZERS: tensors["optimizers"],
            PRIORITIES: tensors["priorities"],
        }
        folder = self._checkpoint(Version(epoch=epoch, counter=learner.sac.updates))
        self._write(folder, files, state | {"env_steps": env_steps})
        for old in self.checkpoints()[: -self.config.learner.keep_checkpoints]:
            shutil.rmtree(old)

    def snapshot(self, name: str, networks: dict[str, Tensor], state: dict[str, Any]) -> Path:
        """Keeps a policy for evaluation."""
        folder = self.folder / "snapshots" / name
        self._write(folder, {NETWORKS: networks}, state)
        return folder

    def checkpoints(self) -> list[Path]:
        """Whole checkpoints, oldest first."""
        return sorted(p for p in (self.folder / "checkpoints").glob("*") if p.suffix != ".part")

    def restore(self, learner: Learner) -> None:
        """Loads the newest checkpoint, if there is one, once the replay holds its episodes again."""
        for newest in self.checkpoints()[-1:]:
            try:
                state = json.loads((newest / STATE).read_text("utf-8"))
                networks = load_tensors(newest / NETWORKS)
                if "from" in state:
                    learner.sac.load_weights(networks)
                else:
                    moments, priorities = (load_tensors(newest / name) for name in (OPTIMIZERS, PRIORITIES))
                    tensors = {"networks": networks, "optimizers": moments, "priorities": priorities}
                    learner.load(tensors, state)
            except (OSError, ValueError, KeyError, TypeError, RuntimeError, UsageError) as error:
                raise UsageError(
                    f"checkpoint {newest} does not fit: {error}; remove it to use an older one"
                ) from None

    def _checkpoint(self, version: Version) -> Path:
        return self.folder / "checkpoints" / f"{version.epoch:05d}-{version.counter:09d}"

    def _write(self, folder: Path, tensors: dict[str, dict[str, Tensor]], state: dict[str, Any]) -> None:
        save_folder(folder, {CONFIG: self.config.to_toml(), STATE: json.dumps(state)}, tensors)


def _weights_for(config: Config, encoder: Encoder, source: Path) -> dict[str, Tensor]:
    """The networks of a checkpoint, or of a run's newest one.

    Raises UsageError when there are none, when they are of another shape than `config` asks for, and when
    another encoder made the codes that they read.
    """
    if (source / "run.json").exists():
        checkpoints = RunDirectory(source).checkpoints()
        if not checkpoints:
            raise UsageError(f"{source} has no checkpoint yet")
        source = checkpoints[-1]
    networks, sac = load_tensors(source / NETWORKS), SAC(config)
    try:
        sac.load_weights(networks)
        own = state_of(perception=sac.perception)
        for name in networks:  # load_weights passes over what it has no use for
            if name.startswith("perception.") and name not in own:
                raise ValueError(f"tensor {name} has no place in it")
    except ValueError as error:
        raise UsageError(f"{source} does not fit the configuration: {error}") from None
    frozen = {} if config.encoder.end_to_end else state_of(encoder=encoder)
    for name, tensor in frozen.items():
        if name not in networks or not torch.equal(networks[name], tensor):
            raise UsageError(
                f"{source} was trained with another encoder than {config.encoder.weights!r}; "
                "set encoder.weights to its folder"
            )
    return networks
