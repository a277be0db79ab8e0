"""Pictures of single moves of a feasibility study."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.move_study import PLANNED
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.reports.filmstrip import render_filmstrip
from drake_clutter.reports.scene_images import Annotations, SceneRenderer
from drake_clutter.scenes.interfaces import MotionSample
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.scene_plant import pose_from_transform

Row = Mapping[str, Any]
"""Row of a table: values by column."""

MAX_CASES_PER_SETUP = 3
"""Number of failures shown of each setup, each with another reason."""
_FRAME_SIDE = 360
"""Side of the pictures of the arm [px]."""


def select_cases(moves: Sequence[Row]) -> list[tuple[str, Row]]:
    """Return the cases of one setup that are worth a picture, with a title.

    They are the planned moves with the least clearance, the least distance from a singularity and
    the longest motion, and one move for each of the most frequent reasons of failure.

    Args:
        moves: Rows of `moves.csv` of the setup.
    """
    planned = [row for row in moves if row["result"] == PLANNED]
    near = [row for row in planned if row["clearance"] is not None]
    cases: list[tuple[str, Row]] = []
    if near:
        cases.append(("Least clearance", min(near, key=lambda row: row["clearance"])))
    if planned:
        cases.append(("Closest to a singularity", min(planned, key=lambda r: r["singular_value"])))
        cases.append(("Longest motion", max(planned, key=lambda row: row["unoptimized_s"])))
    failed = [row for row in moves if row["possible"] and row["result"] != PLANNED]
    reasons = sorted({r["result"] for r in failed}, key=lambda x: -_count(failed, x))
    cases = [(k, row) for n, (k, row) in enumerate(cases) if row not in [r for _, r in cases[:n]]]
    cases += [
        (f"Failure: {reason}", next(row for row in failed if row["result"] == reason))
        for reason in reasons[:MAX_CASES_PER_SETUP]
    ]
    return cases


def _count(rows: Sequence[Row], result: str) -> int:
    return sum(row["result"] == result for row in rows)


def render_case(
    row: Row, scene: Scene, cell: WorkCell, renderer: SceneRenderer
) -> tuple[str, list[bytes]]:
    """Return a description of a move, and its images as PNG.

    The images are the scene, and the arm along the plan if there is one.

    Args:
        row: Row of `moves.csv`.
        scene: The scene.
        cell: Work cell of the setup.
        renderer: Draws the scene.
    """
    X_TO = None
    if row["place_x"] is not None:
        p_TO = (row["place_x"], row["place_y"], row["place_z"])
        X_TO = Pose(p_TO, tuple(row[f"place_q{axis}"] for axis in "wxyz"))
    images = [renderer.render_annotated(scene, Annotations(moved=row["pick"], X_T_placed=X_TO))]
    if row["result"] != PLANNED:
        detail = ": ".join(filter(None, (row["result"], row["detail"])))
        return detail, [_encode_png(image) for image in images]
    distance = "more than 30 mm"
    if row["clearance"] is not None:
        distance = f"{1000 * row['clearance']:.1f} mm ({row['nearest_pair']})"
    detail = (
        f"motion {row['unoptimized_s']:.2f} s, smallest distance {distance}, smallest singular "
        f"value {row['singular_value']:.2f}, torque {100 * row['torque_share']:.0f} % of its limit"
    )
    if X_TO is not None:
        planner = PickPlacePlanner(cell.with_support(scene.support), PlannerConfig(optimize=False))
        plan = planner.plan(scene.objects, row["pick"], X_TO)
        if isinstance(plan, PickPlacePlan):
            frames = _plan_key_frames(plan, scene, cell)
            images.append(render_filmstrip(scene, frames, cell, _FRAME_SIDE))
    return detail, [_encode_png(image) for image in images]


def _plan_key_frames(plan: PickPlacePlan, scene: Scene, cell: WorkCell) -> list[MotionSample]:
    """Return three frames of a plan: at the grasp, halfway to the place, and at the place."""
    carry = plan.segments[1].trajectory
    tool = ToolKinematics(cell, plan.tool)
    frames = []
    for time in (0.0, carry.end_time() / 2, carry.end_time()):
        q = carry.value(time).ravel()
        X_TO = RigidTransform(tool.pose(q)) @ plan.X_OG.inverse()
        poses = {**scene.poses, plan.pick: pose_from_transform(X_TO)}
        frames.append(MotionSample(time, poses, tuple(q.tolist())))
    return frames


def _encode_png(image: NDArray[np.uint8]) -> bytes:
    """Return an image as PNG, at most 480 pixels high."""
    stream = io.BytesIO()
    small = Image.fromarray(image)
    small.thumbnail((image.shape[1], 480))
    small.save(stream, format="PNG")
    return stream.getvalue()
