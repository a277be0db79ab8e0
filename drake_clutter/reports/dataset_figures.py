"""Figure of a recorded data set: results, classes, durations, lengths, speeds and places."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from drake_clutter.files import atomic_write
from drake_clutter.recording.dataset_summary import (
    EpisodeFigures,
    MotionFigures,
    attempted,
    count_reasons,
    count_results,
    motions,
)
from drake_clutter.scenes.interfaces import MoveResult

MAX_BARS = 12
"""Number of bars of a panel; the rest is one bar."""
_NUM_BINS = 20
"""Number of bins of a histogram, and of a side of a heat map."""
_COLORS = {"good": "#2e9e5b", "bad": "#d23f31", "plain": "#7aa6c2"}
_STYLE: dict[Any, Any] = {
    "font.size": 11,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.35,
    "figure.constrained_layout.use": True,
}


def plot_dataset(path: Path, episodes: Sequence[EpisodeFigures]) -> None:
    """Write the figure of a data set as PNG.

    Args:
        path: The file.
        episodes: Figures of its episodes.
    """
    with plt.rc_context(_STYLE):
        figure, panels = plt.subplots(3, 3, figsize=(16, 12))
        first, second, third = panels
        _plot_results(first[0], count_results(episodes))
        _plot_counts(first[1], "moves without a plan, by reason", count_reasons(episodes))
        _plot_classes(first[2], episodes)
        found = motions(episodes)
        _plot_histogram(second[0], "duration of executed moves [s]", [m.duration for m in found])
        _plot_histogram(second[1], "path of the tool [m]", [m.path_length for m in found])
        _plot_histogram(
            second[2], "attempted moves of an episode", [len(e.actions) for e in episodes]
        )
        _plot_limits(third[0], episodes, found)
        size = np.max([e.support_size for e in episodes], axis=0)
        _plot_heat_map(third[1], "picked at", [m.start for m in found], size)
        places = [m.place for m in found if m.place is not None]
        _plot_heat_map(third[2], "placed at", places, size)
        with atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=80)
        plt.close(figure)


def _plot_results(axes: Any, counts: Counter[str]) -> None:
    """Plot the number of moves of each result."""
    good = MoveResult.PLACED.value
    colors = [_COLORS["good" if name == good else "bad"] for name, _ in counts.most_common()]
    _plot_counts(axes, "results of attempted moves", counts, colors)


def _plot_counts(axes: Any, title: str, counts: Counter[str], colors: Sequence[str] = ()) -> None:
    """Plot counts as bars, the largest first."""
    bars = counts.most_common()
    if len(bars) > MAX_BARS:
        bars = [*bars[: MAX_BARS - 1], ("others", sum(n for _, n in bars[MAX_BARS - 1 :]))]
    axes.set_title(title)
    if not bars:
        _show_nothing(axes)
        return
    positions = np.arange(len(bars))
    numbers = [number for _, number in bars]
    axes.barh(positions, numbers, color=[*colors][: len(bars)] or _COLORS["plain"], height=0.65)
    for position, number in zip(positions, numbers, strict=True):
        axes.text(number, position, f" {number}", va="center")
    axes.set_yticks(positions, [name for name, _ in bars])
    axes.set_ylim(max(len(bars), 4) - 0.5, -0.5)
    axes.margins(x=0.15)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.grid(axis="y", visible=False)


def _plot_classes(axes: Any, episodes: Sequence[EpisodeFigures]) -> None:
    """Plot the number of moves of each class, and how many placed the object."""
    rows = attempted(episodes)
    counts = Counter(row.object_class for row in rows)
    placed = Counter(row.object_class for row in rows if row.result is MoveResult.PLACED)
    _plot_counts(axes, "picked classes (green: placed)", counts)
    names = [name for name, _ in counts.most_common(MAX_BARS)]
    names = names if len(counts) <= MAX_BARS else names[:-1]
    axes.barh(np.arange(len(names)), [placed[n] for n in names], color=_COLORS["good"], height=0.65)


def _plot_histogram(axes: Any, title: str, values: Sequence[float]) -> None:
    """Plot a histogram with the median."""
    axes.set_title(title)
    if not values:
        _show_nothing(axes)
        return
    is_whole = all(isinstance(value, int) for value in values)
    bins: Any = np.arange(min(values), max(values) + 2) - 0.5 if is_whole else _NUM_BINS
    axes.hist(values, bins=bins, color=_COLORS["plain"], edgecolor="white")
    median = float(np.median(values))
    axes.axvline(median, color="#22272e", linestyle="--", label=f"median {median:.3g}")
    axes.set_ylabel("number")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    if is_whole:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.legend()


def _plot_limits(
    axes: Any, episodes: Sequence[EpisodeFigures], found: Sequence[MotionFigures]
) -> None:
    """Plot the largest speed and torque of each joint in each move, relative to its limit."""
    axes.set_title("largest speed and torque over limit")
    joints = episodes[0].joints
    rows = [row for row in found if len(row.speed_ratios) == len(joints)]
    if not rows:
        _show_nothing(axes)
        return
    kinds: Mapping[str, tuple[float, str, NDArray[np.float64]]] = {
        "speed": (-0.2, _COLORS["plain"], np.array([row.speed_ratios for row in rows])),
        "torque": (0.2, "#c29a5b", np.array([row.torque_ratios for row in rows])),
    }
    for offset, color, values in kinds.values():
        axes.boxplot(
            values,
            positions=np.arange(len(joints)) + offset,
            widths=0.34,
            whis=(0, 100),
            patch_artist=True,
            boxprops={"facecolor": color},
            medianprops={"color": "#22272e"},
        )
    for name, (_, color, _) in kinds.items():
        axes.bar(0, 0, color=color, label=name)
    axes.axhline(1.0, color=_COLORS["bad"], linestyle="--", label="limit")
    axes.set_xticks(np.arange(len(joints)), [f"{k + 1}" for k in range(len(joints))])
    axes.set_xlabel("joint")
    axes.set_ylim(0, 1.3)
    axes.legend(loc="upper center", ncols=3)


def _plot_heat_map(
    axes: Any, title: str, points: Sequence[tuple[float, float]], size: NDArray[np.float64]
) -> None:
    """Plot how often points lie in each part of the support."""
    axes.set_title(f"{title}, x and y in T [m]")
    half = size / 2
    x, y = np.array(points).reshape(-1, 2).T
    limits = [[-half[0], half[0]], [-half[1], half[1]]]
    counts, _, _ = np.histogram2d(x, y, bins=_NUM_BINS, range=limits)
    image = axes.imshow(
        counts.T,
        origin="lower",
        extent=(-half[0], half[0], -half[1], half[1]),
        cmap="viridis",
        vmin=0,
        vmax=max(1.0, float(counts.max())),
    )
    axes.grid(visible=False)
    bar = axes.figure.colorbar(image, ax=axes, label="moves")
    bar.locator = MaxNLocator(integer=True, min_n_ticks=1)
    bar.update_ticks()


def _show_nothing(axes: Any) -> None:
    """Say that a panel has no data."""
    axes.text(0.5, 0.5, "none", ha="center", va="center", transform=axes.transAxes)
    axes.set_xticks([])
    axes.set_yticks([])
