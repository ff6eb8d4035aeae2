"""The live screen of a run: what its processes tell, drawn on a terminal, or a line every ten seconds."""

from __future__ import annotations

import re
import statistics
import time
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import NamedTuple

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Column, Table
from rich.text import Text

from common.bus import Member
from common.members import Members, Value
from common.messages import ENDINGS, Stat
from deploy.troubles import SILENT, Process, differs, find, find_troubles, lags, number, plain, span

LINE_SECONDS = 10.0
DRAW_SECONDS = 0.4
FORGOTTEN = 300.0
"""Seconds for which a process that is gone stays on the screen."""
MOST_TROUBLES = 8
"""Troubles on a live screen; of more it says the number."""
WIDE, WIDEST = 110, 150
"""Columns of a terminal from which there is room for more."""
WELL = "alive"
ROLES = {"learner": 0, "curriculum": 1}
"""Of the processes of a host these come first."""
CHANNELS = {"episode": "spool", "report": "reports", "task": "", "weights": ""}
"""What actors wait for, and where in their figures it says how much of it waits."""
Supervised = tuple[str, bool, int]
"""Name of a child of this process, whether it runs, and how often it was restarted."""


class Census:
    """The processes of a run as they are known now, those included that have left a while ago."""

    def __init__(self, members: Members) -> None:
        self._members = members
        self._seen: dict[Member, float] = {}

    def take(self) -> list[Process]:
        """One by one."""
        now, alive = time.monotonic(), self._members.alive
        stats, heard = dict(self._members.stats), dict(self._members.heard)
        self._seen = {member: self._seen.get(member, now) for member in alive}
        found = []
        for member in alive | stats.keys():
            silent = now - max(heard.get(member, 0.0), self._seen.get(member, 0.0))
            if member in alive or silent < FORGOTTEN:
                found.append(Process(member, member in alive, max(silent, 0.0), stats.get(member)))
        return sorted(found, key=lambda process: _natural(str(process.member)))


class Screen:
    """Shows a run until closed: `update` as often as you like, `say` for events.

    `supervised` lists the children of this process, if any.
    """

    def __init__(
        self,
        members: Members,
        console: Console,
        title: str,
        supervised: Callable[[], list[Supervised]] = list,
    ) -> None:
        self.title = title
        self._census, self._console, self._supervised = Census(members), console, supervised
        self._events: list[str] = []
        self._drawn = self._last_line = time.monotonic()
        self._live: Live | None = None
        if console.is_terminal:
            self._live = Live(console=console, refresh_per_second=2, transient=True)
            self._live.start()

    def say(self, event: str) -> None:
        """Reports an event."""
        if self._live:
            self._events = [*self._events[-4:], f"{time.strftime('%H:%M:%S')} {event}"]
        else:
            self._console.print(event, highlight=False, soft_wrap=True, markup=False)

    def update(self) -> None:
        """Draws anew what has changed, when it is time."""
        now = time.monotonic()
        if self._live and now - self._drawn >= DRAW_SECONDS:
            self._drawn = now
            known, console = self._census.take(), self._console
            self._live.update(
                picture(known, self.title, console, self._supervised(), self._events, console.height)
            )
        elif not self._live and now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            text = line(self._census.take())
            self._console.print(text, highlight=False, soft_wrap=True, markup=False)

    def close(self) -> None:
        """Gives the terminal back."""
        if self._live:
            self._live.stop()


def line(processes: list[Process]) -> str:
    """A run in one line."""
    learner, troubles = find(processes, "learner"), find_troubles(processes)
    v = learner.values if learner else {}
    told = "waiting for the learner"
    if v:
        told = (
            f"{_clock(v)}  steps {_count(v, 'env_steps')} ({_rate(v, 'steps_per_s')})  "
            f"updates {_count(v, 'updates')} ({_rate(v, 'updates_per_s')})  "
            f"episodes {_count(v, 'episodes')}  success/100 {_share(v, 'charts/success_100')}  "
            f"random tasks {_share(v, 'charts/success_random')}  "
            f"endings {_mix(v, 'endings/')}  tasks {_mix(v, 'tasks/')}  replay {_count(v, 'replay')}  "
            f"staleness {_decimal(v, 'charts/staleness')}  alpha {_decimal(v, 'losses/alpha')}  "
            f"q {_decimal(v, 'losses/qf_values')}  refused {_count(v, 'refused')}  "
            f"failed writes {_count(v, 'failed_writes')}  gate {_gate(find(processes, 'curriculum'))}  "
            f"processes {sum(p.alive for p in processes)}"
        )
    more = f" (and {len(troubles) - 1} more)" if len(troubles) > 1 else ""
    return f"{told}  WRONG: {troubles[0]}{more}" if troubles else told


def picture(
    processes: list[Process],
    title: str,
    console: Console,
    supervised: Iterable[Supervised] = (),
    events: Iterable[str] = (),
    height: int | None = None,
) -> Panel:
    """A run on one page; where that has a `height`, actors that are well may share a row."""
    learner = find(processes, "learner")
    figures = _figures(learner, find(processes, "curriculum"))
    channels = _channels([p for p in processes if p.role == "actor" and p.alive])
    parts: list[RenderableType] = [_troubles(find_troubles(processes), height is not None), ""]
    wide = console.width >= WIDE
    if wide:
        beside = Table.grid(padding=(0, 4))
        beside.add_row(figures, channels)
        parts.append(beside)
    else:
        parts.append(figures)
    said = [Text(plain(event, 300), "dim", overflow="ellipsis", no_wrap=True) for event in events]
    parts += [*_mixes(learner), "", *said]
    used = len(console.render_lines(Group(*parts), console.options.update(width=console.width - 4)))
    room = height - used - 4 if height else None
    table = _table(processes, list(supervised), console.width, room)
    parts.append(table)
    if not wide and (room is None or table.row_count + channels.row_count + 2 <= room):
        parts += ["", channels]
    return Panel(Group(*parts), title=Text(plain(title, 200)))


def _troubles(sentences: list[str], few: bool) -> RenderableType:
    if not sentences:
        return Text("nothing is wrong", "green")
    shown = sentences[:MOST_TROUBLES] if few else sentences
    more = [f"and {len(sentences) - len(shown)} more"] if len(shown) < len(sentences) else []
    table = Table.grid(padding=(0, 2))
    for i, sentence in enumerate([*shown, *more]):
        table.add_row(Text("WRONG" if i == 0 else "", "bold red"), Text(sentence, "red"))
    return table


def _figures(learner: Process | None, curriculum: Process | None) -> Table:
    """What the learner and the curriculum say of the run."""
    v = learner.values if learner else {}
    stat = learner.stat if learner else None
    steps = f"{_count(v, 'env_steps')} ({_rate(v, 'steps_per_s')})"
    updates = f"{_count(v, 'updates')} ({_rate(v, 'updates_per_s')})"
    losses = f"{_decimal(v, 'losses/alpha')}, {_decimal(v, 'losses/qf_values')}"
    versions = f"{stat.protocol}, {plain(v.get('weights', '-'), 24)}" if stat else "-"
    rows = [
        ("elapsed", _clock(v), "success, last 100", _share(v, "charts/success_100")),
        ("env steps", steps, "success, random tasks", _share(v, "charts/success_random")),
        ("updates", updates, "gate", _gate(curriculum)),
        ("episodes", _count(v, "episodes"), "staleness", _decimal(v, "charts/staleness", " updates")),
        ("replay", f"{_count(v, 'replay')} transitions", "alpha, Q", losses),
        ("refused", f"{_count(v, 'refused')} messages", "failed writes", _count(v, "failed_writes")),
        ("code", plain(stat.code, 24) if stat else "-", "protocol, weights", versions),
    ]
    table = Table.grid(padding=(0, 2))
    for name, value, other, that in rows:
        table.add_row(Text(name, "bold"), Text(value), Text(other, "bold"), Text(that))
    return table


def _mixes(learner: Process | None) -> list[Text]:
    """How episodes ended, and why their tasks were proposed."""
    v = learner.values if learner else {}
    return [
        Text.assemble((f"{name:11}", "bold"), _mix(v, f"{name}/"), no_wrap=True, overflow="ellipsis")
        for name in ("endings", "tasks")
    ]


def _channels(actors: list[Process]) -> Table:
    """What actors wait for: the median of their medians, and the slowest 99th percentile with its actor."""
    numbers = _right("p50"), _right("p99"), Column("slowest"), _right("waiting")
    table = Table("latency, ms", *numbers, box=None, padding=(0, 1), pad_edge=False)
    for channel, queue in CHANNELS.items():
        slow = [p for p in actors if f"{channel}_p99_ms" in p.values]
        medians = [number(p.values, f"{channel}_p50_ms") for p in slow]
        worst = max(slow, key=lambda p: number(p.values, f"{channel}_p99_ms"), default=None)
        table.add_row(
            Text(channel),
            f"{statistics.median(medians):.1f}" if medians else "-",
            f"{number(worst.values, f'{channel}_p99_ms'):.1f}" if worst else "-",
            Text(plain(worst.member.label, 20) if worst else "-"),
            f"{sum(number(p.values, queue) for p in actors):.0f}" if queue else "",
        )
    return table


class _Row(NamedTuple):
    """A process in the table; or several, when they are well; or none, of a child that has told nothing."""

    host: str
    name: str
    state: Text
    of: list[Process]
    restarts: str = ""


def _table(processes: list[Process], supervised: list[Supervised], width: int, room: int | None) -> Table:
    """The processes by host, that of the learner first."""
    learner = find(processes, "learner")
    rows = _rows(processes, supervised, learner)
    if room is not None and len(rows) > room:
        rows = _together(rows)
    wide, widest = width >= WIDE, width >= WIDEST
    columns = [_left("host", 24 if wide else 12), _left("process", 32 if wide else 20), _left("state", 24)]
    columns += [_right(name) for name in ("up", "steps/s", "queue", "weights")]
    columns += [_left("code", 24), _right("pid")] if wide else []
    columns += [_right(f"{channel} p99") for channel in CHANNELS] if widest else []
    columns += [_right("restarts")] if supervised else []
    table = Table(*columns, box=None, padding=(0, 1), collapse_padding=not wide, pad_edge=False)
    before = None
    for row in rows:
        stat = row.of[0].stat if len(row.of) == 1 else None
        there = [p for p in row.of if p.alive]
        cells = [
            Text(row.host if row.host != before else "", "bold"),
            Text(row.name),
            row.state,
            _up(stat),
            _sum(there, "steps_per_s", "frames_per_s"),
            _sum(there, "spool", "reports", "inbox"),
            Text(plain(stat.values.get("weights", ""), 16) if stat else ""),
        ]
        if wide:
            cells += [Text(plain(stat.code, 24) if stat else ""), Text(str(stat.pid) if stat else "")]
        if widest:
            cells += [_p99(there, channel) for channel in CHANNELS]
        if supervised:
            cells.append(Text(row.restarts))
        table.add_row(*cells)
        before = row.host
    return table


def _rows(processes: list[Process], supervised: list[Supervised], learner: Process | None) -> list[_Row]:
    restarts = {name: str(count) for name, _, count in supervised}
    rows = [
        _Row(_host(p), plain(p.member, 60), _state(p, learner), [p], restarts.get(p.member.name, ""))
        for p in sorted(processes, key=lambda p: ROLES.get(p.role, len(ROLES)))
    ]
    known = {p.member.name for p in processes}
    for name, alive, _ in supervised:
        if name not in known:
            state = Text("starting", "yellow") if alive else Text("down", "red")
            rows.append(_Row(_host(learner), plain(name, 60), state, [], restarts[name]))
    return sorted(rows, key=lambda row: (row.host == "-", row.host != _host(learner), row.host))


def _together(rows: list[_Row]) -> list[_Row]:
    """The same with the actors of a host that are well in one row."""
    found = []
    for host, those in groupby(rows, lambda row: row.host):
        well: list[Process] = []
        for row in those:
            if row.state.plain == WELL and row.of[0].role == "actor":
                well += row.of
            else:
                found.append(row)
        if well:
            found.append(_Row(host, f"{len(well)} actors", Text(WELL, "green"), well))
    return found


def _state(process: Process, learner: Process | None) -> Text:
    time = span(process.silent)
    if not process.alive:
        return Text(f"gone {time}", "red")
    if process.stat is None:
        return Text(f"starting {time}", "yellow")
    if process.mute:
        return Text(f"silent {time}", "red")
    if number(process.values, "spool_full"):
        return Text("paused, spool full", "red")
    if process.waits >= SILENT:
        waiting = "held back" if process.held_back else "waiting"
        return Text(f"{waiting} {span(process.waits)}", "yellow")
    if differs(process, learner):
        return Text(f"{WELL}, other code", "red")
    if lags(process, learner):
        return Text(f"{WELL}, old weights", "red")
    refused = number(process.values, "refused") + number(process.values, "reports_refused")
    if process.role == "actor" and refused:
        return Text(f"{WELL}, {refused:.0f} refused", "red")
    return Text(WELL, "green")


def _host(process: Process | None) -> str:
    return plain(process.stat.host, 64) if process and process.stat else "-"


def _up(stat: Stat | None) -> Text:
    return Text(span(time.time() - stat.since) if stat and stat.since > 0 else "")


def _sum(processes: list[Process], *names: str) -> Text:
    told = [number(p.values, name) for p in processes for name in names if name in p.values]
    return Text(f"{sum(told):.0f}" if told else "")


def _p99(processes: list[Process], channel: str) -> Text:
    key = f"{channel}_p99_ms"
    told = [number(p.values, key) for p in processes if key in p.values]
    return Text(f"{max(told):.1f}" if told else "")


def _left(name: str, most: int) -> Column:
    return Column(name, no_wrap=True, max_width=most)


def _right(name: str) -> Column:
    return Column(name, justify="right", no_wrap=True)


def _gate(curriculum: Process | None) -> str:
    v = curriculum.values if curriculum else {}
    if "gate_open" not in v:
        return "-"
    return f"{'open' if number(v, 'gate_open') else 'closed'}, success {_share(v, 'gate_success')}"


def _clock(values: dict[str, Value]) -> str:
    whole = max(0, int(number(values, "elapsed_s")))
    return f"{whole // 60:02d}:{whole % 60:02d}"


def _count(values: dict[str, Value], key: str) -> str:
    return f"{number(values, key):.0f}"


def _rate(values: dict[str, Value], key: str) -> str:
    return f"{number(values, key):.1f}/s"


def _share(values: dict[str, Value], key: str) -> str:
    return f"{100 * number(values, key):.0f}%" if key in values else "-"


def _decimal(values: dict[str, Value], key: str, unit: str = "") -> str:
    return f"{number(values, key):.2f}{unit}" if key in values else "-"


def _mix(values: dict[str, Value], prefix: str) -> str:
    found = {k.removeprefix(prefix): k for k in values if k.startswith(prefix)}
    order: list[str] = [name for name in ENDINGS if name in found] or sorted(found)
    return "  ".join(f"{plain(name, 20)} {_share(values, found[name])}" for name in order) or "-"


def _natural(text: str) -> list[int | str]:
    """Sorts x-2 before x-10."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", text))]
