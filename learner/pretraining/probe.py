"""How much of a scene can be read from frozen features by linear maps alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from common.frames import FrameTable, in_parts
from common.networks import to_channels
from learner.pretraining.objectives import Pretraining, pose_targets

Features = Callable[[FrameTable], Tensor]
"""From N frames to (N, features) float32."""
COARSE = 20
"""Side of the picture and the mask that are read from features, pixels."""
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Penalties tried, relative to the number of frames; features have unit variance."""
CHECK = 5
"""One film in so many of the fitting set chooses among them."""


class Truth(NamedTuple):
    """What is to be read from the features of N frames."""

    visible: Tensor
    """(N,) float32."""
    pose: Tensor
    """(N, 4), see `pose_targets`."""
    yaw: Tensor
    """(N,) twice the relative yaw, rad."""
    picture: Tensor
    """(N, 3 COARSE^2) the frame, averaged over areas."""
    mask: Tensor
    """(N, COARSE^2) share of the dolly in each area."""

    @classmethod
    def of(cls, table: FrameTable) -> Truth:
        """The truth of every frame of a table."""
        pictures, masks = [], []
        for part in in_parts(table.rows):
            picture = to_channels(torch.from_numpy(table.stacks(part, 1)))
            mask = torch.from_numpy(table.masks(part)).float()[:, None]
            pictures.append(F.adaptive_avg_pool2d(picture, COARSE).flatten(1))
            masks.append(F.adaptive_avg_pool2d(mask, COARSE).flatten(1))
        return cls(
            torch.from_numpy(table.visible.astype(np.float32)),
            torch.from_numpy(pose_targets(table.goal)),
            torch.from_numpy(2 * table.goal[:, 2]),
            torch.cat(pictures),
            torch.cat(masks),
        )


class LinearProbe:
    """Linear readouts fitted on one set of frames: logistic for visibility, ridge regression for the rest."""

    def __init__(self, features: Features, table: FrameTable) -> None:
        self._features = features
        raw, truth = features(table), Truth.of(table)
        self._mean, self._scale = raw.mean(0), raw.std(0).clamp(min=1e-6)
        x = self._standard(raw)
        _, film = np.unique(table.start, return_inverse=True)
        check = torch.from_numpy(film % CHECK == 0)
        seen = truth.visible > 0
        self._visible = _logistic(x, truth.visible)
        self._pose = _ridge(x[seen], truth.pose[seen], check[seen])
        self._picture = _ridge(x, truth.picture, check)
        self._mask = _ridge(x, truth.mask, check)

    def _standard(self, raw: Tensor) -> Tensor:
        x = (raw - self._mean) / self._scale
        return torch.cat([x, torch.ones(len(x), 1)], dim=1)

    def examine(self, table: FrameTable) -> dict[str, float]:
        """Errors on other frames; those of the pose are mean absolute, over frames that show the dolly."""
        x, truth = self._standard(self._features(table)), Truth.of(table)
        seen = truth.visible > 0
        pose = x[seen] @ self._pose
        turn = torch.atan2(pose[:, 2], pose[:, 3]) - truth.yaw[seen]
        turn = torch.atan2(turn.sin(), turn.cos()).abs() / 2
        found, true = x @ self._mask > 0.5, truth.mask > 0.5
        return {
            "visibility_accuracy": float(((x @ self._visible > 0) == seen).float().mean()),
            "bearing_mae_deg": float((pose[:, 0] - truth.pose[seen, 0]).abs().mean().rad2deg()),
            "distance_mae_m": float((pose[:, 1] - truth.pose[seen, 1]).abs().mean()),
            "yaw_mae_deg": float(turn.mean().rad2deg()),
            "reconstruction_mse": float(F.mse_loss(x @ self._picture, truth.picture)),
            "mask_iou": float((found & true).sum() / (found | true).sum().clamp(min=1)),
        }


def code_features(
    encode: Callable[[NDArray[np.uint8]], NDArray[np.float16]], frames_per_code: int
) -> Features:
    """The code of the newest frame, or of the newest stack, as a policy would see it."""

    def features(table: FrameTable) -> Tensor:
        stacks = (table.stacks(part, frames_per_code) for part in in_parts(table.rows))
        return torch.cat([torch.from_numpy(encode(stack)) for stack in stacks]).float()

    return features


def pixel_features(side: int) -> Features:
    """The newest frame itself, averaged down to `side` pixels."""

    def features(table: FrameTable) -> Tensor:
        pictures = (to_channels(torch.from_numpy(table.stacks(part, 1))) for part in in_parts(table.rows))
        return torch.cat([F.adaptive_avg_pool2d(picture, side).flatten(1) for picture in pictures])

    return features


def decoder_quality(model: Pretraining, table: FrameTable) -> dict[str, float]:
    """What an encoder's own decoder makes of its codes: squared error of all pixels, and the mask's IoU."""
    squares, both, either = 0.0, 0, 0
    with torch.inference_mode():
        for part in in_parts(table.rows):
            images = to_channels(torch.from_numpy(table.stacks(part, model.encoder.frames_per_code)))
            decoded, logits, _ = model(images)
            squares += float(F.mse_loss(decoded, images)) * len(part)
            found, true = logits > 0, torch.from_numpy(table.masks(part)) > 0
            both, either = both + int((found & true).sum()), either + int((found | true).sum())
    quality = {"reconstruction_mse": squares / len(table)}
    return quality | {"mask_iou": both / max(either, 1)} if model.semantic else quality


def _ridge(x: Tensor, y: Tensor, check: Tensor) -> Tensor:
    """Weights (features + 1, targets) of least squares; the penalty is the one that does best on `check`."""

    def fit(rows: Tensor, penalty: float) -> Tensor:
        a, b = x[rows].double(), y[rows].double()
        gram = a.T @ a
        gram.diagonal()[:-1] += penalty * len(a)  # not on the constant, which is last
        solution: Tensor = torch.linalg.solve(gram, a.T @ b)
        return solution.float()

    errors = [F.mse_loss(x[check] @ fit(~check, penalty), y[check]).item() for penalty in RIDGES]
    return fit(torch.ones_like(check), RIDGES[int(np.argmin(errors))])


def _logistic(x: Tensor, y: Tensor) -> Tensor:
    """Weights (features + 1,) of a logistic regression with a slight penalty."""
    weights = torch.zeros(x.shape[1], requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = F.binary_cross_entropy_with_logits(x @ weights, y) + 1e-3 * weights[:-1].square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    return weights.detach()
