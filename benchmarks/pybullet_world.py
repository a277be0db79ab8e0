"""The scenes of `judge_speed.py` in PyBullet: loading, looking, and where the objects are."""

import math
from pathlib import Path
from typing import Any

import pybullet

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.scenes.scene import Pose, Scene


def label_image() -> Any:
    """The body that the overhead camera sees in each pixel of PyBullet's world."""
    camera = default_cell().camera
    X_TC = camera.X_TC
    eye, ahead, up = (X_TC @ p for p in ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]))
    view = pybullet.computeViewMatrix(eye, ahead, up - eye)
    projection = pybullet.computeProjectionMatrixFOV(
        camera.fov_y_deg, camera.width / camera.height, 0.05, 20
    )
    engine = pybullet.ER_TINY_RENDERER
    return pybullet.getCameraImage(
        camera.width, camera.height, view, projection, shadow=0, renderer=engine
    )[4]


def load(path: Path) -> None:
    """Makes a world of an export."""
    pybullet.connect(pybullet.DIRECT)
    for body in pybullet.loadSDF(str(path)):
        pybullet.changeDynamics(
            body, -1, lateralFriction=math.sqrt(0.5)
        )  # those of the two that touch are multiplied
    pybullet.setGravity(0, 0, -9.81)
    pybullet.setTimeStep(1 / 240)


def poses(scene: Scene) -> list[Pose]:
    """X_TO of the scene's objects."""
    found = []
    for body in range(1, len(scene.objects) + 1):
        X_TCm, X_OCm = (
            pybullet.getBasePositionAndOrientation(body),
            pybullet.getDynamicsInfo(body, -1)[3:5],
        )
        p, (x, y, z, w) = pybullet.multiplyTransforms(*X_TCm, *pybullet.invertTransform(*X_OCm))
        found.append(Pose(p, (w, x, y, z)))
    return found
