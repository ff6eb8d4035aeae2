"""`navaclq bench bus`, `learner`, `replay`: rows, rivals, ratios; the figures themselves decide nothing."""

import builtins
import importlib.util
import json

import numpy as np
import pytest

from common.config import resolve
from common.observation import ObservationLayout
from deploy.bench import bus
from deploy.bench import replay as bench
from deploy.cli.main import run
from learner.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")


def navaclq(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["navaclq", "bench", *map(str, arguments), "--json"])
    with pytest.raises(SystemExit) as ended:
        run()
    assert ended.value.code == 0
    found = json.loads(capsys.readouterr().out)
    return found, {row["name"]: row["value"] for row in found["rows"]}


def test_bench_replay_compares_a_full_buffer_with_the_rivals_that_are_installed(monkeypatch, capsys):
    pytest.importorskip("cpprb")
    found, rows = navaclq(monkeypatch, capsys, "replay", "--capacity", 10_000, "--rounds", 2)
    assert rows["transitions"] == 10_000

    def fastest(*names):
        return min(rows[f"{name}: cycle, {n} at one go"] for name in names for n in (1, 4))

    rivals = ("cpprb", "torchrl") if "torchrl: cycle, 1 at one go" in rows else ("cpprb",)
    ours = fastest("navaclq")
    assert 0 < ours < rows["navaclq: SAC update"]
    assert found["ratios"]["over_best_peer"] == pytest.approx(fastest(*rivals) / ours, rel=1.0)
    assert found["ratios"]["update_over_replay_cost"] > 1
    assert len(found["skipped"]) == 2 - len(rivals)


def test_bench_replay_says_which_rivals_are_not_installed(monkeypatch, capsys):
    real = builtins.__import__

    def without_rivals(name, *rest, **named):
        if name.partition(".")[0] in ("cpprb", "tensordict", "torchrl"):
            raise ImportError(f"No module named {name!r}")
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without_rivals)
    found, rows = navaclq(monkeypatch, capsys, "replay", "--capacity", 10_000, "--rounds", 1)
    assert [line.partition(":")[0] for line in found["skipped"]] == ["cpprb", "torchrl"]
    assert all("pip install 'navaclq[bench]'" in line for line in found["skipped"])
    assert set(found["ratios"]) == {"update_over_replay_cost"}
    assert "navaclq: cycle, 1 at one go" in rows


def test_rivals_get_the_observations_that_the_replay_gathers():
    config = resolve("fast", overrides=("replay.capacity=10000", "sac.batch_size=64"))
    learner, rng = Learner(config), np.random.default_rng(0)
    learner.insert(bench.synthetic_episode(config, 25, rng), 0)
    chunk = next(bench._chunks(learner))
    size = ObservationLayout.of(config).size
    assert chunk["obs"].shape == chunk["next_obs"].shape == (bench.CHUNK, size)
    batch = learner.replay.sample(64, config.sac.n_step, config.sac.gamma, 0.4)
    flat = learner.sac.perception(batch.observation).numpy().astype(np.float16)
    assert {row.tobytes() for row in flat} <= {row.tobytes() for row in chunk["obs"]}


def test_bench_learner_compares_with_stable_baselines3_and_the_products_on_one_and_two_threads(
    monkeypatch, capsys
):
    pytest.importorskip("stable_baselines3")
    found, rows = navaclq(monkeypatch, capsys, "learner", "--rounds", 1, "--soak", 1000)
    assert abs(rows.pop("rss_growth_over_1000_updates")) < 50
    assert set(rows) == {f"{name}, {n} thread(s)" for name in ("navaclq", "products", "sb3") for n in (1, 2)}
    ratios = found["ratios"]
    assert {"over_sb3_1_thread", "over_sb3_2_threads", "over_matmul_limit"} <= set(ratios)
    # of one round: what the rows say
    expected = rows["navaclq, 1 thread(s)"] / rows["sb3, 1 thread(s)"]
    assert ratios["over_sb3_1_thread"] == pytest.approx(expected, rel=0.01)
    assert ratios["over_matmul_limit"] < 1.5


def test_bench_bus_compares_acknowledged_delivery_and_loads_a_learner_that_loses_nothing(monkeypatch, capsys):
    for constant, value in (
        ("VOLUME", 1),
        ("LEAST", 4),
        ("SMALL_COUNT", 40),
        ("WINDOW", 0.2),
        ("PROCESSES", 1),
    ):
        monkeypatch.setattr(bus, constant, value)
    found, rows = navaclq(monkeypatch, capsys, "bus", "--rounds", 1, "--load", 2, "--seconds", 0.2)
    if importlib.util.find_spec("zmq"):
        assert rows["zmq_512k"] > 0 and found["ratios"]["acked_over_zmq_512k"] > 0
    else:
        assert found["skipped"] == ["zmq: No module named 'zmq'; pip install 'navaclq[bench]'"]
    for size in bus.SIZES:
        for durability in ("process", "host"):  # of one round: what the rows say
            expected = rows[f"acked_{durability}_{size}"] / rows[f"bare_query_{size}"]
            ratio = found["ratios"][f"acked_{durability}_over_bare_query_{size}"]
            assert ratio == pytest.approx(expected, rel=0.01, abs=0.001)
        volume = rows[f"put_{size}"] * bus.SIZES[size] / 1e6
        assert 0.98 * volume < rows[f"put_{size}_volume"] <= volume
        assert rows[f"spooled_{size}"] > 0
    gain = rows["bundled_4k"] / rows["single_4k"]
    assert found["ratios"]["bundled_over_single_4k"] == pytest.approx(gain, rel=0.01, abs=0.001)
    assert rows["load_sent"] > 0
    assert rows["load_lost"] == rows["load_stored_twice"] == rows["load_refused"] == 0
    assert rows["load_acknowledged_p50"] <= rows["load_acknowledged_p99"]
    assert found["ratios"]["load_over_ingest_limit"] > 0
