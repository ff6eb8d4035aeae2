"""Pictures of examinations: the grid's map of success and of failures, and trajectories. Needs matplotlib."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from actor.evaluation.measures import Drive
from actor.evaluation.suites import GRID_HEADINGS
from common.cells import ROOMS
from common.geometry import SE2, Rectangle
from common.messages import Ending
from common.tasks import PlacedStart, Task, build_scene
from common.world_config import DollyConfig, WorldConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: dict[Ending, str] = {
    "success": "green",
    "timeout": "gray",
    "other_contact": "orange",
    "dolly_contact": "red",
}
ALL_FAILED = 90.0
"""Area of a mark where every episode failed, square points."""
PICTURED = 6
"""Starts of which trajectories are drawn."""


Places = dict[int, dict[tuple[float, float], list[Ending]]]
"""Endings by heading and start position of a grid."""


def _positions(tasks: Sequence[Task], drives: Sequence[Drive]) -> Places:
    found: Places = {heading: defaultdict(list) for heading in GRID_HEADINGS}
    for task, drive in zip(tasks, drives, strict=True):
        assert isinstance(task.start, PlacedStart)
        found[round(task.start.yaw)][task.start.x, task.start.y].append(drive.ending)
    return found


def _panels(title: str, lowest: float) -> tuple[Figure, list[Axes]]:
    """One panel for each heading, from the dolly down to `lowest` (m), with an arrow that shows it."""
    figure = Figure(figsize=(13, 7), layout="constrained")
    figure.suptitle(title)
    axes: list[Axes] = list(np.ravel(figure.subplots(2, 4, sharex=True, sharey=True)))
    for panel, heading in zip(axes, GRID_HEADINGS, strict=True):
        _draw_dolly(panel, SE2(), DollyConfig())
        ahead = SE2(yaw=math.radians(heading)).forward
        panel.annotate(
            "",
            xy=(3.2 + 0.5 * ahead[0], -0.3 + 0.5 * ahead[1]),
            xytext=(3.2 - 0.5 * ahead[0], -0.3 - 0.5 * ahead[1]),
            arrowprops={"arrowstyle": "->", "lw": 1.5},
        )
        panel.set(xlim=(-3.2, 4.0), ylim=(lowest - 0.5, 1.0), aspect="equal")
    for panel in axes[4:]:
        panel.set_xlabel("x from the dolly, m")
    for panel in (axes[0], axes[4]):
        panel.set_ylabel("y from the dolly, m")
    return figure, axes


def grid_map(tasks: Sequence[Task], drives: Sequence[Drive], title: str) -> Figure:
    """Success by start position in a panel for each heading, as the paper's figure of the grid test."""
    found = _positions(tasks, drives)
    figure, axes = _panels(title, min(y for places in found.values() for _, y in places))
    for panel, (heading, places) in zip(axes, found.items(), strict=True):
        x, y = zip(*places, strict=True)
        success = [Counter(endings)["success"] / len(endings) for endings in places.values()]
        dots = panel.scatter(x, y, c=success, cmap="viridis", vmin=0.0, vmax=1.0, s=70, edgecolors="none")
        panel.set_title(f"heading {heading} deg: {100 * np.mean(success):.1f}%", fontsize=10)
    figure.colorbar(dots, ax=axes, label="success", shrink=0.6)
    return figure


def failure_map(tasks: Sequence[Task], drives: Sequence[Drive], title: str) -> Figure:
    """The commonest failure of each start position, the mark's area by the share of failures."""
    found = _positions(tasks, drives)
    figure, axes = _panels(title, min(y for places in found.values() for _, y in places))
    for panel, (heading, places) in zip(axes, found.items(), strict=True):
        for (x, y), endings in places.items():
            failures = Counter(ending for ending in endings if ending != "success")
            panel.scatter(x, y, s=6, color=COLOURS["success"] if not failures else "lightgray")
            if failures:
                kind = failures.most_common(1)[0][0]
                share = failures.total() / len(endings)
                panel.scatter(x, y, s=ALL_FAILED * share, color=COLOURS[kind], alpha=0.8, edgecolors="none")
        counts = Counter(ending for endings in places.values() for ending in endings)
        panel.set_title(f"heading {heading} deg: {counts.total() - counts['success']} failures", fontsize=10)
    _legend_of_endings(figure)
    return figure


def suite_map(drives: Sequence[Drive], title: str) -> Figure:
    """All drives of a suite in the frame of the dolly's last place, by how they ended."""
    figure = Figure(figsize=(7, 7), layout="constrained")
    axes = figure.subplots()
    for drive in sorted(drives, key=lambda drive: drive.ending != "success"):
        seen = np.array([drive.dolly.inverse().apply(x, y) for x, y in drive.track[:, :2].tolist()])
        docked = drive.ending == "success"
        axes.plot(
            *seen.T, color=COLOURS[drive.ending], lw=0.5 if docked else 1.0, alpha=0.35 if docked else 0.9
        )
        axes.plot(*seen[0], marker=".", ms=4, color=COLOURS[drive.ending])
    _draw_dolly(axes, SE2(), DollyConfig())
    axes.set(xlabel="x from the dolly, m", ylabel="y from the dolly, m", aspect="equal", title=title)
    _legend_of_endings(figure)
    return figure


def trajectories(
    tasks: Sequence[Task], driven: Mapping[str, Sequence[Drive]], numbers: Sequence[int], world: WorldConfig
) -> Figure:
    """Ways of several from the same starts, each on the plan of its room with its obstacles."""
    columns = min(3, len(numbers))
    rows = -(-len(numbers) // columns)
    figure = Figure(figsize=(4.4 * columns, 4.4 * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    colours = [matplotlib.color_sequences["tab10"][i % 10] for i in range(len(driven))]
    for panel, number in zip(axes, numbers, strict=False):
        task = tasks[number]
        scene, room = build_scene(task, world), ROOMS[task.cell]
        panel.add_patch(Polygon(room.outline, fill=False, lw=1.5))
        for box in (*room.fixtures, *(obstacle.box for obstacle in scene.obstacles)):
            panel.add_patch(Polygon(box.footprint.corners(), color="0.75"))
        _draw_dolly(panel, scene.dolly, world.dolly)
        if scene.shifted:
            _draw_dolly(panel, scene.shifted, world.dolly, "--")
        start = Rectangle(scene.robot, world.robot.width / 2, world.robot.length / 2)
        panel.add_patch(Polygon(start.corners(), fill=False, lw=0.8))
        for colour, drives in zip(colours, driven.values(), strict=True):
            drive = drives[number]
            panel.plot(*drive.track[:, :2].T, color=colour, lw=1.6)
            end = "o" if drive.ending == "success" else "x"
            panel.plot(*drive.track[-1, :2], marker=end, color=colour, ms=7)
        middle, reach = (scene.robot.x + scene.dolly.x) / 2, 4.5
        panel.set(xlim=(middle - reach, middle + reach), aspect="equal")
        height = (scene.robot.y + scene.dolly.y) / 2
        panel.set(ylim=(height - reach, height + reach), xlabel="x, m", ylabel="y, m")
        panel.set_title(f"{room.name}, seed {task.seed}", fontsize=9)
    for panel in axes[len(numbers) :]:
        panel.set_axis_off()
    handles = [Line2D([], [], color=c, label=name) for c, name in zip(colours, driven, strict=True)]
    marks = (("o", "docked"), ("x", "not"))
    handles += [Line2D([], [], color="k", marker=m, ls="", label=words) for m, words in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=6)
    return figure


def pictured(tasks: Sequence[Task]) -> list[int]:
    """Numbers of the starts of which trajectories are drawn, always the same ones of a list."""
    drawn = np.random.default_rng(0).choice(len(tasks), min(PICTURED, len(tasks)), replace=False)
    return [int(number) for number in sorted(drawn)]


def _draw_dolly(axes: Axes, dolly: SE2, config: DollyConfig, style: str = "-") -> None:
    outline = Rectangle(dolly, config.width / 2, config.length / 2).corners()
    axes.add_patch(Polygon(outline, fill=False, edgecolor="royalblue", lw=1.5, ls=style))


def _legend_of_endings(figure: Figure) -> None:
    handles = [
        Line2D([], [], color=colour, marker="o", ls="", label=ending.replace("_", " "))
        for ending, colour in COLOURS.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
