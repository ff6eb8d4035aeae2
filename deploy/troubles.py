"""What is wrong in a run, in words: from who is connected, and from what each process last told of itself.

Figures come from the bus and are not trusted: one that is missing or odd is passed over.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from common.bus import BUSY, Member
from common.members import Value
from common.messages import Stat

SILENT = 5.0
"""Seconds without a word, or of waiting, that are worth one; a process tells its figures once a second."""
STARTING = 2.5
"""The same for one that has told nothing yet."""
HELD_BACK = 60.0
"""Seconds for which the learner may have an actor wait: it does so to keep a balance."""
FAILED = 90.0
"""Seconds after a failed write for which the disk is not trusted; checkpoints are a minute apart."""
LAG = 15.0
"""Seconds of updates by which an actor's weights may be older than the learner's, besides its pauses."""
NAMED = 3
"""Processes that are named one by one; of more only the first, in one sentence."""


class Process(NamedTuple):
    """A process of a run, as known here and now."""

    member: Member
    alive: bool
    """Whether it is connected."""
    silent: float
    """Seconds since its newest figures, or since it was first seen."""
    stat: Stat | None
    """Its newest figures, those of its former life included; None before any."""

    @property
    def values(self) -> dict[str, Value]:
        """Its newest figures by name."""
        return self.stat.values if self.stat else {}

    @property
    def role(self) -> str:
        """Such as `actor`."""
        return self.member.role

    @property
    def mute(self) -> bool:
        """Whether it is connected, but has been quiet for too long."""
        return self.alive and self.silent >= (SILENT if self.stat else STARTING)

    @property
    def waits(self) -> float:
        """Seconds for which an actor has not got rid of its episodes."""
        return number(self.values, "waiting_s")

    @property
    def held_back(self) -> bool:
        """Whether it waits because the learner told it to."""
        return self.values.get("trouble") == BUSY


def number(values: Mapping[str, object], key: str) -> float:
    """The figure as a finite number; 0 where there is none."""
    value = values.get(key)
    try:
        found = float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:
        return 0.0
    return found if math.isfinite(found) else 0.0


def plain(text: object, most: int = 160) -> str:
    """Text from elsewhere, without anything that could move a terminal's cursor."""
    shown = "".join(c if c.isprintable() else "?" for c in str(text))
    return shown if len(shown) <= most else shown[: most - 3] + "..."


def span(seconds: float) -> str:
    """A time in the largest unit that tells enough."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"


def find(processes: Iterable[Process], role: str) -> Process | None:
    """The process of a role of which there is one: the live one, else the last."""
    return max((p for p in processes if p.role == role), key=lambda p: (p.alive, -p.silent), default=None)


def version_of(process: Process | None) -> tuple[int, int] | None:
    """(Incarnation of the learner, its updates) of the weights of a process; None if it does not say."""
    told = process.values.get("weights") if process else None
    parts = told.split(".") if isinstance(told, str) and len(told) < 40 else []
    known = len(parts) == 2 and all(part.isdecimal() for part in parts)
    return (int(parts[0]), int(parts[1])) if known else None


def lags(process: Process, learner: Process | None) -> bool:
    """Whether an actor drives with weights that it should have replaced."""
    mine, newest = version_of(process), version_of(learner)
    if process.role != "actor" or learner is None or mine is None or newest is None:
        return False
    allowed = LAG + 2 * number(learner.values, "publish_s")
    behind = newest[1] - mine[1]
    return mine[0] < newest[0] or behind > allowed * max(2.0, number(learner.values, "updates_per_s"))


def differs(process: Process, learner: Process | None) -> bool:
    """Whether it runs another program than the learner."""
    mine, theirs = process.stat, learner.stat if learner else None
    return bool(mine and theirs and (mine.code, mine.protocol) != (theirs.code, theirs.protocol))


def find_troubles(processes: Iterable[Process]) -> list[str]:
    """A sentence for each thing that is wrong, the worst first; none when all is well."""
    known = list(processes)
    alive = [p for p in known if p.alive]
    if not alive:
        since = f" since {span(min(p.silent for p in known))}" if known else ""
        return [f"nobody is connected{since}: neither learner, curriculum nor actors"]
    learner = find(known, "learner")
    actors = [p for p in alive if p.role == "actor"]
    return [
        *_absences(known, alive, actors),
        *_failed_writes(alive),
        *_silences(known, alive),
        *_refusals(actors),
        *_deliveries(actors, known),
        *_versions(alive, learner),
    ]


def _absences(known: list[Process], alive: list[Process], actors: list[Process]) -> list[str]:
    """Roles that nobody plays. Actors that film frames for a pre-training need no other role."""
    filming = [p for p in actors if "frames" in p.values]
    driving = [p for p in actors if p.stat and p not in filming]
    learner, curriculum = find(known, "learner"), find(known, "curriculum")
    found = []
    if not (learner and learner.alive) and (driving or learner):
        count = len(driving)
        waiting = f": {count} actor{'s wait' if count > 1 else ' waits'}" if driving else ""
        found.append(f"no learner{_since(learner)}{waiting}")
    if not (curriculum and curriculum.alive) and (driving or (learner and learner.alive)):
        instead = ": actors drive random tasks" if driving else ""
        found.append(f"curriculum is not there{_since(curriculum)}{instead}")
    if learner and learner.alive and not actors:
        found.append("no actors: the learner waits for episodes")
    return found


def _since(gone: Process | None) -> str:
    return f" since {span(gone.silent)}" if gone else ""


def _failed_writes(alive: list[Process]) -> list[str]:
    found = []
    for process in alive:
        count, ago = number(process.values, "failed_writes"), number(process.values, "failed_s")
        if count >= 1 and ago < FAILED:
            writes = f"{count:.0f} failed write{'s' if count > 1 else ''}"
            found.append(f"{process.member}: cannot write to its disk ({writes})")
    return found


def _silences(known: list[Process], alive: list[Process]) -> list[str]:
    mute = [p for p in alive if p.mute]
    roles = "learner", "curriculum"  # of these it is said what their absence means
    return [
        *_say(
            [p for p in known if not p.alive and p.role not in roles],
            "{who} is gone since {time}",
            "{count} processes are gone since {time} or less: {who}",
            _silent,
        ),
        *_say(
            [p for p in mute if p.stat],
            "{who} says nothing since {time}",
            "{count} processes say nothing since {time} or less: {who}",
            _silent,
        ),
        *_say(
            [p for p in mute if not p.stat],
            "{who} is connected but has told nothing for {time}: it starts, or hangs",
            "{count} processes are connected but have told nothing for {time} or less: {who}",
            _silent,
        ),
    ]


def _refusals(actors: list[Process]) -> list[str]:
    reasons: dict[str, list[Process]] = defaultdict(list)
    for actor in actors:
        if number(actor.values, "refused") >= 1 or number(actor.values, "reports_refused") >= 1:
            reasons[plain(actor.values.get("refusal") or "for a reason it does not tell")].append(actor)
    return [
        sentence
        for reason, those in reasons.items()
        for sentence in _say(
            those, "{who}: refused: {what}", "{count} actors: refused: {what}: {who}", what=reason
        )
    ]


def _deliveries(actors: list[Process], known: list[Process]) -> list[str]:
    learner, curriculum = find(known, "learner"), find(known, "curriculum")
    here, served = learner and learner.alive, curriculum and curriculum.alive
    speaking = [p for p in actors if not p.mute]
    return [
        *_say(
            [p for p in speaking if here and not p.held_back and p.waits >= SILENT],
            "{who} waits for the learner since {time}",
            "{count} actors wait for the learner since {time} or less: {who}",
            lambda p: p.waits,
        ),
        *_say(
            [p for p in speaking if here and p.held_back and p.waits >= HELD_BACK],
            "{who} is told by the learner to wait since {time}",
            "{count} actors are told by the learner to wait since {time} or less: {who}",
            lambda p: p.waits,
        ),
        *_say(
            [p for p in speaking if served and number(p.values, "reports_waiting_s") >= SILENT],
            "{who} waits for the curriculum since {time}",
            "{count} actors wait for the curriculum since {time} or less: {who}",
            lambda p: number(p.values, "reports_waiting_s"),
        ),
        *_say(
            [p for p in speaking if number(p.values, "spool_full")],
            "{who}'s spool is full: the simulation is paused",
            "{count} actors' spools are full, their simulations are paused: {who}",
        ),
    ]


def _versions(alive: list[Process], learner: Process | None) -> list[str]:
    others: dict[str, list[Process]] = defaultdict(list)
    for process in alive:
        if learner and learner.stat and process.stat and differs(process, learner):
            mine, theirs = process.stat, learner.stat
            if mine.protocol != theirs.protocol:
                others[f"protocol {mine.protocol}, the learner {theirs.protocol}"].append(process)
            else:
                others[f"{plain(mine.code, 64)}, the learner {plain(theirs.code, 64)}"].append(process)
    different = [
        sentence
        for what, those in others.items()
        for sentence in _say(
            those,
            "{who} runs other code than the learner ({what})",
            "{count} processes run other code than the learner ({what}): {who}",
            what=what,
        )
    ]
    newest = version_of(learner)
    return different + _say(
        [p for p in alive if lags(p, learner) and not p.mute],
        "{who} drives with old weights ({mine}; the learner has {what})",
        "{count} actors drive with old weights (the learner has {what}): {who}",
        what=".".join(map(str, newest or ())),
    )


def _silent(process: Process) -> float:
    return process.silent


def _say(
    those: list[Process],
    one: str,
    many: str,
    time: Callable[[Process], float] = lambda process: 0.0,
    what: str = "",
) -> list[str]:
    """A sentence for each, or one for all when they are more than NAMED."""
    if len(those) > NAMED:
        labels = [plain(p.member.label if p.role == "actor" else p.member) for p in those[:NAMED]]
        who = f"{', '.join(labels)} and {len(those) - NAMED} more"
        return [many.format(count=len(those), who=who, what=what, time=span(max(map(time, those))))]
    return [
        one.format(
            who=plain(p.member), what=what, time=span(time(p)), mine=plain(p.values.get("weights"), 40)
        )
        for p in those
    ]
