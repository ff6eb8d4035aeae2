"""The learner's service within this process, on a real bus: what it asks of log, limiter and folder."""

import logging
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from common.bus import BUSY, Keys
from common.config import Config
from common.errors import UsageError
from common.messages import Episode, Origin, Receipt
from learner import service as module
from learner.checkpoint import RunDirectory
from learner.log import EpisodeLog, Record
from learner.service import LearnerService
from tests.helpers import (
    STORED,
    deliver,
    deliver_all,
    largest_file,
    parcel,
    reason,
    small_config,
    tiny_episode,
    wait_until,
)

pytestmark = pytest.mark.usefixtures("one_thread")
Start = Callable[..., LearnerService]
TRAJECTORY = Keys("run").trajectory
FIRST_EPISODE = 20 * 0.18
"""Seconds that count as gone when the first episode arrives."""


@pytest.fixture
def start(tmp_path: Path, hub: zenoh.Session) -> Iterator[Start]:
    """Starts learners of one run; signals are handled as before afterwards."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    started: list[LearnerService] = []

    def begin(*settings: str, seconds: float = 60.0) -> LearnerService:
        config = small_config("replay.error_buffer=100", *settings)
        started.append(LearnerService(hub, RunDirectory(tmp_path / "run", config), seconds / 60))
        return started[-1]

    yield begin
    for service in started:
        for server in service._servers:
            server.close()
        service.run_directory.release()
    for number, handler in handlers.items():
        signal.signal(number, handler)


class Feeder:
    """Delivers random episodes of 20 steps, one after the other."""

    def __init__(self, session: zenoh.Session, config: Config, digest: dict[str, str]) -> None:
        self._session, self._config, self._digest, self.sent = session, config, digest, 0

    def try_to_deliver(self, **changes) -> Receipt:
        episode = self.episode(self.sent).model_copy(update=changes)
        receipt = deliver(self._session, TRAJECTORY, episode, self.sent, address="local/feeder")
        self.sent += receipt == STORED
        return receipt

    def episode(self, seed: int) -> Episode:
        return tiny_episode(self._config, 20, seed, digest=self._digest)

    def deliver(self) -> None:
        """The next episode, which must be taken."""
        assert self.try_to_deliver() == STORED


def feeder_of(client: zenoh.Session, service: LearnerService) -> Feeder:
    return Feeder(client, service.config, service.contract.digest)


@pytest.mark.parametrize(("durability", "waits"), [("process", 0), ("host", 4)])
def test_every_acknowledgement_waits_for_the_disk_if_it_is_to_survive_the_host(
    start, client, monkeypatch, durability, waits
):
    calls, real = [], os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda number: (calls.append(number), real(number))[1])
    feeder = feeder_of(client, start(f"learner.durability={durability}"))
    for count in range(1, 5):
        feeder.deliver()
        assert len(calls) == (count if waits else 0)


def test_learner_that_lags_behind_holds_the_actors_back_until_it_has_caught_up(start, client):
    # 8 samples per step: a band of 100 and a warm-up of one step leave room for one episode of 20 steps
    service = start("replay.hold_actors=true", "replay.warmup_steps=21", "sac.batch_size=16")
    feeder = feeder_of(client, service)
    for _ in range(2):
        feeder.deliver()
        service._ingest()
    assert reason(feeder.try_to_deliver()) == BUSY
    assert service._log.env_steps == 40
    while service.learner.update(40):
        pass
    feeder.deliver()
    assert service._log.env_steps == 60
    assert not service._receiver.refused, "waiting is no refusal"


def test_episodes_that_come_together_are_taken_one_by_one_and_waited_for_once(start, client, monkeypatch):
    service = start("learner.durability=host")
    calls, real = [], os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda number: (calls.append(number), real(number))[1])
    feeder = feeder_of(client, service)
    episodes = [feeder.episode(seed) for seed in range(4)]
    episodes[1] = episodes[1].model_copy(update={"digest": {}})
    parcels = [parcel(episode, seq, address="local/feeder") for seq, episode in enumerate(episodes)]
    twice = [*parcels, parcels[0]]
    receipt = deliver_all(client, TRAJECTORY, twice, "local/feeder")
    assert [bool(answer) for answer in receipt.answers] == [False, True, False, False, False]
    assert "contract differs" in receipt.answers[1]
    assert len(calls) == 1
    assert [r.origin.seq for r in logged(service)] == [0, 2, 3]
    assert service._receiver.duplicates == 1
    assert sum(service._receiver.refused.values()) == 1
    service._ingest()
    assert service.learner.replay.transitions == 60


def logged(service: LearnerService) -> list[Record]:
    return list(EpisodeLog(service.run_directory.folder / "log", service.config.replay.capacity).restore())


def test_learner_that_lags_behind_says_busy_to_those_of_a_delivery_for_which_there_is_no_room(start, client):
    # as above: past the warm-up there is room for one episode
    service = start("replay.hold_actors=true", "replay.warmup_steps=21", "sac.batch_size=16")
    feeder = feeder_of(client, service)
    for _ in range(2):
        feeder.deliver()
        service._ingest()
    while service.learner.update(40):
        pass
    parcels = [parcel(feeder.episode(seq), seq, address="local/feeder") for seq in range(2, 6)]
    assert deliver_all(client, TRAJECTORY, parcels, "local/feeder").answers == ["", BUSY, BUSY, BUSY]
    assert service._log.env_steps == 60
    service._ingest()
    while service.learner.update(60):
        pass
    assert deliver_all(client, TRAJECTORY, parcels[1:], "local/feeder").answers == ["", BUSY, BUSY]
    assert service._log.env_steps == 80
    assert not service._receiver.refused


def test_learner_that_lags_behind_takes_all_if_it_is_not_to_hold_anybody_back(start, client):
    feeder = feeder_of(client, start())
    for _ in range(20):
        feeder.deliver()


@pytest.mark.parametrize("column", ["reward", "lidar"])
def test_numbers_that_cannot_be_are_refused_before_the_log(start, client, column):
    service = start()
    feeder = feeder_of(client, service)
    absurd = getattr(tiny_episode(service.config, 20), column).copy()
    absurd.flat[3] = 6e4
    assert column in reason(feeder.try_to_deliver(**{column: absurd}))
    assert service._log.episodes == 0


def test_snapshots_come_every_so_many_steps_and_one_that_failed_comes_late(
    start, client, monkeypatch, caplog
):
    monkeypatch.setattr(module, "RETRY_SECONDS", 0.2)
    settings = ("learner.snapshot_steps=50", "learner.checkpoint_seconds=1000")
    service = start(*settings, seconds=FIRST_EPISODE + 3.0)
    feeder = feeder_of(client, service)
    original, failures = service.run_directory.snapshot, []

    def snapshot(name, networks, state):
        if name == "000000060" and len(failures) < 2:
            failures.append(name)
            raise OSError(28, "No space left on device")
        return original(name, networks, state)

    monkeypatch.setattr(service.run_directory, "snapshot", snapshot)
    for _ in range(3):
        feeder.deliver()
    with caplog.at_level(logging.ERROR):
        service.run()
    assert len(failures) == 2
    assert "cannot write a snapshot" in caplog.text
    folder = service.run_directory.folder / "snapshots"
    assert sorted(path.name for path in folder.iterdir()) == ["000000060", "initial"]
    service.close()
    assert sorted(path.name for path in folder.iterdir()) == ["000000060", "final", "initial"]


def test_best_policy_is_kept_until_a_better_one_comes(start):
    service = start()
    scores = []
    for successes in (30, 20, 50):
        service.progress.random_tasks.extend([True] * successes + [False] * (100 - successes))
        service._save()
        scores.append(service.run_directory.best_score)
    assert scores == pytest.approx([0.3, 0.3, 0.5])


def test_replay_that_does_not_fit_into_memory_is_refused_with_its_size(start):
    with pytest.raises(
        UsageError, match=r"replay.capacity = 100000000000 needs \d+\.\d GB of memory, .* lower it"
    ):
        start("replay.capacity=100000000000")


def test_run_that_cannot_be_written_at_its_beginning_is_refused(start, tmp_path):
    config = small_config("replay.error_buffer=100")
    RunDirectory(tmp_path / "run", config)
    with (
        largest_file(1000),
        pytest.raises(UsageError, match=r"cannot write to the run directory .*run: File too large"),
    ):
        start()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_the_loop_between_two_rounds_and_all_is_saved(start, client, monkeypatch, number):
    service = start()
    feeder = feeder_of(client, service)
    for _ in range(3):
        feeder.deliver()
    original, whole = service.learner.update, []

    def update(env_steps):
        os.kill(os.getpid(), number)
        losses = original(env_steps)
        whole.append(losses)
        return losses

    monkeypatch.setattr(service.learner, "update", update)
    service.run()
    assert len(whole) == 1
    service.close()
    assert [path.name for path in service.run_directory.checkpoints()] == ["00001-000000001"]


def test_restart_takes_up_where_the_last_checkpoint_and_the_log_were(start, client):
    service = start(seconds=FIRST_EPISODE + 1.5)
    feeder = feeder_of(client, service)
    for _ in range(6):
        feeder.deliver()
    service.run()
    service.close()
    again = start()
    assert again.updates == service.updates > 0
    assert (again._log.env_steps, again.learner.replay.transitions) == (120, 120)
    assert again._epoch == service._epoch + 1
    wait_until(lambda: again._log.seen.seen(Origin(actor="local/feeder", boot="b1", seq=5)))
