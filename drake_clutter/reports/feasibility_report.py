"""Web page of a feasibility study: one HTML file with embedded images."""

import base64
import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path

from matplotlib import rc_context
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
from drake_clutter.reports.feasibility_maps import (
    MAPS_FILE,
    can_write_maps,
    write_interactive_maps,
)
from drake_clutter.reports.feasibility_tables import (
    comparisons_table,
    margins_table,
    sequences_table,
    setups_table,
    targets_table,
)
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.scene import Scene

MAX_PANELS = 10
"""Number of setups, the best of the ranking, that are shown one by one."""
MAX_COMPARISONS = 15
"""Number of pairs of setups up to which their table is open."""
MAX_LEGEND = 6
"""Number of setups, the best of the ranking, that share the axes of a figure."""
MAX_SETUPS_WITH_CASES = 4
"""Number of setups, the best of the ranking, whose worst cases are drawn."""
_CSS = """body{font:16px/1.5 system-ui,"DejaVu Sans",sans-serif;max-width:1120px;margin:2em auto;
padding:0 1em;color:#1f2630}
h1,h2{line-height:1.2}.scroll{overflow-x:auto}table{border-collapse:collapse;margin:1em 0}
td,th{border:1px solid #cdd2d9;padding:.3em .6em;text-align:left;vertical-align:top}
img{max-width:100%;margin:.5em 0}figure{margin:1em 0;overflow-x:auto}
@media (max-width:700px){figure img{max-width:none;width:900px}}
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
    """Write the page of a feasibility study and, with the extra `data`, interactive maps beside it.

    Args:
        path: HTML file.
        results: Results of the study.
        load_scene: Returns the scene of a name at its settled poses.
    """
    with rc_context(PLOT_STYLE):
        parts = [*_summary_parts(results), *_figure_parts(results)]
    parts += _case_parts(results, load_scene)
    shown = results.summary["ranking"][:MAX_PANELS]
    if shown and can_write_maps():
        write_interactive_maps(path.parent, results.moves, results.maps, results.bases, shown)
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Kinematic feasibility</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_CSS}</style><body>{''.join(parts)}</body></html>"
    )
    write_text(path, page)


def answer_sentences(summary: Row) -> list[str]:
    """Return a summary of a study in three sentences.

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
        verb = "is" if count == 1 else "are"
        failures_text = _number(failed, "failure")
        sentences.append(f"Of its {failures_text}, {count} {verb} \u201c{reason}\u201d.")
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
    sign = 100 if comparison["first"] == best["name"] else -100
    low, high = sorted(sign * bound for bound in comparison["difference_ci95"])
    decided = "" if low <= 0 <= high else "not "
    sentences.append(
        f"{time + '; ' if time else ''}{second} is next, {sign * comparison['difference']:.1f} "
        f"points behind (95 % interval {low:.1f} to {high:.1f}): the data are {decided}compatible "
        "with no difference."
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
    if summary["ranking"] and can_write_maps():
        yield f'<p>To look closer: <a href="{MAPS_FILE}">interactive maps</a>.</p>'
    yield setups_table(summary, results.setups)
    if summary["unstable_scenes"]:
        excluded = escape(", ".join(summary["unstable_scenes"]))
        yield f"<p>Excluded, because they are unstable: {excluded}.</p>"
    if summary["comparisons"]:
        yield "<h2>Differences between setups</h2>"
        table = comparisons_table(summary["comparisons"])
        yield _folded(table, len(summary["comparisons"]), "pairs", MAX_COMPARISONS)
    yield "<h2>Margins of the planned moves</h2>"
    yield _folded(margins_table(summary), count, "setups", MAX_PANELS)
    if results.sequences:
        yield "<h2>Searches of whole scenes</h2>"
        yield sequences_table(summary)
    if results.targets:
        yield f"<h2>Target poses</h2>{targets_table(results.targets)}"


def _folded(table: str, count: int, unit: str, most: int) -> str:
    """Return a table, which is folded up if it has too many rows."""
    if count <= most:
        return table
    return f"<details><summary>{count} {unit}</summary>{table}</details>"


def _figure_parts(results: StudyResults) -> Iterable[str]:
    summary, setups, moves = results.summary, results.setups, results.moves
    ranking = summary["ranking"]
    if not ranking:
        return
    panels, legend = ranking[:MAX_PANELS], ranking[:MAX_LEGEND]
    shown = "" if len(ranking) <= MAX_LEGEND else f" (the best {MAX_LEGEND} setups)"
    if len(ranking) > 1:
        yield _figure("Ranking", plot_ranking(summary))
    failures = {setup["name"]: setup["failures"] for setup in summary["setups"]}
    failing = [name for name in ranking if failures[name]]
    if failing:
        title = "Reasons of failures"
        title += "" if len(failing) <= MAX_LEGEND else f" (the best {MAX_LEGEND} setups with any)"
        yield _figure(title, plot_failures(moves, failing[:MAX_LEGEND]))
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


def _embedded_image(png: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _figure(title: str, figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    image = _embedded_image(stream.getvalue(), title)
    return f"<h2>{escape(title)}</h2><figure>{image}</figure>"
