"""Results of commands in words, for tables in a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

EVALUATION_CAPTION = (
    "moves: allowed per episode; all found: fraction of episodes (95 % CI); found: hidden objects "
    "found per episode; of hidden: fraction of all hidden objects; collapsed: fraction of "
    "episodes; moves used: mean of the episodes in which all objects were found"
)
"""Meaning of the columns of `evaluation_table_rows`."""


def evaluation_table_rows(
    row: Mapping[str, Any], move_limits: Sequence[int]
) -> list[dict[str, str]]:
    """Return an agent's row of `summarize_episodes` as one table row per move limit.

    Args:
        row: Statistics of an agent.
        move_limits: Numbers of allowed moves, ascending.

    Returns:
        Cells by column; see `EVALUATION_CAPTION`.
    """
    rows = []
    for limit in move_limits:
        statistics = row[f"within_{limit}"]
        low, high = statistics["success_ci95"]
        cells = {
            "moves": str(limit),
            "all found": f"{statistics['success']:.2f} ({low:.2f}-{high:.2f})",
            "found": f"{statistics['found']:.2f}",
            "of hidden": f"{statistics['found_of_hidden']:.2f}",
            "collapsed": f"{statistics['collapsed']:.2f}",
            "moves used": "",
        }
        rows.append(cells)
    if row["moves_of_successes"] is not None:
        rows[-1]["moves used"] = f"{row['moves_of_successes']:.1f}"
    return rows


def describe_dataset(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the `summary.json` of a recorded data set as texts by label."""
    rows = {
        "episodes": f"{summary['episodes']:,}",
        "moves": f"{summary['moves']:,}, {summary['executed_moves']:,} of them carried out",
        "results": _counts(summary["results"]),
        "ends of episodes": _counts(summary["terminations"]),
        "recorded motion": f"{summary['recorded_seconds'] / 60:,.1f} min",
    }
    if summary["errors"]:
        rows["policy errors"] = f"{len(summary['errors']):,} episodes"
    return rows


def describe_generation(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the `summary.json` of generated scenes as texts by label."""
    rows = {
        "agent": str(summary["agent"]),
        "seed": str(summary["seed"]),
        "scenes": f"{summary['count']}, each from a graph of {summary['nodes']} nodes",
        "stable": _fraction(summary["stability_rate"], summary["stability_ci95"], "scenes"),
    }
    if summary["hidden_mean"] is not None:
        interval = _interval(summary["hidden_ci95"])
        rows["hidden objects"] = f"{summary['hidden_mean']:.2f} per stable scene{interval}"
    if summary["solvable_share"] is not None:
        rows["solvable"] = _fraction(
            summary["solvable_share"], summary["solvable_ci95"], "stable scenes"
        )
    rows |= {
        "distinct graphs": _fraction(summary["distinct_share"], None, "scenes"),
        "stacks": f"{summary['mean_stacks']:.2f} per scene",
        "objects": f"{summary['mean_objects']:.2f} per scene",
        "largest stack": f"{summary['largest_stack_share']:.0%} of the objects of a scene (mean)",
        "balanced": _fraction(summary["balanced_share"], None, "scenes") + " (no dominant stack)",
        "class entropy": f"{summary['class_entropy']:.2f} bit",
        "objects by class": _counts(summary["classes"]),
    }
    if summary.get("absent_classes"):
        rows["absent classes"] = _names(summary["absent_classes"])
    rows |= {
        "unstable scenes": _counts(summary["instability_reasons"]),
        "failed layouts": _counts(summary["layout_failures"]),
        "time": f"{summary['seconds']:.1f} s with {_number(summary['workers'], 'worker')}",
    }
    return rows


def describe_episode(episode: Mapping[str, Any]) -> dict[str, str]:
    """Return an `episode.json` as texts by label."""
    hidden = episode["initially_hidden"]
    rows = {
        "result": f"{episode['termination']} after {_number(len(episode['moves']), 'move')}",
        "objects": f"{episode['num_objects']}, of which {len(hidden)} hidden at the start",
        "found": f"{len(episode['found'])} of {len(hidden)}: {_names(episode['found'])}",
        "total reward": f"{episode['total_reward']:g}",
    }
    if target := episode.get("target"):
        rows["target"] = f"{target['object_class']}, found: {_names(target['found'])}"
    return rows


def describe_outcomes(episode: Mapping[str, Any]) -> dict[str, str]:
    """Return the outcomes of the moves of an `episode.json` as texts by number of the move."""
    rows = {}
    for number, step in enumerate(episode["moves"], start=1):
        reasons = "; ".join(filter(None, (step["instability"], step["detail"])))
        outcome = f"{step['outcome']}{f' ({reasons})' if reasons else ''}"
        rows[f"move {number}"] = f"{step['move']['pick']} to {step['move']['place']}: {outcome}"
    return rows


def describe_solution(solution: Mapping[str, Any]) -> dict[str, str]:
    """Return a `solution.json` as texts by label."""
    rows = {"result": str(solution["solvability"])}
    if solution["moves"] is not None:
        proof = "optimal" if solution["is_optimal"] else "not proved optimal"
        rows["plan"] = f"{_number(solution['moves'], 'move')}, {proof}"
        rows["moves"] = _names(solution["plan"])
    rows["lower bound"] = _number(solution["lower_bound"], "move")
    if solution["unrevealable"]:
        rows["cannot be revealed"] = _names(solution["unrevealable"])
    if solution["confirmed"] is not None:
        rows["confirmed by Drake"] = "yes" if solution["confirmed"] else "no"
    evaluated = solution["moves_evaluated"]
    rows["search"] = f"{evaluated} of at most {solution['budget']} moves evaluated"
    return rows


def describe_feasibility(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the `summary.json` of a feasibility study as texts by setup, best first."""
    by_name = {setup["name"]: setup for setup in summary["setups"]}
    rows = {}
    for name in summary["ranking"]:
        setup = by_name[name]
        share = _fraction(setup["share"], setup["share_ci95"], "possible moves")
        text = f"{setup['planned']} of {setup['possible']} planned, {share}"
        if setup["failures"]:
            text += f"; failures: {_counts(setup['failures'])}"
        if setup["impossible"]:
            text += f"; impossible: {_counts(setup['impossible'])}"
        if setup["sequences"]:
            found = setup["sequences"]
            text += f"; {found['solved']} of {found['scenes']} scenes searched to the end"
        rows[name] = text
    for name, setup in by_name.items():
        if name not in rows:
            rows[name] = setup["unusable"] or "no possible move"
    return rows


def describe_plans(plans: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the plans of a `plan.json` as texts by move."""
    return {f"{p['move']['pick']} to {p['move']['place']}": _describe_plan(p) for p in plans}


def _describe_plan(plan: Mapping[str, Any]) -> str:
    if not plan["planned"]:
        quantity = f" ({plan['quantity']})" if plan.get("quantity") else ""
        return f"no plan: {': '.join(filter(None, (plan['reason'], plan['detail'])))}{quantity}"
    segments = [f"{segment['name']} {segment['duration']:.2f} s" for segment in plan["segments"]]
    distances = [s["min_distance"] for s in plan["segments"] if s["min_distance"] is not None]
    nearest = f"{1000 * min(distances):.0f} mm" if distances else "farther than 30 mm"
    return (
        f"{', '.join(segments)}; nearest obstacle {nearest}; planned in "
        f"{plan['planning_time']:.2f} s"
    )


def _fraction(value: float, interval: Sequence[float] | None, total: str) -> str:
    return f"{value:.2f} of the {total}{_interval(interval)}"


def _interval(interval: Sequence[float] | None) -> str:
    return f" (95 % CI {interval[0]:.2f} to {interval[1]:.2f})" if interval else ""


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _names(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"
