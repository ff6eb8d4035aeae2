"""Pictures of a curriculum from RUN/curriculum.db, also while the run goes on; they need Matplotlib."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Sequence
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from common.config import Config, CurriculumConfig, parse
from common.errors import UsageError
from common.messages import Category
from curriculum.algorithms.base import State
from curriculum.algorithms.navacl_q import NavaclQ
from curriculum.calibration import brier_score, reliability
from curriculum.curriculum import FORMAT
from curriculum.database import SCHEMA
from curriculum.task_space import make_space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
STAGES = 4
WIDTH, DPI = 12.0, 100
"""Of a picture: inches, and pixels in each."""
GRID = 61
"""Points of f_pi along an axis."""
DOTS = 200
"""Outcomes that are drawn over f_pi at most."""
BINS = 14
POINTS = 600
"""Of a curve at most."""
LEAST = 20
"""Outcomes of which a picture is drawn."""
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9)
"""Of f_pi that get a line."""
FEW = 10
"""Outcomes of which no share is drawn."""
UNITS = {
    "distance": ("distance", "m", 1.0),
    "agent_clearance": ("agent clearance", "m", 1.0),
    "goal_clearance": ("goal clearance", "m", 1.0),
    "relative_angle": ("relative angle", "degrees", 180 / math.pi),
    "lateral_offset": ("lateral offset", "m", 1.0),
    "approach_angle": ("approach angle", "degrees", 180 / math.pi),
}
BLUE, ORANGE = "#0072B2", "#E69F00"
STYLES: dict[str, tuple[str, Any]] = {
    "random": ("#999999", "-"),
    "frontier": (BLUE, "-"),
    "easy": (ORANGE, (0, (5, 1.5))),
    "gate": ("#56B4E9", (0, (1, 1))),
    "rnd": ("#CC79A7", "-"),
    "schedule": ("#009E73", "-"),
    "sfl": ("#D55E00", (0, (5, 1.5))),
    "unserved": ("#000000", (0, (1, 1))),
}
"""Colours that the colour-blind can tell apart (Okabe and Ito 2008) and lines; in the order of the stack."""


QUERY = "SELECT coalesce(requested, ''), category, entry, f, success FROM outcomes ORDER BY id"
FILTERED: tuple[Category, ...] = ("easy", "frontier")
"""Requests that adaptive filtering may fail to meet."""


class LeftOutError(Exception):
    """A picture that this run does not have; the text is the reason."""


class Network(NamedTuple):
    """f_pi as it was after so many outcomes."""

    outcomes: int
    values: Any
    tensors: bytes


class History(NamedTuple):
    """What the pictures need of a run of N outcomes."""

    name: str
    config: Config
    properties: dict[str, Floats]
    """By name, (N,), the axes of the pictures first; m and rad in the docking world."""
    requested: NDArray[np.str_]
    """What the task was to be, (N,); empty where nobody asked for anything."""
    category: NDArray[np.str_]
    """What it is."""
    f: Floats
    """Predicted before the outcome, (N,); NaN where nothing was."""
    success: Flags
    networks: list[Network]
    """At the ends of the stages, as near as f_pi was kept; each once."""

    def __len__(self) -> int:
        """N."""
        return len(self.success)


class Surface(NamedTuple):
    """f_pi over two properties: (A,), (B,) and (B, A)."""

    x: Floats
    y: Floats
    f: Floats


def read(run: Path) -> History:
    """The history of a run, as it was at one moment; raises UsageError for a folder without."""
    file = run / "curriculum.db"
    if not file.is_file():
        raise UsageError(f"{run} has no curriculum.db, which `curriculum serve --run` and `train` keep there")
    config = _read_config(run / "config.toml")
    try:
        sql = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, isolation_level=None)
        try:
            sql.execute("BEGIN")  # all that follows is of one moment
            version = sql.execute("PRAGMA user_version").fetchone()[0]
            if version != SCHEMA:
                raise UsageError(f"{file} is of version {version}; this one reads {SCHEMA}")
            rows = sql.execute(QUERY).fetchall()
            networks = _read_networks(sql, len(rows))
        finally:
            sql.close()
    except sqlite3.DatabaseError as error:
        raise UsageError(f"cannot read {file}: {error}") from None
    tasks = [json.loads(entry)[2] for _, _, entry, _, _ in rows]
    names = _ordered(config.curriculum, tasks[-1] if tasks else {})
    try:
        properties = {name: np.array([task[name] for task in tasks], float) for name in names}
    except KeyError as error:
        raise UsageError(f"{file}: not all tasks have {error}; they are of several worlds") from None
    return History(
        run.resolve().name,
        config,
        properties,
        np.array([row[0] for row in rows], str),
        np.array([row[1] for row in rows], str),
        np.array([row[3] for row in rows], float),
        np.array([row[4] for row in rows], bool),
        networks,
    )


def _read_config(file: Path) -> Config:
    """Its section `curriculum`; defaults without the file, as where only the curriculum ran."""
    try:
        return parse(file.read_text("utf-8"), ("curriculum",))
    except FileNotFoundError:
        return Config()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {file}: {error}") from None
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from None


def _read_networks(sql: sqlite3.Connection, total: int) -> list[Network]:
    """Those of the present algorithm at the ends of the stages; the last is the saved state's."""
    found = {n: json.loads(text) for n, text in sql.execute("SELECT outcomes, text FROM networks")}
    tensors = "SELECT tensors FROM networks WHERE outcomes = ?"
    state = sql.execute("SELECT text, tensors FROM states WHERE name = 'curriculum'").fetchone()
    values = json.loads(state[0]) if state else found[max(found)] if found else {}
    last = values["outcomes"] if state else 0
    fit = [n for n in found if found[n]["kind"] == values["kind"]] + [last] * (last > 0)
    return [
        Network(n, values, state[1])
        if n == last
        else Network(n, found[n], sql.execute(tensors, (n,)).fetchone()[0])
        for n in choose(fit, total)
    ]


def _ordered(config: CurriculumConfig, task: dict[str, float]) -> list[str]:
    """Names of properties: the configured parameters' order, or distance and relative angle first."""
    first = [p.name for p in config.parameters] or ["distance", "relative_angle"]
    return sorted(task, key=lambda name: first.index(name) if name in first else len(first))


# What is drawn


def stages(total: int, count: int = STAGES) -> list[slice]:
    """So many outcomes in parts of about the same size."""
    ends = [round(total * i / count) for i in range(count + 1)]
    return [slice(a, b) for a, b in pairwise(ends)]


def choose(numbers: Sequence[int], total: int) -> list[int]:
    """Of these numbers of outcomes those nearest to the end of each stage of a run, each once."""
    if not numbers:
        return []
    return sorted({min(numbers, key=lambda n: (abs(n - stage.stop), n)) for stage in stages(total)})


def nearby(number: int, total: int) -> slice:
    """The outcomes around the number'th: an eighth of all before and after it, or the last quarter."""
    count = min(total, max(2 * FEW, total // STAGES))
    first = min(max(number - count // 2, 0), total - count)
    return slice(first, first + count)


def window(total: int) -> int:
    """Outcomes, of so many, that a moving share is taken of."""
    return int(np.clip(total // 15, min(3 * FEW, total // 2), 1000))


def moving_sum(flags: Flags, size: int) -> NDArray[np.int64]:
    """How many of the last `size` are set, (N,); fewer than `size` count at the beginning."""
    sums = np.concatenate([[0], np.cumsum(flags, dtype=np.int64)])
    ends = np.arange(1, len(flags) + 1)
    return np.asarray(sums[ends] - sums[np.maximum(ends - size, 0)])


def task_mix(history: History) -> dict[str, Floats]:
    """Share of each category that occurs in the last outcomes, (N,) each; they add up to 1."""
    size = window(len(history))
    of = moving_sum(np.ones(len(history), bool), size)
    present = [name for name in STYLES if (history.category == name).any()]
    return {name: moving_sum(history.category == name, size) / of for name in present}


def met(history: History, name: str) -> Floats:
    """Share of the last requests for a type that were met, (N,); NaN where there are hardly any."""
    asked, size = history.requested == name, window(len(history))
    of = moving_sum(asked, size)
    share = moving_sum(asked & (history.category == name), size) / np.maximum(of, 1)
    return np.asarray(np.where(of >= FEW, share, np.nan))


def success_of(history: History, category: str | None = None) -> Floats:
    """Success in the last outcomes of a category, or of all, (N,); NaN where it has hardly any."""
    chosen = np.full(len(history), True) if category is None else history.category == category
    size = window(len(history))
    of = moving_sum(chosen, size)
    share = moving_sum(chosen & history.success, size) / np.maximum(of, 1)
    return np.asarray(np.where(of >= FEW, share, np.nan))


def bin_edges(values: Sequence[Floats], bins: int = BINS) -> Floats:
    """Edges of the bins that all these values share."""
    low, high = _extent(np.concatenate(values))
    return np.linspace(low, high, bins + 1)


def shares(values: Floats, edges: Floats) -> Floats:
    """Share of values in each bin; all 0 without any."""
    counts, _ = np.histogram(values, edges)
    return np.asarray(counts / max(len(values), 1))


def proposed(history: History, name: str, stage: slice) -> Floats:
    """A property of the tasks of a stage that the curriculum proposed."""
    served = history.category[stage] != "unserved"
    return np.asarray(history.properties[name][stage][served])


def predict(history: History, network: Network) -> NavaclQ:
    """f_pi as it was then; raises LeftOutError when there is none or config.toml is another's."""
    algorithm, inputs, hidden, scales, *saved_by = network.values["kind"]
    if not algorithm.startswith("navacl"):
        raise LeftOutError(f"{algorithm} has no f_pi")
    if saved_by[:1] != [FORMAT]:
        raise LeftOutError(f"f_pi after {network.outcomes} outcomes was saved by another version of navaclq")
    values = network.values["algorithm"]
    corrected = len(values["calibration"][2])
    settings = history.config.curriculum.model_copy(
        update={
            "algorithm": algorithm,
            "hidden": tuple(hidden),
            "calibrate": corrected > 0,
            "calibration_window": max(corrected, 1),
            **({} if history.config.curriculum.parameters else {"inputs": tuple(inputs)}),
        }
    )
    space = make_space(history.config.model_copy(update={"curriculum": settings}))
    if space.inputs != tuple(inputs) or list(map(list, space.scales.values())) != scales:
        raise LeftOutError("config.toml, with the ranges of its parameters, is missing or another's")
    found = NavaclQ(settings, space, 0)
    try:
        found.restore(State(safetensors.numpy.load(network.tensors), values))
    except (KeyError, ValueError, safetensors.SafetensorError) as error:
        raise LeftOutError(f"f_pi after {network.outcomes} outcomes cannot be read: {error}") from None
    return found


def f_pi_axes(history: History, network: Network) -> tuple[str, str]:
    """The first two properties that f_pi sees."""
    seen = [name for name in history.properties if name in network.values["kind"][1]]
    if len(seen) < 2:
        raise LeftOutError(f"f_pi sees {' and '.join(network.values['kind'][1])} alone; a plane needs two")
    return seen[0], seen[1]


def surface(history: History, network: Network) -> Surface:
    """f_pi over those two, other properties at the median of the outcomes nearby, Q at its running mean."""
    x, y = f_pi_axes(history, network)
    around = nearby(network.outcomes, len(history))
    others = {name: float(np.median(values[around])) for name, values in history.properties.items()}
    xs, ys = (np.linspace(*_extent(history.properties[name]), GRID) for name in (x, y))
    tasks = [{**others, x: float(a), y: float(b)} for b in ys for a in xs]
    f = predict(history, network).score(tasks, [None] * len(tasks))
    return Surface(xs, ys, f.reshape(len(ys), len(xs)))


def judged(history: History) -> tuple[Floats, Flags]:
    """(predictions made before the outcome, success), (M,) each."""
    known = ~np.isnan(history.f)
    return history.f[known], history.success[known]


def interval(share: float, count: int) -> tuple[float, float]:
    """The 95% confidence interval of a share of `count` (Wilson 1927)."""
    z = 1.959964
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2)
    return middle - half, middle + half


def _extent(values: Floats) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low, high) if low < high else (low - 0.5, high + 0.5)


# How it is drawn


def draw(history: History, rival: History | None = None) -> tuple[dict[str, Figure], dict[str, str]]:
    """The pictures by name, and why others were left out.

    Raises UsageError without Matplotlib, or when the rival's tasks are of another world.
    """
    left_out = {}
    beside = [rival] if rival is not None and len(rival) >= LEAST else []
    if rival is not None and not beside:
        left_out[f"tasks of {rival.name}"] = _too_few(rival)
    makers: dict[str, Callable[[], Figure]] = {
        "f_pi": lambda: draw_f_pi(history),
        "tasks": lambda: draw_tasks([history, *beside]),
        "mix": lambda: draw_mix(history),
        "reliability": lambda: draw_reliability(history),
    }
    figures = {}
    for name, make in makers.items():
        try:
            if len(history) < LEAST:
                raise LeftOutError(_too_few(history))
            figures[name] = make()
        except LeftOutError as error:
            left_out[name] = str(error)
    return figures, left_out


def _too_few(history: History) -> str:
    return f"{len(history)} outcomes; it takes {LEAST}"


def render(figure: Figure, kind: str) -> bytes:
    """A picture as `png` or `svg`."""
    content = BytesIO()
    figure.savefig(content, format=kind, dpi=DPI, metadata={"Date": None} if kind == "svg" else None)
    return content.getvalue()


def _figure(title: str, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("pictures need Matplotlib: pip install 'navaclq[plots]'") from None
    figure = Figure((WIDTH, height), dpi=DPI, layout="constrained")
    figure.suptitle(title)
    return figure


def _label(name: str) -> tuple[str, float]:
    """What an axis is called, and the factor to its unit."""
    text, unit, factor = UNITS.get(name, (name, "", 1.0))
    return f"{text}, {unit}" if unit else text, factor


def draw_f_pi(history: History) -> Figure:
    """f_pi in a plane of two properties at the end of each stage, the outcomes of then as dots."""
    if not history.networks:
        raise LeftOutError("no f_pi has been kept yet")
    surfaces = [surface(history, network) for network in history.networks]
    x, y = f_pi_axes(history, history.networks[0])
    title = f"{history.name}: predicted success, other inputs at their medians"
    if "q" in history.networks[0].values["kind"][1]:
        title += ", Q at its mean"
    rows, columns = (len(surfaces) + 1) // 2, min(len(surfaces), 2)
    figure = _figure(title, 1.0 + 4.1 * rows)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    for axes, network, found in zip(panels, history.networks, surfaces, strict=False):
        filled = _draw_surface(axes, found, x, y)
        _draw_dots(axes, history, network, x, y)
        share = 100 * network.outcomes / len(history)
        axes.set_title(f"after {network.outcomes:,} outcomes ({share:.0f}%)")
        axes.label_outer()
    for axes in list(panels)[len(surfaces) :]:
        axes.remove()
    bar = figure.colorbar(filled, ax=figure.axes, fraction=0.04, pad=0.02, label="predicted success")
    bar.set_ticks([0, 0.25, 0.5, 0.75, 1])
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _draw_surface(axes: Axes, found: Surface, x: str, y: str) -> Any:
    (x_label, x_factor), (y_label, y_factor) = _label(x), _label(y)
    xs, ys = found.x * x_factor, found.y * y_factor
    filled = axes.contourf(xs, ys, found.f, np.linspace(0, 1, 21), cmap="cividis", vmin=0, vmax=1)
    if found.f.min() < LEVELS[-1] and found.f.max() > LEVELS[0]:
        axes.contour(xs, ys, found.f, LEVELS, colors="black", linewidths=2.5)
        lines = axes.contour(xs, ys, found.f, LEVELS, colors="white", linewidths=1.2)
        box = {"facecolor": "white", "edgecolor": "black", "boxstyle": "round,pad=0.15", "linewidth": 0.6}
        for text in axes.clabel(lines, fmt="%g", fontsize=10, colors="black", inline=False, zorder=5):
            x_at, y_at = text.get_position()
            at = np.clip(x_at, *np.quantile(xs, (0.04, 0.96))), np.clip(y_at, *np.quantile(ys, (0.04, 0.96)))
            text.set(bbox=box, rotation=0, position=at)
    axes.set(xlabel=x_label, ylabel=y_label, xlim=(xs[0], xs[-1]), ylim=(ys[0], ys[-1]))
    return filled


def _draw_dots(axes: Axes, history: History, network: Network, x: str, y: str) -> None:
    around = np.arange(len(history))[nearby(network.outcomes, len(history))]
    around = around[np.linspace(0, len(around) - 1, min(DOTS, len(around))).astype(int)]
    xs, ys = (history.properties[name][around] * _label(name)[1] for name in (x, y))
    done = history.success[around]
    draw = partial(axes.scatter, clip_on=False)
    draw(xs[~done], ys[~done], s=42, c="white", marker="x", linewidths=3.0)
    draw(xs[~done], ys[~done], s=34, c="black", marker="x", linewidths=1.4, label="failure")
    draw(xs[done], ys[done], s=30, c="white", edgecolors="black", label="success")


def draw_tasks(histories: Sequence[History]) -> Figure:
    """Histograms of the first property of proposed tasks: a column for each stage, a row for each run."""
    name = next(iter(histories[0].properties))
    for history in histories:
        if name not in history.properties:
            raise UsageError(
                f"{history.name} cannot stand beside {histories[0].name}: no {name} in its tasks"
            )
    label, factor = _label(name)
    parts = [[proposed(h, name, stage) * factor for stage in stages(len(h))] for h in histories]
    if not any(len(part) for part in parts[0]):
        raise LeftOutError("no outcome of a task that was proposed")
    edges = bin_edges([part for row in parts for part in row])
    what = label.partition(",")[0]
    figure = _figure(f"Proposed tasks by {what}, in four stages of the run", 1.0 + 3.2 * len(histories))
    panels = figure.subplots(len(histories), STAGES, sharex=True, sharey=True, squeeze=False)
    for row, history, found, colour in zip(panels, histories, parts, (BLUE, ORANGE), strict=False):
        for axes, part, stage in zip(row, found, stages(len(history)), strict=True):
            axes.stairs(100 * shares(part, edges), edges, fill=True, color=colour, alpha=0.75)
            axes.stairs(100 * shares(part, edges), edges, color="black", linewidth=0.8)
            axes.set_title(f"outcomes {stage.start + 1:,} to {stage.stop:,}", fontsize=11)
            axes.set_xlabel(label)
            axes.locator_params(axis="y", integer=True)
            axes.grid(axis="y", alpha=0.3)
            axes.label_outer()
        row[0].set_ylabel(f"{history.name}: tasks, %")
    return figure


def draw_mix(history: History) -> Figure:
    """Share of each category over time, and below it how many of them succeeded."""
    size, mix = window(len(history)), task_mix(history)
    at = np.unique(np.linspace(size // 2, len(history) - 1, POINTS).astype(int))
    title = f"{history.name}: the last {size:,} outcomes, by category of the task"
    filtered = bool(np.isin(history.requested, FILTERED).any())
    rows = 2 + filtered if len(mix) > 1 else 1  # a single category has all the share
    figure = _figure(title, 4.0 * min(rows, 2) + 2.0 * (rows > 2))
    panels = list(figure.subplots(rows, 1, sharex=True, squeeze=False).flat)
    if rows > 1:
        _draw_shares(panels[0], history, mix, at)
    _draw_success(panels[-1], history, mix, at)
    if rows > 2:
        _draw_met(panels[1], history, at)
    for axes in panels:
        axes.margins(x=0)
        axes.grid(alpha=0.3)
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, reverse=axes is panels[0])
    return figure


def _draw_shares(axes: Axes, history: History, mix: dict[str, Floats], at: NDArray[np.int64]) -> None:
    shown = [100 * values[at] for values in mix.values()]
    colours = [STYLES[name][0] for name in mix]
    axes.stackplot(at + 1, shown, labels=list(mix), colors=colours, edgecolor="white")
    axes.set(ylabel="share of tasks, %", ylim=(0, 100))


def _draw_met(axes: Axes, history: History, at: NDArray[np.int64]) -> None:
    for name in FILTERED:
        colour, line = STYLES[name]
        axes.plot(at + 1, 100 * met(history, name)[at], color=colour, linestyle=line, linewidth=2, label=name)
    axes.set(ylabel="requests met, %", ylim=(-2, 102))


def _draw_success(axes: Axes, history: History, mix: dict[str, Floats], at: NDArray[np.int64]) -> None:
    for name in mix:
        colour, line = STYLES[name]
        values = 100 * success_of(history, name)[at]
        axes.plot(at + 1, values, color=colour, linestyle=line, linewidth=2, label=name)
    if len(mix) > 1:
        axes.plot(at + 1, 100 * success_of(history)[at], color="black", linewidth=1, label="all")
    axes.set(xlabel="outcomes", ylabel="success, %", ylim=(-2, 102))


def draw_reliability(history: History) -> Figure:
    """How often what was predicted came true, in both halves of the run, with counts and Brier score."""
    f, success = judged(history)
    if not len(f):
        raise LeftOutError("no success was predicted before an outcome")
    if len(f) < LEAST:
        raise LeftOutError(f"{len(f)} predictions; it takes {LEAST}")
    figure = _figure(f"{history.name}: predictions made before each outcome", 6.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
    curve, counts = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    for i, half in enumerate(stages(len(f), 2)):
        _draw_half(curve, counts, i, f[half], success[half])
    curve.plot([0, 1], [0, 1], color="black", linestyle=":", label="perfect")
    curve.set(xlabel="predicted success", ylabel="share of successes, 95% intervals")
    curve.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    curve.legend(loc="lower right")
    counts.set(xlabel="predicted success", ylabel="outcomes", xlim=(0, 1))
    counts.locator_params(axis="y", integer=True)
    _draw_brier(figure.add_subplot(grid[1, 1]), f, success)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    return figure


def _draw_half(curve: Axes, counts: Axes, i: int, f: Floats, success: Flags) -> None:
    name, colour, marker = (("first half", ORANGE, "s"), ("second half", BLUE, "o"))[i]
    predicted, happened, numbers = zip(*reliability(f, success), strict=True)
    reach = [interval(share, n) for share, n in zip(happened, numbers, strict=True)]
    errors = [[abs(y - ends[k]) for y, ends in zip(happened, reach, strict=True)] for k in (0, 1)]
    curve.errorbar(
        predicted,
        happened,
        errors,
        fmt=f"{marker}-",
        color=colour,
        markersize=8,
        linewidth=1,
        elinewidth=1.5,
        capsize=4,
        label=f"{name}: Brier score {brier_score(f, success):.3f}",
    )
    bins = [min(int(10 * p), 9) / 10 + 0.03 + 0.04 * i for p in predicted]
    counts.bar(bins, numbers, width=0.04, color=colour, edgecolor="black", linewidth=0.6, label=name)
    counts.legend()


def _draw_brier(axes: Axes, f: Floats, success: Flags) -> None:
    """The Brier score over time, and that of whoever knows only how many succeed."""
    size = window(len(f))
    ends = np.unique(np.linspace(size, len(f), min(POINTS, len(f))).astype(int))
    score = [brier_score(f[end - size : end], success[end - size : end]) for end in ends]
    rate = moving_sum(success, size)[ends - 1] / size
    axes.plot(ends, score, color=BLUE, linewidth=2, label="f_pi")
    axes.plot(ends, rate * (1 - rate), color="black", linestyle="--", label="always the mean")
    axes.set(xlabel="predictions", ylabel=f"Brier score of the last {size:,}", ylim=(0, None))
    axes.legend()
