"""Frames on disk: shards of checksummed records as they arrive, and a manifest once there are enough."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.config import Config, differing_keys
from common.delivery import Parcel
from common.errors import UsageError
from common.files import write_atomically
from common.frames import Film, FrameTable
from common.messages import Frames, Origin, decode
from common.policy_files import CONFIG, load_config
from common.resources import check_disk
from learner.log import EpisodeLog

log = logging.getLogger(__name__)
STORE_SCHEMA = 1
"""Version of the folder's layout."""
SHARD_BYTES = 64 * 2**20
HOLD_OUT = 10
"""One drive in so many, by the seed of its task, is never trained on."""
FIXED = ("world.", "pretraining.drive_steps", "pretraining.near_share", "curriculum.gate.ranges")
"""Settings that shape the frames: those of a folder never change."""
MADE_BY = ("world", "pretraining", "curriculum")
"""The sections of a configuration that they are in."""


class FrameStore:
    """`frames/`: config.toml, shards `*.log` of drives, and `manifest.json` when it is complete.

    Opens a folder or starts one. A shard that is missing is gathered anew; one that differs from the manifest
    is a UsageError, as are frames of another world and a disk with too little room.
    """

    def __init__(self, folder: Path, config: Config) -> None:
        self.folder, self.config = folder, config
        self.sequences = self.drives = 0
        self._manifest = folder / "manifest.json"
        self._check_config()
        self._check_shards()
        size = config.world.camera.size
        need = config.pretraining.sequences * size * size * 25 / 8
        need -= sum(path.stat().st_size for path in self._shards())
        check_disk(folder, "pretraining.sequences", need, "lower it or choose another --frames")
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / CONFIG).exists():
            write_atomically(folder / CONFIG, config.to_toml().encode())
        self._log = EpisodeLog(folder, 2**62, SHARD_BYTES)
        if not self.complete:
            self._manifest.unlink(missing_ok=True)  # it will not hold any longer
            self.sequences = self.drives = 0
            for record in self._log.restore():
                self._count(record.length)
            if self.complete:
                self.seal()

    @property
    def complete(self) -> bool:
        """Whether there are as many sequences as configured."""
        return self.sequences >= self.config.pretraining.sequences

    def seen(self, origin: Origin) -> bool:
        """Whether a drive is here already."""
        return self._log.seen.seen(origin)

    def add(self, parcel: Parcel, message: Frames) -> None:
        """Writes a drive that was not seen before, on record when this returns.

        Raises MessageError when it does not fit, and OSError when it cannot be written.
        """
        most = self.config.pretraining.drive_steps + 1
        message.check_layout(self.config.world.camera.size, most)
        self._log.append(parcel, len(message.frame))
        self._count(len(message.frame))

    def seal(self) -> None:
        """Closes the shards and writes the manifest."""
        self._log.close()
        shards = [{"file": path.name, "sha256": _sha256(path)} for path in self._shards()]
        manifest = {
            "schema": STORE_SCHEMA,
            "sequences": self.sequences,
            "drives": self.drives,
            "shards": shards,
        }
        write_atomically(self._manifest, json.dumps(manifest, indent=1).encode())

    def close(self) -> None:
        """Closes the current shard; what it holds is found again."""
        self._log.close()

    def load(self) -> tuple[FrameTable, NDArray[np.bool_]]:
        """The configured number of sequences in memory, and (N,) which of them are held out of training."""
        rows, size = self.config.pretraining.sequences, self.config.world.camera.size
        held: list[bool] = []

        def films() -> Iterator[Film]:
            for record in self._log.restore():
                message = decode(Frames, record.payload)
                held.extend([message.task.seed % HOLD_OUT == 0] * len(message.frame))
                yield Film(message.frame, message.mask, message.goal)
                if len(held) >= rows:
                    return

        table = FrameTable.of(films(), rows, size)
        return table, np.array(held[:rows])

    def _shards(self) -> list[Path]:
        return sorted(self.folder.glob("*.log"))

    def _count(self, frames: int) -> None:
        self.sequences += frames
        self.drives += 1

    def _check_config(self) -> None:
        if self.folder.is_file():
            raise UsageError(f"{self.folder} is a file; choose another --frames")
        if not (self.folder / CONFIG).exists():
            if self.folder.exists() and any(path.suffix != ".part" for path in self.folder.iterdir()):
                raise UsageError(f"{self.folder} is not empty and holds no frames; choose another --frames")
            return
        found = differing_keys(self.config, load_config(self.folder, MADE_BY), FIXED)
        if found:
            key, asked, has = found[0]
            raise UsageError(
                f"the frames in {self.folder} were made with {key} = {has}, asked was {asked}; "
                "choose another --frames"
            )

    def _check_shards(self) -> None:
        """Holds the shards against the manifest, if there is one."""
        if not self._manifest.exists():
            return
        try:
            manifest = json.loads(self._manifest.read_text("utf-8"))
            schema, sequences, drives = (int(manifest[key]) for key in ("schema", "sequences", "drives"))
            shards = {str(shard["file"]): str(shard["sha256"]) for shard in manifest["shards"]}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(
                f"{self._manifest} is damaged: {error!r}; remove it and the shards are read anew"
            ) from None
        if schema != STORE_SCHEMA:
            raise UsageError(f"{self._manifest} has schema {schema}, this version has {STORE_SCHEMA}")
        there = {path.name for path in self._shards()}
        for name in there & shards.keys():
            if _sha256(self.folder / name) != shards[name]:
                raise UsageError(
                    f"shard {self.folder / name} is damaged: its sha256 differs from the manifest's; "
                    "remove it, and what it held is gathered anew"
                )
        if there == shards.keys():
            self.sequences, self.drives = sequences, drives
        else:
            log.warning("%s: not the shards of its manifest; what they lack is gathered anew", self.folder)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
