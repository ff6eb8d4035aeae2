"""Encoders on disk: those that are shipped, and those that `navaclq pretrain` makes.

An encoder's folder holds config.toml, encoder.safetensors and heads.safetensors (decoder and heads, which
only its figures need).
"""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load as parse_tensors
from safetensors.torch import save as save_tensors

from common.config import Config, differing_keys
from common.errors import UsageError
from common.networks import Encoder, load_state, make_encoder, state_of
from common.policy_files import CONFIG, load_config, load_tensors

ENCODER, HEADS = "encoder.safetensors", "heads.safetensors"
SHIPPED_FOLDER = Path(__file__).parent / "encoders"
SHIPPED = ("fast", "paper")
RANDOM = "random"
AGREED = ("encoder.kind", "encoder.frames_per_code", "encoder.channels", "world.camera")
"""What a configuration must share with the encoder that it names."""
MADE_BY = ("seed", "preset", "world", "encoder", "pretraining")
"""The sections of a configuration that an encoder was made by."""


def encoder_folder(name: str) -> Path:
    """The folder of a shipped encoder, or of one made here; raises UsageError when it holds none."""
    folder = SHIPPED_FOLDER / name if name in SHIPPED else Path(name)
    if not (folder / CONFIG).is_file() or not (folder / ENCODER).is_file():
        raise UsageError(
            f"encoder {name!r} does not exist; choose {', '.join(SHIPPED)}, {RANDOM}, or the folder of one "
            "that `navaclq pretrain` made"
        )
    return folder


def read_encoder(folder: Path) -> tuple[Config, Encoder]:
    """An encoder with the configuration it was made with; raises UsageError when the files do not fit."""
    config = load_config(folder, MADE_BY)
    encoder = make_encoder(config)
    try:
        load_state(load_tensors(folder / ENCODER), encoder=encoder)
    except ValueError as error:
        raise UsageError(f"{folder / ENCODER} is of another shape than its {CONFIG} says: {error}") from None
    return config, encoder


def frozen_encoder(config: Config) -> Encoder:
    """The encoder that `encoder.weights` names; raises UsageError when it is none, or another one's."""
    name = config.encoder.weights
    if name == RANDOM:
        return make_encoder(config)
    made_with, encoder = read_encoder(encoder_folder(name))
    found = differing_keys(config, made_with, AGREED)
    if found:
        key, asked, has = found[0]
        raise UsageError(
            f"encoder {name!r} has {key} = {has}, the configuration asks for {asked}; pre-train one "
            f"(navaclq pretrain) or set encoder.weights={RANDOM}"
        )
    return encoder


def pack_encoder(encoder: Encoder) -> bytes:
    """The weights as safetensors: the same bytes as in the file."""
    return save_tensors(state_of(encoder=encoder))


def unpack_encoder(weights: bytes, config: Config) -> Encoder:
    """The encoder of packed weights; raises UsageError when they do not fit `config`."""
    encoder = make_encoder(config)
    try:
        load_state(parse_tensors(weights), encoder=encoder)
    except Exception as error:  # safetensors raises its own class without exporting a common base
        raise UsageError(f"the run's encoder does not fit: {error}") from None
    return encoder
