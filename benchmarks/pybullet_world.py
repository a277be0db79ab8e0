"""Scenes in PyBullet, for the benchmarks that compare it with Drake."""

from pathlib import Path
from typing import Any

import pybullet

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.export.sdf_writer import PYBULLET_FILE
from drake_clutter.scenes.scene import Pose, Scene

TIME_STEP = 1 / 240
"""Time step of the simulation, PyBullet's default [s]."""


def load_world(path: Path) -> None:
    """Create a world from an exported scene.

    Args:
        path: SDF file of the scene; the file for PyBullet beside it is loaded.
    """
    pybullet.connect(pybullet.DIRECT)
    pybullet.loadSDF(str(path.with_name(PYBULLET_FILE)))
    pybullet.setGravity(0, 0, -9.81)
    pybullet.setTimeStep(TIME_STEP)


def render_labels() -> Any:
    """Return the body that the cell's camera sees in each pixel. Shape (H, W)."""
    camera = default_cell().camera
    X_TC = camera.X_TC
    p_TC, ahead, up = (X_TC @ p for p in ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]))
    view = pybullet.computeViewMatrix(p_TC, ahead, up - p_TC)
    projection = pybullet.computeProjectionMatrixFOV(
        camera.fov_y_deg, camera.width / camera.height, 0.05, 20
    )
    engine = pybullet.ER_TINY_RENDERER
    return pybullet.getCameraImage(
        camera.width, camera.height, view, projection, shadow=0, renderer=engine
    )[4]


def object_poses(scene: Scene) -> list[Pose]:
    """Return the pose X_TO of each object in the world that was created from a scene."""
    poses = []
    for body in range(1, len(scene.objects) + 1):
        X_TCm = pybullet.getBasePositionAndOrientation(body)
        X_OCm = pybullet.getDynamicsInfo(body, -1)[3:5]
        p, (x, y, z, w) = pybullet.multiplyTransforms(*X_TCm, *pybullet.invertTransform(*X_OCm))
        poses.append(Pose(p, (w, x, y, z)))
    return poses
