"""Who takes part in a run, and what each process last told about itself."""

from __future__ import annotations

import time
from collections.abc import Callable

import zenoh

from common.bus import EVERYBODY, Keys, Member, Subscription, watch_members
from common.messages import Stat
from common.version import code_version

Value = float | int | str
MOST = 4096
"""Processes of which figures are kept, the gone ones making room for those that are alive."""


class Members:
    """Everything heard from the processes of a run: who is alive, and their newest figures.

    `say` hears of joining, once a process has told what it is, and of leaving.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, say: Callable[[str], None] = lambda event: None
    ) -> None:
        self.stats: dict[Member, Stat] = {}
        self.heard: dict[Member, float] = {}
        """When the newest figures came, by time.monotonic()."""
        self._lives: dict[Member, set[str]] = {}
        self._say, self._joined = say, set[Member]()
        self._subscriptions = (
            Subscription(
                session, keys.stat(EVERYBODY), Stat, self._hear, lambda s: f"{s.role}/{s.group}/{s.name}"
            ),
            watch_members(session, keys, self._watch),
        )

    @property
    def alive(self) -> set[Member]:
        """Those that are connected; of a process that froze or lost its link it is known after the lease."""
        return set(self._lives)

    def of(self, role: str) -> dict[str, dict[str, Value]]:
        """Newest figures of the processes of a role, by label."""
        return {member.label: stat.values for member, stat in list(self.stats.items()) if member.role == role}

    @property
    def learner(self) -> dict[str, Value]:
        """The learner's figures; empty before it has spoken."""
        return next(iter(self.of("learner").values()), {})

    @property
    def curriculum(self) -> dict[str, Value]:
        """The curriculum's figures; empty before it has spoken."""
        return next(iter(self.of("curriculum").values()), {})

    def _hear(self, stat: Stat) -> None:
        member = Member(stat.role, stat.group, stat.name)
        if member not in self.stats and len(self.stats) >= MOST:
            gone = next((known for known in self.stats if known not in self._lives), None)
            if gone is None or member not in self._lives:
                return
            del self.stats[gone], self.heard[gone]
        self.stats[member], self.heard[member] = stat, time.monotonic()
        if member in self._lives and member not in self._joined:
            self._joined.add(member)
            other = (
                "" if stat.code == code_version() else f", code {stat.code}, which is not that of this host"
            )
            self._say(f"{member} joined from {stat.host} (process {stat.pid}{other})")

    def _watch(self, member: Member, life: str, alive: bool) -> None:
        if alive:
            self._lives.setdefault(member, set()).add(life)
            return
        lives = self._lives.get(member, set())
        lives.discard(life)
        if not lives:
            self._lives.pop(member, None)
        if not lives and member in self._joined:
            self._joined.discard(member)
            self._say(f"{member} left")
