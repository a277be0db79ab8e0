"""The page of a feasibility study: one file, pictures within, to be sent to a colleague."""

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
from drake_clutter.config import ClutterConfig
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

CASES_PER_KIND = 3
"""Moves that are shown of each kind: nearest to a collision, longest, and one for each reason."""
_STYLE: dict[Any, Any] = {
    "font.size": 15,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "figure.constrained_layout.use": True,
}
_CSS = """body{font:16px/1.5 system-ui,sans-serif;max-width:1120px;margin:2em auto;padding:0 1em;color:#1f2630}
h1,h2{line-height:1.2}table{border-collapse:collapse;margin:1em 0}
td,th{border:1px solid #cdd2d9;padding:.3em .6em;text-align:left}
img{max-width:100%;margin:.5em 0}figure{margin:1em 0}
.case{border-top:1px solid #cdd2d9;padding:.5em 0}"""


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
    config: ClutterConfig,
) -> None:
    """Writes the page; see `commands/feasibility.py` for what it is given."""
    plt.rcParams.update(_STYLE)
    parts = [
        f"<h1>Kinematic feasibility: {summary['scenes']} scenes, {len(moves)} moves</h1>",
        _setups_table(setups, summary),
    ]
    if summary["unstable_scenes"]:
        parts.append(
            f"<p>Left out, because they do not stay as they are: {escape(', '.join(summary['unstable_scenes']))}.</p>"
        )
    if len(setups) > 1:
        rows = "".join(
            f"<tr><td>{escape(pair)}</td><td>{n}</td></tr>"
            for pair, n in summary["planned_by"].items()
        )
        parts.append(
            f"<h2>The same moves, compared</h2><table><tr><th>planned by</th><th>moves</th></tr>{rows}</table>"
        )
    if moves:
        parts += [
            _figure("Results of all moves", _plot_results(moves, list(setups))),
            _figure(
                "Planned, of all legal moves of a kind (bars: 95 %)",
                _plot_by_object(moves, list(setups)),
            ),
            _figure(
                "Planned, of the moves that pick there (number of moves)",
                _plot_by_pick_position(moves, setups),
            ),
        ]
    for setup, reachability_map in reachability_maps.items():
        parts.append(
            _figure(
                f"{setup}: where a cup that points down can go, in the empty cell",
                _plot_reachability(reachability_map),
            )
        )
    parts.append(
        _figure(
            "Places of the base, as high and turned as the first setup's",
            _plot_base_positions(bases, next(iter(setups.values()))),
        )
    )
    if pose_errors:
        parts.append(
            _figure(
                "Plans made from wrong poses that hold where the objects really are (bars: 95 %)",
                _plot_pose_errors(pose_errors),
            )
        )
    if targets:
        parts.append(_targets_table(targets))
    if moves:
        parts.append("<h2>Worst cases</h2>")
        parts += _worst_cases_html(moves, setups, load_scene, config)
    page = "<!doctype html><html lang=en><meta charset=utf-8><title>Feasibility</title>"
    page += f"<style>{_CSS}</style><body>{''.join(parts)}"
    write_text(path, page + "</body></html>")


def _setups_table(setups: Mapping[str, WorkCell], summary: Mapping[str, Any]) -> str:
    rows = ""
    for name, cell in setups.items():
        statistics = summary["setups"][name]
        low, high = statistics["planned_ci95"]
        share = (
            "-"
            if statistics["planned_share"] is None
            else f"{statistics['planned_share']:.3f} ({low:.3f} to {high:.3f})"
        )
        motion = (
            "-"
            if statistics["motion_s_median"] is None
            else f"{statistics['motion_s_median']:.2f} s"
        )
        base = ", ".join(
            f"{v:g}" for v in (*cell.robot.base.translation, cell.robot.base.rpy_deg[2])
        )
        cells = (
            name,
            base,
            f"{1000 * cell.gripper.cup_diameter:g} mm, {1000 * cell.gripper.extension:g} mm",
            f"{cell.robot.payload:g} kg",
            f"{statistics['planned']} of {statistics['moves']}",
            share,
            motion,
            f"{1000 * statistics['planning_s']['p50']:.0f} / {1000 * statistics['planning_s']['p95']:.0f} ms (p50 / p95)",
        )
        rows += f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
    heads = (
        "setup",
        "base x, y, z, yaw (m, deg)",
        "cup, tube",
        "payload",
        "planned",
        "share (95 %)",
        "motion",
        "planning",
    )
    return f"<table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{rows}</table>"


def _targets_table(targets: Rows) -> str:
    rows = "".join(
        f"<tr><td>{escape(t['setup'])}</td><td>{escape(t['target'])}</td><td>{t['branches']}</td><td>{t['manipulability']:.3f}</td>"
        f"<td>{escape(t['in_the_way'] or ('' if t['branches'] else 'out of reach'))}</td></tr>"
        for t in targets
    )
    heads = "<th>setup</th><th>pose</th><th>branches without collision</th><th>manipulability, m&sup3;</th><th>in the way</th>"
    return f"<h2>Poses asked for</h2><table><tr>{heads}</tr>{rows}</table>"


def _embedded_image(png: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _figure(title: str, figure: Figure) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    plt.close(figure)
    return f"<h2>{escape(title)}</h2><figure>{_embedded_image(stream.getvalue(), title)}</figure>"


def _plot_results(moves: Rows, setups: Sequence[str]) -> Figure:
    results = [result for result, _ in Counter(row["result"] for row in moves).most_common()]
    results = [PLANNED, *(r for r in results if r != PLANNED)]
    figure, axes = plt.subplots(figsize=(12, 1.6 + 0.55 * len(results) * max(1, len(setups) / 2)))
    height = 0.8 / len(setups)
    for k, setup in enumerate(setups):
        rows = [row for row in moves if row["setup"] == setup]
        counts = Counter(row["result"] for row in rows)
        share = [counts[result] / max(1, len(rows)) for result in results]
        at = np.arange(len(results)) + k * height
        axes.barh(at, share, height, label=setup)
        for y, value, result in zip(at, share, results, strict=True):
            axes.text(value + 0.005, y, str(counts[result]), va="center", fontsize=12)
    axes.set_yticks(np.arange(len(results)) + 0.4 - height / 2, results)
    axes.invert_yaxis()
    axes.set(xlabel="share of the legal moves", xlim=(0, 1))
    if len(setups) > 1:
        axes.legend()
    return figure


def _plot_planned_fractions(
    axes: Any,
    moves: Rows,
    setups: Sequence[str],
    key: Callable[[Mapping[str, Any]], str],
    label: str,
) -> None:
    kinds = sorted({key(row) for row in moves})
    width = 0.8 / len(setups)
    for k, setup in enumerate(setups):
        found = []
        for kind in kinds:
            rows = [row for row in moves if row["setup"] == setup and key(row) == kind]
            good = sum(row["result"] == PLANNED for row in rows)
            found.append((good / max(1, len(rows)), *wilson_interval(good, len(rows))))
        share, low, high = np.array(found).T
        error = np.clip([share - low, high - share], 0, None)
        axes.bar(
            np.arange(len(kinds)) + k * width, share, width, yerr=error, capsize=3, label=setup
        )
    axes.set_xticks(
        np.arange(len(kinds)) + 0.4 - width / 2,
        kinds,
        rotation=40,
        ha="right",
        rotation_mode="anchor",
        fontsize=12,
    )
    axes.set(title=label, ylim=(0, 1))


def _plot_by_object(moves: Rows, setups: Sequence[str]) -> Figure:
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.2), sharey=True, width_ratios=(2, 1, 1.3))
    _plot_planned_fractions(
        axes[0], moves, setups, lambda row: str(row["object_class"]).replace("_", " "), "class"
    )
    _plot_planned_fractions(
        axes[1], moves, setups, lambda row: str(row["rest"]), "axis that points up"
    )
    _plot_planned_fractions(
        axes[2],
        moves,
        setups,
        lambda row: f"{10 * int(row['pick_top'] // 0.1):02d}+ cm",
        "height of its top",
    )
    axes[0].set_ylabel("share planned")
    if len(setups) > 1:
        axes[2].legend(fontsize=11)
    return figure


def _plot_heatmap(
    axes: Any, values: NDArray[np.float64], extent: Sequence[float], top: float
) -> Any:
    axes.grid(visible=False)
    return axes.imshow(
        values.T, origin="lower", extent=extent, vmin=0, vmax=top, cmap="viridis", aspect="equal"
    )


def _plot_by_pick_position(moves: Rows, setups: Mapping[str, WorkCell]) -> Figure:
    picked = np.abs([(row["pick_x"], row["pick_y"]) for row in moves])
    half_x, half_y = np.max(
        [*picked, *(cell.support.half_size for cell in setups.values())], axis=0
    )
    edges_x, edges_y = np.linspace(-half_x, half_x, 8), np.linspace(-half_y, half_y, 8)
    figure, axes = plt.subplots(1, len(setups), figsize=(6.6 * len(setups), 5.6), squeeze=False)
    for panel, setup in zip(axes[0], setups, strict=True):
        rows = [row for row in moves if row["setup"] == setup]
        x, y = np.array([row["pick_x"] for row in rows]), np.array([row["pick_y"] for row in rows])
        good = np.array([row["result"] == PLANNED for row in rows], float)
        count, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y))
        planned, _, _ = np.histogram2d(x, y, bins=(edges_x, edges_y), weights=good)
        with np.errstate(invalid="ignore"):
            image = _plot_heatmap(panel, planned / count, (-half_x, half_x, -half_y, half_y), 1.0)
        for i, cx in enumerate((edges_x[1:] + edges_x[:-1]) / 2):
            for j, cy in enumerate((edges_y[1:] + edges_y[:-1]) / 2):
                if count[i, j]:
                    panel.text(
                        cx,
                        cy,
                        f"{count[i, j]:.0f}",
                        ha="center",
                        va="center",
                        color="white",
                        fontsize=11,
                    )
        panel.set(title=setup, xlabel="x of the tray, m", ylabel="y, m")
    figure.colorbar(image, ax=axes[0], label="share planned")
    return figure


def _plot_reachability(reachability_map: Mapping[str, Any]) -> Figure:
    heights = reachability_map["heights"]
    half_x, half_y = (
        along[-1] + (along[1] - along[0]) / 2
        for along in (reachability_map["x"], reachability_map["y"])
    )
    extent = (-half_x, half_x, -half_y, half_y)
    figure, axes = plt.subplots(
        2, len(heights), figsize=(3.9 * len(heights), 7.2), squeeze=False, sharex=True, sharey=True
    )
    best = max(0.01, float(np.max(reachability_map["manipulability"])))
    for k, height in enumerate(heights):
        top = _plot_heatmap(axes[0][k], np.array(reachability_map["share"][k]), extent, 1.0)
        bottom = _plot_heatmap(
            axes[1][k], np.array(reachability_map["manipulability"][k]), extent, best
        )
        axes[0][k].set_title(f"{100 * height:g} cm above the floor", fontsize=13)
        axes[1][k].set_xlabel("x of the tray, m")
    for row, name in ((0, "y, m"), (1, "y, m")):
        axes[row][0].set_ylabel(name)
    figure.colorbar(top, ax=axes[0], label="share of 12 yaws")
    figure.colorbar(bottom, ax=axes[1], label="manipulability, m$^3$")
    return figure


def _plot_base_positions(bases: Rows, cell: WorkCell) -> Figure:
    x, y = sorted({row["x"] for row in bases}), sorted({row["y"] for row in bases})
    figure, axes = plt.subplots(1, 2, figsize=(13, 6))
    half_x, half_y = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    labels = {"share": "share of poses reached", "manipulability": "manipulability, m$^3$"}
    for panel, (name, label) in zip(axes, labels.items(), strict=True):
        at = {(row["x"], row["y"]): row[name] for row in bases}
        values = np.array([[at[i, j] for j in y] for i in x])
        figure.colorbar(
            _plot_heatmap(panel, values, extent, max(0.01, float(values.max()))),
            ax=panel,
            label=label,
        )
        panel.plot(*cell.robot.base.translation[:2], "r*", markersize=18, label="first setup")
        best = max(bases, key=lambda row: (row["share"], row["manipulability"]))
        panel.plot(
            best["x"],
            best["y"],
            "wo",
            markersize=12,
            markeredgecolor="black",
            label="best of the grid",
        )
        panel.set(xlabel="x of the base, m (the tray's middle is 0, 0)", ylabel="y, m")
        panel.legend(fontsize=11, loc="upper left")
    return figure


def _plot_pose_errors(pose_errors: Rows) -> Figure:
    figure, axes = plt.subplots(figsize=(10, 5))
    errors = sorted({row["error"] for row in pose_errors})
    for setup in dict.fromkeys(row["setup"] for row in pose_errors):
        found = []
        for error in errors:
            rows = [row for row in pose_errors if row["setup"] == setup and row["error"] == error]
            good = sum(row["result"] == "holds" for row in rows)
            found.append((good / len(rows), *wilson_interval(good, len(rows))))
        share, low, high = np.array(found).T
        around = np.clip([share - low, high - share], 0, None)
        axes.errorbar(1000 * np.array(errors), share, around, marker="o", capsize=5, label=setup)
    axes.set(
        xlabel="standard deviation of x and of y, mm; yaw: half a degree for each mm",
        ylim=(0, 1.03),
    )
    axes.set_ylabel("share that holds")
    axes.legend()
    return figure


def _worst_cases_html(
    moves: Rows,
    setups: Mapping[str, WorkCell],
    load_scene: Callable[[str], Scene],
    world: ClutterConfig,
) -> list[str]:
    planned = [row for row in moves if row["result"] == PLANNED]
    nearest_to_collision = sorted(
        (row for row in planned if row["clearance"] is not None),
        key=lambda row: float(row["clearance"]),
    )
    long = sorted(planned, key=lambda row: -float(row["motion_s"]))
    cases = [("nearest to a collision", row) for row in nearest_to_collision[:CASES_PER_KIND]] + [
        ("longest", row) for row in long[:CASES_PER_KIND]
    ]
    for reason in dict.fromkeys(
        row["result"] for row in moves if row["result"] not in (PLANNED, "no free spot")
    ):
        cases.append((reason, next(row for row in moves if row["result"] == reason)))
    camera, parts = SceneRenderer(), []
    for kind, row in cases:
        scene, cell = load_scene(row["scene"]), setups[row["setup"]]
        has_placement = row["place_x"] is not None
        X_TO = (
            Pose(
                (row["place_x"], row["place_y"], row["place_z"]), scene[row["pick"]].X_TO.quaternion
            )
            if has_placement
            else None
        )
        title = f"{row['setup']}, {row['scene']}: {row['pick']} to {row['place']}"
        if row["result"] == PLANNED:
            min_distance = row["clearance"]
            distance = (
                "nothing within 3 cm"
                if min_distance is None
                else f"{1000 * min_distance:.1f} mm ({row['between']})"
            )
            detail = f"{row['motion_s']:.2f} s, {distance}"
        else:
            detail = ": ".join(filter(None, (row["result"], row["about"])))
        pictures = [camera.render_annotated(scene, Annotations(moved=row["pick"], X_T_placed=X_TO))]
        if row["result"] == PLANNED and X_TO is not None:
            planner = PickPlacePlanner(
                cell.with_support(scene.support), PlannerConfig(optimize=False)
            )
            plan = planner.plan(scene.objects, row["pick"], X_TO)
            if isinstance(plan, PickPlacePlan):
                pictures.append(render_filmstrip(scene, _plan_key_frames(plan, scene, cell), cell))
        images = "".join(_embedded_image(_encode_png(picture), title) for picture in pictures)
        parts.append(
            f'<div class="case"><h3>{escape(kind)}</h3><p>{escape(title)}: {escape(detail)}</p>{images}</div>'
        )
    return parts


def _plan_key_frames(plan: PickPlacePlan, scene: Scene, cell: WorkCell) -> list[MotionSample]:
    """At the grasp, in the middle of the way, and at the place."""
    carry, frames = plan.segments[1].trajectory, []
    tool = ToolKinematics(cell)
    for time in (0.0, carry.end_time() / 2, carry.end_time()):
        q = carry.value(time).ravel()
        X_TO = RigidTransform(tool.pose(q)) @ plan.X_OG.inverse()
        poses = {**scene.poses, plan.pick: pose_from_transform(X_TO)}
        frames.append(MotionSample(time, poses, ArmState(tuple(q.tolist()), (), (), True)))
    return frames


def _encode_png(picture: NDArray[np.uint8]) -> bytes:
    stream = io.BytesIO()
    image = Image.fromarray(picture)
    image.thumbnail((1080, 480))
    image.save(stream, format="PNG", optimize=True)
    return stream.getvalue()
