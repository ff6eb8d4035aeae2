"""Pre-training on synthetic frames: what is minimised, resuming, what is exported, probes and figures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from actor.frames import film
from actor.world.world import DockingWorld
from common.config import Config, differing_keys
from common.encoders import ENCODER, HEADS, MADE_BY, read_encoder
from common.errors import UsageError
from common.frames import Film, FrameTable
from common.networks import compile_encoder, load_state, make_encoder, state_of
from common.policy_files import load_tensors
from common.tasks import PlacedStart, Task
from learner.optimizers import load_moments, moments_of
from learner.pretraining.figure import GAP, reconstruction_figure
from learner.pretraining.objectives import (
    POSE_SCALES,
    Batch,
    Decoder,
    Losses,
    Pretraining,
    Sampler,
    pose_targets,
)
from learner.pretraining.probe import LinearProbe, code_features, decoder_quality, pixel_features
from learner.pretraining.trainer import CODE_RMS, TRAINING, Progress, Trainer
from tests.helpers import small_config

KINDS = [("light", 1), ("light", 4), ("residual", 1), ("residual", 4)]
FLOAT32 = "pretraining.precision=float32"


pytestmark = pytest.mark.usefixtures("one_thread")


def settings(*more: str) -> Config:
    """Three batches of 32 an epoch for the 96 training rows of `squares()`."""
    return small_config("pretraining.batch_size=32", "pretraining.epochs=2", FLOAT32, *more)


def squares(films: int = 20, length: int = 6, seed: int = 0) -> FrameTable:
    """Drives past a bright square, which stands for the dolly, before a dark floor: 16 pixels a side.

    The farther the smaller, the more to the left in the picture the larger the bearing; in every fifth film
    there is none.
    """
    rng, found = np.random.default_rng(seed), []
    for index in range(films):
        frame = rng.integers(0, 30, (length, 16, 16, 3), dtype=np.uint8)
        mask, goal = np.zeros((length, 16, 16), np.uint8), np.zeros((length, 3), np.float32)
        for t in range(length):
            side, left, top = int(rng.integers(4, 8)), int(rng.integers(0, 9)), int(rng.integers(0, 9))
            goal[t] = (8 - left - side / 2) / 20, 16.0 / side, rng.uniform(-3, 3)
            if index % 5 != 4:
                frame[t, top : top + side, left : left + side] = 40, 80, 220
                mask[t, top : top + side, left : left + side] = 1
        found.append(Film(frame, np.packbits(mask.reshape(length, -1), axis=1), goal))
    return FrameTable.of(found, films * length, 16)


def every_fifth(table: FrameTable) -> np.ndarray:
    """Held out: one film in five."""
    return table.start // 6 % 5 == 1


TABLE = squares()
HELD_OUT = every_fifth(TABLE)


def trainer(folder: Path, config: Config | None = None, table: FrameTable = TABLE) -> Trainer:
    return Trainer(config or settings(), table, HELD_OUT, folder)


def ignore(progress: Progress) -> None:
    pass


def model_of(config: Config) -> Pretraining:
    torch.manual_seed(0)
    return Pretraining(config, make_encoder(config))


def constant(model: Pretraining, color: float, logit: float) -> Pretraining:
    """The model with a decoder that answers everything alike."""
    last = model.decoder.blocks[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(color)
        last.bias[-1] = logit if model.semantic else color
    return model


def batch_of(config: Config, rows: range = range(0, 120, 7)) -> Batch:
    return Sampler(TABLE, config.encoder.frames_per_code)(np.array(rows))


def weights(model: nn.Module) -> Tensor:
    return torch.cat([value.detach().flatten() for value in model.state_dict().values()])


def test_targets_are_the_same_after_half_a_turn_of_the_dolly():
    rng = np.random.default_rng(0)
    goal = rng.uniform(-3, 3, (50, 3)).astype(np.float32)
    turned = goal + np.array([0, 0, math.pi], np.float32)
    np.testing.assert_allclose(pose_targets(turned), pose_targets(goal), atol=1e-5)
    quarter = pose_targets(goal + np.array([0, 0, math.pi / 2], np.float32))
    np.testing.assert_allclose(quarter[:, 2:], -pose_targets(goal)[:, 2:], atol=1e-5)
    found = pose_targets(np.array([[0.1, 2.0, math.radians(30)]], np.float32))
    assert found.dtype == np.float32
    assert found[0] == pytest.approx([0.1, 2.0, math.sqrt(3) / 2, 0.5], abs=1e-6)


@pytest.mark.parametrize("frames_per_code", [1, 4])
def test_samples_are_the_newest_stack_with_the_truth_of_its_newest_frame(frames_per_code):
    rows = np.array([0, 1, 23, 24, 59, 119])
    batch = Sampler(TABLE, frames_per_code)(rows)
    for i, row in enumerate(rows.tolist()):
        first = row // 6 * 6
        stack = [TABLE.frame[max(first, row - back)] for back in range(frames_per_code - 1, -1, -1)]
        expected = np.concatenate([frame.transpose(2, 0, 1) for frame in stack]) / np.float32(255)
        np.testing.assert_allclose(batch.images[i].numpy(), expected, rtol=1e-6)
        blue = (TABLE.frame[row] == (40, 80, 220)).all(-1)
        assert np.array_equal(batch.mask[i].numpy(), blue)
        assert batch.visible[i].item() == blue.any()
        bearing, distance, yaw = TABLE.goal[row].tolist()
        assert batch.pose[i].tolist() == pytest.approx(
            [bearing, distance, math.sin(2 * yaw), math.cos(2 * yaw)], abs=1e-5
        )
    assert set(batch.visible.tolist()) == {0.0, 1.0}


def test_mirrored_samples_are_those_of_a_mirrored_scene():
    """What the simulator gives for the start on the other side of the dolly's axis."""
    own = small_config("world.camera.size=48", "world.obstacles.count_min=0", "world.obstacles.count_max=0")
    world = DockingWorld(own.world, 10)
    films = []
    for side in (1, -1):
        start = PlacedStart(x=1.1 * side, y=-3.5, yaw=8.0 * side)
        films.append(film(world, Task(cell=0, seed=1, start=start), np.random.default_rng(0), 0))
    world.close()
    left, right = (Sampler(FrameTable.of([one], 1, 48), 1)(np.array([0])) for one in films)
    mirrored = left.mirrored(torch.tensor([True]))
    assert (left.pose - right.pose).abs().max() > 0.1
    torch.testing.assert_close(mirrored.pose, right.pose, rtol=0, atol=1e-5)
    middles = [batch.mask[0].nonzero()[:, 1].double().mean().item() for batch in (left, right, mirrored)]
    assert middles[0] < 16 < 32 < middles[1]
    assert middles[2] == pytest.approx(middles[1], abs=0.5)
    assert left.visible == mirrored.visible == right.visible == 1
    assert torch.equal(mirrored.images.flip(3), left.images)


def test_only_the_chosen_samples_are_mirrored():
    batch = batch_of(settings("encoder.frames_per_code=4"))
    which = torch.arange(len(batch.visible)) % 3 == 0
    found = batch.mirrored(which)
    for i, turned in enumerate(which.tolist()):
        bearing, distance, sine, cosine = batch.pose[i].tolist()
        sign = -1 if turned else 1
        assert found.pose[i].tolist() == [sign * bearing, distance, sign * sine, cosine]
        for ours, theirs in ((found.images[i], batch.images[i]), (found.mask[i], batch.mask[i])):
            assert np.array_equal(ours.numpy()[..., ::sign], theirs.numpy())
    assert torch.equal(found.visible, batch.visible)


@pytest.mark.parametrize("size", [16, 48])
@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS)
@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
def test_decoder_gives_images_as_large_as_those_that_were_encoded(objective, kind, frames_per_code, size):
    config = settings(
        f"pretraining.objective={objective}",
        f"encoder.kind={kind}",
        f"encoder.frames_per_code={frames_per_code}",
        f"world.camera.size={size}",
        "encoder.channels=[4, 6, 8, 10]",
    )
    model, colors = model_of(config), 3 * frames_per_code
    images, mask, heads = model(torch.rand(2, colors, size, size))
    assert images.shape == (2, colors, size, size)
    assert mask.shape == (2, size, size)
    assert heads.shape == (2, 5)
    decoded = Decoder(config.encoder, size, 7)(torch.rand(3, 10 * (size // 16) ** 2))
    assert decoded.shape == (3, 7, size, size)


@pytest.mark.parametrize("kind", ["light", "residual"])
def test_decoder_keeps_what_is_where(kind):
    """A change in one place of the code's map changes the picture about there, and nothing far away."""
    config = settings(f"encoder.kind={kind}", "world.camera.size=128")
    torch.manual_seed(0)
    decoder, code = Decoder(config.encoder, 128, 1), torch.rand(1, 4, 8, 8)
    other = code.clone()
    other[0, :, 1, 6] += 1.0  # the middle of that sixteenth is row 24, column 104
    with torch.no_grad():
        changed = (decoder(code.flatten(1)) - decoder(other.flatten(1)))[0, 0].abs().numpy()
    rows, columns = np.indices(changed.shape)
    assert (changed * rows).sum() / changed.sum() == pytest.approx(24, abs=8)
    assert (changed * columns).sum() / changed.sum() == pytest.approx(104, abs=8)
    assert (changed[80:] == 0).all()
    assert (changed[:, :48] == 0).all()


@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
def test_losses_are_finite_and_reach_every_weight_that_they_concern(
    objective, precision, kind, frames_per_code
):
    config = settings(
        f"pretraining.objective={objective}",
        f"encoder.kind={kind}",
        f"encoder.frames_per_code={frames_per_code}",
    )
    model = model_of(config)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        losses = model.losses(batch_of(config))
    assert all(math.isfinite(loss.item()) for loss in losses)
    losses.total.backward()
    for part in (model.encoder, model.decoder):
        gradients = torch.cat([p.grad.flatten() for p in part.parameters()])
        assert gradients.isfinite().all()
        assert (gradients != 0).float().mean() > 0.1
    heads = model.heads.weight.grad
    assert heads is None if objective == "reconstruction" else (heads != 0).any(1).all()


@pytest.mark.parametrize("frames_per_code", [1, 4])
def test_reconstruction_is_exactly_the_mean_squared_error_of_all_channels(frames_per_code):
    config = settings("pretraining.objective=reconstruction", f"encoder.frames_per_code={frames_per_code}")
    model, batch = model_of(config), batch_of(config)
    with torch.no_grad():
        losses, decoded = model.losses(batch), model(batch.images)[0]
    assert decoded.shape[1] == 3 * frames_per_code
    gap = decoded.double().numpy() - batch.images.double().numpy()
    assert losses.total.item() == pytest.approx((gap**2).mean(), rel=1e-5)
    assert losses.pixels.item() == losses.total.item()
    assert (losses.mask.item(), losses.visible.item(), losses.pose.item()) == (0, 0, 0)


def test_semantic_loss_is_the_weighted_sum_of_what_numpy_makes_of_the_same_outputs():
    config = settings("pretraining.mask_weight=0.3", "pretraining.pose_weight=0.7")
    model, batch = model_of(config), batch_of(config)
    with torch.no_grad():
        losses = Losses(*(loss.item() for loss in model.losses(batch)))
        decoded, mask, heads = (part.double().numpy() for part in model(batch.images))
    images, true, seen, pose = (part.double().numpy() for part in batch)

    def cross_entropy(logits: np.ndarray, truth: np.ndarray) -> float:
        p = 1 / (1 + np.exp(-logits))
        return float(-(truth * np.log(p) + (1 - truth) * np.log(1 - p)).mean())

    gap = np.abs(heads[:, 1:] - pose) * POSE_SCALES
    huber = np.where(gap < 0.1, gap**2 / 0.2, gap - 0.05).sum(1)
    assert losses.pixels == pytest.approx(((decoded - images) ** 2).mean(), rel=1e-4)
    assert losses.mask == pytest.approx(cross_entropy(mask, true), rel=1e-4)
    assert losses.visible == pytest.approx(cross_entropy(heads[:, 0], seen), rel=1e-4)
    assert losses.pose == pytest.approx(huber[seen == 1].mean(), rel=1e-4)
    total = losses.pixels + 0.3 * losses.mask + 0.7 * (losses.visible + losses.pose)
    assert losses.total == pytest.approx(total, rel=1e-5)


def test_pose_of_a_dolly_that_is_not_seen_does_not_matter():
    config = settings()
    model, batch = model_of(config), batch_of(config)
    unseen = batch.visible == 0
    assert 0 < unseen.sum() < len(unseen)
    with torch.no_grad():
        losses = model.losses(batch)
        elsewhere = model.losses(batch._replace(pose=batch.pose + 5 * unseen[:, None]))
        moved = model.losses(batch._replace(pose=batch.pose + 5 * ~unseen[:, None]))
        never = model.losses(batch._replace(visible=torch.zeros_like(batch.visible)))
    assert elsewhere == losses
    assert moved.pose > losses.pose + 1
    assert never.pose.item() == 0.0
    assert math.isfinite(never.total.item())


@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
def test_training_lowers_every_loss_also_on_drives_that_were_held_out(tmp_path, objective):
    config = settings(
        f"pretraining.objective={objective}",
        "pretraining.epochs=6",
        "pretraining.batch_size=16",
        "pretraining.learning_rate=0.005",
        "encoder.channels=[16, 16, 16, 16]",
    )
    table, heard = squares(100), []
    found = Trainer(config, table, every_fifth(table), tmp_path)
    before = found.held_out_losses()
    found.run(heard.append)
    after = found.held_out_losses()
    assert heard[-1].losses["total"] < 0.8 * heard[0].losses["total"]
    concerned = ("total", "pixels") if objective == "reconstruction" else Losses._fields
    for name in concerned:
        assert after[name] < 0.7 * before[name], name
    assert (heard[0].epoch, heard[-1].epoch, heard[-1].samples) == (1, 6, 6 * 480)
    assert [p.epoch for p in heard] == sorted(p.epoch for p in heard)
    assert [p.samples for p in heard] == sorted({p.samples for p in heard})
    assert found.finished
    assert list((tmp_path / "tensorboard").iterdir())


def test_held_out_losses_are_those_of_the_held_out_rows(tmp_path):
    found = trainer(tmp_path)
    with torch.no_grad():
        expected = found.model.losses(Sampler(TABLE, 1)(HELD_OUT.nonzero()[0]))
    assert found.held_out_losses() == pytest.approx(
        {k: v.item() for k, v in expected._asdict().items()}, rel=1e-4
    )


def test_held_out_drives_are_never_learned_from_and_all_others_are(tmp_path):
    other = squares()
    other.frame[HELD_OUT] = 255 - other.frame[HELD_OUT]
    other.goal[HELD_OUT] += 1.0
    changed = squares()
    changed.frame[np.flatnonzero(~HELD_OUT)[-1]] //= 2
    found = []
    for index, table in enumerate((TABLE, other, changed)):
        one = trainer(tmp_path / str(index), settings("pretraining.epochs=1"), table)
        one.run(ignore)
        found.append(weights(one.model))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_epoch_takes_each_training_row_once_in_an_order_of_its_own(tmp_path):
    class Noting(FrameTable):
        """Remembers which rows were asked for."""

        def stacks(self, rows: np.ndarray, count: int) -> np.ndarray:
            asked.append(rows.tolist())
            return super().stacks(rows, count)

    asked: list[list[int]] = []
    own = squares()
    table = Noting(own.frame, own.mask, own.goal, own.start)
    found = trainer(tmp_path, settings("pretraining.batch_size=40"), table)
    epochs: list[list[int]] = []
    found.run(lambda progress: epochs.append([row for rows in asked[-3:] for row in rows]))
    assert [len(rows) for rows in asked[:3]] == [40, 40, 16]
    train = np.flatnonzero(~HELD_OUT).tolist()
    assert [sorted(epoch) for epoch in epochs] == [train, train]
    assert epochs[0] != epochs[1]


def test_learning_rate_falls_along_a_cosine(tmp_path):
    config = settings("pretraining.learning_rate=0.002", "pretraining.final_learning_rate=0.0002")
    found, rates = trainer(tmp_path, config), []
    found.run(lambda progress: rates.append(found._optimizer.param_groups[0]["lr"]))
    at = [0.0002 + 0.0018 * (1 + math.cos(math.pi * batch / 6)) / 2 for batch in (2, 5)]
    assert rates == pytest.approx(at)


def test_half_of_the_samples_are_mirrored_if_asked_for(tmp_path):
    """On frames that are their own mirror images the losses of both are the same but for the pose."""
    found = {}
    for mirror in ("true", "false"):
        one = trainer(tmp_path / mirror, settings(f"pretraining.mirror={mirror}", "pretraining.epochs=1"))
        one.run(ignore)
        found[mirror] = weights(one.model)
    assert not torch.equal(found["true"], found["false"])
    even = squares()
    even.frame[:] = np.concatenate([even.frame[:, :, :8], even.frame[:, :, 7::-1]], axis=2)
    again = {}
    for mirror in ("true", "false"):
        config = settings(
            f"pretraining.mirror={mirror}", "pretraining.epochs=1", "pretraining.objective=reconstruction"
        )
        one = trainer(tmp_path / f"even-{mirror}", config, even)
        one.run(ignore)
        again[mirror] = weights(one.model)
    assert torch.equal(again["true"], again["false"])


def test_same_seed_learns_the_same_and_another_does_not(tmp_path):
    found = []
    for index, seed in enumerate((3, 3, 4)):
        one = trainer(tmp_path / str(index), settings(f"seed={seed}", "pretraining.epochs=1"))
        torch.manual_seed(index)
        one.run(ignore)
        found.append(weights(one.model))
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


class Interrupting(FrameTable):
    """Gives so many batches of a training, then comes a Ctrl-C, once."""

    left = 0

    def stacks(self, rows: np.ndarray, count: int) -> np.ndarray:
        if len(rows) == 32:  # as many as only a batch has
            Interrupting.left -= 1
            if Interrupting.left == -1:
                raise SystemExit(130)
        return super().stacks(rows, count)


@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
@pytest.mark.parametrize("batches", [1, 3, 5])
def test_interrupted_training_goes_on_to_the_same_weights(tmp_path, objective, batches):
    """Three batches make an epoch: it is interrupted in the middle of one, or at its end by the report."""
    config = settings("pretraining.epochs=3", f"pretraining.objective={objective}")
    whole = trainer(tmp_path / "whole", config)
    whole.run(ignore)

    def stop(progress: Progress) -> None:
        if progress.epoch * 3 == batches:
            raise SystemExit(143)

    own = squares()
    table = Interrupting(own.frame, own.mask, own.goal, own.start)
    Interrupting.left = batches if batches % 3 else 1000
    first = trainer(tmp_path / "cut", config, table)
    with pytest.raises(SystemExit):
        first.run(stop)
    assert (first.done, first.finished) == (batches, False)
    second = trainer(tmp_path / "cut", config)
    assert second.done == batches
    assert torch.equal(weights(second.model), weights(first.model))
    second.run(ignore)
    assert second.finished
    torch.testing.assert_close(weights(second.model), weights(whole.model), rtol=0, atol=1e-7)
    assert not torch.allclose(weights(second.model), weights(first.model), atol=1e-4)


def test_finished_training_has_nothing_left_to_do(tmp_path):
    first = trainer(tmp_path)
    first.run(ignore)
    second, heard = trainer(tmp_path), []
    assert second.finished
    second.run(heard.append)
    assert heard == []
    assert torch.equal(weights(second.model), weights(first.model))


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
@pytest.mark.parametrize(("kind", "frames_per_code"), KINDS[::3])
def test_checkpoint_is_an_encoder_that_can_be_used(tmp_path, objective, kind, frames_per_code):
    config = settings(
        f"pretraining.objective={objective}",
        f"encoder.kind={kind}",
        f"encoder.frames_per_code={frames_per_code}",
    )
    found = trainer(tmp_path, config)
    found.done = 4
    found.save()
    checkpoint = tmp_path / "checkpoint"
    assert set(files(checkpoint)) == {"config.toml", "state.json", ENCODER, HEADS, TRAINING}
    assert json.loads((checkpoint / "state.json").read_text()) == {"batches": 4}
    made_with, encoder = read_encoder(checkpoint)
    assert not differing_keys(made_with, config, MADE_BY)
    exported = found.exported()
    assert torch.equal(weights(encoder), weights(exported.encoder))
    again = Pretraining(config, encoder)
    load_state(state_of(**{"model.encoder": encoder}) | load_tensors(checkpoint / HEADS), model=again)
    assert torch.equal(weights(again), weights(exported))


def test_loss_that_is_not_finite_ends_the_training_and_spares_the_checkpoint(tmp_path):
    trainer(tmp_path).run(ignore)
    before, broken = files(tmp_path / "checkpoint"), squares()
    broken.goal[~HELD_OUT] = np.nan
    second = trainer(tmp_path, settings("pretraining.epochs=4"), broken)
    assert not second.finished
    with pytest.raises(ArithmeticError, match="the loss is not finite at batch 6"):
        second.run(ignore)
    assert files(tmp_path / "checkpoint") == before
    assert all(value.isfinite().all() for value in second.model.state_dict().values())
    fresh = trainer(tmp_path / "fresh", settings(), broken)
    with pytest.raises(ArithmeticError, match="at batch 0"):
        fresh.run(ignore)
    assert not (tmp_path / "fresh" / "checkpoint").exists()


@pytest.mark.parametrize("objective", ["reconstruction", "semantic"])
@pytest.mark.parametrize("kind", ["light", "residual"])
def test_exported_codes_are_of_the_wanted_size_and_are_decoded_as_before(tmp_path, objective, kind):
    config = settings(f"pretraining.objective={objective}", f"encoder.kind={kind}", "pretraining.epochs=1")
    found = trainer(tmp_path, config)
    found.run(ignore)
    images = Sampler(TABLE, 1)(np.flatnonzero(~HELD_OUT)).images
    before = weights(found.model)
    exported = found.exported()
    with torch.no_grad():
        raw, codes = found.model.encoder(images), exported.encoder(images)
        assert codes.square().mean().sqrt().item() == pytest.approx(CODE_RMS, rel=1e-3) == 0.5
        factor = (codes.sum() / raw.sum()).item()
        assert abs(factor - 1) > 0.1
        torch.testing.assert_close(codes, factor * raw, rtol=1e-4, atol=1e-5)
        for ours, theirs in zip(found.model(images), exported(images), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    assert exported.unit.item() == pytest.approx(1 / factor, rel=1e-4)
    assert torch.equal(weights(found.model), before), "what is trained stays as it is"


def test_encoder_whose_codes_are_all_zero_is_exported_as_it_is(tmp_path):
    found = trainer(tmp_path)
    with torch.no_grad():
        for parameter in found.model.encoder.parameters():
            parameter.fill_(-1.0)
    exported = found.exported()
    assert exported.unit.item() == 1.0
    assert torch.equal(weights(exported), weights(found.model))


def test_checkpoint_of_another_shape_is_refused_by_the_tensor(tmp_path):
    trainer(tmp_path).save()
    for other in (
        "encoder.channels=[8, 8, 8, 6]",
        "encoder.kind=residual",
        "pretraining.objective=reconstruction",
    ):
        with pytest.raises(
            UsageError, match=r"checkpoint .* does not fit: tensor model\..* remove it to begin"
        ):
            trainer(tmp_path, settings(other))


@pytest.mark.parametrize("file", ["state.json", TRAINING])
@pytest.mark.parametrize("damage", [None, b"", b"[]", "cut"])
def test_damaged_checkpoint_is_a_usage_error_that_names_it(tmp_path, file, damage):
    trainer(tmp_path).save()
    path = tmp_path / "checkpoint" / file
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-3] if damage == "cut" else damage)
    with pytest.raises(UsageError, match="checkpoint"):
        trainer(tmp_path)


@pytest.mark.parametrize("held_out", [np.zeros_like(HELD_OUT), np.ones_like(HELD_OUT)])
def test_drives_that_are_all_held_out_or_none_are_too_few(tmp_path, held_out):
    with pytest.raises(UsageError, match=r"are too few .* raise pretraining\.sequences"):
        Trainer(settings(), TABLE, held_out, tmp_path)
    assert list(tmp_path.iterdir()) == []


def stepped(
    steps: int, start: dict[str, Tensor] | None = None, skip: str = ""
) -> tuple[nn.Module, torch.optim.Adam]:
    """A linear map after some steps of Adam on a fixed slope, the moments taken over after two."""
    torch.manual_seed(0)
    module = nn.Linear(3, 2)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
    for step in range(steps):
        if step == 2 and start is not None:
            optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
            load_moments(optimizer, {k: v for k, v in start.items() if not skip or skip not in k})
        optimizer.zero_grad()
        ((step + 1) * module(torch.tensor([1.0, -2.0, 0.5])).square().sum()).backward()
        optimizer.step()
    return module, optimizer


def test_adam_goes_on_with_the_moments_that_were_kept():
    moments = moments_of(stepped(2)[1])
    assert sorted(moments) == sorted(
        f"adam.{index}.{key}" for index in (0, 1) for key in ("step", "exp_avg", "exp_avg_sq")
    )
    kept = {key: value.clone() for key, value in moments.items()}
    expected, resumed = stepped(6)[0], stepped(6, moments)[0]
    assert torch.equal(weights(resumed), weights(expected))
    assert not torch.equal(weights(stepped(6, {})[0]), weights(expected))
    assert all(torch.equal(value, kept[key]) for key, value in moments.items()), "they are not stepped on"


def test_parameters_without_moments_begin_anew():
    moments = moments_of(stepped(2)[1])
    expected, resumed, fresh = stepped(6)[0], stepped(6, moments, "adam.1.")[0], stepped(6, {})[0]
    assert not torch.equal(resumed.bias, expected.bias)
    assert not torch.equal(resumed.weight, fresh.weight)
    assert moments_of(stepped(3, moments, "adam.1.")[1])["adam.1.step"].item() == 1
    assert moments_of(stepped(3, moments, "adam.1.")[1])["adam.0.step"].item() == 3


SHOWN = ("none", "left", "right")


def plain(films: int, seed: int, length: int = 4) -> tuple[FrameTable, Tensor]:
    """Frames of one brightness with the dolly in the left half, the right half or nowhere, and the features
    of which all that is asked for is a linear map."""
    rng, found, features = np.random.default_rng(seed), [], []
    for _ in range(films):
        where = rng.integers(0, 3, length)
        level = rng.integers(0, 256, length, dtype=np.uint8)
        mask = np.zeros((length, 16, 16), np.uint8)
        mask[where == 1, :, :8] = 1
        mask[where == 2, :, 8:] = 1
        goal = np.stack(
            [rng.uniform(-0.5, 0.5, length), rng.uniform(1, 5, length), rng.uniform(-3, 3, length)], axis=1
        ).astype(np.float32)
        frame = np.broadcast_to(level[:, None, None, None], (length, 16, 16, 3)).copy()
        found.append(Film(frame, np.packbits(mask.reshape(length, -1), axis=1), goal))
        double = 2 * goal[:, 2]
        columns = [
            where == 1,
            where == 2,
            level / 255,
            goal[:, 0],
            goal[:, 1],
            np.sin(double),
            np.cos(double),
        ]
        features.append(np.stack(columns, axis=1))
    table = FrameTable.of(found, films * length, 16)
    return table, torch.from_numpy(np.concatenate(features)).float()


LEFT, RIGHT, LEVEL, BEARING, DISTANCE, SINE, COSINE = range(7)


def probed(fitted: tuple[FrameTable, Tensor], examined: tuple[FrameTable, Tensor]) -> dict[str, float]:
    """What a probe that was fitted on the one finds in the other."""
    known = dict(zip((id(fitted[0]), id(examined[0])), (fitted[1], examined[1]), strict=True))
    return LinearProbe(lambda table: known[id(table)], fitted[0]).examine(examined[0])


def test_probe_reads_what_is_in_the_features_without_error():
    found = probed(plain(100, 0), plain(60, 1))
    assert found["visibility_accuracy"] == 1.0
    assert found["mask_iou"] == 1.0
    assert found["bearing_mae_deg"] < 0.05
    assert found["distance_mae_m"] < 0.01
    assert found["yaw_mae_deg"] < 0.1
    assert found["reconstruction_mse"] < 1e-5


def test_probes_figures_are_the_errors_that_were_made():
    """The features of the examined frames say something else than what the frames show, by known amounts."""
    fitted, (table, features) = plain(100, 0), plain(60, 1)
    features[:, BEARING] += 0.1
    features[:, DISTANCE] += torch.where(torch.arange(len(features)) % 2 > 0, 0.5, -0.5)
    sine, cosine = features[:, SINE].clone(), features[:, COSINE].clone()
    turn = math.radians(2 * 12)
    features[:, SINE] = sine * math.cos(turn) + cosine * math.sin(turn)
    features[:, COSINE] = cosine * math.cos(turn) - sine * math.sin(turn)
    features[:, LEVEL] += 0.1
    found = probed(fitted, (table, features))
    assert found["bearing_mae_deg"] == pytest.approx(math.degrees(0.1), rel=0.01)
    assert found["distance_mae_m"] == pytest.approx(0.5, rel=0.01)
    assert found["yaw_mae_deg"] == pytest.approx(12.0, rel=0.01)
    assert found["reconstruction_mse"] == pytest.approx(0.01, rel=0.02)
    assert (found["visibility_accuracy"], found["mask_iou"]) == (1.0, 1.0)


def test_probes_mask_and_visibility_are_counted_over_all_pixels_and_frames():
    fitted, (table, features) = plain(100, 0), plain(60, 1)
    left, right = features[:, LEFT] == 1, features[:, RIGHT] == 1
    features[left, LEFT], features[left, RIGHT] = 0.0, 1.0  # all left ones are taken for right ones
    found = probed(fitted, (table, features))
    both = int(right.sum())
    either = both + 2 * int(left.sum())
    assert found["mask_iou"] == pytest.approx(both / either)
    assert found["visibility_accuracy"] == 1.0
    features[left, RIGHT] = 0.0  # they are overlooked
    found = probed(fitted, (table, features))
    assert found["mask_iou"] == pytest.approx(int(right.sum()) / int((left | right).sum()))
    assert found["visibility_accuracy"] == pytest.approx(1 - left.float().mean().item())


def test_errors_of_the_pose_are_of_frames_that_show_the_dolly_only():
    fitted, (table, features) = plain(100, 0), plain(60, 1)
    seen = features[:, LEFT] + features[:, RIGHT] > 0
    features[~seen, BEARING:] = 9.0
    found = probed(fitted, (table, features))
    assert found["bearing_mae_deg"] < 0.05
    spoilt = plain(100, 0)
    unseen = ~spoilt[0].visible
    spoilt[0].goal[unseen] = np.random.default_rng(2).normal(0, 7, (unseen.sum(), 3))
    found = probed(spoilt, (table, features))
    assert found["bearing_mae_deg"] < 0.05


def test_half_a_turn_is_no_error_of_yaw():
    fitted, (table, features) = plain(100, 0), plain(60, 1)
    table.goal[:, 2] += math.pi
    assert probed(fitted, (table, features))["yaw_mae_deg"] < 0.1


def test_probe_of_noise_is_at_chance():
    fitted, examined = plain(200, 0), plain(200, 1)
    rng = torch.Generator().manual_seed(0)
    noise = [torch.randn(len(table), 5, generator=rng) for table in (fitted[0], examined[0])]
    found = probed((fitted[0], noise[0]), (examined[0], noise[1]))
    table = examined[0]
    goal, seen = table.goal, table.visible
    assert found["visibility_accuracy"] == pytest.approx(seen.mean(), abs=0.03)
    assert found["bearing_mae_deg"] == pytest.approx(np.degrees(np.abs(goal[seen, 0]).mean()), rel=0.1)
    assert found["distance_mae_m"] == pytest.approx(np.abs(goal[seen, 1] - 3).mean(), rel=0.1)
    assert found["yaw_mae_deg"] == pytest.approx(45.0, rel=0.12)
    assert found["reconstruction_mse"] == pytest.approx((table.frame / 255).var(), rel=0.1)
    assert found["mask_iou"] < 0.1


def test_constant_features_do_not_upset_the_probe():
    fitted, examined = plain(100, 0), plain(60, 1)
    widened = [
        (table, torch.cat([x, torch.full((len(x), 2), 3.0)], dim=1)) for table, x in (fitted, examined)
    ]
    found = probed(*widened)
    assert found["visibility_accuracy"] == 1.0
    assert found["bearing_mae_deg"] < 0.05


@pytest.mark.parametrize("frames_per_code", [1, 4])
def test_code_features_are_the_codes_of_the_newest_frames(frames_per_code):
    config = settings(f"encoder.frames_per_code={frames_per_code}")
    encoder, table = make_encoder(config), squares(55)  # more than a batch
    features = code_features(compile_encoder(encoder, 16), frames_per_code)(table)
    stacks = table.stacks(np.arange(len(table)), frames_per_code)
    with torch.no_grad():
        expected = encoder.encode_groups(torch.from_numpy(stacks))
    assert features.shape == (330, 4)
    assert features.dtype == torch.float32
    torch.testing.assert_close(features, expected, rtol=2e-3, atol=2e-4)


def test_pixel_features_are_averages_over_areas_of_the_newest_frame():
    table = squares(55)
    features = pixel_features(4)(table)
    areas = table.frame.reshape(330, 4, 4, 4, 4, 3).mean(axis=(2, 4)) / 255
    np.testing.assert_allclose(features.numpy(), areas.transpose(0, 3, 1, 2).reshape(330, -1), atol=1e-6)


@pytest.mark.parametrize("frames_per_code", [1, 4])
def test_decoders_quality_of_a_known_answer(frames_per_code):
    """A decoder that says 0.25 and `dolly` everywhere: over all pixels, whatever the batches."""
    config, table = settings(f"encoder.frames_per_code={frames_per_code}"), squares(45)
    table.frame[256:] //= 4  # the last, smaller batch is of another kind
    table.mask[256:] = 0
    images = table.stacks(np.arange(270), frames_per_code) / 255
    masks = np.unpackbits(table.mask, axis=1)
    found = decoder_quality(constant(model_of(config), 0.25, 3.0), table)
    assert found["reconstruction_mse"] == pytest.approx(((images - 0.25) ** 2).mean(), rel=1e-4)
    assert found["mask_iou"] == pytest.approx(masks.mean(), rel=1e-6)
    assert decoder_quality(constant(model_of(config), 0.25, -3.0), table)["mask_iou"] == 0.0
    table.mask[:] = 255
    assert decoder_quality(constant(model_of(config), 0.25, 3.0), table)["mask_iou"] == 1.0
    table.mask[:] = 0
    assert decoder_quality(constant(model_of(config), 0.25, -3.0), table)["mask_iou"] == 0.0


def test_decoder_without_a_mask_has_no_figure_for_it():
    config = settings("pretraining.objective=reconstruction")
    found = decoder_quality(constant(model_of(config), 0.5, 0.0), TABLE)
    assert found == {"reconstruction_mse": pytest.approx(((TABLE.frame / 255 - 0.5) ** 2).mean(), rel=1e-4)}


def blocks(picture: np.ndarray, lines: int, rows: int, scale: int) -> list[np.ndarray]:
    """The sequences of a figure in two columns, each (16 lines, 64, 3), scaled down again."""
    high = 16 * lines
    assert picture.dtype == np.uint8
    assert picture.shape == (scale * (rows * (high + GAP) - GAP), scale * (2 * (64 + GAP) - GAP), 3)
    small = picture[::scale, ::scale]
    assert np.array_equal(picture, small.repeat(scale, axis=0).repeat(scale, axis=1))
    assert (small[:, 64 : 64 + GAP] == 255).all()
    if rows > 1:
        assert (small[high : high + GAP] == 255).all()
    corners = [(i * (high + GAP), j * (64 + GAP)) for i in range(rows) for j in range(2)]
    return [small[y : y + high, x : x + 64] for y, x in corners]


@pytest.mark.parametrize(
    ("objective", "frames_per_code"),
    [("semantic", 1), ("semantic", 4), ("reconstruction", 1), ("reconstruction", 4)],
)
def test_figure_shows_the_true_frames_above_what_the_model_makes_of_them(objective, frames_per_code):
    config = settings(f"pretraining.objective={objective}", f"encoder.frames_per_code={frames_per_code}")
    model, lines = model_of(config), 3 if objective == "semantic" else 2
    rows = np.array([5, 24, 61, 118])  # 24 begins a film, 61 is its second
    picture = reconstruction_figure(model, TABLE, rows, columns=2, scale=2)
    sequences = [[2, 3, 4, 5], [24] * 4, [60, 60, 60, 61], [115, 116, 117, 118]]
    for block, sequence in zip(blocks(picture, lines, 2, 2), sequences, strict=True):
        stack = TABLE.frame[sequence]
        assert np.array_equal(block[:16], np.concatenate(list(stack), axis=1))
        groups = stack.reshape(-1, frames_per_code, 16, 16, 3).transpose(0, 1, 4, 2, 3)
        with torch.no_grad():
            decoded, logits, _ = model(
                torch.from_numpy(groups.reshape(len(groups), -1, 16, 16) / np.float32(255))
            )
        frames = decoded.reshape(4, 3, 16, 16).clamp(0, 1).permute(0, 2, 3, 1).numpy()
        assert np.abs(block[16:32] - 255 * np.concatenate(list(frames), axis=1)).max() <= 0.51
        if lines == 3:
            share = np.concatenate(list(1 / (1 + np.exp(-logits.numpy()))), axis=1)[..., None]
            assert np.abs(block[32:, -share.shape[1] :] - 255 * share).max() <= 0.51
            assert (block[32:, : -share.shape[1]] == 0).all()


def test_sequences_that_fill_no_line_leave_white_behind():
    picture = reconstruction_figure(model_of(settings()), TABLE, np.array([5, 24, 61]), columns=2, scale=1)
    assert picture.shape == (2 * 48 + GAP, 2 * 64 + GAP, 3)
    assert (picture[48 + GAP :, 64 + GAP :] == 255).all()


def test_trainers_figure_is_of_held_out_sequences_that_show_the_dolly(tmp_path):
    held_out = HELD_OUT | ~TABLE.visible
    found = Trainer(settings(), TABLE, held_out, tmp_path)
    held = {TABLE.frame[row].tobytes() for row in np.flatnonzero(held_out & TABLE.visible)}
    newest = [block[:16, 48:].tobytes() for block in blocks(found.figure(6, scale=1), 3, 3, 1)]
    assert set(newest) <= held
    assert len(set(newest)) == 6
