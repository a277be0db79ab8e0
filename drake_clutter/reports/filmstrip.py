"""Pictures of the arm at work: moments of a recorded move, side by side."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.reports.scene_images import RENDER_ENGINE, look_at_pose
from drake_clutter.scenes.interfaces import MotionSample
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.cell_plant import add_work_cell, set_joint_angles
from drake_clutter.simulation.scene_plant import add_scene_plant, rigid_transform

_FRAME_SIZE = (480, 480)
_OVERSAMPLING = 2
_CAMERA_POSITION, _CAMERA_TARGET, _FOV_Y_DEG = (1.10, -1.90, 1.30), (-0.22, 0.0, 0.46), 36.0
"""Where the camera is and what it looks at [m], if the arm's base is at -x; and its view [deg]."""
_RENDERER = "arm_pictures"


def select_key_frames(frames: Sequence[MotionSample], pick: str) -> list[MotionSample]:
    """The frames of a recorded move that tell it: before, the object's rise, its way, and when it stands."""
    height = np.array([frame.poses[pick].p[2] for frame in frames])
    horizontal_distance = np.array(
        [np.linalg.norm(frame.poses[pick].p[:2] - frames[0].poses[pick].p[:2]) for frame in frames]
    )
    above_start = np.flatnonzero(height > height[0] + 0.002)
    lift_start = int(above_start[0]) if len(above_start) else len(frames) // 2
    arrival = (
        int(np.flatnonzero(horizontal_distance >= 0.98 * horizontal_distance.max())[0])
        if len(above_start)
        else len(frames) // 2
    )
    moving = np.flatnonzero(np.abs(height - height[-1]) > 0.002)
    placed = min(int(moving[-1]) + 1, len(frames) - 1) if len(moving) else len(frames) - 1
    return [
        frames[k]
        for k in (
            max(lift_start - 2, 0),
            (lift_start + arrival) // 2,
            placed,
            (placed + len(frames)) // 2,
        )
    ]


def rotation_to_base_side(cell: WorkCell) -> NDArray[np.float64]:
    """Return the rotation (3, 3), by quarter turns about z, of the direction -x to that of the arm's base."""
    x, y = cell.robot.X_TB.translation()[:2]
    c, s = (-np.sign(x), 0.0) if abs(x) >= abs(y) else (0.0, -np.sign(y))
    if not c and not s:
        c = 1.0
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def render_filmstrip(
    scene: Scene, frames: Sequence[MotionSample], cell: WorkCell
) -> NDArray[np.uint8]:
    """Pictures of frames that know where the arm was, side by side: (480, 480 n, 3) uint8."""
    builder, cell = DiagramBuilder(), cell.with_support(scene.support)
    scene_plant = add_scene_plant(
        builder,
        [(o.name, o.object_class) for o in scene.objects],
        scene.support,
        0.01,
        visuals=True,
    )
    plant = scene_plant.plant
    arm = add_work_cell(plant, scene_plant.scene_graph, cell, compliant=True, visuals=True)
    plant.Finalize()
    scene_plant.scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(RENDER_ENGINE))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    width, height = (_OVERSAMPLING * size for size in _FRAME_SIZE)
    info = CameraInfo(width, height, np.radians(_FOV_Y_DEG))
    camera = ColorRenderCamera(
        RenderCameraCore(_RENDERER, info, ClippingRange(0.05, 20.0), RigidTransform()), False
    )
    R = rotation_to_base_side(cell)
    X_TC = rigid_transform(
        look_at_pose(R @ np.array(_CAMERA_POSITION), R @ np.array(_CAMERA_TARGET))
    )
    query_port = scene_plant.scene_graph.get_query_output_port()
    pictures = []
    for frame in frames:
        for name, body in scene_plant.bodies.items():
            plant.SetFreeBodyPose(context, body, rigid_transform(frame.poses[name]))
        assert frame.arm is not None, "these are an arm's motions"
        set_joint_angles(plant, context, arm, frame.arm.q)
        query = query_port.Eval(scene_plant.scene_graph.GetMyContextFromRoot(root))
        color = query.RenderColorImage(camera, query.inspector().world_frame_id(), X_TC).data[
            :, :, :3
        ]
        pictures.append(
            np.asarray(Image.fromarray(color).resize(_FRAME_SIZE, Image.Resampling.LANCZOS))
        )
    return np.hstack(pictures)
