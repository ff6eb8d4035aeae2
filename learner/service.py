"""The learner process: takes episodes in, logs, replays, updates, publishes weights, keeps checkpoints."""

from __future__ import annotations

import json
import logging
import math
import os
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import zenoh
from torch.utils.tensorboard import SummaryWriter

from common.access import LOCAL
from common.bus import BUSY, Keys, Member, QueryServer, announce, publish, serve
from common.contract import check_digest, make_contract
from common.delivery import Parcel, Receiver
from common.encoders import unpack_encoder
from common.errors import RunError, UsageError
from common.files import write_atomically
from common.members import Members
from common.messages import (
    ENDINGS,
    ContractReply,
    Episode,
    Message,
    MessageError,
    Nothing,
    Version,
    decode,
    encode,
)
from common.networks import state_of
from common.observation import ObservationLayout
from common.resources import check_memory, learner_threads
from common.signals import stop_on_signals
from common.telemetry import Rate, Reporter
from common.weights import pack
from common.world_config import StartRanges
from learner.checkpoint import RunDirectory
from learner.learner import Learner
from learner.log import EpisodeLog
from learner.replay.buffer import Replay
from learner.sac import Losses

log = logging.getLogger(__name__)
RETRY_SECONDS = 5.0
"""Until a snapshot that could not be written is tried again."""
BEST_OF = 100
"""Tasks whose success decides which policy is the best so far; at least half of them must be there."""


class Progress:
    """What the run has achieved so far, over the last 500 episodes where it is an average."""

    def __init__(self, full: StartRanges) -> None:
        self._full = full
        self.recent: deque[tuple[str, float, int, str]] = deque(maxlen=500)
        """(ending, return, length, category)."""
        self.staleness: deque[int] = deque(maxlen=100)
        self.losses: deque[Losses] = deque(maxlen=200)
        self.random_tasks: deque[bool] = deque(maxlen=BEST_OF)
        """Whether tasks that no curriculum chose, drawn from the full ranges of starts, succeeded."""

    def add(self, episode: Episode) -> None:
        """Takes note of an episode."""
        item = (episode.ending, float(episode.reward.sum()), episode.length, episode.category)
        self.recent.append(item)
        if episode.category in ("random", "unserved") and episode.task.start == self._full:
            self.random_tasks.append(episode.ending == "success")

    def success(self, last: int) -> float:
        """Share of successes among the last episodes; NaN before the first."""
        window = list(self.recent)[-last:]
        return sum(ending == "success" for ending, *_ in window) / len(window) if window else math.nan

    def figures(self) -> dict[str, float]:
        """Scalars under fixed names, as for TensorBoard; only those that exist yet."""
        scalars = {"charts/success_100": self.success(100), "charts/success_500": self.success(500)}
        if len(self.random_tasks) >= BEST_OF // 2:
            scalars["charts/success_random"] = float(np.mean(self.random_tasks))
        if self.recent:
            scalars["charts/episodic_return"] = float(np.mean([item[1] for item in self.recent]))
            scalars["charts/episodic_length"] = float(np.mean([item[2] for item in self.recent]))
            counts = Counter(item[0] for item in self.recent)
            scalars |= {f"endings/{name}": counts[name] / len(self.recent) for name in ENDINGS}
            categories = Counter(item[3] for item in self.recent)
            scalars |= {f"tasks/{name}": n / len(self.recent) for name, n in categories.items()}
        if self.staleness:
            scalars["charts/staleness"] = float(np.mean(self.staleness))
        if self.losses:
            table = np.array(self.losses, np.float64)
            names = (
                "losses/qf_loss",
                "losses/qf_values",
                "losses/actor_loss",
                "losses/entropy",
                "losses/alpha",
            )
            for column, name in enumerate(names):
                finite = table[:, column][~np.isnan(table[:, column])]
                if len(finite):
                    scalars[name] = float(finite.mean())
        return {name: value for name, value in scalars.items() if math.isfinite(value)}


class LearnerService:
    """One learner; owns the log, the replay with its tree, the networks and the run directory."""

    def __init__(
        self, session: zenoh.Session, run: RunDirectory, minutes: float = math.inf, group: str = LOCAL
    ) -> None:
        config = run.config
        torch.set_num_threads(learner_threads(config.learner.threads, os.cpu_count() or 1))
        self.config, self.run_directory, self._session = config, run, session
        self.keys = Keys(run.name)
        member = Member("learner", group, "learner")
        self._token = announce(session, self.keys, member)
        self._minutes = minutes
        self._check_memory()
        self.learner = Learner(config)
        log.info("SAC on %s, %d thread(s) of torch", self.learner.sac.device, torch.get_num_threads())
        self.contract = make_contract(run.name, config, run.encoder)
        frozen = not config.encoder.end_to_end
        self._frozen = state_of(encoder=unpack_encoder(run.encoder, config)) if frozen else {}
        self._epoch = run.next_epoch()
        sync = config.learner.durability == "host"
        self._log = EpisodeLog(run.folder / "log", config.replay.capacity, sync=sync)
        self.progress = Progress(config.world.start)
        self._best = run.best_score
        self._failed_writes, self._complained = 0, -math.inf
        self._restore()
        self._accepted = self.learner.limiter.inserted
        """Transitions in the log, those that wait in the inbox included."""
        self._inbox: queue.SimpleQueue[tuple[Episode, int]] = queue.SimpleQueue()
        self._blobs: dict[str, bytes] = {}
        self._blobs_lock = threading.Lock()
        self._publish()
        self._snapshot_due = self._next_snapshot()
        seen = self._log.seen.seen
        commit = self._log.commit if sync else None  # without it each is answered at once
        self._receiver = Receiver(
            session, self.keys.trajectory, self._take, seen, Episode.max_bytes, commit=commit
        )
        self._servers = [
            self._receiver,
            serve(session, self.keys.contract, Nothing, self._answer_contract),
            QueryServer(session, self.keys.weights("policy"), partial(self._answer_weights, "policy")),
            QueryServer(session, self.keys.weights("critic"), partial(self._answer_weights, "critic")),
        ]
        self._reporter = Reporter(session, self.keys, member)
        self._members = Members(session, self.keys, log.info)
        self._board: SummaryWriter | None = None
        self._began: float | None = None
        self._ended = time.monotonic()

    @property
    def updates(self) -> int:
        """SAC updates of the run so far."""
        return self.learner.sac.updates

    def run(self) -> None:
        """Learns until SIGTERM or SIGINT, or until the minutes since the first episode are over.

        Raises RunError when it cannot go on.
        """
        stopping = stop_on_signals()  # not in the middle of an update, which the last checkpoint would keep
        rates = Rate(), Rate()
        last_publish = last_checkpoint = last_board = snapshot_again = time.monotonic()
        while not (self._over() or stopping.is_set()):
            self._ingest()
            now = time.monotonic()
            losses = self.learner.update(self._log.env_steps)
            if losses is None:
                time.sleep(0.002)
            else:
                self.progress.losses.append(losses)
            if now - last_publish >= self.config.learner.publish_seconds:
                last_publish = now
                self._publish()
            if now - last_checkpoint >= self.config.learner.checkpoint_seconds:
                last_checkpoint = now
                self._try("a checkpoint", self._save)
            if self._log.env_steps >= self._snapshot_due and now >= snapshot_again:
                if self._try("a snapshot", partial(self._snapshot, f"{self._log.env_steps:09d}")):
                    self._snapshot_due = self._next_snapshot()
                snapshot_again = now + RETRY_SECONDS
            if self._reporter.due:
                self._report(rates[0].read(self._log.env_steps), rates[1].read(self.updates))
            if now - last_board >= 5.0:
                last_board = now
                speed = {"charts/SPS": rates[0].value, "charts/UPS": rates[1].value}
                self._try("the curves", partial(self._draw, self.progress.figures() | speed))
        why = "stopped" if stopping.is_set() else "the time is over"
        log.info("%s after %d updates", why, self.updates)

    def close(self) -> None:
        """Takes no more episodes, then writes checkpoint, final snapshot and summary, and lets the folder go.

        Raises RunError when they cannot be written.
        """
        self._ended = time.monotonic()
        for server in self._servers:
            server.close()
        self._ingest()
        self._log.close()
        folder = self.run_directory.folder
        try:
            self._save()
            self._snapshot("final")
            if self._board:
                self._board.close()
            write_atomically(folder / "summary.json", json.dumps(self.summary(), indent=1).encode())
        except OSError as error:
            raise RunError(
                f"cannot write the last checkpoint to {folder}: {error.strerror}; "
                "the one before it and all episodes are whole, and the run resumes from them"
            ) from None
        finally:
            self.run_directory.release()
            self._token.undeclare()  # type: ignore[no-untyped-call]

    def summary(self) -> dict[str, Any]:
        """The run in numbers."""
        return {
            "run": self.run_directory.name,
            "env_steps": self._log.env_steps,
            "episodes": self._log.episodes,
            "updates": self.updates,
            "minutes": round((self._ended - self._began) / 60, 3) if self._began else 0.0,
            "figures": {name: round(value, 5) for name, value in self.progress.figures().items()},
            "refused": dict(sum((server.refused for server in self._servers), Counter())),
        }

    def _check_memory(self) -> None:
        config = self.config
        steps = config.world.max_episode_steps
        need = Replay.bytes_needed(config.replay, ObservationLayout.of(config), steps)
        log.info("replay of %d transitions takes up to %.2f GB", config.replay.capacity, need / 1e9)
        check_memory(f"replay.capacity = {config.replay.capacity}", need, "lower it")

    def _restore(self) -> None:
        for record in self._log.restore():
            episode = decode(Episode, record.payload)
            self.learner.insert(episode, record.env_steps - record.length, restored=True)
            self.progress.add(episode)
        self.run_directory.restore(self.learner)
        if self._log.episodes:
            log.info(
                "resumed with %d episodes (%d steps), %d transitions in the replay, %d updates",
                self._log.episodes,
                self._log.env_steps,
                self.learner.replay.transitions,
                self.updates,
            )
        else:
            try:
                self._snapshot("initial")
            except OSError as error:
                raise UsageError(
                    f"cannot write to the run directory {self.run_directory.folder}: {error.strerror}"
                ) from None

    def _take(self, parcel: Parcel) -> None:
        """From the bus, in a thread of its own: an episode is acknowledged when it is in the log.

        It is sent again later when the disk is full, or when the limiter holds the actors back.
        """
        episode = decode(Episode, parcel.payload)
        check_digest(self.contract.digest, episode.digest)
        world = self.config.world
        episode.check_layout(self.learner.layout, world.max_episode_steps, world.reward.largest)
        waiting = self._accepted - self.learner.limiter.inserted
        if not self.learner.limiter.may_insert(waiting + episode.length):
            raise MessageError(BUSY)
        try:
            record = self._log.append(parcel, episode.length)
        except OSError as error:
            self._complain("an episode", error)
            raise MessageError(BUSY) from None
        self._accepted += episode.length
        self._inbox.put((episode, record.env_steps - record.length))

    def _ingest(self) -> None:
        while not self._inbox.empty():
            episode, first_step = self._inbox.get()
            if self._began is None:
                self._began = time.monotonic() - episode.length * self.config.world.control_period
            self.learner.insert(episode, first_step)
            self.progress.add(episode)
            if episode.first_version.epoch == self._epoch:
                self.progress.staleness.append(self.updates - episode.first_version.counter)
        if self._log.broken is not None:
            raise RunError(
                f"the disk could not confirm the log of episodes in {self.run_directory.folder} "
                f"({self._log.broken.strerror}); what was not acknowledged is sent again after a restart"
            )

    def _try(self, what: str, write: Callable[[], None]) -> bool:
        """Whether it could be written; if not, it is tried again: a full disk must not end the training."""
        try:
            write()
        except OSError as error:
            self._complain(what, error)
            return False
        return True

    def _complain(self, what: str, error: OSError) -> None:
        self._failed_writes += 1
        now = time.monotonic()
        if now - self._complained >= 5.0:
            self._complained = now
            log.error(
                "cannot write %s to %s: %s; training goes on, and it is tried again",
                what,
                self.run_directory.folder,
                error.strerror or error,
            )

    def _save(self) -> None:
        self.run_directory.save(self.learner, self._frozen, self._epoch, self._log.env_steps)
        score = self.progress.figures().get("charts/success_random", -math.inf)
        if score > self._best:
            self._snapshot("best", success_random=score)
            self._best = score

    def _draw(self, scalars: dict[str, float]) -> None:
        if self._board is None:
            self._board = SummaryWriter(str(self.run_directory.folder / "tensorboard"))
        try:
            for name, value in scalars.items():
                self._board.add_scalar(name, value, self._log.env_steps)
        except OSError:
            self._board = None  # its thread has ended with the error; the next attempt begins a new file
            raise

    def _publish(self) -> None:
        version = Version(epoch=self._epoch, counter=self.updates)
        blobs = {
            "policy": encode(pack(version, self.learner.sac.policy_state())),
            "critic": encode(pack(version, self.learner.sac.critic_state())),
        }
        with self._blobs_lock:
            self._blobs = blobs
        publish(self._session, self.keys.version, version)

    def _answer_weights(self, kind: str, payload: bytes, *_: bytes | str) -> bytes:
        decode(Nothing, payload)
        with self._blobs_lock:
            return self._blobs[kind]

    def _answer_contract(self, question: Message) -> ContractReply:
        return self.contract

    def _snapshot(self, name: str, **figures: float) -> None:
        networks = self.learner.sac.policy_state() | self._frozen
        state = {"updates": self.updates, "env_steps": self._log.env_steps, **figures}
        self.run_directory.snapshot(name, networks, state)

    def _next_snapshot(self) -> int:
        """The number of environment steps at which the next snapshot is due."""
        every = self.config.learner.snapshot_steps
        return (self._log.env_steps // every + 1) * every

    def _over(self) -> bool:
        return self._began is not None and time.monotonic() - self._began >= 60 * self._minutes

    def _report(self, steps_per_s: float, updates_per_s: float) -> None:
        values: dict[str, float | int | str] = {
            "env_steps": self._log.env_steps,
            "episodes": self._log.episodes,
            "updates": self.updates,
            "steps_per_s": round(steps_per_s, 1),
            "updates_per_s": round(updates_per_s, 1),
            "replay": self.learner.replay.transitions,
            "failed_writes": self._failed_writes,
            "elapsed_s": round(time.monotonic() - self._began, 1) if self._began else 0.0,
            "refused": sum(sum(server.refused.values()) for server in self._servers),
            "duplicates": self._receiver.duplicates,
            "inbox": len(self._receiver) + self._inbox.qsize(),
            "weights": f"{self._epoch}.{self.updates}",
            "publish_s": self.config.learner.publish_seconds,
            "members": len(self._members.alive),
        }
        if self._failed_writes:
            values["failed_s"] = round(time.monotonic() - self._complained, 1)
        values |= {name: round(value, 5) for name, value in self.progress.figures().items()}
        self._reporter.report(values)
