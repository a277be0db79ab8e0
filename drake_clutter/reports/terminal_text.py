"""Results as text for a terminal."""

from collections.abc import Sequence
from typing import Any


def evaluation_table_rows(row: dict[str, Any], limits: Sequence[int]) -> list[dict[str, str]]:
    """Return a row of `summarise_episodes` as lines of a table, one for each limit of moves.

    A line has its cells by column.
    """
    lines = []
    for limit in limits:
        part = row[f"within_{limit}"]
        low, high = part["success_ci95"]
        cells = {
            "in": str(limit),
            "success (95 %)": f"{part['success']:.2f} ({low:.2f}-{high:.2f})",
        }
        cells |= {"found": f"{part['found']:.2f}", "of hidden": f"{part['found_of_hidden']:.2f}"}
        lines.append(cells | {"collapsed": f"{part['collapsed']:.2f}", "moves": ""})
    if row["moves_of_successes"] is not None:
        lines[-1]["moves"] = f"{row['moves_of_successes']:.1f}"
    return lines


def describe_plans(plans: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what of `plan.json` fits on a screen, by move."""
    descriptions = {}
    for plan in plans:
        move = f"{plan['move']['pick']} to {plan['move']['place']}"
        if plan["planned"]:
            parts = [
                f"{segment['name']} {segment['duration']:.2f} s" for segment in plan["segments"]
            ]
            nearest = min(
                (s["min_distance"] for s in plan["segments"] if s["min_distance"] is not None),
                default=None,
            )
            distance_text = "nothing near" if nearest is None else f"{1000 * nearest:.0f} mm clear"
            descriptions[move] = (
                f"{', '.join(parts)}; {distance_text}; planned in {plan['planning_time']:.2f} s"
            )
        else:
            descriptions[move] = (
                f"no plan: {plan['reason']}{': ' + plan['detail'] if plan['detail'] else ''}"
            )
    return descriptions
