"""A policy on disk: a folder with config.toml and networks.safetensors, written whole or not at all.

What the learner writes as checkpoint or snapshot and what evaluation reads.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from common.config import Config, parse
from common.errors import UsageError
from common.files import sync

CONFIG, NETWORKS = "config.toml", "networks.safetensors"


def save_folder(
    folder: Path, files: Mapping[str, str | bytes], tensors: dict[str, dict[str, Tensor]]
) -> None:
    """Writes files, of text or bytes, and files of tensors into a new folder by way of a temporary name.

    The disk has them when this returns. Raises OSError when it cannot.
    """
    part, old = _unfinished(folder)
    _finish(folder)
    part.mkdir(parents=True)
    for name, content in files.items():
        (part / name).write_bytes(content.encode() if isinstance(content, str) else content)
    for name, group in tensors.items():
        # safetensors refuses tensors that share memory, as those of a target network may
        own = {key: value.detach().clone().contiguous() for key, value in group.items()}
        try:
            save_file(own, part / name)
        except SafetensorError as error:
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1])), str(part / name)) from None
    for path in (*part.iterdir(), part):
        sync(path)
    if folder.exists():
        folder.rename(old)
    part.rename(folder)
    sync(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


def finish_saving(parent: Path) -> None:
    """Brings the folders in `parent` in order after a `save_folder` that was killed."""
    for left in [path for path in parent.glob("*.part") if path.is_dir()]:
        _finish(parent / left.name.removesuffix(".part").removesuffix(".old"))


def _unfinished(folder: Path) -> tuple[Path, Path]:
    """The names of what is being written, and of what it is about to replace."""
    return folder.with_name(folder.name + ".part"), folder.with_name(folder.name + ".old.part")


def _finish(folder: Path) -> None:
    part, old = _unfinished(folder)
    if old.exists() and not folder.exists():
        old.rename(folder)
    for left in (part, old):
        if left.exists():
            shutil.rmtree(left)


def load_tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a file; raises UsageError when it is missing or damaged."""
    try:
        return dict(load_file(file))
    except FileNotFoundError:
        raise UsageError(f"{file} does not exist") from None
    except (SafetensorError, OSError) as error:
        raise UsageError(f"{file} is damaged: {error}") from None


def load_config(folder: Path, sections: tuple[str, ...] = ()) -> Config:
    """The configuration in a folder; raises UsageError when it is damaged or of another version.

    With `sections` only those count, and all others have their defaults: what was made for one purpose
    outlives changes elsewhere.
    """
    try:
        return parse((folder / CONFIG).read_text("utf-8"), sections)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{folder / CONFIG} is damaged: {error}") from None
    except UsageError as error:
        raise UsageError(f"{folder} was made by another version of navaclq: {error}") from None


def load_policy(folder: Path) -> tuple[Config, dict[str, Tensor]]:
    """Configuration and networks; raises UsageError when `folder` is no policy, or a damaged one."""
    if not (folder / CONFIG).is_file():
        raise UsageError(
            f"{folder} is no policy: a checkpoint folder with {CONFIG} and {NETWORKS} is expected"
        )
    return load_config(folder), load_tensors(folder / NETWORKS)
