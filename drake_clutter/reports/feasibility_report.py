"""Web page of a feasibility study: one HTML file with embedded images."""

import base64
import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import write_text
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.reports.filmstrip import render_filmstrip
from drake_clutter.reports.scene_images import Annotations, SceneRenderer
from drake_clutter.scenes.interfaces import ArmState, MotionSample
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.feasibility_study import PLANNED

Rows = Sequence[Mapping[str, Any]]
"""Rows of a table: values by column."""

CASES_PER_KIND = 3
"""Number of moves shown of each kind of extreme case."""
_PLOT_STYLE: dict[Any, Any] = {
    "font.size": 15,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "figure.constrained_layout.use": True,
}
_CSS = """body{font:16px/1.5 system-ui,"DejaVu Sans",sans-serif;max-width:1120px;margin:2em auto;
padding:0 1em;color:#1f2630}
h1,h2{line-height:1.2}.scroll{overflow-x:auto}table{border-collapse:collapse;margin:1em 0}
td,th{border:1px solid #cdd2d9;padding:.3em .6em;text-align:left;vertical-align:top}
img{max-width:100%;margin:.5em 0}figure{margin:1em 0}
.case{border-top:1px solid #cdd2d9;padding:.5em 0}"""
_REACHABLE_LABEL = "reachable fraction of the cup poses"
_MANIPULABILITY_LABEL = "manipulability [m$^3$]"
_PLANNED_LABEL = "fraction of the moves planned"


def write_feasibility_report(
    path: Path,
    setups: Mapping[str, WorkCell],
    moves: Rows,
    pose_errors: Rows,
    reachability_maps: Mapping[str, Mapping[str, Any]],
    bases: Rows,
    targets: Rows,
    summary: Mapping[str, Any],
    load_scene: Callable[[str], Scene],
) -> None:
    """Write the page of a feasibility study.

    Args:
        path: HTML file.
        setups: Work cells by name.
        moves: Rows of `moves.csv`.
        pose_errors: Rows of `pose_errors.csv`.
        reachability_maps: Reachability map of each setup, by its fields.
        bases: Rows of `bases.csv`.
        targets: Rows of `targets.csv`.
        summary: Document of `summary.json`.
        load_scene: Returns the scene of a name at its settled poses.
    """
    plt.rcParams.update(_PLOT_STYLE)
    first_setup = next(iter(setups.values()))
    parts = [
        f"<h1>Kinematic feasibility: {summary['scenes']} scenes, {len(setups)} setups, "
        f"{len(moves)} planning problems</h1>",
        _setups_table(setups, summary),
    ]
    if summary["unstable_scenes"]:
        excluded = escape(", ".join(summary["unstable_scenes"]))
        parts.append(f"<p>Excluded, because they are unstable: {excluded}.</p>")
    if len(setups) > 1:
        rows = [(pair, str(count)) for pair, count in summary["planned_by"].items()]
        parts.append("<h2>Moves planned by one setup and not by another</h2>")
        parts.append(_table(("planned by", "number of moves"), rows))
    if moves:
        names = list(setups)
        parts += [
            _figure(
                "Results of all legal moves (labels: number of moves)", _plot_results(moves, names)
            ),
            _figure(
                "Fraction of legal moves planned, by picked object (bars: 95 % CI)",
                _plot_by_object(moves, names),
            ),
            _figure(
                "Fraction of legal moves planned, by pick position (labels: number of moves)",
                _plot_by_pick_position(moves, setups),
            ),
        ]
    for setup, reachability_map in reachability_maps.items():
        title = f"{setup}: poses reachable with the cup pointing down, in the empty cell"
        parts.append(_figure(title, _plot_reachability(reachability_map)))
    parts.append(
        _figure(
            "Base positions, at the height and yaw of the first setup",
            _plot_base_positions(bases, first_setup),
        )
    )
    if pose_errors:
        parts.append(
            _figure(
                "Plans from erroneous object poses, valid for the true poses (bars: 95 % CI)",
                _plot_pose_errors(pose_errors),
            )
        )
    if targets:
        parts.append(_targets_table(targets))
    if moves:
        parts.append(
            "<h2>Extreme cases</h2><p>The move from above and, if it is planned, the arm at the "
            "grasp, halfway to the place, and at the place.</p>"
        )
        parts += _extreme_cases_html(moves, setups, load_scene)
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Kinematic feasibility</title>'
    )
    page += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    page += f"<style>{_CSS}</style><body>{''.join(parts)}"
    write_text(path, page + "</body></html>")


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts, which scrolls sideways where it is too wide."""
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _setups_table(setups: Mapping[str, WorkCell], summary: Mapping[str, Any]) -> str:
    rows = []
    for name, cell in setups.items():
        statistics = summary["setups"][name]
        low, high = statistics["planned_ci95"]
        fraction = statistics["planned_fraction"]
        duration = statistics["median_motion_duration_s"]
        times = statistics["planning_time_s"]
        base = (*cell.robot.base.translation, cell.robot.base.rpy_deg[2])
        rows.append(
            (
                name,
                ", ".join(f"{value:g}" for value in base),
                cell.gripper.description,
                f"{cell.robot.payload:g} kg",
                f"{statistics['planned']} of {statistics['moves']}",
                "-" if fraction is None else f"{fraction:.3f} ({low:.3f} to {high:.3f})",
                "-" if duration is None else f"{duration:.2f} s",
                f"{1000 * times['p50']:.0f} ms, {1000 * times['p95']:.0f} ms",
            )
        )
    columns = (
        "setup",
        "base x, y, z [m], yaw [deg]",
        "gripper",
        "payload",
        "moves planned",
        "fraction planned (95 % CI)",
        "median motion duration",
        "planning time (p50, p95)",
    )
    return _table(columns, rows)


def _targets_table(targets: Rows) -> str:
    rows = [
        (
            target["setup"],
            target["target"],
            str(target["num_solutions"]),
            f"{target['manipulability']:.3f}",
            target["blocking_bodies"] or ("" if target["num_solutions"] else "out of reach"),
        )
        for target in targets
    ]
    columns = (
        "setup",
        "target pose",
        "collision-free IK solutions",
        "manipulability [m\N{SUPERSCRIPT THREE}]",
        "bodies in collision",
    )
    return f"<h2>Target poses</h2>{_table(columns, rows)}"


def _embedded_image(png: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _figure(title: str, figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    plt.close(figure)
    image = _embedded_image(stream.getvalue(), title)
    return f"<h2>{escape(title)}</h2><figure>{image}</figure>"


def _plot_results(moves: Rows, setups: Sequence[str]) -> Figure:
    """Plot the fraction of moves with each result as horizontal bars."""
    results = [result for result, _ in Counter(row["result"] for row in moves).most_common()]
    results = [PLANNED, *(result for result in results if result != PLANNED)]
    figure, axes = plt.subplots(figsize=(12, 1.6 + 0.55 * len(results) * max(1, len(setups) / 2)))
    height = 0.8 / len(setups)
    for k, setup in enumerate(setups):
        rows = [row for row in moves if row["setup"] == setup]
        counts = Counter(row["result"] for row in rows)
        fractions = [counts[result] / max(1, len(rows)) for result in results]
        positions = np.arange(len(results)) + k * height
        axes.barh(positions, fractions, height, label=setup)
        for y, fraction, result in zip(positions, fractions, results, strict=True):
            axes.text(fraction + 0.005, y, str(counts[result]), va="center", fontsize=12)
    axes.set_yticks(np.arange(len(results)) + 0.4 - height / 2, results)
    axes.invert_yaxis()
    axes.set(xlabel="fraction of the legal moves", xlim=(0, 1))
    if len(setups) > 1:
        axes.legend()
    return figure


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
            planned = sum(row["result"] == PLANNED for row in rows)
            statistics.append((planned / max(1, len(rows)), *wilson_interval(planned, len(rows))))
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


def _plot_by_object(moves: Rows, setups: Sequence[str]) -> Figure:
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.2), sharey=True, width_ratios=(2, 1, 1.3))
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
    axes[0].set_ylabel(_PLANNED_LABEL)
    if len(setups) > 1:
        axes[2].legend(fontsize=11)
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


def _plot_by_pick_position(moves: Rows, setups: Mapping[str, WorkCell]) -> Figure:
    """Plot the fraction of moves planned over the support, on a grid of 7 by 7 cells."""
    positions = np.abs([(row["pick_x"], row["pick_y"]) for row in moves])
    half_x, half_y = np.max(
        [*positions, *(cell.support.half_size for cell in setups.values())], axis=0
    )
    edges_x = np.linspace(-half_x, half_x, 8)
    edges_y = np.linspace(-half_y, half_y, 8)
    figure, axes = plt.subplots(1, len(setups), figsize=(6.6 * len(setups), 5.6), squeeze=False)
    for panel, setup in zip(axes[0], setups, strict=True):
        rows = [row for row in moves if row["setup"] == setup]
        x = np.array([row["pick_x"] for row in rows])
        y = np.array([row["pick_y"] for row in rows])
        is_planned = np.array([row["result"] == PLANNED for row in rows], float)
        count, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y))
        planned, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y), weights=is_planned)
        with np.errstate(invalid="ignore"):
            fraction = planned / count
        image = _plot_heatmap(panel, fraction, (-half_x, half_x, -half_y, half_y), 1.0)
        for i, center_x in enumerate((edges_x[1:] + edges_x[:-1]) / 2):
            for j, center_y in enumerate((edges_y[1:] + edges_y[:-1]) / 2):
                if count[i, j]:
                    panel.text(
                        center_x,
                        center_y,
                        f"{count[i, j]:.0f}",
                        ha="center",
                        va="center",
                        color="white" if fraction[i, j] < 0.6 else "black",
                        fontsize=11,
                    )
        panel.set(title=setup, xlabel="x in the tray frame [m]", ylabel="y [m]")
    figure.colorbar(image, ax=axes[0], label=_PLANNED_LABEL)
    return figure


def _plot_reachability(reachability_map: Mapping[str, Any]) -> Figure:
    heights = reachability_map["heights"]
    half_x, half_y = (
        values[-1] + (values[1] - values[0]) / 2
        for values in (reachability_map["x"], reachability_map["y"])
    )
    extent = (-half_x, half_x, -half_y, half_y)
    figure, axes = plt.subplots(
        2, len(heights), figsize=(3.9 * len(heights), 7.2), squeeze=False, sharex=True, sharey=True
    )
    max_manipulability = max(0.01, float(np.max(reachability_map["manipulability"])))
    for k, height in enumerate(heights):
        fraction = np.array(reachability_map["reachable_fraction"][k])
        manipulability = np.array(reachability_map["manipulability"][k])
        top = _plot_heatmap(axes[0][k], fraction, extent, 1.0)
        bottom = _plot_heatmap(axes[1][k], manipulability, extent, max_manipulability)
        axes[0][k].set_title(f"{100 * height:g} cm above the floor", fontsize=13)
        axes[1][k].set_xlabel("x in the tray frame [m]")
    for row in axes:
        row[0].set_ylabel("y [m]")
    figure.colorbar(top, ax=axes[0], label="reachable fraction of 12 yaws")
    figure.colorbar(bottom, ax=axes[1], label=_MANIPULABILITY_LABEL)
    return figure


def _plot_base_positions(bases: Rows, cell: WorkCell) -> Figure:
    x = sorted({row["x"] for row in bases})
    y = sorted({row["y"] for row in bases})
    figure, axes = plt.subplots(1, 2, figsize=(13, 6))
    half_x = (x[1] - x[0]) / 2
    half_y = (y[1] - y[0]) / 2
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    labels = {"reachable_fraction": _REACHABLE_LABEL, "manipulability": _MANIPULABILITY_LABEL}
    best = max(bases, key=lambda row: (row["reachable_fraction"], row["manipulability"]))
    for panel, (name, label) in zip(axes, labels.items(), strict=True):
        value_at = {(row["x"], row["y"]): row[name] for row in bases}
        values = np.array([[value_at[i, j] for j in y] for i in x])
        image = _plot_heatmap(panel, values, extent, max(0.01, float(values.max())))
        figure.colorbar(image, ax=panel, label=label)
        panel.plot(*cell.robot.base.translation[:2], "r*", markersize=18, label="first setup")
        panel.plot(
            best["x"],
            best["y"],
            "wo",
            markersize=12,
            markeredgecolor="black",
            label="best of the grid",
        )
        panel.set(xlabel="x of the base in the tray frame [m]", ylabel="y of the base [m]")
        panel.legend(fontsize=11, loc="upper left")
    return figure


def _plot_pose_errors(pose_errors: Rows) -> Figure:
    figure, axes = plt.subplots(figsize=(10, 5))
    errors = sorted({row["error"] for row in pose_errors})
    for setup in dict.fromkeys(row["setup"] for row in pose_errors):
        statistics = []
        for error in errors:
            rows = [row for row in pose_errors if row["setup"] == setup and row["error"] == error]
            valid = sum(row["result"] == "holds" for row in rows)
            statistics.append((valid / len(rows), *wilson_interval(valid, len(rows))))
        fraction, low, high = np.array(statistics).T
        interval = np.clip([fraction - low, high - fraction], 0, None)
        axes.errorbar(
            1000 * np.array(errors), fraction, interval, marker="o", capsize=5, label=setup
        )
    axes.set(
        xlabel="standard deviation of the position error in x and in y [mm]; yaw: 0.5 deg per mm",
        ylabel="fraction of the plans that are valid",
        ylim=(0, 1.03),
    )
    axes.legend()
    return figure


def _extreme_cases_html(
    moves: Rows, setups: Mapping[str, WorkCell], load_scene: Callable[[str], Scene]
) -> list[str]:
    """Return images of the moves nearest to a collision, the longest, and one of each failure."""
    planned = [row for row in moves if row["result"] == PLANNED]
    near = [row for row in planned if row["clearance"] is not None]
    nearest = sorted(near, key=lambda row: float(row["clearance"]))[:CASES_PER_KIND]
    longest = sorted(planned, key=lambda row: -float(row["motion_s"]))[:CASES_PER_KIND]
    cases = [("Nearest to a collision", row) for row in nearest]
    cases += [("Longest motion", row) for row in longest]
    failures = (row for row in moves if row["result"] not in (PLANNED, "no free spot"))
    for reason in dict.fromkeys(row["result"] for row in failures):
        first = next(row for row in moves if row["result"] == reason)
        cases.append((f"Failure: {reason}", first))
    renderer = SceneRenderer()
    return [
        _case_html(kind, row, load_scene(row["scene"]), setups[row["setup"]], renderer)
        for kind, row in cases
    ]


def _case_html(
    kind: str, row: Mapping[str, Any], scene: Scene, cell: WorkCell, renderer: SceneRenderer
) -> str:
    """Return the images of a move: the scene, and the arm along the plan if there is one."""
    X_TO = None
    if row["place_x"] is not None:
        p_TO = (row["place_x"], row["place_y"], row["place_z"])
        X_TO = Pose(p_TO, scene[row["pick"]].X_TO.quaternion)
    title = f"{row['setup']}, {row['scene']}: {row['pick']} to {row['place']}"
    images = [renderer.render_annotated(scene, Annotations(moved=row["pick"], X_T_placed=X_TO))]
    if row["result"] == PLANNED:
        distance = "more than 30 mm"
        if row["clearance"] is not None:
            distance = f"{1000 * row['clearance']:.1f} mm ({row['nearest_pair']})"
        detail = f"motion {row['motion_s']:.2f} s, smallest distance {distance}"
        if X_TO is not None:
            planner = PickPlacePlanner(
                cell.with_support(scene.support), PlannerConfig(optimize=False)
            )
            plan = planner.plan(scene.objects, row["pick"], X_TO)
            if isinstance(plan, PickPlacePlan):
                images.append(render_filmstrip(scene, _plan_key_frames(plan, scene, cell), cell))
    else:
        detail = ": ".join(filter(None, (row["result"], row["detail"])))
    embedded = "".join(_embedded_image(_encode_png(image), title) for image in images)
    return (
        f'<div class="case"><h3>{escape(kind)}</h3><p>{escape(title)}: {escape(detail)}</p>'
        f"{embedded}</div>"
    )


def _plan_key_frames(plan: PickPlacePlan, scene: Scene, cell: WorkCell) -> list[MotionSample]:
    """Return three frames of a plan: at the grasp, halfway to the place, and at the place."""
    carry = plan.segments[1].trajectory
    tool = ToolKinematics(cell, plan.tool)
    frames = []
    for time in (0.0, carry.end_time() / 2, carry.end_time()):
        q = carry.value(time).ravel()
        X_TO = RigidTransform(tool.pose(q)) @ plan.X_OG.inverse()
        poses = {**scene.poses, plan.pick: pose_from_transform(X_TO)}
        frames.append(MotionSample(time, poses, ArmState(tuple(q.tolist()), (), (), plan.tool)))
    return frames


def _encode_png(image: NDArray[np.uint8]) -> bytes:
    """Return an image as PNG, at most 1080 by 480 pixels."""
    stream = io.BytesIO()
    small = Image.fromarray(image)
    small.thumbnail((1080, 480))
    small.save(stream, format="PNG", optimize=True)
    return stream.getvalue()
