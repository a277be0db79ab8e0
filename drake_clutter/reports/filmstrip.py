"""Images of the arm during a recorded move."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.reports.scene_images import PICTURE_LIGHTING, look_at_pose
from drake_clutter.scenes.interfaces import MotionSample
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.cell_plant import add_work_cell, set_joint_angles
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.simulation.scene_plant import add_scene_plant, rigid_transform

_OVERSAMPLING = 2
_CAMERA_POSITION = (1.10, -1.90, 1.30)
"""Position of the camera in the tray frame, if the arm's base is at -x [m]."""
_CAMERA_TARGET = (-0.22, 0.0, 0.46)
"""Point that the camera looks at [m]."""
_FOV_Y_DEG = 36.0
_MIN_HEIGHT_CHANGE = 0.002
"""Smallest change of an object's height that counts as lifting or lowering [m]."""


def select_key_frames(frames: Sequence[MotionSample], pick: str) -> list[MotionSample]:
    """Return four frames of a recorded move: before the lift, carrying, placed, and retreating.

    Args:
        frames: The recorded motion.
        pick: Name of the moved object.
    """
    positions = np.array([frame.poses[pick].p for frame in frames])
    height = positions[:, 2]
    horizontal_distance = np.linalg.norm(positions[:, :2] - positions[0, :2], axis=1)
    above_start = np.flatnonzero(height > height[0] + _MIN_HEIGHT_CHANGE)
    lift_start = arrival = len(frames) // 2
    if len(above_start):
        lift_start = int(above_start[0])
        arrived = horizontal_distance >= 0.98 * horizontal_distance.max()
        arrival = int(np.flatnonzero(arrived)[0])
    moving = np.flatnonzero(np.abs(height - height[-1]) > _MIN_HEIGHT_CHANGE)
    placed = min(int(moving[-1]) + 1, len(frames) - 1) if len(moving) else len(frames) - 1
    carry = (lift_start + arrival) // 2
    retreat = (placed + 3 * len(frames)) // 4
    return [frames[k] for k in (max(lift_start - 2, 0), carry, placed, retreat)]


def rotation_to_base_side(cell: WorkCell) -> NDArray[np.float64]:
    """Return the rotation by quarter turns about z from -x to the side of the arm's base.

    Returns:
        Rotation matrix. Shape (3, 3).
    """
    x, y = cell.robot.X_TB.translation()[:2]
    c, s = (-np.sign(x), 0.0) if abs(x) >= abs(y) else (0.0, -np.sign(y))
    if not c and not s:
        c = 1.0
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def render_filmstrip(
    scene: Scene, frames: Sequence[MotionSample], cell: WorkCell, side: int
) -> NDArray[np.uint8]:
    """Return the images of n frames side by side; see `render_frames`. Shape (side, side n, 3)."""
    return np.hstack([*render_frames(scene, frames, cell, side)])


def render_frames(
    scene: Scene, frames: Sequence[MotionSample], cell: WorkCell, side: int
) -> Iterator[NDArray[np.uint8]]:
    """Yield an image of the cell for each frame.

    Args:
        scene: The objects.
        frames: Frames with joint positions of the arm.
        cell: The work cell; its support is replaced by the scene's.
        side: Side of an image [px].

    Yields:
        RGB images. Shape (side, side, 3) each.
    """
    cell = cell.with_support(scene.support)
    builder = DiagramBuilder()
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
    diagram = builder.Build()
    root_context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(root_context)
    rasterizer = PlantRasterizer(scene_plant.scene_graph.model_inspector())
    num_pixels = _OVERSAMPLING * side
    camera = Camera.overhead(1.0, width=num_pixels, height=num_pixels, fov_y_deg=_FOV_Y_DEG)
    R = rotation_to_base_side(cell)
    X_TC = rigid_transform(
        look_at_pose(R @ np.array(_CAMERA_POSITION), R @ np.array(_CAMERA_TARGET))
    )
    query_port = scene_plant.scene_graph.get_query_output_port()
    for frame in frames:
        for name, body in scene_plant.bodies.items():
            plant.SetFreeBodyPose(plant_context, body, rigid_transform(frame.poses[name]))
        set_joint_angles(plant, plant_context, arm, frame.q)
        query = query_port.Eval(scene_plant.scene_graph.GetMyContextFromRoot(root_context))
        color = rasterizer.render(camera, X_TC, query, PICTURE_LIGHTING).color
        image = Image.fromarray(color).resize((side, side), Image.Resampling.LANCZOS)
        yield np.asarray(image)
