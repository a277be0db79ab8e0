"""Interactive maps of a feasibility study: a page that needs no network."""

import importlib.util
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.files import atomic_write, write_text

Row = Mapping[str, Any]
"""Row of a table: values by column."""
Rows = Sequence[Row]
"""Rows of a table."""

MAPS_FILE = "maps.html"
PLOTLY_FILE = "plotly.min.js"
_TEMPLATE = Path(__file__).with_suffix(".html")


def can_write_maps() -> bool:
    """Return whether Plotly is installed, which the extra `data` brings."""
    return importlib.util.find_spec("plotly") is not None


def write_interactive_maps(
    folder: Path, moves: Rows, maps: Mapping[str, Row], bases: Rows, setups: Sequence[str]
) -> None:
    """Write `maps.html` with Plotly's script beside it.

    Args:
        folder: Output folder of the study.
        moves: Rows of `moves.csv`.
        maps: Reachability maps by setup.
        bases: Rows of `bases.csv`.
        setups: Setups to show.
    """
    # Imported late, because the extra is optional.
    from plotly.offline import get_plotlyjs

    document = {
        "reach": [_rounded({"setup": name, **maps[name]}) for name in setups if name in maps],
        "bases": _base_maps(bases),
        "moves": [
            {"setup": name, "rows": [_mark(row) for row in moves if _is_shown(row, name)]}
            for name in setups
        ],
    }
    # In a script element "<" could end it.
    text = json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")
    with atomic_write(folder / PLOTLY_FILE) as temporary:
        temporary.write_text(get_plotlyjs())
    write_text(folder / MAPS_FILE, _TEMPLATE.read_text().replace("DATA", text, 1))


def _is_shown(row: Row, setup: str) -> bool:
    return bool(row["setup"] == setup and row["possible"])


def _mark(row: Row) -> dict[str, Any]:
    """Return a move as a mark: position, result and text."""
    lines = [f"{row['scene']}: {row['pick']} to {row['place']}"]
    lines.append(": ".join(filter(None, (row["result"], row["detail"]))))
    if row["clearance"] is not None and math.isfinite(row["clearance"]):
        lines.append(f"clearance {1000 * row['clearance']:.1f} mm ({row['nearest_pair']})")
    return {
        "result": row["result"],
        "pick": [row["pick_x"], row["pick_y"]],
        "place": [row["place_x"], row["place_y"]],
        "text": "<br>".join(map(escape, lines)),
    }


def _rounded(document: Any) -> Any:
    """Return a document with numbers of four decimals, to keep the page small."""
    if isinstance(document, Mapping):
        return {name: _rounded(value) for name, value in document.items()}
    if isinstance(document, (list, tuple)):
        return [_rounded(value) for value in document]
    return round(document, 4) if isinstance(document, float) else document


def _base_maps(bases: Rows) -> list[dict[str, Any]]:
    """Return the numbers of moves in reach as grids, one for each setting of other fields.

    Bases in the support have no number.
    """
    axes = {name: sorted({row[name] for row in bases}) for name in ("x", "y", "z", "yaw")}
    x, y, z, yaw = ({value: k for k, value in enumerate(axis)} for axis in axes.values())
    grids = []
    for settings in dict.fromkeys(row["settings"] for row in bases):
        rows = [row for row in bases if row["settings"] == settings]
        counts = np.full((len(z), len(yaw), len(x), len(y)), None, object)
        for row in rows:
            counts[z[row["z"]], yaw[row["yaw"]], x[row["x"]], y[row["y"]]] = row["reachable"]
        grids.append(
            {
                "settings": settings,
                "x": axes["x"],
                "y": axes["y"],
                "z": axes["z"],
                "yaw_deg": [round(math.degrees(value), 1) for value in axes["yaw"]],
                "possible": max(1, rows[0]["possible"]),
                "reachable": counts.tolist(),
            }
        )
    return grids
