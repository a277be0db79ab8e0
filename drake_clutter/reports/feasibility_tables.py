"""Tables of a feasibility study's page."""

from collections.abc import Mapping, Sequence
from html import escape

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.reports.feasibility_figures import Row, Rows


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a table, which scrolls sideways where it is too wide.

    Args:
        rows: Texts by column. The first row has all columns; cells that others lack are empty.
    """
    if not rows:
        return ""
    columns = [*rows[0]]
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    lines = [[escape(row.get(column, "")) for column in columns] for row in rows]
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in line)}</tr>" for line in lines)
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _format(value: float | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def _with_interval(
    value: float | None, bounds: Sequence[float | None] | None, digits: int = 3, unit: str = ""
) -> str:
    """Return a value with its interval; "-" if the data do not determine it."""
    if value is None or bounds is None or all(bound is None for bound in bounds):
        return _format(value, digits, unit)
    low, high = (_format(bound, digits) for bound in bounds)
    return f"{_format(value, digits)} ({low} to {high}){unit}"


def _quantile(found: Row, name: str, digits: int, unit: str = "", scale: float = 1.0) -> str:
    """Return a quantile of `summary.json` with its interval, if it has one."""
    value = found[name]
    bounds = found.get(f"{name}_ci95")
    scaled = None if bounds is None else [None if b is None else scale * b for b in bounds]
    return _with_interval(None if value is None else scale * value, scaled, digits, unit)


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def setups_table(summary: Row, cells: Mapping[str, WorkCell]) -> str:
    """Return the table of the setups, best first.

    Args:
        summary: Document of `summary.json`.
        cells: Work cells of the setups that could be studied, by name.
    """
    by_name = {setup["name"]: setup for setup in summary["setups"]}
    ranking = summary["ranking"]
    order = [*ranking, *(name for name in by_name if name not in ranking)]
    usable = [by_name[name] for name in order if by_name[name]["unusable"] is None]
    rows = [_setup_row(setup, cells[setup["name"]], ranking) for setup in usable]
    unusable = [
        {"setup": name, "why it is not studied": setup["unusable"]}
        for name, setup in by_name.items()
        if setup["unusable"] is not None
    ]
    return _table(rows) + _table(unusable)


def _setup_row(setup: Row, cell: WorkCell, ranking: Sequence[str]) -> dict[str, str]:
    name = setup["name"]
    base = (*cell.robot.base.translation, cell.robot.base.rpy_deg[2])
    return {
        "rank": str(ranking.index(name) + 1) if name in ranking else "",
        "setup": name,
        "base x, y, z [m], yaw [deg]": ", ".join(f"{value:.4g}" for value in base),
        "payload": f"{cell.robot.payload:g} kg",
        "home": "given" if setup["home"]["is_given"] else "searched",
        "planned of possible": f"{setup['planned']} of {setup['possible']}",
        "share (95 % interval)": _with_interval(setup["share"], setup["share_ci95"]),
        "legal, but impossible": _counts(setup["impossible"]) or "none",
        "cycle time, median": _quantile(setup["cycle_s"], "median", 2, " s"),
    }


def comparisons_table(comparisons: Rows) -> str:
    """Return the table of pairs of setups.

    Args:
        comparisons: `comparisons` of `summary.json`.
    """
    return _table(
        [
            {
                "first": row["first"],
                "second": row["second"],
                "possible in both": str(row["possible_in_both"]),
                "planned by the first only": str(row["planned_by_first_only"]),
                "by the second only": str(row["planned_by_second_only"]),
                "difference of the shares (95 % interval)": _with_interval(
                    row["difference"], row["difference_ci95"]
                ),
            }
            for row in comparisons
        ]
    )


def margins_table(summary: Row) -> str:
    """Return the table of the margins of the planned moves."""
    return _table([_margins_row(setup) for setup in summary["setups"] if setup["planned"]])


def _margins_row(setup: Row) -> dict[str, str]:
    margins = setup["margins"]

    def low_and_median(name: str, digits: int, scale: float = 1.0) -> str:
        keys = ("p05", "median")
        return ", ".join(_quantile(margins[name], key, digits, "", scale) for key in keys)

    def shares(name: str) -> str:
        keys = ("median", "p95", "largest")
        return ", ".join(_quantile(margins[name], key, 0, " %", 100) for key in keys)

    return {
        "setup": setup["name"],
        "clearance [mm]: 5 %, median (-: above 30)": low_and_median("clearance", 0, 1000),
        "to joint limits [rad]: 5 %, median": low_and_median("joint_margin", 2),
        "smallest singular value: 5 %, median": low_and_median("singular_value", 3),
        "manipulability: 5 %, median": low_and_median("manipulability", 4),
        "torque of its limit: median, 95 %, largest": shares("torque_share"),
        "acceleration of what the tool holds: median, 95 %, largest": shares("load_share"),
    }


def sequences_table(summary: Row) -> str:
    """Return the table of the searches of whole scenes."""
    found = {setup["name"]: setup["sequences"] for setup in summary["setups"]}
    return _table(
        [
            {
                "setup": name,
                "scenes searched to the end": f"{searches['solved']} of {searches['scenes']}",
                "share (95 % interval)": _with_interval(
                    searches["solved_share"], searches["solved_ci95"], 2
                ),
                "robot time of these, median": _quantile(
                    searches["minutes_of_solved"], "median", 2, " min"
                ),
                "moves of these, median": _quantile(searches["moves_of_solved"], "median", 0),
                "moves without a plan": str(searches["not_planned"]),
                "ends": _counts(searches["ended"]),
            }
            for name, searches in found.items()
            if searches is not None
        ]
    )


def targets_table(targets: Rows) -> str:
    """Return the table of the target poses.

    Args:
        targets: Rows of `targets.csv`.
    """
    return _table(
        [
            {
                "setup": target["setup"],
                "target pose": target["target"],
                "reachable": "yes" if target["reachable"] else "no",
                "IK solutions": str(target["num_solutions"]),
                "smallest singular value": _format(target["singular_value"], 3),
                "bodies in collision": target["obstacles"]
                or ("" if target["reachable"] else "out of reach"),
            }
            for target in targets
        ]
    )
