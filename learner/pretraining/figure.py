"""The reconstruction figure: ground truth above, what the codes keep of it below (the paper's figure)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from common.frames import FrameTable
from common.networks import to_channels
from common.observation import HISTORY
from learner.pretraining.objectives import Pretraining

GAP = 6
"""White pixels between sequences."""


def reconstruction_figure(
    model: Pretraining, table: FrameTable, rows: NDArray[np.int64], columns: int = 2, scale: int = 2
) -> NDArray[np.uint8]:
    """The sequences that end at `rows`, side by side: frames, reconstructions and, if learned, the masks.

    (H, W, 3); every pixel is `scale` pixels wide.
    """
    stacks = table.stacks(rows, HISTORY)
    blocks = []
    with torch.inference_mode():
        for stack in stacks:
            groups = stack.reshape(-1, model.encoder.frames_per_code, *stack.shape[1:])
            decoded, logits, _ = model(to_channels(torch.from_numpy(groups)))
            frames = decoded.unflatten(1, (-1, 3)).flatten(0, 1).permute(0, 2, 3, 1)
            lines = [stack, (255 * frames.clamp(0, 1)).round().byte().numpy()]
            if model.semantic:
                masks = np.zeros(stack.shape, np.uint8)  # black where a code has but one mask for its frames
                each = model.encoder.frames_per_code
                masks[each - 1 :: each] = (255 * torch.sigmoid(logits)).round().byte().numpy()[..., None]
                lines.append(masks)
            block = np.concatenate([np.concatenate(list(line), axis=1) for line in lines])
            blocks.append(np.pad(block, ((0, GAP), (0, GAP), (0, 0)), constant_values=255))
    blocks += [np.full_like(blocks[0], 255)] * (-len(blocks) % columns)
    lines = [np.concatenate(blocks[i : i + columns], axis=1) for i in range(0, len(blocks), columns)]
    sheet = np.concatenate(lines)[:-GAP, :-GAP]
    return np.repeat(np.repeat(sheet, scale, axis=0), scale, axis=1)
