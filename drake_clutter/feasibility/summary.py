"""Summary of a feasibility study: shares of the possible moves, ranking and comparisons.

The moves of one scene are not independent of each other: intervals take the scenes as the sample.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from drake_clutter.feasibility.move_study import PLANNED
from drake_clutter.feasibility.setups import Setup, UnusableSetup
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.statistics import quantile_interval, ratio_interval, wilson_interval
from drake_clutter.tasks.exploration_task import TerminationReason

Row = Mapping[str, Any]
"""Row of a table: values by column."""

MAX_ALL_PAIRS = 12
"""Number of setups up to which all pairs are compared; more are compared with the best one."""
_SMALLEST = {"smallest": 0.0, "p05": 0.05, "median": 0.5}
_LARGEST = {"median": 0.5, "p95": 0.95, "largest": 1.0}
MARGIN_QUANTILES = {
    **dict.fromkeys(("clearance", "joint_margin", "singular_value", "manipulability"), _SMALLEST),
    **dict.fromkeys(("torque_share", "load_share"), _LARGEST),
}
"""Quantiles of each margin over the planned moves."""
_DURATION_QUANTILES = {"median": 0.5, "p95": 0.95}
GROUP_KEYS: dict[str, Callable[[Row], str]] = {
    "object_class": lambda row: row["object_class"],
    "resting_side": lambda row: row["resting_side"],
    "objects_below": lambda row: str(row["num_below"]),
    "top_height_cm": lambda row: (
        f"{10 * int(10 * row['pick_top'])} to {10 * int(10 * row['pick_top']) + 10}"
    ),
    "pick_from_cm": lambda row: (
        f"x {_bin_of_20_cm(row['pick_x'])}, y {_bin_of_20_cm(row['pick_y'])}"
    ),
    "place_at_cm": lambda row: (
        f"x {_bin_of_20_cm(row['place_x'])}, y {_bin_of_20_cm(row['place_y'])}"
    ),
}
"""Groups of possible moves in a summary: by name, the function that returns a move's group.

Positions are in the tray frame, heights above its floor.
"""


def _bin_of_20_cm(coordinate: float) -> str:
    """Return the interval of 20 cm that contains a coordinate in m, as text in cm."""
    low = 20 * math.floor((coordinate + 0.1) / 0.2) - 10
    return f"{low} to {low + 20}"


def summarize_study(
    setups: Mapping[str, Setup | UnusableSetup],
    moves: Sequence[Row],
    noise: Sequence[Row],
    sequences: Sequence[Row],
    scenes: Sequence[str],
) -> dict[str, Any]:
    """Return the statistics of each setup, their ranking, and comparisons of two setups.

    Args:
        setups: Setups by name.
        moves: Rows of `moves.csv`.
        noise: Rows of `noise.csv`.
        sequences: Rows of `sequences.csv`.
        scenes: Names of the scenes.
    """

    def by_setup(rows: Sequence[Row]) -> dict[str, list[Row]]:
        groups: dict[str, list[Row]] = {name: [] for name in setups}
        for row in rows:
            groups[row["setup"]].append(row)
        return groups

    moves_of, noise_of, sequences_of = map(by_setup, (moves, noise, sequences))
    summaries = [
        _summarize_setup(setup, moves_of[name], noise_of[name], sequences_of[name])
        for name, setup in setups.items()
    ]
    ranking = [s["name"] for s in sorted(summaries, key=_rank) if s["possible"]]
    if len(ranking) <= MAX_ALL_PAIRS:
        pairs = list(combinations(ranking, 2))
    else:
        pairs = [(ranking[0], other) for other in ranking[1:]]
    return {
        "scenes": len(scenes),
        "setups": summaries,
        "ranking": ranking,
        "comparisons": [_compare(a, b, moves_of[a], moves_of[b]) for a, b in pairs],
    }


def _rank(summary: Row) -> tuple[float, float]:
    """Return the sorting key of a setup: most of the possible moves, then shortest cycles."""
    cycle = summary["cycle_s"]["median"]
    return -(summary["share"] or 0.0), math.inf if cycle is None else cycle


def share_interval(
    counts: Iterable[tuple[int, int]], lowest: int = 0
) -> tuple[float, float] | None:
    """Return the 95 % interval of a share, with the scenes as the sample.

    It is Gaffke's interval of a ratio of means, see `ratio_interval`: as if one more scene, as
    large as the largest, had the lowest or the highest count.

    Args:
        counts: Count and number of possible moves of each scene.
        lowest: Sign of the lowest count of a scene as a fraction of its moves: 0 for shares, -1 for
            differences.

    Returns:
        The interval; None without possible moves.
    """
    pairs = [(count, total) for count, total in counts if total]
    if not pairs:
        return None
    most = max(total for _, total in pairs)
    numerators, denominators = zip(*pairs, strict=True)
    return ratio_interval(numerators, denominators, (lowest * most, most), (most, most))


def count_by_scene(moves: Iterable[Row], result: str) -> list[tuple[int, int]]:
    """Return the numbers of moves with a result and of all moves, of each scene."""
    rows = [*moves]
    total = Counter(row["scene"] for row in rows)
    found = Counter(row["scene"] for row in rows if row["result"] == result)
    return [(found[scene], count) for scene, count in total.items()]


def _summarize_setup(
    setup: Setup | UnusableSetup,
    moves: Sequence[Row],
    noise: Sequence[Row],
    sequences: Sequence[Row],
) -> dict[str, Any]:
    """Return the statistics of one setup from its rows."""
    possible = [row for row in moves if row["possible"]]
    planned = [row for row in possible if row["result"] == PLANNED]
    failures = _count_results(row for row in possible if row["result"] != PLANNED)
    # Only some of the motions are optimized.
    optimized = [row for row in planned if math.isfinite(row["cycle_s"] or math.nan)]
    return {
        "name": setup.name,
        "unusable": setup.reason if isinstance(setup, UnusableSetup) else None,
        "home": None
        if isinstance(setup, UnusableSetup)
        else {"q": list(setup.home.q), "is_given": setup.home.is_given},
        "legal": len(moves),
        "possible": len(possible),
        "planned": len(planned),
        "share": len(planned) / len(possible) if possible else None,
        "share_ci95": share_interval(count_by_scene(possible, PLANNED)),
        "impossible": _count_results(row for row in moves if not row["possible"]),
        "failures": failures,
        "failures_ci95": {
            result: share_interval(count_by_scene(possible, result)) for result in failures
        },
        "groups": {
            group: {
                value: {"possible": count, "planned": sum(key(row) == value for row in planned)}
                for value, count in sorted(Counter(map(key, possible)).items())
            }
            for group, key in GROUP_KEYS.items()
        },
        "cycle_s": _quantiles(optimized, "cycle_s", _DURATION_QUANTILES),
        "margins": {
            name: _quantiles(planned, name, quantiles)
            for name, quantiles in MARGIN_QUANTILES.items()
        },
        "noise": [
            _summarize_noise(kind, size, rows) for (kind, size), rows in _group_noise(noise).items()
        ],
        "sequences": _summarize_sequences(sequences) if sequences else None,
    }


def _count_results(moves: Iterable[Row]) -> dict[str, int]:
    return dict(Counter(row["result"] for row in moves).most_common())


def _quantiles(moves: Sequence[Row], column: str, quantiles: Mapping[str, float]) -> dict[str, Any]:
    """Return quantiles of a column; distances that are not computed count as infinite.

    All but the extremes have an interval, with the scenes as the sample.
    """
    scenes: dict[str, list[float]] = {}
    for row in moves:
        value = math.inf if row[column] is None else row[column]
        scenes.setdefault(row["scene"], []).append(value)
    values = [value for scene in scenes.values() for value in scene]
    found: dict[str, Any] = {}
    for name, quantile in quantiles.items():
        found[name] = (
            _finite(float(np.quantile(values, quantile, method="lower"))) if values else None
        )
        if 0 < quantile < 1:
            bounds = quantile_interval([*scenes.values()], quantile)
            found[f"{name}_ci95"] = [_finite(bound) for bound in bounds] if values else None
    return found


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def _group_noise(rows: Sequence[Row]) -> dict[tuple[str, float], list[Row]]:
    groups: dict[tuple[str, float], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["size"]), []).append(row)
    return dict(sorted(groups.items()))


def _summarize_noise(kind: str, size: float, rows: Sequence[Row]) -> dict[str, Any]:
    counts = count_by_scene(rows, MoveResult.PLACED.value)
    return {
        "kind": kind,
        "size": size,
        "moves": len(rows),
        "placed": sum(placed for placed, _ in counts),
        "placed_ci95": share_interval(counts),
        "results": _count_results(rows),
    }


def _summarize_sequences(rows: Sequence[Row]) -> dict[str, Any]:
    solved = [row for row in rows if row["ended"] == TerminationReason.ALL_FOUND.value]
    return {
        "scenes": len(rows),
        "solved": len(solved),
        "solved_share": len(solved) / len(rows),
        "solved_ci95": wilson_interval(len(solved), len(rows)),
        "minutes_of_solved": _quantiles(solved, "minutes", _DURATION_QUANTILES),
        "moves_of_solved": _quantiles(solved, "moves", _DURATION_QUANTILES),
        "ended": dict(Counter(row["ended"] for row in rows).most_common()),
        "not_planned": sum(row["not_planned"] for row in rows),
    }


def _compare(first: str, second: str, moves_a: Sequence[Row], moves_b: Sequence[Row]) -> Row:
    """Return the comparison of two setups over the moves that are possible in both."""

    def by_move(moves: Sequence[Row]) -> dict[tuple[str, str, str], bool]:
        return {
            (row["scene"], row["pick"], row["place"]): row["result"] == PLANNED
            for row in moves
            if row["possible"]
        }

    a, b = by_move(moves_a), by_move(moves_b)
    scenes: dict[str, list[int]] = {}
    for key in a.keys() & b.keys():
        scenes.setdefault(key[0], []).append(a[key] - b[key])
    differences = [(sum(values), len(values)) for _, values in sorted(scenes.items())]
    total = sum(count for _, count in differences)
    return {
        "first": first,
        "second": second,
        "possible_in_both": total,
        "planned_by_first_only": sum(a[key] and not b[key] for key in a.keys() & b.keys()),
        "planned_by_second_only": sum(b[key] and not a[key] for key in a.keys() & b.keys()),
        "difference": sum(d for d, _ in differences) / total if total else None,
        "difference_ci95": share_interval(differences, lowest=-1),
    }
