"""Anybody's Gymnasium environment under a curriculum: its tasks come from there, its outcomes go there."""

from __future__ import annotations

import logging
import math
import re
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium
import zenoh
from gymnasium.core import ActType, ObsType

from common.access import LOCAL
from common.bus import Keys, Member, ask
from common.delivery import Sender, Spool
from common.errors import NoAnswerError, RefusedError, UsageError
from common.link import Link, make_link, open_client
from common.messages import MEGABYTE, MessageError, Outcome, Proposal, Proposals, TaskQuery

log = logging.getLogger(__name__)
SPOOL_BYTES = 16 * MEGABYTE
"""Outcomes that wait for a curriculum: some 60 000."""
CLOSE_SECONDS = 5.0
"""That `close` takes at most to deliver them."""

Info = dict[str, Any]


def is_success(info: Info, terminated: bool, total_reward: float) -> bool:
    """What the environment says itself; UsageError when it says nothing."""
    if "is_success" not in info:
        raise UsageError("info has no is_success at the end of the episode; pass a function as success=")
    return bool(info["is_success"])


class CurriculumWrapper(gymnasium.Wrapper[ObsType, ActType, ObsType, ActType]):
    """Resets to tasks of a running curriculum (`navaclq curriculum serve`), and reports how they end.

    A task is a number for each of the curriculum's parameters, and goes to `env.reset(options=...)` over the
    caller's options of the same names. info["curriculum"] of a reset says what came: `id`, `category`, `why`,
    `f` (predicted success, nan without one) and `task`. No answer within `timeout` s: the environment resets
    as it does by itself, category `unserved`, `task` empty, and nothing is reported of that episode; nor is
    of one that is reset before its end.

    Outcomes wait in a spool on disk until they are acknowledged, if need be by the next life of whoever has
    the same `name` and `spool`. While the spool is full they are dropped and counted in `dropped`.
    """

    def __init__(
        self,
        env: gymnasium.Env[ObsType, ActType],
        curriculum: str | Link | zenoh.Session,
        spool: Path,
        name: str,
        *,
        success: Callable[[Info, bool, float], bool] = is_success,
        timeout: float = 2.0,
        patience: float = 10.0,
        run: str = "standalone",
        group: str = LOCAL,
    ) -> None:
        """`curriculum`: an endpoint, a link (with certificates) or a session, which several may share; worker
        processes (AsyncVectorEnv with context "spawn") take an endpoint or a link.

        `name`: one of its own for each environment. `success`: of (last info, terminated, sum of rewards).
        `run`: the name of the folder of `--run`, if the curriculum has one. `group`: that of a session's
        certificate. Raises UsageError for a malformed endpoint or name, and NoAnswerError when there is no
        hub after `patience` s.
        """
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", name):
            raise UsageError(f"name {name!r}: one to 64 letters, digits, dots, hyphens and underscores")
        super().__init__(env)
        self.unserved, self.dropped, self.steps = 0, 0, 0
        self._success, self._timeout, self._keys = success, timeout, Keys(run)
        self._proposal: Proposal | None = None
        self._total, self._trouble, self._closed = 0.0, "", False
        self._open = ExitStack()
        link = make_link(curriculum) if isinstance(curriculum, str) else curriculum
        if isinstance(link, Link):
            self._session, group = self._open.enter_context(open_client(link, patience=patience)), link.group
        else:
            self._session = link
        member = Member("actor", group, name)
        # by address: a receiver takes nothing that is under another's name
        waiting = Spool(spool / group / name, SPOOL_BYTES)
        self.reports = Sender(self._session, waiting, member, uuid.uuid4().hex[:12], timeout=5.0)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[ObsType, Info]:
        """Begins an episode, with a task of the curriculum if it answers."""
        self._proposal, self._total = self._ask(), 0.0
        if self._proposal is not None:
            assert isinstance(self._proposal.task, dict)
            options = {**(options or {}), **self._proposal.task}
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "curriculum": self._told()}

    def step(self, action: ActType) -> tuple[ObsType, float, bool, bool, Info]:
        """A step; the last one of an episode reports."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        self._total += float(reward)
        if (terminated or truncated) and self._proposal is not None:
            self._report(self._proposal, self._success(info, terminated, self._total))
            self._proposal = None
        return observation, float(reward), terminated, truncated, info

    def close(self) -> None:
        """Delivers what waits, as far as CLOSE_SECONDS allow; the rest stays in the spool. Once is enough."""
        if self._closed:
            return
        self._closed = True
        left = self.reports.close(CLOSE_SECONDS)
        if left:
            log.warning("%d outcomes stay in the spool %s", left, self.reports.spool.folder)
        self._open.close()
        super().close()

    def _ask(self) -> Proposal | None:
        question, began = TaskQuery(cell=0, t=self.steps), time.monotonic()
        try:
            tasks = ask(self._session, self._keys.task, question, Proposals, self._timeout).tasks
            if not tasks or not isinstance(tasks[0].task, dict):
                raise MessageError("the curriculum has no task of numbers; has it curriculum.parameters?")
            self._trouble = ""
            return tasks[0]
        except (NoAnswerError, RefusedError, MessageError) as error:
            self.unserved += 1
            if str(error) != self._trouble:
                log.warning("no task after %.1f s: %s", time.monotonic() - began, error)
            self._trouble = str(error)
            return None

    def _told(self) -> Info:
        """Always the same keys and types, or a vector environment could not put several together."""
        proposal = self._proposal
        if proposal is None:
            return {"id": "", "category": "unserved", "why": self._trouble, "f": math.nan, "task": {}}
        values = proposal.model_dump(include={"id", "category", "why", "task"})
        return {**values, "f": math.nan if proposal.f is None else proposal.f}

    def _report(self, proposal: Proposal, success: bool) -> None:
        if self.reports.spool.full:
            self.dropped += 1
        else:
            outcome = Outcome(proposal=proposal.id, task=proposal.task, success=success)
            self.reports.put(self._keys.result, outcome)
