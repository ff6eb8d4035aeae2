"""Versioned weights on the wire: safetensors with a checksum that is verified before use."""

from __future__ import annotations

import hashlib

from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from common.messages import MessageError, Version, WeightsBlob


def pack(version: Version, tensors: dict[str, Tensor]) -> WeightsBlob:
    """Tensors as a message."""
    blob = save_tensors({key: value.detach().contiguous() for key, value in tensors.items()})
    return WeightsBlob(version=version, sha256=hashlib.sha256(blob).hexdigest(), blob=blob)


def unpack(message: WeightsBlob) -> dict[str, Tensor]:
    """The tensors; raises MessageError when the checksum or the format is wrong."""
    if hashlib.sha256(message.blob).hexdigest() != message.sha256:
        raise MessageError("weights are corrupted: the checksum does not match")
    try:
        return dict(load_tensors(message.blob))
    except Exception as error:  # safetensors raises its own class without exporting a common base
        raise MessageError(f"weights are not safetensors: {error}") from None
