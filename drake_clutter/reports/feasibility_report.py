"""Web page of a feasibility study: one HTML file with embedded images."""

import base64
import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import write_text
from drake_clutter.reports.feasibility_cases import render_case, select_cases
from drake_clutter.reports.feasibility_figures import (
    PLOT_STYLE,
    Row,
    Rows,
    plot_base_search,
    plot_by_object,
    plot_by_position,
    plot_failures,
    plot_noise,
    plot_ranking,
    plot_reachability,
)
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.scene import Scene

MAX_PANELS = 10
"""Number of setups, the best of the ranking, that are shown one by one."""
MAX_LEGEND = 6
"""Number of setups, the best of the ranking, that share the axes of a figure."""
MAX_SETUPS_WITH_CASES = 4
"""Number of setups, the best of the ranking, whose worst cases are drawn."""
_CSS = """body{font:16px/1.5 system-ui,"DejaVu Sans",sans-serif;max-width:1120px;margin:2em auto;
padding:0 1em;color:#1f2630}
h1,h2{line-height:1.2}.scroll{overflow-x:auto}table{border-collapse:collapse;margin:1em 0}
td,th{border:1px solid #cdd2d9;padding:.3em .6em;text-align:left;vertical-align:top}
img{max-width:100%;margin:.5em 0}figure{margin:1em 0}
.case{border-top:1px solid #cdd2d9;padding:.5em 0}.case img{max-height:300px;margin-right:1em}"""


@dataclass(frozen=True)
class StudyResults:
    """Results of a study.

    Attributes:
        setups: Work cells of the setups that could be studied, by name.
        moves: Rows of `moves.csv`.
        noise: Rows of `noise.csv`.
        sequences: Rows of `sequences.csv`.
        maps: Reachability maps by setup.
        bases: Rows of `bases.csv`.
        targets: Rows of `targets.csv`.
        summary: Document of `summary.json`.
    """

    setups: Mapping[str, WorkCell]
    moves: Rows
    noise: Rows
    sequences: Rows
    maps: Mapping[str, Row]
    bases: Rows
    targets: Rows
    summary: Row


def write_feasibility_report(
    path: Path, results: StudyResults, load_scene: Callable[[str], Scene]
) -> None:
    """Write the page of a feasibility study.

    Args:
        path: HTML file.
        results: Results of the study.
        load_scene: Returns the scene of a name at its settled poses.
    """
    with plt.rc_context(PLOT_STYLE):
        parts = [*_summary_parts(results), *_figure_parts(results)]
    parts += _case_parts(results, load_scene)
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Kinematic feasibility</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_CSS}</style><body>{''.join(parts)}</body></html>"
    )
    write_text(path, page)


def answer_sentences(summary: Row) -> list[str]:
    """Return three sentences that answer the question of a study.

    Args:
        summary: Document of `summary.json`.
    """
    by_name = {setup["name"]: setup for setup in summary["setups"]}
    if not summary["ranking"]:
        return [f"None of the {len(by_name)} setups has a possible move."]
    best = by_name[summary["ranking"][0]]
    low, high = best["share_ci95"]
    sentences = [
        f"{best['name']} does {best['planned']} of the {best['possible']} moves that "
        f"{_number(summary['scenes'], 'scene')} and its tools allow: {100 * best['share']:.1f} % "
        f"(95 % interval over scenes {100 * low:.1f} to {100 * high:.1f} %)."
    ]
    failures = Counter(best["failures"])
    if failures:
        reason, count = failures.most_common(1)[0]
        failed = best["possible"] - best["planned"]
        sentences.append(f"Of its {_number(failed, 'failure')}, {count} are \u201c{reason}\u201d.")
    else:
        sentences.append("No possible move fails.")
    cycle = best["cycle_s"]["median"]
    time = "" if cycle is None else f"A move takes {cycle:.1f} s at the median"
    if len(summary["ranking"]) == 1:
        return [*sentences, *([f"{time}."] if time else [])]
    second = summary["ranking"][1]
    comparison = next(
        c for c in summary["comparisons"] if {c["first"], c["second"]} == {best["name"], second}
    )
    difference = 100 * comparison["difference"] * (1 if comparison["first"] == best["name"] else -1)
    bounds = [100 * value for value in comparison["difference_ci95"]]
    decided = "" if bounds[0] <= 0 <= bounds[1] else "not "
    sentences.append(
        f"{time + '; ' if time else ''}{second} is next, {difference:.1f} points behind: the data "
        f"are {decided}compatible with no difference."
    )
    return sentences


def _summary_parts(results: StudyResults) -> Iterable[str]:
    summary = results.summary
    count = len(summary["setups"])
    yield (
        f"<h1>Kinematic feasibility: {_number(summary['scenes'], 'scene')}, "
        f"{_number(count, 'setup')}</h1>"
    )
    yield f"<p><b>{escape(' '.join(answer_sentences(summary)))}</b></p>"
    yield (
        "<p>A move is <i>possible</i> if the scene and the tools allow it: the object has nothing "
        "on top, a tool holds it, and there is a free place. All shares are of the possible moves. "
        "Intervals take the scenes as the sample.</p>"
    )
    yield _setups_table(results)
    if summary["unstable_scenes"]:
        excluded = escape(", ".join(summary["unstable_scenes"]))
        yield f"<p>Excluded, because they are unstable: {excluded}.</p>"
    if summary["comparisons"]:
        yield "<h2>Differences between setups</h2>"
        yield _comparisons_table(summary["comparisons"])
    yield "<h2>Margins of the planned moves</h2>"
    yield _margins_table(summary)
    if results.sequences:
        yield "<h2>Searches of whole scenes</h2>"
        yield _sequences_table(summary)
    if results.targets:
        yield f"<h2>Target poses</h2>{_targets_table(results.targets)}"


def _figure_parts(results: StudyResults) -> Iterable[str]:
    summary, setups, moves = results.summary, results.setups, results.moves
    ranking = summary["ranking"]
    if not ranking:
        return
    panels, legend = ranking[:MAX_PANELS], ranking[:MAX_LEGEND]
    shown = "" if len(ranking) <= MAX_LEGEND else f" (the best {MAX_LEGEND} setups)"
    if len(ranking) > 1:
        yield _figure("Ranking", plot_ranking(summary))
    if any(setup["failures"] for setup in summary["setups"]):
        yield _figure(f"Reasons of failures{shown}", plot_failures(moves, legend))
    yield _figure(
        f"Planned share by picked object{shown}",
        plot_by_object(moves, legend),
    )
    for end in ("pick", "place"):
        yield _figure(
            f"Planned share by position of the {end} (labels: number of moves)",
            plot_by_position(moves, setups, end, panels),
        )
    if results.maps:
        names = [name for name in panels if name in results.maps]
        yield _figure(
            "Reachability of the first tool in the empty cell, mean over "
            f"{len(results.maps[names[0]]['heights'])} heights",
            plot_reachability(results.maps, names),
        )
    if results.bases:
        finalists = [cell for name, cell in setups.items() if "robot.base" in name]
        yield _figure(
            "Search of the base (stars: compared by the planner)",
            plot_base_search(results.bases, finalists),
        )
    if results.noise:
        yield _figure(
            "Moves planned from erroneous data, simulated to the end (bars: 95 % interval)",
            plot_noise(summary),
        )


def _case_parts(results: StudyResults, load_scene: Callable[[str], Scene]) -> Iterable[str]:
    """Return pictures of the worst cases of the best setups."""
    ranking = results.summary["ranking"][:MAX_SETUPS_WITH_CASES]
    if not ranking:
        return
    yield (
        "<h2>Worst cases</h2><p>The move from above and, if it is planned, the arm at the grasp, "
        "halfway to the place, and at the place.</p>"
    )
    renderer = SceneRenderer()
    for name in ranking:
        yield f"<h3>{escape(name)}</h3>"
        for kind, row in select_cases([row for row in results.moves if row["setup"] == name]):
            title = f"{row['scene']}: {row['pick']} to {row['place']}"
            scene = load_scene(row["scene"])
            detail, images = render_case(row, scene, results.setups[name], renderer)
            embedded = "".join(_embedded_image(image, title) for image in images)
            text = f"{escape(title)}; {escape(detail)}"
            yield f'<div class="case"><p><b>{escape(kind)}.</b> {text}</p>{embedded}</div>'


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts, which scrolls sideways where it is too wide."""
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _format(value: float | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def _interval(bounds: Sequence[float] | None, digits: int = 3) -> str:
    return "" if bounds is None else f" ({bounds[0]:.{digits}f} to {bounds[1]:.{digits}f})"


def _setups_table(results: StudyResults) -> str:
    rows = []
    summary = results.summary
    by_name = {setup["name"]: setup for setup in summary["setups"]}
    order = [*summary["ranking"], *(name for name in by_name if name not in summary["ranking"])]
    for place, name in enumerate(order, start=1):
        setup = by_name[name]
        if setup["unusable"] is not None:
            rows.append(("", name, setup["unusable"], *[""] * 7))
            continue
        cell = results.setups[name]
        base = (*cell.robot.base.translation, cell.robot.base.rpy_deg[2])
        impossible = ", ".join(f"{n} {reason}" for reason, n in setup["impossible"].items())
        rows.append(
            (
                str(place) if name in summary["ranking"] else "",
                name,
                ", ".join(f"{value:.4g}" for value in base),
                f"{cell.robot.payload:g} kg",
                "given" if setup["home"]["is_given"] else "searched",
                f"{setup['planned']} of {setup['possible']}",
                _format(setup["share"], 3) + _interval(setup["share_ci95"]),
                impossible or "none",
                _format(setup["cycle_s"]["median"], 2, " s"),
                _format(setup["planning_s"]["median"], 3, " s"),
            )
        )
    columns = (
        "rank",
        "setup",
        "base x, y, z [m], yaw [deg]",
        "payload",
        "home",
        "planned of possible",
        "share (95 % interval)",
        "legal, but impossible",
        "cycle time, median",
        "planning time, median",
    )
    return _table(columns, rows)


def _comparisons_table(comparisons: Rows) -> str:
    rows = [
        (
            row["first"],
            row["second"],
            str(row["possible_in_both"]),
            str(row["planned_by_first_only"]),
            str(row["planned_by_second_only"]),
            _format(row["difference"], 3) + _interval(row["difference_ci95"]),
        )
        for row in comparisons
    ]
    columns = (
        "first",
        "second",
        "possible in both",
        "planned by the first only",
        "by the second only",
        "difference of the shares (95 % interval)",
    )
    return _table(columns, rows)


def _margins_table(summary: Row) -> str:
    rows = []
    for setup in summary["setups"]:
        if not setup["planned"]:
            continue
        margins = setup["margins"]

        def pair(name: str, digits: int, scale: float, found: Row = margins) -> str:
            low, middle = found[name]["p05"], found[name]["median"]
            return ", ".join(_format(v if v is None else scale * v, digits) for v in (low, middle))

        def shares(name: str, found: Row = margins) -> str:
            values = (found[name][key] for key in ("median", "p95", "largest"))
            return ", ".join(_format(None if v is None else 100 * v, 0, " %") for v in values)

        rows.append(
            (
                setup["name"],
                pair("clearance", 0, 1000),
                pair("joint_margin", 2, 1),
                pair("singular_value", 3, 1),
                pair("manipulability", 4, 1),
                shares("torque_share"),
                shares("load_share"),
            )
        )
    columns = (
        "setup",
        "clearance [mm]: 5 %, median (-: above 30)",
        "to joint limits [rad]: 5 %, median",
        "smallest singular value: 5 %, median",
        "manipulability: 5 %, median",
        "torque of its limit: median, 95 %, largest",
        "acceleration of what the tool holds: median, 95 %, largest",
    )
    return _table(columns, rows)


def _sequences_table(summary: Row) -> str:
    rows = []
    for setup in summary["setups"]:
        found = setup["sequences"]
        if found is None:
            continue
        rows.append(
            (
                setup["name"],
                f"{found['solved']} of {found['scenes']}",
                _format(found["solved_share"], 2) + _interval(found["solved_ci95"], 2),
                _format(found["minutes_of_solved"]["median"], 2, " min"),
                _format(found["moves_of_solved"]["median"], 0),
                str(found["not_planned"]),
                ", ".join(f"{n} {ended}" for ended, n in found["ended"].items()),
            )
        )
    columns = (
        "setup",
        "scenes searched to the end",
        "share (95 % interval)",
        "robot time of these, median",
        "moves of these, median",
        "moves without a plan",
        "ends",
    )
    return _table(columns, rows)


def _targets_table(targets: Rows) -> str:
    rows = [
        (
            target["setup"],
            target["target"],
            "yes" if target["reachable"] else "no",
            str(target["num_solutions"]),
            _format(target["singular_value"], 3),
            target["obstacles"] or ("" if target["reachable"] else "out of reach"),
        )
        for target in targets
    ]
    columns = (
        "setup",
        "target pose",
        "reachable",
        "IK solutions",
        "smallest singular value",
        "bodies in collision",
    )
    return _table(columns, rows)


def _embedded_image(png: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _figure(title: str, figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    plt.close(figure)
    image = _embedded_image(stream.getvalue(), title)
    return f"<h2>{escape(title)}</h2><figure>{image}</figure>"
