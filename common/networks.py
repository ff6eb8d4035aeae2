"""The networks: image encoder, sensor fusion, policy and critic (figures of network and ResNet blocks)."""

from __future__ import annotations

import math
from collections.abc import Callable
from io import BytesIO
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from common.config import Config, EncoderConfig, NetworkConfig
from common.observation import ACTION_SIZE, Observation, ObservationLayout

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


class ConcatBlock(nn.Module):
    """Two 3x3 convolutions, the identity concatenated, a 2x2 stride-2 convolution (appendix A)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.down = nn.Conv2d(outputs + inputs, outputs, 2, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, S, S) -> (B, outputs, S / 2, S / 2)."""
        y = F.relu(self.second(F.relu(self.first(x))))
        return F.relu(self.down(torch.cat([y, x], dim=1)))


LIGHT_CODE_SCALE = 0.1
"""Brings untrained codes, about 2, to the size of LiDAR readings, which they would otherwise outweigh."""


class LightBlock(nn.Module):
    """A 3x3 stride-2 convolution and a residual 3x3 convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.down = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1)
        self.residual = nn.Conv2d(outputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, S, S) -> (B, outputs, S / 2, S / 2)."""
        y = F.relu(self.down(x))
        return F.relu(y + self.residual(y))


class Encoder(nn.Module):
    """Images to codes: four halvings, flattened; a code has (size / 16)^2 * channels[-1] features."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        sizes = (3 * config.frames_per_code, *config.channels)
        blocks: list[nn.Module]
        if config.kind == "residual":
            blocks = [ConcatBlock(a, b) for a, b in pairwise(sizes)]
        else:
            stem = nn.Sequential(nn.Conv2d(sizes[0], sizes[1], 4, stride=2, padding=1), nn.ReLU())
            blocks = [stem, *(LightBlock(a, b) for a, b in pairwise(sizes[1:]))]
        self.blocks = nn.Sequential(*blocks)
        self.frames_per_code = config.frames_per_code
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        if isinstance(blocks[-1], LightBlock):
            self.scale_codes(LIGHT_CODE_SCALE)

    def forward(self, frames: Tensor) -> Tensor:
        """(B, 3 * frames_per_code, S, S) float32 in [0, 1] -> (B, code) float32."""
        maps: Tensor = self.blocks(frames)
        return maps.flatten(1)

    def scale_codes(self, factor: float) -> None:
        """Multiplies all codes by a positive factor, through the weights of the last block."""
        with torch.no_grad():
            for name, parameter in self.blocks[-1].named_parameters():
                if name in ("down.weight", "down.bias", "residual.bias"):  # ReLU lets the factor through
                    parameter.mul_(factor)

    def encode_stacks(self, frames: Tensor) -> Tensor:
        """(B, 4, S, S, 3) uint8 -> (B, codes * code) float32, for training end to end."""
        b, n, s = frames.shape[:3]
        grouped = frames.reshape(b * n // self.frames_per_code, self.frames_per_code, s, s, 3)
        return self.encode_groups(grouped).reshape(b, -1)

    def encode_groups(self, frames: Tensor) -> Tensor:
        """(B, frames_per_code, S, S, 3) uint8 -> (B, code) float32."""
        codes: Tensor = self(to_channels(frames))
        return codes


def to_channels(frames: Tensor) -> Tensor:
    """(B, F, S, S, 3) uint8 -> (B, 3 F, S, S) float32 in [0, 1]."""
    b, f, s = frames.shape[:3]
    return frames.permute(0, 1, 4, 2, 3).reshape(b, 3 * f, s, s).float() / 255.0


def make_encoder(config: Config) -> Encoder:
    """The encoder at its seeded initialisation."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return Encoder(config.encoder)


def export_onnx(encoder: Encoder, image_size: int) -> bytes:
    """The encoder as an ONNX graph: `frames` (B, 3 * frames_per_code, S, S) float32 to `code` (B, code)."""
    channels = 3 * encoder.frames_per_code
    graph = BytesIO()
    torch.onnx.export(
        encoder.eval(),
        (torch.zeros(1, channels, image_size, image_size),),
        graph,  # type: ignore[arg-type]  # a file is taken, though not declared
        dynamo=False,  # the other exporter needs onnxscript, for the same graph
        input_names=["frames"],
        output_names=["code"],
        dynamic_axes={"frames": {0: "batch"}, "code": {0: "batch"}},
    )
    return graph.getvalue()


def compile_encoder(
    encoder: Encoder, image_size: int, dtype: type[np.floating[Any]] = np.float16
) -> Callable[[NDArray[np.uint8]], NDArray[Any]]:
    """A frozen encoder as an ONNX Runtime function on one thread.

    Takes (B, frames_per_code, S, S, 3) uint8, returns the codes (B, code) in `dtype`.
    """
    import onnxruntime  # heavy, and only processes that encode need it

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        export_onnx(encoder, image_size), options, providers=["CPUExecutionProvider"]
    )

    def encode(frames: NDArray[np.uint8]) -> NDArray[Any]:
        images = to_channels(torch.from_numpy(frames)).numpy()
        codes: NDArray[np.float32] = session.run(None, {"frames": images})[0]
        return codes.astype(dtype)

    return encode


class ParallelLinear(nn.Module):
    """Linear layers of `members` networks side by side, of one input or of the concatenation of several.

    Weights lie (members, inputs, outputs) and apart for every input: products, and gradients, of all members
    are then one call, nothing is concatenated or transposed, and an input without a gradient costs none.
    """

    def __init__(self, members: int, inputs: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        bound = sum(inputs) ** -0.5  # torch.nn.Linear's
        shapes = [(members, size, outputs) for size in inputs]
        self.weights = nn.ParameterList(torch.empty(shape).uniform_(-bound, bound) for shape in shapes)
        self.bias = nn.Parameter(torch.empty(members, 1, outputs).uniform_(-bound, bound))

    def forward(self, *inputs: Tensor) -> Tensor:
        """(B, inputs) for all members or (members, B, inputs) each -> (members, B, outputs)."""
        return self._add(self.bias, inputs, list(self.weights))

    def begin(self, *inputs: Tensor) -> Tensor:
        """What the first inputs contribute, and the bias."""
        return self._add(self.bias, inputs, list(self.weights)[: len(inputs)])

    def extend(self, out: Tensor, *inputs: Tensor) -> Tensor:
        """Adds to `out`, which `begin` gave, what the last inputs contribute."""
        return self._add(out, inputs, list(self.weights)[-len(inputs) :] if inputs else [])

    @staticmethod
    def _add(out: Tensor, inputs: tuple[Tensor, ...], weights: list[nn.Parameter]) -> Tensor:
        for x, w in zip(inputs, weights, strict=True):
            out = torch.baddbmm(out, x if x.dim() == 3 else x.expand(len(w), -1, -1), w)
        return out


class ParallelNorm(nn.Module):
    """LayerNorm over the features of each member."""

    def __init__(self, members: int, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(members, 1, features))
        self.bias = nn.Parameter(torch.zeros(members, 1, features))

    def forward(self, x: Tensor) -> Tensor:
        """(members, B, features), the same shape."""
        return torch.addcmul(self.bias, F.layer_norm(x, x.shape[-1:]), self.weight)


def _activation(members: int, features: int, layer_norm: bool) -> list[nn.Module]:
    return [*([ParallelNorm(members, features)] if layer_norm else []), nn.ReLU(inplace=True)]


def _mlp(members: int, sizes: tuple[int, ...], layer_norm: bool = False) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in pairwise(sizes):
        layers += [ParallelLinear(members, (a,), b), *_activation(members, b, layer_norm)]
    return nn.Sequential(*layers)


class FusionNetwork(nn.Module):
    """Networks side by side: branches for LiDAR and history, fused with the code (and actions), a head."""

    def __init__(
        self,
        layout: ObservationLayout,
        config: NetworkConfig,
        members: int,
        extra: tuple[int, ...],
        outputs: int,
        layer_norm: bool,
    ) -> None:
        super().__init__()
        self._sizes = [layout.visual, layout.lidar, layout.history]
        self._branched = bool(config.lidar_branch or config.history_branch)
        lidar, history = (layout.lidar, *config.lidar_branch), (layout.history, *config.history_branch)
        self.lidar_branch = _mlp(members, lidar)
        self.history_branch = _mlp(members, history)
        fused = (layout.visual, lidar[-1], history[-1]) if self._branched else (layout.size,)
        first = config.hidden[0]
        self.fusion = ParallelLinear(members, (*fused, *extra), first)
        self.head = nn.Sequential(
            *_activation(members, first, layer_norm), *_mlp(members, config.hidden, layer_norm)
        )
        self.output = ParallelLinear(members, (config.hidden[-1],), outputs)

    def embed(self, flat: Tensor) -> Tensor:
        """(B, layout.size) -> (members, B, hidden): the first layer after fusion, without what is extra."""
        parts = [flat]
        if self._branched:
            visual, lidar, history = torch.split(flat, self._sizes, dim=-1)
            parts = [visual, self.lidar_branch(lidar), self.history_branch(history)]
        embedded: Tensor = self.fusion.begin(*parts)
        return embedded

    def finish(self, embedded: Tensor, *extra: Tensor) -> Tensor:
        """What `embed` gave, and (B, extra) if any -> (members, B, outputs)."""
        out: Tensor = self.output(self.head(self.fusion.extend(embedded, *extra)))
        return out

    def forward(self, flat: Tensor, *extra: Tensor) -> Tensor:
        """(B, layout.size), and (B, extra) if any -> (members, B, outputs)."""
        return self.finish(self.embed(flat), *extra)


class Policy(nn.Module):
    """Tanh-Gaussian policy (section 3.1): actions in [-1, 1]^2 are [v in m/s, w in rad/s]."""

    def __init__(self, layout: ObservationLayout, config: NetworkConfig) -> None:
        super().__init__()
        self.net = FusionNetwork(layout, config, 1, (), 2 * ACTION_SIZE, layer_norm=False)

    def forward(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        """(B, layout.size) -> mean and log standard deviation before the tanh, (B, 2) each."""
        mean, log_std = self.net(flat)[0].chunk(2, dim=-1)
        middle, half = (LOG_STD_MAX + LOG_STD_MIN) / 2, (LOG_STD_MAX - LOG_STD_MIN) / 2
        return mean, middle + half * torch.tanh(log_std)

    def mode(self, flat: Tensor) -> Tensor:
        """The greedy action tanh(mean), (B, 2)."""
        return torch.tanh(self(flat)[0])

    def sample(self, flat: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Reparameterised action (B, 2) for standard normal `noise` (B, 2), and its log density (B,)."""
        mean, log_std = self(flat)
        raw = torch.addcmul(mean, log_std.exp(), noise)
        log_gaussian = -0.5 * noise**2 - 0.5 * math.log(2 * math.pi) - log_std
        # log(1 - tanh(raw)^2), written so that it does not underflow
        log_jacobian = 2 * (math.log(2) - raw - F.softplus(-2 * raw))
        return torch.tanh(raw), (log_gaussian - log_jacobian).sum(-1)


class TwinCritic(nn.Module):
    """Two critics Q(s, a); they differ from the policy in the output layer and the action input only."""

    def __init__(self, layout: ObservationLayout, config: NetworkConfig) -> None:
        super().__init__()
        self.net = FusionNetwork(layout, config, 2, (ACTION_SIZE,), 1, config.layer_norm)

    def forward(self, flat: Tensor, action: Tensor) -> Tensor:
        """(B, layout.size), (B, 2) -> (2, B)."""
        return self.judge(self.net.embed(flat), action)

    def judge(self, embedded: Tensor, action: Tensor) -> Tensor:
        """What `net.embed` made of the observation, which actions can share, (B, 2) -> (2, B)."""
        return self.net.finish(embedded, action).squeeze(-1)


class Normalizer(nn.Module):
    """Running mean and variance of each feature, over all batches that it was shown."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def update(self, batch: Tensor) -> None:
        """Merges a batch (B, size) into the statistics (Chan et al. 1979)."""
        share = len(batch) / (self.count + len(batch))
        shift = batch.mean(0) - self.mean
        self.variance.lerp_(batch.var(0, correction=0) + (1 - share) * shift**2, share)
        self.mean += share * shift
        self.count += len(batch)

    def forward(self, x: Tensor) -> Tensor:
        """(B, size) -> (B, size), centred, scaled and cut at 5 standard deviations."""
        return ((x - self.mean) * (self.variance + 1e-4).rsqrt()).clamp(-5.0, 5.0)


class Perception(nn.Module):
    """From an observation to the vector [visual, lidar, actions, rewards] that policy and critics take.

    Holds whatever lies between what is stored and that vector: the encoder when it trains end to end, and the
    running normalisation, which leaves learned codes alone.
    """

    _like: Tensor
    """Empty; of the type, and on the device, that observations are brought to."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        layout = ObservationLayout.of(config)
        self.register_buffer("_like", torch.empty(0), persistent=False)
        self.encoder = make_encoder(config) if config.encoder.end_to_end else None
        stored = layout.size if self.encoder is None else layout.size - layout.visual
        self.normalizer = Normalizer(stored) if config.network.normalize else None

    def _stored(self, observation: Observation) -> Tensor:
        """The parts that are stored as they are, so that their scale can be known: all but learned codes."""
        parts = [observation.lidar, observation.history]
        if self.encoder is None:
            parts.insert(0, observation.visual)
        return torch.cat([torch.from_numpy(part).flatten(1) for part in parts], dim=1).to(self._like)

    def forward(self, observation: Observation) -> Tensor:
        """B observations -> (B, layout.size) float32."""
        stored = self._stored(observation)
        if self.normalizer is not None:
            stored = self.normalizer(stored)
        if self.encoder is None:
            return stored
        frames = torch.from_numpy(observation.visual).to(self._like.device)
        return torch.cat([self.encoder.encode_stacks(frames), stored], dim=1)

    def watch(self, observation: Observation) -> None:
        """Lets the running normalisation see a batch."""
        if self.normalizer is not None:
            with torch.no_grad():
                self.normalizer.update(self._stored(observation))


def initial_q(policy: Policy, critic: TwinCritic, flat: Tensor) -> NDArray[np.float64]:
    """Q(s0, a0) of start observations (B, layout.size): minimum of the twin critics at the greedy action."""
    with torch.no_grad():
        twins: Tensor = critic(flat, policy.mode(flat))
    least: NDArray[np.float64] = twins.amin(0).double().numpy()
    return least


def state_of(**modules: nn.Module) -> dict[str, Tensor]:
    """One flat dictionary of tensors, `name.parameter`."""
    return {
        f"{name}.{key}": value
        for name, module in modules.items()
        for key, value in module.state_dict().items()
    }


def load_state(tensors: dict[str, Any], **modules: nn.Module) -> None:
    """Loads what `state_of` made; raises ValueError naming the first tensor that does not fit."""
    for name, module in modules.items():
        own = module.state_dict()
        for key, value in own.items():
            given = tensors.get(f"{name}.{key}")
            if given is None or given.shape != value.shape:
                found = "missing" if given is None else f"of shape {tuple(given.shape)}"
                raise ValueError(f"tensor {name}.{key} is {found}, expected shape {tuple(value.shape)}")
        module.load_state_dict({key: tensors[f"{name}.{key}"] for key in own})
