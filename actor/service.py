"""The actor process: asks for tasks, drives the worlds, ships episodes, outcomes and candidates."""

from __future__ import annotations

import logging
import queue
import time
import uuid
from collections import Counter, deque
from functools import partial
from pathlib import Path

import numpy as np
import zenoh

from actor.inference import Eyes, PolicyActor
from actor.rollout import Finished, Rollout
from common.bus import Keys, Member, announce, ask_later
from common.config import Config
from common.contract import CONTRACT_DIFFERS
from common.delivery import Sender, Spool, count_life
from common.encoders import unpack_encoder
from common.errors import NoAnswerError, RefusedError, RunError, UsageError
from common.messages import (
    Candidate,
    Candidates,
    ContractReply,
    MessageError,
    Outcome,
    Proposal,
    Proposals,
    TaskQuery,
    Version,
    decode,
    encode,
)
from common.signals import stop_on_signals
from common.tasks import Task, candidate_task, random_task
from common.telemetry import Quantiles, Rate, Reporter
from common.weights import WeightsPuller

log = logging.getLogger(__name__)
CANDIDATE_BATCH = 40
RANDOM_TASKS = 100
"""Of the last ones it counts how many succeeded."""


class ActorService:
    """One actor process: W worlds, each its own agent in everything the paper says of agents."""

    def __init__(
        self,
        session: zenoh.Session,
        contract: ContractReply,
        config: Config,
        member: Member,
        spool: Path,
        cells: list[int],
    ) -> None:
        self.config, self.contract = config, contract
        self.keys = Keys(contract.run)
        self._session = session
        self._token = announce(session, self.keys, member)
        boot = uuid.uuid4().hex[:12]
        # each actor, and each of its lives, drives other episodes
        seeds = np.random.SeedSequence([config.seed, count_life(spool), *member.name.encode()]).spawn(2)
        self._rng = np.random.default_rng(seeds[0])
        eyes = Eyes(config, unpack_encoder(contract.encoder, config))
        self._rollout = Rollout(config, eyes, config.actor.worlds, config.world.max_episode_steps)
        self._actor = PolicyActor(config, len(self._rollout), np.random.default_rng(seeds[1]))
        self._cells = [cells[i % len(cells)] for i in range(len(self._rollout))]
        self._weights = WeightsPuller(session, self.keys, "policy")
        limit = config.actor.spool_megabytes * 2**20
        self._episodes = Sender(session, Spool(spool / "learner", limit), member, boot)
        self._reports = Sender(session, Spool(spool / "curriculum", limit / 8), member, boot, timeout=5.0)
        self._proposals: list[Proposal | None] = [None] * len(self._rollout)
        self._tasks: list[Task | None] = [None] * len(self._rollout)
        self._first_version = [Version()] * len(self._rollout)
        self._agent_steps = [0] * len(self._rollout)
        self._answers: queue.SimpleQueue[tuple[int, float, bytes | Exception]] = queue.SimpleQueue()
        self._task_latency = Quantiles()
        self._candidates: list[Candidate] = []
        self._random_successes: deque[bool] = deque(maxlen=RANDOM_TASKS)
        self._categories: Counter[str] = Counter()
        self._endings: Counter[str] = Counter()
        self._reporter = Reporter(session, self.keys, member)
        self._rate = Rate()

    @property
    def worlds(self) -> int:
        """How many worlds it drives."""
        return len(self._rollout)

    def run(self) -> None:
        """Drives until SIGTERM or SIGINT; raises RunError when the learner has another contract by now."""
        stopping = stop_on_signals()  # not in the middle of anything
        for slot in range(len(self._rollout)):
            for _ in range(self.config.actor.candidates_at_start):
                if stopping.is_set():
                    return
                self._look(slot)
            self._send_candidates()
            self._ask(slot)
        while not stopping.is_set():
            self._start_answered()
            self._refresh_weights()
            if self._episodes.last_refusal.startswith(CONTRACT_DIFFERS):
                raise RunError(f"the run is not the one it was: {self._episodes.last_refusal}; start again")
            if self._episodes.spool.full or self._episodes.held_back:
                time.sleep(0.05)  # back-pressure: the learner is behind or away
            else:
                for finished in self._rollout.step(self._actor):
                    self._ship(finished)
            if len(self._rollout.idle) == len(self._rollout):
                time.sleep(0.002)
            if self._reporter.due:
                self._report()

    def close(self) -> None:
        """Delivers what is waiting, as far as a few seconds allow; the rest stays in the spool."""
        left = self._episodes.close(patience=2.0)
        self._reports.close(patience=0.2)
        self._rollout.close()
        if left:
            log.warning("%d episodes stay in the spool %s", left, self._episodes.spool.folder)

    def _ask(self, slot: int) -> None:
        """Asks for the slot's next task; the other worlds go on meanwhile."""
        query = TaskQuery(cell=self._cells[slot], t=self._agent_steps[slot])
        timeout, asked = self.config.actor.task_timeout, time.monotonic()
        answer = partial(self._hear, slot, asked)
        ask_later(self._session, self.keys.task, encode(query), answer, timeout, urgent=True)

    def _hear(self, slot: int, asked: float, answer: bytes | Exception) -> None:
        self._answers.put((slot, 1000 * (time.monotonic() - asked), answer))

    def _start_answered(self) -> None:
        while not self._answers.empty():
            slot, waited_ms, answer = self._answers.get()
            proposal = _proposal(answer, self._cells[slot])
            if proposal is not None:
                self._task_latency.add(waited_ms)
            task = random_task(self._cells[slot], self.config, self._rng)
            if proposal is not None and isinstance(proposal.task, Task):
                task = proposal.task
            self._proposals[slot], self._tasks[slot] = proposal, task
            self._categories[proposal.category if proposal else "unserved"] += 1
            self._actor.refresh(slot)
            self._first_version[slot] = self._actor.version(slot)
            self._rollout.reset(slot, task)

    def _refresh_weights(self) -> None:
        newest = self._weights.newest
        if newest is not None and self._actor.newest.version < newest[0]:
            try:
                self._actor.load(*newest)
            except ValueError as error:
                raise UsageError(
                    f"the learner has other networks than are configured here: {error}"
                ) from None
            if self.config.actor.refresh == "step":
                for slot in range(len(self._rollout)):
                    self._actor.refresh(slot)

    def _ship(self, finished: Finished) -> None:
        slot, proposal = finished.slot, self._proposals[finished.slot]
        self._agent_steps[slot] += len(finished.columns.reward) - 1
        self._endings[finished.ending] += 1
        category = proposal.category if proposal else "unserved"
        if category == "random":
            self._random_successes.append(finished.ending == "success")
        episode = finished.message(
            self.contract.digest, self._first_version[slot], self._actor.version(slot), category
        )
        self._episodes.put(self.keys.trajectory, episode)
        if not self._reports.spool.full:
            outcome = Outcome(
                digest=self.contract.digest,
                proposal=proposal.id if proposal else None,
                task=self._tasks[slot],
                success=finished.ending == "success",
            )
            self._reports.put(self.keys.result, outcome)
        if proposal is not None and proposal.f is not None:
            self._look(slot)  # in place of the candidate that this episode used up
        self._ask(slot)

    def _look(self, slot: int) -> None:
        """Adds one more candidate start to the next batch for the curriculum's task database."""
        if not self.config.curriculum.uses_q:
            return
        fades = self.config.curriculum.narrowed_fades
        solved = sum(self._random_successes) / RANDOM_TASKS if fades else 0.0
        task: Task = candidate_task(self._cells[slot], self.config, self._rng, solved)
        self._candidates.append(self._rollout.look(slot, task))
        if len(self._candidates) >= CANDIDATE_BATCH:
            self._send_candidates()

    def _send_candidates(self) -> None:
        if self._candidates and not self._reports.spool.full:
            self._reports.put(
                self.keys.candidates,
                Candidates(digest=self.contract.digest, candidates=self._candidates),
            )
        self._candidates = []

    def _report(self) -> None:
        version = self._actor.newest.version
        self._reporter.report(
            {
                "env_steps": self._rollout.steps,
                "steps_per_s": round(self._rate.read(self._rollout.steps), 1),
                "spool": len(self._episodes.spool),
                "spool_full": int(self._episodes.spool.full),
                "acknowledged": self._episodes.sent,
                "refused": sum(self._episodes.refused.values()),
                "refusal": (self._episodes.last_refusal or self._reports.last_refusal)[:120],
                "weights": f"{version.epoch}.{version.counter}",
                "waiting_s": _seconds_since(self._episodes.waiting_since),
                "trouble": self._episodes.trouble[:120],
                "reports": len(self._reports.spool),
                "reports_refused": sum(self._reports.refused.values()),
                "reports_waiting_s": _seconds_since(self._reports.waiting_since),
                **self._episodes.latency.figures("episode", "ms"),
                **self._reports.latency.figures("report", "ms"),
                **self._task_latency.figures("task", "ms"),
                **self._weights.latency.figures("weights", "ms"),
                **{f"ending_{key}": value for key, value in self._endings.items()},
                **{f"task_{key}": value for key, value in self._categories.items()},
            }
        )


def _seconds_since(moment: float | None) -> float:
    return round(time.monotonic() - moment, 1) if moment else 0.0


def _proposal(answer: bytes | Exception, cell: int) -> Proposal | None:
    """The proposal for a cell in what the curriculum answered, if there is one."""
    try:
        if isinstance(answer, Exception):
            raise answer
        tasks = decode(Proposals, answer).tasks
    except (NoAnswerError, RefusedError, MessageError) as error:
        log.info("no task: %s", error)
        return None
    if not tasks or not isinstance(tasks[0].task, Task) or tasks[0].task.cell != cell:
        return None
    return tasks[0]
