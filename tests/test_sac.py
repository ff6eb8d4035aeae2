import copy
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from common.config import Config, resolve
from common.networks import Perception, Policy, TwinCritic, load_state
from common.observation import Columns, ObservationLayout, observe
from learner.replay.buffer import Batch
from learner.sac import SAC, WATCH_INTERVAL, critic_loss, policy_loss, td_target, temperature_loss
from tests.helpers import small_config

NORMALIZED = "network.normalize=true"
PAPER = ("world.camera.size=16", "world.lidar.beams=2", "network.hidden=[16, 16]", "sac.target_interval=3")


pytestmark = pytest.mark.usefixtures("one_thread")


def make_batch(config: Config, size: int = 8, seed: int = 0, **fixed: float) -> Batch:
    """Random transitions in the layout of `config`; `fixed` sets reward, discount or weight throughout."""
    layout, rng = ObservationLayout.of(config), np.random.default_rng(seed)
    columns, rows = Columns.empty(2 * size, layout), np.arange(2 * size)
    columns.visual[:] = rng.uniform(0, 255 if layout.row_dtype == "uint8" else 2, columns.visual.shape)
    columns.lidar[:] = rng.uniform(0, 1, columns.lidar.shape)
    columns.action[:] = rng.uniform(-1, 1, columns.action.shape)
    columns.reward[:] = rng.uniform(-1, 1, columns.reward.shape)
    drawn = {
        "reward": rng.uniform(-1, 1, size),
        "discount": rng.uniform(0, 1, size),
        "weight": rng.random(size),
    }
    drawn |= {name: np.full(size, value) for name, value in fixed.items()}
    return Batch(
        observation=observe(columns, rows[:size], np.zeros(size, np.int64), layout),
        action=columns.action[:size],
        next_observation=observe(columns, rows[size:], np.zeros(size, np.int64), layout),
        rows=rows[:size],
        steps=rows[:size],
        **{name: value.astype(np.float32) for name, value in drawn.items()},
    )


def values_of(module: torch.nn.Module) -> list[Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def gradients(module: torch.nn.Module) -> Tensor:
    return torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None])


def whole_state(sac: SAC) -> dict[str, Tensor]:
    """All of `SAC.state`, by value."""
    networks, moments = sac.state()
    return {key: value.detach().clone() for key, value in (networks | moments).items()}


def test_td_target_of_a_worked_case():
    target = td_target(
        reward=torch.tensor([1.0, 2.0, -1.0]),
        discount=torch.tensor([0.5, 0.0, 0.9]),
        q_next=torch.tensor([[4.0, 5.0, 1.0], [3.0, 7.0, 2.0]]),
        alpha=torch.tensor(0.1),
        log_density=torch.tensor([2.0, 3.0, -1.0]),
    )
    # 1 + .5 (3 - .2), 2 + 0, -1 + .9 (1 + .1)
    assert target.tolist() == pytest.approx([2.4, 2.0, -0.01])


def test_critic_loss_of_a_worked_case():
    q = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    loss = critic_loss(q, torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.5]))
    # twin 1: (.5 + .25) / 2, twin 2: (4.5 + 2.25) / 2
    assert loss.item() == pytest.approx(0.375 + 3.375)


def test_huber_loss_of_a_worked_case():
    q = torch.tensor([[1.0, 2.5], [-3.0, 0.5]], requires_grad=True)
    loss = critic_loss(q, torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.5]), "huber")
    # twin 1: (.5 + .5 * 1) / 2, twin 2: (2.5 + .5 * .125) / 2
    assert loss.item() == pytest.approx(0.5 + 1.28125)
    loss.backward()
    assert q.grad is not None
    assert q.grad.tolist() == [[0.5, 0.25], [-0.5, -0.125]], "beyond 1 the error pulls no harder"


def test_policy_loss_of_a_worked_case():
    q = torch.tensor([[1.0, 2.0], [3.0, 0.0]])
    loss = policy_loss(q, torch.tensor(0.5), torch.tensor([2.0, -4.0]))
    # ((1 - 1) + (-2 - 0)) / 2
    assert loss.item() == pytest.approx(-1.0)


def test_temperature_loss_of_a_worked_case_and_the_direction_it_pushes():
    log_alpha = torch.tensor(math.log(0.2), requires_grad=True)
    loss = temperature_loss(log_alpha, torch.tensor([-1.0, 3.0]), target_entropy=-2.0)
    # mean of log density + target entropy is (-3 + 1) / 2
    assert loss.item() == pytest.approx(math.log(0.2))
    loss.backward()
    assert log_alpha.grad is not None
    assert log_alpha.grad.item() == pytest.approx(1.0), "entropy above the target lets alpha fall"


def test_update_reports_the_mean_of_the_twins_absolute_td_errors():
    config = small_config("network.normalize=false")
    sac, batch = SAC(config), make_batch(config, discount=0.0)
    with torch.no_grad():
        q = sac.critic(sac.perception(batch.observation), torch.from_numpy(batch.action)).numpy()
    losses, errors = sac.update(batch)
    np.testing.assert_allclose(errors, np.abs(q - batch.reward).mean(0), rtol=1e-5)
    assert losses.q == pytest.approx(q.mean(), rel=1e-5)
    assert losses.critic == pytest.approx(
        (0.5 * batch.weight * (q - batch.reward) ** 2).mean(1).sum(), rel=1e-4
    )


def test_target_of_an_update_uses_target_critics_fresh_actions_and_alpha():
    config = small_config("network.normalize=false", "sac.initial_alpha=0.3")
    sac, batch = SAC(config), make_batch(config, seed=1)
    with torch.no_grad():
        for parameter in sac.target.parameters():
            parameter.mul_(1.5)
        noise = torch.randn(8, 2, generator=torch.Generator().manual_seed(config.seed))
        following = sac.perception(batch.next_observation)
        action, log_density = sac.policy.sample(following, noise)
        soft = sac.target(following, action).numpy().min(0) - 0.3 * log_density.numpy()
        q = sac.critic(sac.perception(batch.observation), torch.from_numpy(batch.action)).numpy()
    _, errors = sac.update(batch)
    np.testing.assert_allclose(errors, np.abs(q - batch.reward - batch.discount * soft).mean(0), rtol=1e-4)


def still_critics(sac: SAC) -> SAC:
    """The same, with critics that do not learn, so that what the policy sees of them stays equal."""
    sac.optimizer.param_groups[0]["lr"] = 0.0
    return sac


def test_importance_weights_scale_the_critic_loss_and_leave_policy_and_temperature_alone():
    config = small_config("sac.policy_delay=1")
    light, heavy = (still_critics(SAC(config)) for _ in range(2))
    batch = make_batch(config, weight=0.25)
    a, errors_a = light.update(batch)
    b, errors_b = heavy.update(batch._replace(weight=np.ones(8, np.float32)))
    assert b.critic == pytest.approx(4 * a.critic, rel=1e-5)
    torch.testing.assert_close(gradients(heavy.critic), 4 * gradients(light.critic))
    assert gradients(heavy.critic).abs().max() > 1e-3
    assert same(values_of(light.policy), values_of(heavy.policy))
    assert torch.equal(light.log_alpha, heavy.log_alpha)
    assert (a.policy, a.entropy, a.alpha) == (b.policy, b.entropy, b.alpha)
    assert errors_a.tolist() == errors_b.tolist(), "priorities are of unweighted errors"


def test_each_transition_has_its_own_weight_in_the_critic_loss():
    config = small_config()
    batch = make_batch(config, discount=0.0)
    parts = []
    for i in range(8):
        alone = still_critics(SAC(config))
        alone.update(batch._replace(weight=np.eye(8, dtype=np.float32)[i]))
        parts.append(gradients(alone.critic))
    together = still_critics(SAC(config))
    together.update(batch)
    expected = sum(float(w) * part for w, part in zip(batch.weight, parts, strict=True))
    torch.testing.assert_close(gradients(together.critic), expected, rtol=1e-4, atol=1e-6)


def test_policy_step_leaves_no_gradient_in_the_critic_and_moves_only_the_policy():
    config = small_config("sac.policy_delay=1")
    sac = SAC(config)
    critic = values_of(sac.critic)
    before = values_of(sac.policy)
    sac.update(make_batch(config, weight=0.0))
    assert gradients(sac.critic).abs().max() == 0
    assert same(critic, values_of(sac.critic))
    assert not same(before, values_of(sac.policy))
    assert all(parameter.requires_grad for parameter in sac.critic.parameters())


@pytest.mark.parametrize("end_to_end", [False, True])
def test_policy_and_temperature_learn_from_the_observations_they_are_given_in_place_of_the_batch(end_to_end):
    config = small_config("sac.policy_delay=1", f"encoder.end_to_end={str(end_to_end).lower()}")
    batch, other = make_batch(config, weight=0.0), make_batch(config, seed=1)
    given, swapped, plain = (SAC(config) for _ in range(3))
    a, errors_a = given.update(batch, other.observation)
    b, _ = swapped.update(other._replace(weight=batch.weight))
    c, errors_c = plain.update(batch)
    assert errors_a.tolist() == errors_c.tolist()
    assert same(values_of(given.policy), values_of(swapped.policy))
    assert not same(values_of(given.policy), values_of(plain.policy))
    assert (a.policy, a.entropy, a.alpha) == (b.policy, b.entropy, b.alpha)
    assert (a.policy, a.entropy) != (c.policy, c.entropy)
    assert (a.critic, a.q) == (c.critic, c.q)
    assert same(values_of(given.perception), values_of(SAC(config).perception)), "weights of 0 teach nothing"


def test_critics_learn_from_their_batch_whatever_the_policy_learns_from():
    config = small_config("sac.policy_delay=1")
    batch, other = make_batch(config), make_batch(config, seed=1)
    given, plain = SAC(config), SAC(config)
    given.update(batch, other.observation)
    plain.update(batch)
    assert same(values_of(given.critic), values_of(plain.critic))
    assert not same(values_of(given.critic), values_of(SAC(config).critic))


def test_policy_is_due_before_the_updates_that_move_it():
    config = small_config("sac.policy_delay=3")
    sac = SAC(config)
    due, moved = [], []
    for seed in range(7):
        due.append(sac.policy_due)
        before = values_of(sac.policy)
        sac.update(make_batch(config, seed=seed))
        moved.append(not same(before, values_of(sac.policy)))
    assert due == moved == [True, False, False, True, False, False, True]


def test_critic_loss_is_the_one_that_is_configured():
    squared, huber = (small_config(f"sac.critic_loss={kind}") for kind in ("squared", "huber"))
    batch = make_batch(squared, reward=4.0, discount=0.0)
    a, errors_a = SAC(squared).update(batch)
    b, errors_b = SAC(huber).update(batch)
    assert errors_a.tolist() == errors_b.tolist(), "priorities are of errors, not of losses"
    assert errors_a.min() > 1
    assert b.critic == pytest.approx((batch.weight * (2 * errors_a - 1)).mean(), rel=1e-4)
    assert b.critic < 0.7 * a.critic


@pytest.mark.parametrize("floor", [0.0, 0.05])
def test_alpha_falls_no_lower_than_its_floor(floor):
    config = small_config(
        f"sac.alpha_floor={floor}",
        "sac.initial_alpha=0.06",
        "sac.learning_rate=0.3",
        "sac.target_entropy=-20.0",
    )
    sac = SAC(config)
    assert sac.alpha.item() == pytest.approx(0.06)
    sac.optimizer.param_groups[1]["lr"] = 0.0  # keeps the entropy above the target
    for seed in range(4):
        losses, _ = sac.update(make_batch(config, seed=seed))
    assert losses.alpha == sac.alpha.item()
    assert sac.alpha.item() == pytest.approx(floor or 0.06 * math.exp(-2 * 0.3), rel=1e-4)


def test_alpha_rises_when_the_policy_is_less_random_than_asked():
    config = small_config("sac.target_entropy=5.0")
    sac = SAC(config)
    sac.update(make_batch(config))
    assert sac.alpha.item() > config.sac.initial_alpha


def test_policy_and_temperature_are_updated_every_second_time_with_a_delay_of_two():
    config = small_config("sac.policy_delay=2")
    sac = SAC(config)
    moved, known = [], []
    for seed in range(5):
        before, alpha = values_of(sac.policy), sac.alpha.item()
        losses, _ = sac.update(make_batch(config, seed=seed))
        moved.append(not same(before, values_of(sac.policy)))
        known.append(not math.isnan(losses.policy) and not math.isnan(losses.entropy))
        assert (sac.alpha.item() != alpha) == moved[-1]
        assert math.isfinite(losses.critic)
    assert moved == known == [True, False, True, False, True]
    assert sac.updates == 5


def test_hard_target_is_a_copy_every_interval_and_only_then():
    config = small_config("sac.target='hard'", "sac.target_interval=3")
    sac = SAC(config)
    assert same(values_of(sac.target), values_of(sac.critic))
    copied = []
    for seed in range(7):
        before = values_of(sac.target)
        sac.update(make_batch(config, seed=seed))
        copied.append(same(values_of(sac.target), values_of(sac.critic)))
        assert same(values_of(sac.target), before) != copied[-1]
    assert copied == [False, False, True, False, False, True, False]


def test_soft_target_moves_by_tau_towards_the_critic_at_every_update():
    config = small_config("sac.target='soft'", "sac.tau=0.25", "sac.learning_rate=0.05")
    sac = SAC(config)
    for seed in range(3):
        before = values_of(sac.target)
        sac.update(make_batch(config, seed=seed))
        for old, online, new in zip(before, values_of(sac.critic), values_of(sac.target), strict=True):
            torch.testing.assert_close(new, 0.75 * old + 0.25 * online, rtol=1e-6, atol=1e-7)


def test_value_of_a_single_state_is_learned():
    config = small_config("sac.learning_rate=0.01", "sac.policy_delay=1000")
    sac = SAC(config)
    batch = make_batch(config, reward=1.5, discount=0.0, weight=1.0)
    first = sac.update(batch)[1].mean()
    for _ in range(200):
        losses, errors = sac.update(batch)
    assert first > 0.5
    assert errors.max() < 0.1
    assert losses.q == pytest.approx(1.5, abs=0.05)


def test_policy_learns_the_action_that_the_critics_value():
    config = small_config("sac.learning_rate=0.01", "sac.policy_delay=1")
    sac = SAC(config)
    for seed in range(150):
        batch = make_batch(config, 32, seed, discount=0.0, weight=1.0)
        sac.update(batch._replace(reward=batch.action[:, 0] - batch.action[:, 1]))
    with torch.no_grad():
        mode = sac.policy.mode(sac.perception(make_batch(config, 32, 999).observation))
    assert mode[:, 0].min() > 0.5
    assert mode[:, 1].max() < -0.5


def test_normaliser_sees_one_batch_in_ten_and_equals_mean_and_variance_of_all_it_saw():
    config = small_config(NORMALIZED)
    sac, plain = SAC(config), Perception(small_config("network.normalize=false"))
    batches = [make_batch(config, 5 + seed % 3, seed) for seed in range(2 * WATCH_INTERVAL + 1)]
    for batch in batches:
        sac.update(batch)
    shown = [plain(batches[i].observation) for i in range(0, len(batches), WATCH_INTERVAL)]
    rows = torch.cat(shown).double().numpy()
    normalizer = sac.perception.normalizer
    assert normalizer is not None
    assert normalizer.count.item() == len(rows) == 5 + 6 + 7
    np.testing.assert_allclose(normalizer.mean, rows.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(normalizer.variance, rows.var(0), rtol=1e-4, atol=1e-5)


CASES: dict[str, Callable[[], Config]] = {
    "smoke": lambda: small_config("sac.tau=0.1", NORMALIZED),
    "paper": lambda: resolve("paper", overrides=PAPER),
    "end to end": lambda: small_config(
        "encoder.end_to_end=true", "encoder.channels=[2, 2, 2, 2]", NORMALIZED
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_loaded_learner_goes_on_to_the_bit_as_the_one_that_was_saved(case):
    config = CASES[case]()
    original, restored = SAC(config), SAC(config.model_copy(update={"seed": 99}))
    for seed in range(5):
        original.update(make_batch(config, seed=seed))
    restored.load(*original.state(), original.updates)
    assert restored.updates == 5
    for seed in range(5, 13):  # past a hard copy and a look of the normaliser
        batch = make_batch(config, seed=seed)
        a, errors_a = original.update(batch)
        b, errors_b = restored.update(batch)
        np.testing.assert_array_equal(a, b)
        assert errors_a.tolist() == errors_b.tolist()
    ours, theirs = whole_state(original), whole_state(restored)
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert torch.equal(value, theirs[key]), key


def test_loaded_learner_shares_no_memory_with_what_it_was_loaded_from():
    config = small_config()
    original, restored = SAC(config), SAC(config)
    original.update(make_batch(config))
    restored.load(*original.state(), original.updates)
    before = whole_state(original)
    restored.update(make_batch(config, seed=1))
    for key, value in whole_state(original).items():
        assert torch.equal(value, before[key]), key


def test_learner_starts_from_its_seed_and_leaves_the_global_generator_alone():
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    states = [whole_state(SAC(small_config().model_copy(update={"seed": seed}))) for seed in (1, 1, 2)]
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(value, states[1][key]) for key, value in states[0].items())
    key = "policy.net.fusion.weights.0"
    assert not torch.equal(states[0][key], states[2][key])


def test_state_of_another_architecture_is_refused_naming_the_tensor():
    wider = SAC(small_config("network.hidden=[24, 16]"))
    state = wider.state()
    with pytest.raises(ValueError, match=r"tensor policy\.net\.fusion\.bias is of shape \(1, 1, 24\)"):
        SAC(small_config()).load(*state, 0)
    networks, moments = SAC(small_config()).state()
    del networks["target.net.output.bias"]
    with pytest.raises(ValueError, match=r"tensor target\.net\.output\.bias is missing"):
        SAC(small_config()).load(networks, moments, 0)


def test_encoder_learns_from_the_critic_only():
    config = small_config("encoder.end_to_end=true", "sac.policy_delay=1")
    unweighted, weighted = SAC(config), SAC(config)
    for sac, weight in ((unweighted, 0.0), (weighted, 1.0)):
        assert sac.perception.encoder is not None
        encoder, policy = values_of(sac.perception.encoder), values_of(sac.policy)
        sac.update(make_batch(config, weight=weight))
        assert not same(policy, values_of(sac.policy))
        assert (gradients(sac.perception.encoder).abs().max() > 0) == (weight > 0)
        assert same(encoder, values_of(sac.perception.encoder)) == (weight == 0)


def test_target_encoder_is_a_copy_of_its_own_with_the_online_normaliser():
    config = small_config("encoder.end_to_end=true", NORMALIZED, "sac.tau=0.25", "sac.learning_rate=0.01")
    sac = SAC(config)
    target = sac.target_perception
    assert target.normalizer is sac.perception.normalizer
    addresses = {p.data_ptr() for p in sac.perception.parameters()}
    assert addresses.isdisjoint(p.data_ptr() for p in target.parameters())
    before = values_of(target)
    sac.update(make_batch(config))
    for old, online, new in zip(before, values_of(sac.perception), values_of(target), strict=True):
        torch.testing.assert_close(new, 0.75 * old + 0.25 * online, rtol=1e-6, atol=1e-7)
        assert not torch.equal(old, new)


def test_td_target_end_to_end_sees_codes_of_the_target_encoder_and_the_policy_those_of_the_online_one():
    config = small_config("encoder.end_to_end=true", "network.normalize=false")
    sac, batch = SAC(config), make_batch(config, seed=1)
    with torch.no_grad():
        for parameter in sac.target_perception.parameters():
            parameter.mul_(1.5)
        noise = torch.randn(8, 2, generator=torch.Generator().manual_seed(config.seed))
        action, log_density = sac.policy.sample(sac.perception(batch.next_observation), noise)
        q_next = sac.target(sac.target_perception(batch.next_observation), action).numpy()
        soft = q_next.min(0) - sac.alpha.item() * log_density.numpy()
        q = sac.critic(sac.perception(batch.observation), torch.from_numpy(batch.action)).numpy()
    _, errors = sac.update(batch)
    np.testing.assert_allclose(errors, np.abs(q - batch.reward - batch.discount * soft).mean(0), rtol=1e-4)


def test_weights_alone_leave_temperature_optimisers_and_count_as_they_were():
    config = small_config(NORMALIZED, "sac.policy_delay=1", "sac.learning_rate=0.01")
    source, fresh = SAC(config), SAC(config.model_copy(update={"seed": 8}))
    for seed in range(3):
        source.update(make_batch(config, seed=seed))
    fresh.load_weights(source.state()[0])
    for name in ("perception", "policy", "critic", "target"):
        ours, theirs = getattr(fresh, name).state_dict(), getattr(source, name).state_dict()
        assert all(torch.equal(value, theirs[key]) for key, value in ours.items()), name
    assert fresh.alpha.item() == pytest.approx(config.sac.initial_alpha)
    assert source.alpha.item() != fresh.alpha.item()
    assert fresh.updates == 0
    assert set(fresh.state()[1]) == {"generator"}
    before = whole_state(source)
    fresh.update(make_batch(config, seed=9))
    assert all(torch.equal(value, before[key]) for key, value in whole_state(source).items())


@pytest.mark.parametrize(("algorithm", "source"), [("navacl-q", "target"), ("navacl-q+", "critic")])
def test_curriculum_gets_the_target_critics_to_the_letter_and_else_the_current_ones(algorithm, source):
    config = small_config(f"curriculum.algorithm='{algorithm}'")
    sac = SAC(config)
    sac.update(make_batch(config))
    state, layout = sac.critic_state(), ObservationLayout.of(config)
    critic, policy, perception = (
        TwinCritic(layout, config.network),
        Policy(layout, config.network),
        Perception(config),
    )
    load_state(state, critic=critic, policy=policy, perception=perception)
    other = sac.critic if source == "target" else sac.target
    assert same(values_of(critic), values_of(getattr(sac, source)))
    assert not same(values_of(critic), values_of(other))
    assert same(values_of(policy), values_of(sac.policy))


def test_actors_get_policy_and_perception_and_nothing_else():
    sac = SAC(small_config(NORMALIZED))
    assert {key.split(".")[0] for key in sac.policy_state()} == {"policy", "perception"}
    sac.update(make_batch(small_config(NORMALIZED)))
    assert torch.equal(sac.policy_state()["perception.normalizer.count"], torch.tensor(8.0))


@pytest.mark.parametrize("preset", ["paper", "fast"])
def test_preset_updates_with_finite_figures_at_full_size(preset):
    config = resolve(preset)
    sac, batch = SAC(config), make_batch(config, config.sac.batch_size)
    before = copy.deepcopy(whole_state(sac))
    losses, errors = sac.update(batch)
    assert all(math.isfinite(value) for value in losses)
    assert errors.shape == (config.sac.batch_size,)
    assert np.isfinite(errors).all()
    assert losses.alpha == pytest.approx(config.sac.initial_alpha, rel=0.01)
    after = whole_state(sac)
    assert all(torch.isfinite(value.float()).all() for value in after.values())
    key = "critic.net.fusion.weights.0"
    for twin in range(2):
        assert not torch.equal(before[key][twin], after[key][twin])
