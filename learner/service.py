"""The learner process: takes episodes in, logs, replays, updates, publishes weights, keeps checkpoints."""

from __future__ import annotations

import json
import logging
import math
import queue
import threading
import time
from collections import Counter, deque
from typing import Any

import numpy as np
import torch
import zenoh
from torch.utils.tensorboard import SummaryWriter

from common.bus import Keys, QueryServer, announce, publish, serve
from common.contract import check_digest, contract_encoder, make_contract
from common.delivery import unpack_header
from common.files import write_atomically
from common.messages import (
    ENDINGS,
    Acknowledgement,
    ContractReply,
    Episode,
    Message,
    Nothing,
    Version,
    decode,
    encode,
)
from common.networks import state_of
from common.observation import ObservationLayout
from common.resources import check_memory
from common.telemetry import Rate, Reporter
from common.weights import pack
from learner.checkpoint import RunDirectory
from learner.log import EpisodeLog
from learner.replay.buffer import Replay
from learner.sac import SAC, Losses

log = logging.getLogger(__name__)


class Progress:
    """What the run has achieved so far, over the last 500 episodes where it is an average."""

    def __init__(self) -> None:
        self.recent: deque[tuple[str, float, int, str]] = deque(maxlen=500)
        """(ending, return, length, category)."""
        self.staleness: deque[int] = deque(maxlen=100)
        self.losses: deque[Losses] = deque(maxlen=200)

    def success(self, last: int) -> float:
        """Share of successes among the last episodes; NaN before the first."""
        window = list(self.recent)[-last:]
        return sum(ending == "success" for ending, *_ in window) / len(window) if window else math.nan

    def figures(self) -> dict[str, float]:
        """Scalars under fixed names, as for TensorBoard; only those that exist yet."""
        scalars = {"charts/success_100": self.success(100), "charts/success_500": self.success(500)}
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

    def __init__(self, session: zenoh.Session, run: RunDirectory, minutes: float = math.inf) -> None:
        config = run.config
        torch.set_num_threads(config.learner.threads)
        self.config, self.run_directory, self._session = config, run, session
        self.keys = Keys(run.name)
        self._token = announce(session, self.keys, "learner", "learner")
        self.layout = ObservationLayout.of(config)
        self._minutes = minutes
        self._check_memory()
        self.replay = Replay(
            config.replay,
            self.layout,
            config.world.max_episode_steps,
            np.random.default_rng([config.seed, 1]),
        )
        self.sac = SAC(config)
        self.contract = make_contract(run.name, config, run.encoder)
        frozen = not config.encoder.end_to_end
        self._frozen = state_of(encoder=contract_encoder(self.contract, config)) if frozen else {}
        self._epoch = run.next_epoch()
        self._log = EpisodeLog(run.folder / "log", config.replay.capacity)
        self.progress = Progress()
        self._restore()
        self._inbox: queue.SimpleQueue[Episode] = queue.SimpleQueue()
        self._blobs: dict[str, bytes] = {}
        self._blobs_lock = threading.Lock()
        self._publish()
        every = config.learner.snapshot_steps
        self._snapshot_due = (self._log.env_steps // every + 1) * every
        self._servers = [
            QueryServer(session, self.keys.trajectory, self._take),
            serve(session, self.keys.contract, Nothing, self._answer_contract),
            QueryServer(session, self.keys.weights("policy"), lambda *_: self._answer_weights("policy")),
            QueryServer(session, self.keys.weights("critic"), lambda *_: self._answer_weights("critic")),
        ]
        self._reporter = Reporter(session, self.keys, "learner", "learner")
        self._board = SummaryWriter(str(run.folder / "tensorboard"))
        self._began: float | None = None
        self._ended = time.monotonic()
        self._first_update_from = self._log.env_steps
        self._updates_before = self.sac.updates

    def run(self) -> None:
        """Learns until SystemExit, or until the minutes since the first episode are over."""
        rates = Rate(), Rate()
        last_publish = last_checkpoint = last_board = time.monotonic()
        while not self._over():
            self._ingest()
            now = time.monotonic()
            if self._update_due():
                self._update()
            else:
                time.sleep(0.002)
            if now - last_publish >= self.config.learner.publish_seconds:
                last_publish = now
                self._publish()
            if now - last_checkpoint >= self.config.learner.checkpoint_seconds:
                last_checkpoint = now
                self.run_directory.save(self.sac, self._frozen, self._log.env_steps)
            if self._log.env_steps >= self._snapshot_due:
                self._snapshot(f"{self._log.env_steps:09d}")
                self._snapshot_due += self.config.learner.snapshot_steps
            if self._reporter.due:
                self._report(rates[0].read(self._log.env_steps), rates[1].read(self.sac.updates))
            if now - last_board >= 5.0:
                last_board = now
                speed = {"charts/SPS": rates[0].value, "charts/UPS": rates[1].value}
                for name, value in (self.progress.figures() | speed).items():
                    self._board.add_scalar(name, value, self._log.env_steps)
        log.info("the time is over after %d updates", self.sac.updates)

    def close(self) -> None:
        """Takes no more episodes, then writes checkpoint, final snapshot and summary."""
        self._ended = time.monotonic()
        for server in self._servers:
            server.close()
        self._ingest()
        self._log.close()
        self.run_directory.save(self.sac, self._frozen, self._log.env_steps)
        self._snapshot("final")
        self._board.close()
        write_atomically(
            self.run_directory.folder / "summary.json", json.dumps(self.summary(), indent=1).encode()
        )

    def summary(self) -> dict[str, Any]:
        """The run in numbers."""
        return {
            "run": self.run_directory.name,
            "env_steps": self._log.env_steps,
            "episodes": self._log.episodes,
            "updates": self.sac.updates,
            "minutes": round((self._ended - self._began) / 60, 3) if self._began else 0.0,
            "figures": {name: round(value, 5) for name, value in self.progress.figures().items()},
            "refused": dict(sum((server.refused for server in self._servers), Counter())),
        }

    def _check_memory(self) -> None:
        config = self.config
        need = Replay.bytes_needed(config.replay, self.layout, config.world.max_episode_steps)
        log.info("replay of %d transitions takes up to %.2f GB", config.replay.capacity, need / 1e9)
        check_memory(f"replay.capacity = {config.replay.capacity}", need, "lower it")

    def _restore(self) -> None:
        self.run_directory.restore(self.sac)
        for record in self._log.restore():
            self._store(decode(Episode, record.payload))
        if self._log.episodes:
            log.info(
                "resumed with %d episodes (%d steps), %d transitions in the replay, %d updates",
                self._log.episodes,
                self._log.env_steps,
                self.replay.transitions,
                self.sac.updates,
            )
        else:
            self._snapshot("initial")

    def _take(self, payload: bytes, attachment: bytes) -> bytes:
        """From the bus, in a thread of its own: an episode is acknowledged when it is in the log."""
        origin = unpack_header(attachment, payload)
        if self._log.seen.seen(origin):
            return encode(Acknowledgement(duplicate=True))
        episode = decode(Episode, payload)
        check_digest(self.contract.digest, episode.digest)
        episode.check_layout(self.layout, self.config.world.max_episode_steps)
        self._log.append(origin, episode.length, payload)
        self._inbox.put(episode)
        return encode(Acknowledgement())

    def _ingest(self) -> None:
        while not self._inbox.empty():
            episode = self._inbox.get()
            if self._began is None:
                self._began = time.monotonic() - episode.length * self.config.world.control_period
            self._store(episode)
            if episode.first_version.epoch == self._epoch:
                self.progress.staleness.append(self.sac.updates - episode.first_version.counter)

    def _store(self, episode: Episode) -> None:
        self.replay.add(episode)
        item = (episode.ending, float(episode.reward.sum()), episode.length, episode.category)
        self.progress.recent.append(item)

    def _update_due(self) -> bool:
        """Within the ratio of updates to steps, counted from this start: a resumed run does not catch up."""
        if self.replay.transitions < self.config.replay.warmup_steps:
            self._first_update_from = self._log.env_steps
            return False
        steps = self._log.env_steps - self._first_update_from
        return self.sac.updates - self._updates_before < self.config.learner.updates_per_step * steps

    def _update(self) -> None:
        config = self.config
        done = min(1.0, self._log.env_steps / config.replay.importance_steps)
        start, end = config.replay.importance_start, config.replay.importance_end
        batch = self.replay.sample(
            config.sac.batch_size, config.sac.n_step, config.sac.gamma, start + done * (end - start)
        )
        losses, errors = self.sac.update(batch)
        if not (math.isfinite(losses.critic) and math.isfinite(losses.alpha)):
            raise ArithmeticError(f"losses are not finite at update {self.sac.updates}: {losses}")
        self.replay.update_priorities(batch, errors)
        self.progress.losses.append(losses)

    def _publish(self) -> None:
        version = Version(epoch=self._epoch, counter=self.sac.updates)
        blobs = {
            "policy": encode(pack(version, self.sac.policy_state())),
            "critic": encode(pack(version, self.sac.critic_state())),
        }
        with self._blobs_lock:
            self._blobs = blobs
        publish(self._session, self.keys.version, version)

    def _answer_weights(self, kind: str) -> bytes:
        with self._blobs_lock:
            return self._blobs[kind]

    def _answer_contract(self, question: Message) -> ContractReply:
        return self.contract

    def _snapshot(self, name: str) -> None:
        networks = self.sac.policy_state() | self._frozen
        state = {"updates": self.sac.updates, "env_steps": self._log.env_steps}
        self.run_directory.snapshot(name, networks, state)

    def _over(self) -> bool:
        return self._began is not None and time.monotonic() - self._began >= 60 * self._minutes

    def _report(self, steps_per_s: float, updates_per_s: float) -> None:
        values: dict[str, float | int | str] = {
            "env_steps": self._log.env_steps,
            "episodes": self._log.episodes,
            "updates": self.sac.updates,
            "steps_per_s": round(steps_per_s, 1),
            "updates_per_s": round(updates_per_s, 1),
            "replay": self.replay.transitions,
            "elapsed_s": round(time.monotonic() - self._began, 1) if self._began else 0.0,
            "refused": sum(sum(server.refused.values()) for server in self._servers),
        }
        values |= {name: round(value, 5) for name, value in self.progress.figures().items()}
        self._reporter.report(values)
