"""Figures of a feasibility study.

They are made without `pyplot`, whose import takes long.
"""

import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.move_study import PLANNED
from drake_clutter.feasibility.summary import count_by_scene, share_interval

Row = Mapping[str, Any]
"""Row of a table: values by column."""
Rows = Sequence[Row]
"""Rows of a table."""

MAX_BARS = 30
"""Number of setups in the ranking's figure."""
PLOT_STYLE: dict[Any, Any] = {
    "font.size": 13,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "figure.constrained_layout.use": True,
}
_SHARE_LABEL = "planned share of the possible moves"


def plot_ranking(summary: Row) -> Figure:
    """Plot the share of the possible moves of each setup with its interval, best first."""
    by_name = {setup["name"]: setup for setup in summary["setups"]}
    setups = [by_name[name] for name in summary["ranking"][:MAX_BARS]]
    figure = Figure(figsize=(11, 1.2 + 0.42 * len(setups)))
    axes = figure.subplots()
    share = np.array([setup["share"] for setup in setups])
    low, high = np.array([setup["share_ci95"] for setup in setups]).T
    positions = np.arange(len(setups))
    error = np.clip([share - low, high - share], 0, None)
    axes.barh(positions, share, xerr=error, capsize=4, color="#7aa6c2", height=0.6)
    for y, setup in zip(positions, setups, strict=True):
        cycle = setup["cycle_s"]["median"]
        text = f"{setup['planned']} of {setup['possible']}"
        text += "" if cycle is None else f", {cycle:.1f} s"
        box = {"color": "white", "alpha": 0.85, "pad": 1.5}
        axes.text(0.012, float(y), text, va="center", fontsize=10, bbox=box)
    axes.set_yticks(positions, [setup["name"] for setup in setups])
    axes.invert_yaxis()
    axes.set(xlabel=f"{_SHARE_LABEL} (bars: 95 % interval)", xlim=(0, 1.02))
    return figure


def plot_failures(moves: Rows, setups: Sequence[str]) -> Figure:
    """Plot the share of the possible moves with each reason of failure, and its interval."""
    possible = [row for row in moves if row["possible"] and row["setup"] in setups]
    failed = Counter(row["result"] for row in possible if row["result"] != PLANNED)
    reasons = [reason for reason, _ in failed.most_common()]
    size = 2.2 + 0.3 * len(reasons) * (1 + len(setups))
    figure = Figure(figsize=(11, min(size, 12)))
    axes = figure.subplots()
    height = 0.8 / len(setups)
    for k, setup in enumerate(setups):
        rows = [row for row in possible if row["setup"] == setup]
        counts = Counter(row["result"] for row in rows)
        shares = np.array([counts[reason] / max(1, len(rows)) for reason in reasons])
        bounds = [share_interval(count_by_scene(rows, reason)) or (0, 1) for reason in reasons]
        low, high = np.array(bounds).T
        positions = np.arange(len(reasons)) + k * height
        error = np.clip([shares - low, high - shares], 0, None)
        axes.barh(positions, shares, height, xerr=error, capsize=3, label=setup)
        for y, end, reason in zip(positions, high, reasons, strict=True):
            axes.text(end, y, f"  {counts[reason]}", va="center", fontsize=11)
    axes.set_yticks(np.arange(len(reasons)) + 0.4 - height / 2, reasons)
    axes.invert_yaxis()
    axes.set(xlabel="share of the possible moves (bars: 95 % interval; labels: number of moves)")
    axes.set_xlim(0, None)
    axes.margins(x=0.15)
    _add_legend(figure, axes)
    return figure


def _add_legend(figure: Figure, axes: Any) -> None:
    """Add the legend of axes with several setups below the figure."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:
        figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=10)


def _share(rows: Rows) -> float:
    planned = sum(1 for row in rows if row["result"] == PLANNED)
    return planned / max(1, len(rows))


def _plot_planned_fractions(
    axes: Any,
    moves: Rows,
    setups: Sequence[str],
    group_key: Callable[[Mapping[str, Any]], str],
    title: str,
) -> None:
    """Plot the fraction of moves planned in each group as bars with confidence intervals."""
    groups = sorted({group_key(row) for row in moves})
    width = 0.8 / len(setups)
    for k, setup in enumerate(setups):
        statistics = []
        for group in groups:
            rows = [row for row in moves if row["setup"] == setup and group_key(row) == group]
            statistics.append(
                (_share(rows), *(share_interval(count_by_scene(rows, PLANNED)) or (0, 1)))
            )
        fraction, low, high = np.array(statistics).T
        error = np.clip([fraction - low, high - fraction], 0, None)
        positions = np.arange(len(groups)) + k * width
        axes.bar(positions, fraction, width, yerr=error, capsize=3, label=setup)
    axes.set_xticks(
        np.arange(len(groups)) + 0.4 - width / 2,
        groups,
        rotation=40,
        ha="right",
        rotation_mode="anchor",
        fontsize=12,
    )
    axes.set(title=title, ylim=(0, 1))


def _height_interval(row: Mapping[str, Any]) -> str:
    """Return the interval of 10 cm of the height of the picked object's top face."""
    low = 10 * int(row["pick_top"] // 0.1)
    return f"{low:2d} to {low + 10} cm"


def plot_by_object(moves: Rows, setups: Sequence[str]) -> Figure:
    """Plot the share of the possible moves by class, resting pose and height of the object."""
    moves = [row for row in moves if row["possible"]]
    figure = Figure(figsize=(15, 5.2))
    axes = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1.3))
    _plot_planned_fractions(
        axes[0], moves, setups, lambda row: str(row["object_class"]).replace("_", " "), "class"
    )
    _plot_planned_fractions(
        axes[1], moves, setups, lambda row: str(row["resting_side"]), "resting pose"
    )
    _plot_planned_fractions(
        axes[2],
        moves,
        setups,
        _height_interval,
        "height of the top face",
    )
    axes[0].set_ylabel(_SHARE_LABEL)
    _add_legend(figure, axes[0])
    return figure


def _plot_heatmap(
    axes: Any, values: NDArray[np.float64], extent: Sequence[float], max_value: float
) -> Any:
    axes.grid(visible=False)
    return axes.imshow(
        values.T,
        origin="lower",
        extent=extent,
        vmin=0,
        vmax=max_value,
        cmap="viridis",
        aspect="equal",
    )


def plot_by_position(
    moves: Rows, setups: Mapping[str, WorkCell], end: str, names: Sequence[str]
) -> Figure:
    """Plot the share of the possible moves over the support, on a grid of 7 by 7 cells.

    Args:
        moves: Rows of `moves.csv`.
        setups: Work cells by name.
        end: `pick` or `place`: the position by which moves are counted.
        names: Setups to show, each in a panel.
    """
    moves = [row for row in moves if row["possible"]]
    columns = f"{end}_x", f"{end}_y"
    positions = np.abs([[row[column] for column in columns] for row in moves])
    half_x, half_y = np.max(
        [*positions, *(cell.support.half_size for cell in setups.values())], axis=0
    )
    edges_x = np.linspace(-half_x, half_x, 8)
    edges_y = np.linspace(-half_y, half_y, 8)
    figure, panels = _panels(len(names), 4.4, 4.0)
    for panel, setup in zip(panels, names, strict=False):
        rows = [row for row in moves if row["setup"] == setup]
        x, y = (np.array([row[column] for row in rows]) for column in columns)
        is_planned = np.array([row["result"] == PLANNED for row in rows], float)
        count, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y))
        planned, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y), weights=is_planned)
        with np.errstate(invalid="ignore"):
            share = planned / count
        image = _plot_heatmap(panel, share, (-half_x, half_x, -half_y, half_y), 1.0)
        for i, center_x in enumerate((edges_x[1:] + edges_x[:-1]) / 2):
            for j, center_y in enumerate((edges_y[1:] + edges_y[:-1]) / 2):
                if count[i, j]:
                    color = "white" if share[i, j] < 0.6 else "black"
                    text = f"{count[i, j]:.0f}"
                    panel.text(
                        center_x, center_y, text, ha="center", va="center", color=color, fontsize=9
                    )
        panel.set_title(textwrap.fill(setup, 40), fontsize=11)
        panel.set(xlabel="x in T [m]", ylabel="y [m]")
    figure.colorbar(image, ax=panels, label="planned share", shrink=0.8)
    return figure


def _panels(count: int, width: float, height: float) -> tuple[Figure, list[Any]]:
    """Return a figure with a number of panels, at most three in a row."""
    num_columns = min(3, count)
    num_rows = -(-count // num_columns)
    figure = Figure(figsize=(width * num_columns, height * num_rows))
    axes = figure.subplots(num_rows, num_columns, squeeze=False)
    for unused in axes.ravel()[count:]:
        unused.set_axis_off()
    return figure, [*axes.ravel()[:count]]


def plot_reachability(maps: Mapping[str, Row], names: Sequence[str]) -> Figure:
    """Plot the reachable share of the directions over the support, by setup and tilt of the tool.

    Args:
        maps: Reachability maps by setup.
        names: Setups to show, each in a row.
    """
    tilts = maps[names[0]]["tilts_deg"]
    figure = Figure(figsize=(3.2 * len(tilts), 2.9 * len(names)))
    axes = figure.subplots(len(names), len(tilts), squeeze=False, sharex=True, sharey=True)
    for row, name in zip(axes, names, strict=True):
        found = maps[name]
        ends = [v[-1] + (v[1] - v[0]) / 2 for v in (found["x"], found["y"])]
        extent = (-ends[0], ends[0], -ends[1], ends[1])
        for panel, tilt, fraction in zip(row, tilts, found["reachable_fraction"], strict=True):
            image = _plot_heatmap(panel, np.array(fraction).mean(axis=0), extent, 1.0)
            panel.text(
                *(0.03, 0.93, f"{np.mean(fraction):.2f}"),
                transform=panel.transAxes,
                bbox={"color": "white", "alpha": 0.8, "pad": 1.5},
                fontsize=10,
                va="center",
            )
            if panel in axes[0]:
                panel.set_title(_tilt_name(tilt), fontsize=11)
        row[0].set_ylabel(f"{textwrap.fill(name, 32)}\ny [m]", fontsize=10)
    for panel in axes[-1]:
        panel.set_xlabel("x in T [m]")
    figure.colorbar(image, ax=axes, label="reachable share of 12 directions", shrink=0.7)
    return figure


def _tilt_name(tilt_deg: float) -> str:
    names = {0.0: "straight down", 90.0: "horizontal"}
    return names.get(tilt_deg, f"tilted by {tilt_deg:g} deg")


def plot_base_search(bases: Rows, finalists: Sequence[WorkCell]) -> Figure:
    """Plot the share of the moves that bases reach over x and y, by height.

    The best yaw and the best of the other fields count.

    Args:
        bases: Rows of `bases.csv`.
        finalists: Work cells with the bases that the planner compared.
    """
    heights = sorted({row["z"] for row in bases})
    shown = [heights[k] for k in np.linspace(0, len(heights) - 1, min(6, len(heights))).astype(int)]
    figure, panels = _panels(len(shown), 4.6, 4.2)
    x, y = (np.array(sorted({row[axis] for row in bases})) for axis in ("x", "y"))
    half = [(np.diff(v).min() if len(v) > 1 else 0.1) / 2 for v in (x, y)]
    extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
    for panel, z in zip(panels, shown, strict=True):
        share = np.full((len(x), len(y)), np.nan)
        for row in bases:
            if row["z"] == z:
                cell = np.searchsorted(x, row["x"]), np.searchsorted(y, row["y"])
                share[cell] = np.fmax(share[cell], row["reachable"] / max(1, row["possible"]))
        image = _plot_heatmap(panel, share, extent, 1.0)
        near = [cell.robot.base.translation for cell in finalists]
        for px, py, pz in near:
            if min(shown, key=lambda height: abs(height - pz)) == z:
                panel.plot(px, py, "r*", markersize=13, markeredgecolor="white")
        panel.set_title(f"z = {z:g} m", fontsize=11)
        panel.set(xlabel="x of the base in T [m]", ylabel="y [m]")
    label = "share of the possible moves in reach, by the map"
    figure.colorbar(image, ax=panels, label=label, shrink=0.8)
    return figure


def plot_noise(summary: Row) -> Figure:
    """Plot the share of moves that are placed in simulation over the size of each error."""
    titles = {
        "pose": ("pose of each object", "position [mm], yaw 0.5 deg/mm", 1000),
        "calibration": ("camera calibration", "position [mm], yaw 0.1 deg/mm", 1000),
        "mass": ("mass of the object", "mass [%]", 100),
    }
    figure = Figure(figsize=(14, 4.6))
    axes = figure.subplots(1, len(titles), sharey=True)
    for panel, (kind, (title, label, scale)) in zip(axes, titles.items(), strict=True):
        for setup in summary["setups"]:
            rows = [row for row in setup["noise"] if row["kind"] == kind]
            if not rows:
                continue
            share = np.array([row["placed"] / row["moves"] for row in rows])
            low, high = np.array([row["placed_ci95"] for row in rows]).T
            sizes = scale * np.array([row["size"] for row in rows])
            error = np.clip([share - low, high - share], 0, None)
            panel.errorbar(sizes, share, error, marker="o", capsize=4, label=setup["name"])
        panel.set_title(title, fontsize=12)
        panel.set(xlabel=f"standard deviation\n{label}", ylim=(0, 1.03))
    axes[0].set_ylabel("share of the moves placed in simulation")
    _add_legend(figure, axes[0])
    return figure
