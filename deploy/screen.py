"""The live screen of a run: what the processes tell, as a table on a terminal or a line every ten seconds."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import zenoh
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table

from common.bus import Keys, Subscription, watch_members
from common.messages import ENDINGS, Stat

Value = float | int | str
LINE_SECONDS = 10.0


class Monitor:
    """Everything heard from the processes of a run: their newest figures, and who is alive."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self.stats: dict[tuple[str, str], Stat] = {}
        self.alive: dict[tuple[str, str], bool] = {}
        self._subscriptions = (
            Subscription(session, keys.stat("*", "*"), Stat, self._hear),
            watch_members(session, keys, self._member),
        )

    def _hear(self, stat: Stat) -> None:
        self.stats[stat.role, stat.id] = stat

    def _member(self, role: str, name: str, alive: bool) -> None:
        self.alive[role, name] = alive

    def of(self, role: str) -> dict[str, dict[str, Value]]:
        """Newest figures of the processes of a role, by name."""
        return {name: stat.values for (kind, name), stat in list(self.stats.items()) if kind == role}

    @property
    def learner(self) -> dict[str, Value]:
        """The learner's figures; empty before it has spoken."""
        return self.of("learner").get("learner", {})

    @property
    def curriculum(self) -> dict[str, Value]:
        """The curriculum's figures; empty before it has spoken."""
        return self.of("curriculum").get("curriculum", {})


class Screen:
    """Shows a Monitor: `update` as often as you like, `say` for events."""

    def __init__(self, monitor: Monitor, title: str) -> None:
        self._monitor, self._title = monitor, title
        self._console = Console(stderr=True)
        self._events: list[str] = []
        self._last_line = time.monotonic()
        self._live: Live | None = None
        if sys.stderr.isatty():
            self._live = Live(console=self._console, refresh_per_second=2, transient=True)
            self._live.start()

    def say(self, event: str) -> None:
        """Reports an event."""
        if self._live:
            self._events = [*self._events[-4:], f"{time.strftime('%H:%M:%S')} {event}"]
        else:
            self._console.print(event, highlight=False, soft_wrap=True)

    def update(self, processes: Callable[[], list[tuple[str, bool, int]]]) -> None:
        """Redraws; `processes` lists (name, alive, restarts) of the supervised ones."""
        if self._live:
            self._live.update(self._picture(processes()))
        elif time.monotonic() - self._last_line >= LINE_SECONDS:
            self._last_line = time.monotonic()
            self._console.print(self._line(), highlight=False, soft_wrap=True)

    def close(self) -> None:
        """Gives the terminal back."""
        if self._live:
            self._live.stop()

    def _line(self) -> str:
        v = self._monitor.learner
        if not v:
            return "waiting for the learner"
        gate = self._monitor.curriculum
        alive = sum(self._monitor.alive.values())
        return (
            f"{_clock(v.get('elapsed_s', 0))}  steps {v['env_steps']} ({v['steps_per_s']}/s)  "
            f"updates {v['updates']} ({v['updates_per_s']}/s)  episodes {v['episodes']}  "
            f"success/100 {_share(v, 'charts/success_100')}  "
            f"random tasks {_share(v, 'charts/success_random')}  "
            f"endings {_mix(v, 'endings/')}  tasks {_mix(v, 'tasks/')}  replay {v['replay']}  "
            f"staleness {_number(v, 'charts/staleness')}  alpha {_number(v, 'losses/alpha')}  "
            f"q {_number(v, 'losses/qf_values')}  refused {v['refused']}  "
            f"failed writes {v['failed_writes']}  gate {_gate(gate)}  processes {alive}"
        )

    def _picture(self, processes: list[tuple[str, bool, int]]) -> Panel:
        v = self._monitor.learner
        left = Table.grid(padding=(0, 2))
        rows = [
            ("elapsed", _clock(v.get("elapsed_s", 0))),
            ("environment steps", f"{v.get('env_steps', 0)}  ({v.get('steps_per_s', 0)}/s)"),
            ("updates", f"{v.get('updates', 0)}  ({v.get('updates_per_s', 0)}/s)"),
            ("episodes", str(v.get("episodes", 0))),
            ("success, last 100", _share(v, "charts/success_100")),
            ("success on random tasks", _share(v, "charts/success_random")),
            ("success on random tasks", _share(v, "charts/success_random")),
            ("endings", _mix(v, "endings/")),
            ("tasks", _mix(v, "tasks/")),
            ("replay", f"{v.get('replay', 0)} transitions"),
            ("staleness", f"{_number(v, 'charts/staleness')} updates"),
            ("temperature", _number(v, "losses/alpha")),
            ("Q", _number(v, "losses/qf_values")),
            ("refused messages", str(v.get("refused", 0))),
            ("failed writes", str(v.get("failed_writes", 0))),
            ("gate", _gate(self._monitor.curriculum)),
        ]
        for name, value in rows:
            left.add_row(f"[bold]{name}[/]", value)
        table = Table("process", "state", "restarts", box=None)
        for name, alive, restarts in processes:
            table.add_row(name, "[green]alive[/]" if alive else "[red]down[/]", str(restarts))
        for (role, name), present in sorted(self._monitor.alive.items()):
            if present and not any(name == known for known, *_ in processes):
                table.add_row(f"{role} {name}", "[green]alive[/]", "-")
        return Panel(Group(left, "", table, *self._events), title=self._title)


def _gate(values: dict[str, Value]) -> str:
    return "open" if values.get("gate_open") else "closed"


def _clock(seconds: Value) -> str:
    whole = int(float(seconds))
    return f"{whole // 60:02d}:{whole % 60:02d}"


def _share(values: dict[str, Value], key: str) -> str:
    return f"{100 * float(values[key]):.0f}%" if key in values else "-"


def _number(values: dict[str, Value], key: str) -> str:
    return f"{float(values[key]):.2f}" if key in values else "-"


def _mix(values: dict[str, Value], prefix: str) -> str:
    found = {k.removeprefix(prefix): float(v) for k, v in values.items() if k.startswith(prefix)}
    order: list[str] = [name for name in ENDINGS if name in found] or sorted(found)
    return " ".join(f"{name} {100 * found[name]:.0f}%" for name in order) or "-"
