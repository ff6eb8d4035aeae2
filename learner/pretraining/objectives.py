"""What an encoder learns from: rebuilding its input (section 3.5), and telling where the dolly is (ours)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from common.config import Config, EncoderConfig
from common.frames import FrameTable
from common.networks import Encoder, to_channels

HEADS = 5
"""Visibility (logit), bearing (rad), distance (m), sine and cosine of twice the relative yaw."""

POSE_SCALES = (4.0, 1.0, 2.0, 2.0)
"""Factors of the heads but the first that bring what they tell to a standard deviation of about 1."""


class Batch(NamedTuple):
    """B samples."""

    images: Tensor
    """(B, 3 * frames_per_code, S, S) float32 in [0, 1]."""
    mask: Tensor
    """(B, S, S) float32, 1 where the newest frame shows the dolly."""
    visible: Tensor
    """(B,) float32, 1 where it shows enough of it."""
    pose: Tensor
    """(B, 4) float32: the targets of the heads but the first."""

    def mirrored(self, which: Tensor) -> Batch:
        """The same with the samples that `which` (B,) bool names seen in a mirror: left is right."""
        flips = torch.tensor([-1.0, 1.0, -1.0, 1.0])
        return Batch(
            torch.where(which[:, None, None, None], self.images.flip(-1), self.images),
            torch.where(which[:, None, None], self.mask.flip(-1), self.mask),
            self.visible,
            torch.where(which[:, None], self.pose * flips, self.pose),
        )


class Losses(NamedTuple):
    """Means over a batch; `total` is what is minimised."""

    total: Tensor
    pixels: Tensor
    """Squared error of the images, which are in [0, 1]."""
    mask: Tensor
    visible: Tensor
    pose: Tensor


def pose_targets(goal: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 3) bearing, distance, yaw -> (N, 4) targets; doubled yaw, for half a turn leaves a dolly alike."""
    double = 2 * goal[:, 2]
    return np.stack([goal[:, 0], goal[:, 1], np.sin(double), np.cos(double)], axis=1)


class UpBlock(nn.Module):
    """The mirror of a ConcatBlock: a 2x2 stride-2 and two 3x3 transposed convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, outputs, 2, stride=2)
        self.first = nn.ConvTranspose2d(outputs, outputs, 3, padding=1)
        self.second = nn.ConvTranspose2d(outputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, S, S) -> (B, outputs, 2 S, 2 S)."""
        return F.relu(self.second(F.relu(self.first(F.relu(self.up(x))))))


class LightUpBlock(nn.Module):
    """The mirror of a LightBlock: a residual 3x3 convolution and a 4x4 stride-2 transposed one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.residual = nn.Conv2d(inputs, inputs, 3, padding=1)
        self.up = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, S, S) -> (B, outputs, 2 S, 2 S)."""
        return F.relu(self.up(F.relu(x + self.residual(x))))


class Decoder(nn.Module):
    """The encoder's mirror image: codes to images, and in one more channel the logits of the dolly's mask."""

    def __init__(self, config: EncoderConfig, size: int, outputs: int) -> None:
        super().__init__()
        self._side = size // 16
        sizes = config.channels[::-1]
        if config.kind == "residual":
            blocks: list[nn.Module] = [UpBlock(a, b) for a, b in pairwise((*sizes, sizes[-1]))]
            last: nn.Module = nn.Conv2d(sizes[-1], outputs, 1)
        else:
            # a code has few channels; the decoder begins with as many as the block before the code had
            first = nn.Conv2d(sizes[0], sizes[1], 1)
            blocks = [first, *(LightUpBlock(a, b) for a, b in pairwise((sizes[1], *sizes[1:])))]
            last = nn.ConvTranspose2d(sizes[-1], outputs, 4, stride=2, padding=1)
        self.blocks = nn.Sequential(*blocks, last)

    def forward(self, codes: Tensor) -> Tensor:
        """(B, code) -> (B, outputs, S, S)."""
        images: Tensor = self.blocks(codes.reshape(len(codes), -1, self._side, self._side))
        return images


class Pretraining(nn.Module):
    """An encoder with what is trained around it and dropped afterwards."""

    unit: Tensor
    """Codes are multiplied by it before they are decoded: undoes what `scale_codes` did to the encoder."""

    def __init__(self, config: Config, encoder: Encoder) -> None:
        super().__init__()
        self.config = config.pretraining
        self.semantic = config.pretraining.objective == "semantic"
        self.encoder = encoder
        size, colors = config.world.camera.size, 3 * config.encoder.frames_per_code
        self.decoder = Decoder(config.encoder, size, colors + self.semantic)
        self.heads = nn.Linear((size // 16) ** 2 * config.encoder.channels[-1], HEADS)
        self.register_buffer("unit", torch.ones(()))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Images (B, C, S, S), mask logits (B, S, S) and heads (B, 5); zeros for what the objective lacks."""
        codes = self.encoder(images) * self.unit
        decoded = self.decoder(codes)
        colors = images.shape[1]
        if not self.semantic:
            return decoded, torch.zeros_like(decoded[:, 0]), codes.new_zeros(len(codes), HEADS)
        return decoded[:, :colors], decoded[:, colors], self.heads(codes)

    def losses(self, batch: Batch) -> Losses:
        """The paper's L2 over all pixels of all frames, and the weighted terms of `semantic`."""
        decoded, mask, heads = (part.float() for part in self(batch.images))
        pixels = F.mse_loss(decoded, batch.images)
        if not self.semantic:
            nothing = torch.zeros(())
            return Losses(pixels, pixels, nothing, nothing, nothing)
        config, seen = self.config, batch.visible
        of_mask = F.binary_cross_entropy_with_logits(mask, batch.mask)
        of_visible = F.binary_cross_entropy_with_logits(heads[:, 0], seen)
        scale = torch.tensor(POSE_SCALES)
        errors = F.smooth_l1_loss(heads[:, 1:] * scale, batch.pose * scale, reduction="none", beta=0.1).sum(1)
        of_pose = (errors * seen).sum() / seen.sum().clamp(min=1.0)
        total = pixels + config.mask_weight * of_mask + config.pose_weight * (of_visible + of_pose)
        return Losses(total, pixels, of_mask, of_visible, of_pose)


class Sampler:
    """Batches of a table."""

    def __init__(self, table: FrameTable, frames_per_code: int) -> None:
        self._table, self._count = table, frames_per_code
        self._visible = table.visible.astype(np.float32)
        self._pose = pose_targets(table.goal)

    def __call__(self, rows: NDArray[np.int64]) -> Batch:
        """The samples at `rows` (B,)."""
        return Batch(
            to_channels(torch.from_numpy(self._table.stacks(rows, self._count))),
            torch.from_numpy(self._table.masks(rows)).float(),
            torch.from_numpy(self._visible[rows]),
            torch.from_numpy(self._pose[rows]),
        )
