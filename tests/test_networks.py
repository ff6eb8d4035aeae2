import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from common.config import Config, resolve
from common.networks import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    Encoder,
    FusionNetwork,
    Normalizer,
    ParallelLinear,
    ParallelNorm,
    Perception,
    Policy,
    TwinCritic,
    compile_encoder,
    initial_q,
    load_state,
    make_encoder,
    state_of,
)
from common.observation import Columns, Observation, ObservationLayout, observe

PRESETS = ("paper", "fast", "smoke")


def policy_with(mean: list[float], log_std: list[float]) -> tuple[Policy, torch.Tensor]:
    """A policy whose distribution is the same everywhere, and an observation for it."""
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    policy = Policy(layout, config.network)
    squashed = [(x - LOG_STD_MIN) / (LOG_STD_MAX - LOG_STD_MIN) * 2 - 1 for x in log_std]
    with torch.no_grad():
        policy.net.output.weights[0].zero_()
        policy.net.output.bias[0, 0] = torch.tensor([*mean, *map(math.atanh, squashed)])
    return policy, torch.zeros(1, layout.size)


def linear_sizes(module: nn.Module, members: int) -> list[tuple[tuple[int, ...], int]]:
    """Inputs and outputs of every linear layer, each of which must have so many members."""
    sizes = []
    for layer in module.modules():
        assert not isinstance(layer, nn.Linear)
        if isinstance(layer, ParallelLinear):
            shapes = [tuple(weight.shape) for weight in layer.weights]
            outputs = layer.bias.shape[2]
            assert layer.bias.shape == (members, 1, outputs)
            assert all(shape == (members, shape[1], outputs) for shape in shapes)
            sizes.append((tuple(shape[1] for shape in shapes), outputs))
    return sizes


def norms(*modules: nn.Module) -> list[ParallelNorm]:
    """The normalisations of features; nn.LayerNorm is none of them."""
    found = [m for module in modules for m in module.modules()]
    assert not any(isinstance(m, nn.LayerNorm) for m in found)
    return [m for m in found if isinstance(m, ParallelNorm)]


def randomize(module: nn.Module, seed: int = 0) -> None:
    """Gives every parameter, also those that begin as zeros or ones, values of its own."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)


def linear(layer: ParallelLinear, member: int, x: Tensor) -> Tensor:
    """What one member does, on the concatenation of its inputs, by torch's own function."""
    weight = torch.cat([part[member] for part in layer.weights])
    return F.linear(x, weight.T, layer.bias[member, 0])


def chain(layers: nn.Sequential, member: int, x: Tensor) -> Tensor:
    """One member of layers in a row, by torch's own functions."""
    for layer in layers:
        if isinstance(layer, ParallelLinear):
            x = linear(layer, member, x)
        elif isinstance(layer, ParallelNorm):
            x = F.layer_norm(x, x.shape[-1:], layer.weight[member, 0], layer.bias[member, 0])
        else:
            assert isinstance(layer, nn.ReLU)
            x = x.clamp(min=0)
    return x


def test_paper_encoder_gives_5_by_5_by_32_features_for_a_stack_of_80_by_80():
    encoder = make_encoder(resolve("paper"))
    frames = torch.rand(2, 12, 80, 80)
    assert encoder.blocks(frames).shape == (2, 32, 5, 5)
    assert encoder(frames).shape == (2, 800)


def test_paper_encoder_has_four_blocks_with_the_identity_concatenated():
    encoder = make_encoder(resolve("paper"))
    kernels = [
        (m.in_channels, m.out_channels, m.kernel_size, m.stride)
        for m in encoder.modules()
        if isinstance(m, nn.Conv2d)
    ]
    expected = []
    for a, b in ((12, 16), (16, 16), (16, 32), (32, 32)):
        expected += [(a, b, (3, 3), (1, 1)), (b, b, (3, 3), (1, 1)), (a + b, b, (2, 2), (2, 2))]
    assert kernels == expected


@pytest.mark.parametrize("preset", PRESETS)
def test_encoder_gives_the_code_that_the_layout_promises(preset):
    config = resolve(preset)
    layout = ObservationLayout.of(config)
    code = make_encoder(config)(torch.rand(1, 3 * config.encoder.frames_per_code, 80, 80))
    assert code.shape == (1, *layout.row_shape)
    assert layout.stack * code.shape[1] == layout.visual


def test_encoder_starts_from_the_seed_and_leaves_the_global_generator_alone():
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    a, b = make_encoder(resolve(seed=3)), make_encoder(resolve(seed=3))
    other = make_encoder(resolve(seed=4))
    assert torch.equal(torch.random.get_rng_state(), before)
    for key, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[key])
    assert not torch.equal(a.state_dict()["blocks.0.0.weight"], other.state_dict()["blocks.0.0.weight"])


@pytest.mark.parametrize("preset", PRESETS)
def test_compiled_encoder_equals_torch_within_float16_for_any_batch(preset):
    config = resolve(preset)
    encoder, frames_per_code = make_encoder(config), config.encoder.frames_per_code
    compiled = compile_encoder(encoder, 80)
    rng = np.random.default_rng(0)
    for batch in (1, 5):
        frames = rng.integers(0, 256, (batch, frames_per_code, 80, 80, 3), dtype=np.uint8)
        channels = [frames[:, f, :, :, c] for f in range(frames_per_code) for c in range(3)]
        scaled = torch.from_numpy(np.stack(channels, axis=1).astype(np.float32) / 255)
        with torch.no_grad():
            expected = encoder(scaled).numpy()
        codes = compiled(frames)
        assert codes.dtype == np.float16
        np.testing.assert_allclose(codes, expected, rtol=1e-3, atol=1e-4)
        assert expected.std() > 0.01


def test_codes_do_not_depend_on_the_batch_they_are_computed_in():
    config = resolve("fast")
    compiled = compile_encoder(make_encoder(config), 80)
    frames = np.random.default_rng(1).integers(0, 256, (6, 1, 80, 80, 3), dtype=np.uint8)
    together = compiled(frames)
    alone = np.concatenate([compiled(frames[i : i + 1]) for i in range(6)])
    np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("frames_per_code", [1, 4])
def test_stacks_encoded_end_to_end_equal_the_codes_of_their_frames(frames_per_code):
    config = resolve("smoke", overrides=(f"encoder.frames_per_code={frames_per_code}",))
    encoder, compiled = make_encoder(config), compile_encoder(make_encoder(config), 80)
    stacks = np.random.default_rng(2).integers(0, 256, (3, 4, 80, 80, 3), dtype=np.uint8)
    with torch.no_grad():
        codes = encoder.encode_stacks(torch.from_numpy(stacks)).numpy()
    assert codes.shape == (3, ObservationLayout.of(config).visual)
    for b in range(3):
        parts = compiled(stacks[b].reshape(-1, frames_per_code, 80, 80, 3)).reshape(-1)
        np.testing.assert_allclose(codes[b], parts, rtol=1e-3, atol=1e-4)


def random_observation(config: Config, batch: int, seed: int = 0) -> Observation:
    """A batch of observations of random rows."""
    layout, rng = ObservationLayout.of(config), np.random.default_rng(seed)
    columns = Columns.empty(batch, layout)
    high = 256 if layout.row_dtype == "uint8" else 3
    columns.visual[:] = rng.uniform(0, high, columns.visual.shape)
    columns.lidar[:] = rng.uniform(0, 1, columns.lidar.shape)
    columns.action[:] = rng.uniform(-1, 1, columns.action.shape)
    columns.reward[:] = rng.uniform(-1, 0, columns.reward.shape)
    return observe(columns, np.arange(batch), np.zeros(batch, np.int64), layout)


def test_plain_perception_is_visual_then_lidar_then_history():
    config = resolve("smoke", overrides=("network.normalize=false",))
    layout = ObservationLayout.of(config)
    columns = Columns.empty(4, layout)
    columns.visual[:] = np.arange(4)[:, None]
    columns.lidar[:], columns.action[:], columns.reward[:] = 0.5, 0.25, -1
    flat = Perception(config)(observe(columns, np.array([3]), np.array([0]), layout))
    assert flat.dtype == torch.float32
    visual, lidar, history = flat[0].split([layout.visual, layout.lidar, layout.history])
    assert visual.reshape(4, -1)[:, 0].tolist() == [0, 1, 2, 3]
    assert (lidar == 0.5).all()
    assert history.tolist() == [0, 0, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0, -1, -1, -1]


def test_perception_of_the_paper_changes_nothing():
    config = resolve("paper")
    seen = random_observation(config, 2)
    parts = [seen.visual.reshape(2, -1), seen.lidar, seen.history]
    expected = np.concatenate([part.astype(np.float32) for part in parts], axis=1)
    np.testing.assert_array_equal(Perception(config)(seen).numpy(), expected)


def test_watched_batches_are_what_perception_normalises_by():
    config = resolve("smoke", overrides=("network.normalize=true",))
    plain = Perception(resolve("smoke", overrides=("network.normalize=false",)))
    perception, batches = Perception(config), [random_observation(config, n, n) for n in (30, 7, 60)]
    for batch in batches:
        perception.watch(batch)
    flat = torch.cat([plain(batch) for batch in batches])
    found = torch.cat([perception(batch) for batch in batches])
    expected = (flat - flat.mean(0)) / (flat.var(0, correction=0) + 1e-4).sqrt()
    torch.testing.assert_close(found, expected.clamp(-5, 5), rtol=1e-3, atol=1e-3)


def test_running_statistics_equal_those_of_all_batches_together():
    rng = torch.Generator().manual_seed(0)
    batches = [torch.randn(n, 3, generator=rng) * torch.tensor([1.0, 5.0, 0.1]) + n for n in (1, 16, 2, 40)]
    normalizer = Normalizer(3)
    for batch in batches:
        normalizer.update(batch)
    together = torch.cat(batches)
    torch.testing.assert_close(normalizer.mean, together.mean(0))
    torch.testing.assert_close(normalizer.variance, together.var(0, correction=0))
    assert normalizer.count.item() == 59


def test_outliers_and_constant_features_stay_bounded():
    normalizer = Normalizer(2)
    normalizer.update(torch.tensor([[0.0, 7.0], [1.0, 7.0]]))
    found = normalizer(torch.tensor([[1e6, 7.0], [-1e6, 7.01]]))
    assert found[:, 0].tolist() == [5.0, -5.0]
    assert found[:, 1].tolist() == pytest.approx([0.0, 1.0], abs=1e-3)


def test_statistics_travel_with_the_state():
    config = resolve("smoke", overrides=("network.normalize=true",))
    source, target, seen = Perception(config), Perception(config), random_observation(config, 9)
    source.watch(seen)
    assert not torch.equal(source(seen), target(seen))
    load_state(state_of(perception=source), perception=target)
    assert torch.equal(source(seen), target(seen))


def test_perception_end_to_end_passes_gradients_to_its_encoder_and_leaves_its_codes_alone():
    config = resolve("smoke", variant="e2e")
    layout, perception, seen = ObservationLayout.of(config), Perception(config), random_observation(config, 3)
    perception.watch(seen)
    flat = perception(seen)
    assert flat.shape == (3, layout.size)
    assert perception.encoder is not None
    codes = perception.encoder.encode_stacks(torch.from_numpy(seen.visual))
    torch.testing.assert_close(flat[:, : layout.visual], codes)
    flat.sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in perception.encoder.parameters())


def test_paper_networks_have_the_papers_branches_and_differ_in_the_output_layer_only():
    config = resolve("paper")
    layout = ObservationLayout.of(config)
    policy, critic = Policy(layout, config.network), TwinCritic(layout, config.network)
    for net, members in ((policy.net, 1), (critic.net, 2)):
        assert linear_sizes(net.lidar_branch, members) == [((256,), 64), ((64,), 32)]
        assert linear_sizes(net.history_branch, members) == [((12,), 8)]
        assert linear_sizes(net.head, members) == [((256,), 256)]
    assert linear_sizes(policy.net.fusion, 1) == [((800, 32, 8), 256)]
    assert linear_sizes(critic.net.fusion, 2) == [((800, 32, 8, 2), 256)]
    assert linear_sizes(policy.net.output, 1) == [((256,), 4)]
    assert linear_sizes(critic.net.output, 2) == [((256,), 1)]
    for module, members in ((policy, 1), (critic, 2)):
        assert len(linear_sizes(module, members)) == 6
    assert norms(policy, critic) == []


def test_fast_networks_pass_lidar_and_history_through_and_normalise_the_critics():
    config = resolve("fast")
    layout = ObservationLayout.of(config)
    policy, critic = Policy(layout, config.network), TwinCritic(layout, config.network)
    assert layout.size == layout.visual + 256 + 12
    assert linear_sizes(policy, 1) == [((layout.size,), 256), ((256,), 256), ((256,), 4)]
    assert linear_sizes(critic, 2) == [((layout.size, 2), 256), ((256,), 256), ((256,), 1)]
    assert norms(policy) == []
    assert [tuple(norm.weight.shape) for norm in norms(critic)] == [(2, 1, 256), (2, 1, 256)]


@pytest.mark.parametrize("members", [1, 2, 3])
@pytest.mark.parametrize("inputs", [(5,), (4, 3), (6, 1, 2)])
def test_parallel_layer_equals_linear_layers_of_the_concatenated_input(members, inputs):
    generator = torch.Generator().manual_seed(members)
    layer = ParallelLinear(members, inputs, 7).double()
    parts = [torch.randn(9, size, generator=generator, dtype=torch.float64) for size in inputs]
    apart = [torch.randn(members, 9, n, generator=generator, dtype=torch.float64) for n in inputs]
    mixed = [apart[0], *parts[1:]]
    for given in (parts, apart, mixed):
        found = layer(*given)
        assert found.shape == (members, 9, 7)
        for member in range(members):
            own = [x if x.dim() == 2 else x[member] for x in given]
            expected = linear(layer, member, torch.cat(own, dim=1))
            torch.testing.assert_close(found[member], expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("shared", [True, False])
def test_gradients_of_a_parallel_layer_are_those_of_its_linear_layers(shared):
    layer = ParallelLinear(2, (4, 3), 5).double()
    torch.manual_seed(0)
    given = [torch.randn(6, 4).double(), torch.randn(*(() if shared else (2,)), 6, 3).double()]
    given = [x.requires_grad_() for x in given]
    factors = torch.randn(2, 6, 5).double()
    wanted = [*given, *layer.parameters()]
    ours = torch.autograd.grad((layer(*given) * factors).sum(), wanted)
    plain = torch.stack(
        [linear(layer, m, torch.cat([x if x.dim() == 2 else x[m] for x in given], dim=1)) for m in range(2)]
    )
    theirs = torch.autograd.grad((plain * factors).sum(), wanted)
    for a, b in zip(ours, theirs, strict=True):
        assert a.abs().min() > 0
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_parallel_layer_takes_as_many_inputs_as_it_was_made_for():
    layer = ParallelLinear(1, (4, 3), 5)
    with pytest.raises(ValueError, match=r"zip\(\) argument"):
        layer(torch.zeros(6, 4))


@pytest.mark.parametrize("inputs", [(400,), (300, 100)])
def test_parallel_layer_begins_as_a_linear_layer_of_the_whole_input(inputs):
    torch.manual_seed(0)
    layer, plain = ParallelLinear(2, inputs, 500), nn.Linear(400, 500)
    for parameter in layer.weights:
        assert parameter.abs().max() <= 0.05  # 400^-1/2
        assert parameter.std().item() == pytest.approx(plain.weight.std().item(), rel=0.02)
        assert not torch.equal(parameter[0], parameter[1])
    assert layer.bias.abs().max() <= 0.05
    assert layer.bias.std().item() == pytest.approx(plain.bias.std().item(), rel=0.1)


@pytest.mark.parametrize("members", [1, 2])
def test_parallel_norm_equals_a_layer_norm_per_member(members):
    torch.manual_seed(0)
    norm = ParallelNorm(members, 6).double()
    plain = [nn.LayerNorm(6).double() for _ in range(members)]
    x = 3 * torch.randn(members, 8, 6).double() + 2
    x[0, 0] = 1e-3 * x[0, 0]  # here the variance is not far from the epsilon
    x.requires_grad_()
    for trained in (False, True):
        if trained:
            randomize(norm)
            for member, layer in enumerate(plain):
                layer.weight.data.copy_(norm.weight[member, 0])
                layer.bias.data.copy_(norm.bias[member, 0])
        factors = torch.randn(members, 8, 6).double()
        ours, theirs = norm(x), torch.stack([layer(x[m]) for m, layer in enumerate(plain)])
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
        a = torch.autograd.grad((ours * factors).sum(), [x, norm.weight, norm.bias])
        b = torch.autograd.grad(
            (theirs * factors).sum(), [x, *(p for layer in plain for p in layer.parameters())]
        )
        torch.testing.assert_close(a[0], b[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(a[1][:, 0], torch.stack(b[1::2]), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(a[2][:, 0], torch.stack(b[2::2]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("hidden", [(11,), (11, 9), (11, 9, 8)])
@pytest.mark.parametrize(("lidar", "history"), [((), ()), ((6, 5), (3,)), ((6,), ()), ((), (3,))])
def test_networks_side_by_side_equal_plain_ones(layer_norm, hidden, lidar, history):
    branches = (f"network.lidar_branch={list(lidar)}", f"network.history_branch={list(history)}")
    config = resolve("smoke", overrides=(*branches, f"network.hidden={list(hidden)}"))
    layout = ObservationLayout.of(config)
    net = FusionNetwork(layout, config.network, 2, (2,), 3, layer_norm).double()
    randomize(net)
    assert len(norms(net)) == (len(hidden) if layer_norm else 0), "none in the branches"
    generator = torch.Generator().manual_seed(1)
    flat = torch.rand(10, layout.size, generator=generator, dtype=torch.float64)
    action = torch.rand(10, 2, generator=generator, dtype=torch.float64)
    before = flat.clone(), action.clone()
    found = net(flat, action)
    assert found.shape == (2, 10, 3)
    visual, scans, past = flat.split([layout.visual, layout.lidar, layout.history], dim=1)
    for m in range(2):
        parts = [visual, chain(net.lidar_branch, m, scans), chain(net.history_branch, m, past), action]
        if not lidar:
            assert torch.equal(parts[1], scans)
        if not history:
            assert torch.equal(parts[2], past)
        fused = linear(net.fusion, m, torch.cat(parts, dim=1))
        expected = linear(net.output, m, chain(net.head, m, fused))
        torch.testing.assert_close(found[m], expected, rtol=1e-12, atol=1e-12)
        assert expected.std() > 0.01
    assert torch.equal(flat, before[0])
    assert torch.equal(action, before[1])


def test_twin_critics_share_no_parameter():
    config = resolve("paper")
    layout = ObservationLayout.of(config)
    critic = TwinCritic(layout, config.network)
    twins = critic(torch.rand(3, layout.size), torch.ones(3, 2))
    for member in range(2):
        critic.zero_grad()
        twins[member].sum().backward(retain_graph=True)
        for name, parameter in critic.named_parameters():
            assert parameter.grad is not None
            assert parameter.grad[member].abs().sum() > 0, name
            assert parameter.grad[1 - member].abs().sum() == 0, name


@pytest.mark.parametrize("preset", PRESETS)
def test_every_part_of_the_observation_and_the_action_reach_the_output(preset):
    torch.manual_seed(0)
    config = resolve(preset)
    layout = ObservationLayout.of(config)
    policy, critic = Policy(layout, config.network), TwinCritic(layout, config.network)
    flat, action = torch.rand(1, layout.size, requires_grad=True), torch.zeros(1, 2, requires_grad=True)
    (critic(flat, action).sum() + sum(part.sum() for part in policy(flat))).backward()
    parts = flat.grad[0].split([layout.visual, layout.lidar, layout.history])
    assert all(part.abs().sum() > 0 for part in parts)
    assert (action.grad != 0).all()


def test_twin_critics_give_two_independent_values_per_observation():
    torch.manual_seed(0)
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    critic = TwinCritic(layout, config.network)
    q = critic(torch.rand(5, layout.size), torch.zeros(5, 2))
    assert q.shape == (2, 5)
    assert not torch.allclose(q[0], q[1])


def test_initial_q_is_the_lesser_critic_at_the_greedy_action():
    torch.manual_seed(1)
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    policy, critic = Policy(layout, config.network), TwinCritic(layout, config.network)
    flat = torch.rand(64, layout.size) * 3
    with torch.no_grad():
        a, b = critic(flat, torch.tanh(policy(flat)[0]))
    found = initial_q(policy, critic, flat)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, torch.minimum(a, b).numpy(), rtol=1e-6)


@pytest.mark.parametrize(
    ("mean", "log_std"), [([0.0, 0.0], [-0.7, 0.0]), ([0.8, -1.3], [0.3, -2.0]), ([-2.0, 2.0], [1.0, -4.5])]
)
def test_policy_log_density_is_that_of_a_gaussian_through_tanh(mean, log_std):
    policy, flat = policy_with(mean, log_std)
    noise = torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    action, log_density = policy.sample(flat.expand(200, -1), noise)
    scale = torch.tensor(log_std, dtype=torch.float64).exp()
    raw = torch.tensor(mean, dtype=torch.float64) + scale * noise
    squash = TanhTransform(cache_size=1)  # the cache spares the reference an atanh close to 1
    expected_action = squash(raw)
    gaussian = Normal(torch.tensor(mean, dtype=torch.float64), scale)
    reference = Independent(TransformedDistribution(gaussian, squash), 1)
    torch.testing.assert_close(action.double(), expected_action, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(
        log_density.double(), reference.log_prob(expected_action), rtol=1e-4, atol=1e-4
    )


def test_policy_log_density_by_hand():
    policy, flat = policy_with([0.5, 0.0], [math.log(0.5), math.log(2.0)])
    action, log_density = policy.sample(flat, torch.tensor([[1.0, 0.25]]))
    assert action[0].tolist() == pytest.approx([math.tanh(1.0), math.tanh(0.5)], abs=1e-6)
    gaussian = [
        math.exp(-0.5) / (0.5 * math.sqrt(2 * math.pi)),
        math.exp(-0.03125) / (2 * math.sqrt(2 * math.pi)),
    ]
    slopes = [1 - math.tanh(1.0) ** 2, 1 - math.tanh(0.5) ** 2]
    density = gaussian[0] / slopes[0] * gaussian[1] / slopes[1]
    assert log_density.item() == pytest.approx(math.log(density), abs=1e-5)


def test_policy_density_integrates_to_one_over_the_square_of_actions():
    policy, flat = policy_with([0.4, -0.3], [-0.5, -0.8])
    mean, log_std = (part[0].detach() for part in policy(flat))
    edge = np.linspace(-1, 1, 401)
    grid = torch.tensor((edge[:-1] + edge[1:]) / 2, dtype=torch.float32)
    action = torch.cartesian_prod(grid, grid)
    noise = (torch.atanh(action) - mean) / log_std.exp()
    _, log_density = policy.sample(flat.expand(len(action), -1), noise)
    total = log_density.detach().double().exp().sum().item() * (2 / 400) ** 2
    assert total == pytest.approx(1.0, abs=2e-3)


def test_policy_log_density_stays_finite_where_tanh_saturates():
    policy, flat = policy_with([30.0, -30.0], [0.0, 0.0])
    action, log_density = policy.sample(flat, torch.zeros(1, 2))
    assert action.tolist() == [[1.0, -1.0]]
    # log N(0) - log(4 exp(-2 |raw|)) per dimension
    expected = 2 * (-0.5 * math.log(2 * math.pi) - math.log(4) + 60)
    assert log_density.item() == pytest.approx(expected, rel=1e-5)


def test_log_standard_deviation_stays_within_its_limits():
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    policy = Policy(layout, config.network)
    with torch.no_grad():
        policy.net.output.bias[0, 0, 2:] = torch.tensor([1e6, -1e6])
    _, log_std = policy(torch.zeros(1, layout.size))
    assert log_std[0].tolist() == pytest.approx([2.0, -5.0])


def test_greedy_action_is_the_squashed_mean():
    policy, flat = policy_with([0.7, -0.2], [0.0, 0.0])
    assert policy.mode(flat)[0].tolist() == pytest.approx([math.tanh(0.7), math.tanh(-0.2)], abs=1e-6)


def test_sample_is_differentiable_through_mean_and_deviation():
    torch.manual_seed(0)
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    policy = Policy(layout, config.network)
    action, log_density = policy.sample(torch.rand(4, layout.size), torch.ones(4, 2))
    (action.sum() + log_density.sum()).backward()
    assert (policy.net.output.bias.grad != 0).all()


def test_state_is_loaded_back_under_its_names():
    torch.manual_seed(0)
    config = resolve("smoke")
    layout = ObservationLayout.of(config)
    source, target = Policy(layout, config.network), Policy(layout, config.network)
    critic = TwinCritic(layout, config.network)
    state = state_of(policy=source, critic=critic)
    assert state["policy.net.output.weights.0"].shape == (1, 32, 4)
    assert state["critic.net.output.bias"].shape == (2, 1, 1)
    flat = torch.rand(3, layout.size)
    assert not torch.equal(source.mode(flat), target.mode(flat))
    load_state(state, policy=target)
    assert torch.equal(source.mode(flat), target.mode(flat))


def test_loaded_state_is_a_copy():
    encoder, other = Encoder(resolve("smoke").encoder), Encoder(resolve("smoke").encoder)
    state = state_of(encoder=encoder)
    load_state(state, encoder=other)
    with torch.no_grad():
        next(encoder.parameters()).zero_()
    assert next(other.parameters()).abs().sum() > 0


def test_missing_and_misshapen_tensors_are_named():
    encoder = make_encoder(resolve("smoke"))
    state = state_of(encoder=encoder)
    without = {key: value for key, value in state.items() if key != "encoder.blocks.1.down.bias"}
    with pytest.raises(
        ValueError, match=r"tensor encoder\.blocks\.1\.down\.bias is missing, expected shape \(8,\)"
    ):
        load_state(without, encoder=encoder)
    wrong = {**state, "encoder.blocks.0.0.weight": torch.zeros(8, 3, 2, 2)}
    with pytest.raises(
        ValueError,
        match=r"encoder\.blocks\.0\.0\.weight is of shape \(8, 3, 2, 2\), expected shape \(8, 3, 4, 4\)",
    ):
        load_state(wrong, encoder=encoder)


def test_nothing_is_loaded_from_a_state_of_which_one_tensor_does_not_fit():
    encoder = make_encoder(resolve("smoke"))
    before = {key: value.clone() for key, value in encoder.state_dict().items()}
    state = {key: torch.zeros_like(value) for key, value in state_of(encoder=encoder).items()}
    state.popitem()
    with pytest.raises(ValueError, match="is missing"):
        load_state(state, encoder=encoder)
    assert all(torch.equal(value, before[key]) for key, value in encoder.state_dict().items())
