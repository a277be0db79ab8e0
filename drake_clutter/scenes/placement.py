"""Where exactly a picked object lands: decided once, from what the camera sees, for every fidelity."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.signal import fftconvolve
from scipy.spatial import ConvexHull

from drake_clutter.config import ExplorationConfig
from drake_clutter.scenes.scene import TRAY, Pose
from drake_clutter.scenes.seams import Detection, Move, Observation

CELL = 0.005
"""m, of the grid of places on the tray that are considered."""
_DEPTH_TOLERANCE = 0.004
"""m, within which a measured height is taken to be a known one."""
_LEVEL_STEP = 0.020
"""m between the heights at which the air over a place is looked through."""
_SUPPORT_MARGIN = 0.005
"""m from the edge of the support within which no centre of mass is put."""
_YAWS = (0.0, np.pi / 2)
"""rad by which the picked object may be turned, the first that fits is taken."""


@dataclass(frozen=True)
class _Grid:
    """Square cells over the tray.

    Attributes:
        centres: (n,) m, along x and along y.
    """

    centres: NDArray[np.float64]

    @staticmethod
    def over(tray_side: float) -> "_Grid":
        count = int(tray_side / CELL)
        return _Grid(np.asarray((np.arange(count) - (count - 1) / 2) * CELL, float))

    def points(self, height: float) -> NDArray[np.float64]:
        """(n * n, 3) m, the cells' centres at a height, x varying slowest."""
        x, y = np.meshgrid(self.centres, self.centres, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])

    def square(self, values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return values.reshape(len(self.centres), len(self.centres))


def _pixels(observation: Observation, p_T: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of the pixel that points (N, 3) m fall on; points out of the frame fall on its edge."""
    camera = observation.camera
    columns, rows = np.rint(camera.project(p_T)).astype(np.int64).T
    return np.clip(rows, 0, camera.height - 1), np.clip(columns, 0, camera.width - 1)


def seen_through(observation: Observation, p_T: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether the camera sees past each point (N, 3) m in the tray frame, so that it is known to be free."""
    rows, columns = _pixels(observation, p_T)
    return np.asarray(observation.depth[rows, columns] >= observation.camera.altitude - p_T[:, 2])


def _turned(pose: Pose, yaw: float) -> NDArray[np.float64]:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.asarray(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ pose.rotation)


def _footprint(corners_xy: NDArray[np.float64], clearance: float) -> NDArray[np.float64]:
    """Odd-sized kernel, 1 where a cell's centre lies within `clearance` of the convex footprint, about its origin."""
    reach = int(np.ceil((np.abs(corners_xy).max() + clearance) / CELL))
    offsets = np.arange(-reach, reach + 1) * CELL
    x, y = np.meshgrid(offsets, offsets, indexing="ij")
    lines = ConvexHull(corners_xy).equations
    outside = (lines[:, :2] @ np.vstack([x.ravel(), y.ravel()]) + lines[:, 2:]).max(axis=0)
    # Half a cell more: no part of the footprint lies in a cell that is not looked at.
    return np.asarray((outside.reshape(x.shape) <= clearance + CELL / 2).astype(float))


def _clear_of(blocked: NDArray[np.bool_], footprint: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Cells at which the footprint covers no blocked cell and stays on the grid."""
    pad = footprint.shape[0] // 2
    padded = np.pad(blocked, pad, constant_values=True).astype(float)
    return np.asarray(fftconvolve(padded, footprint[::-1, ::-1], mode="valid") < 0.5)


def top_height(detection: Detection) -> float:
    """Height of a detected object's highest point above the tray's floor, m."""
    return float(detection.X_TO.apply(detection.object_class.corners)[:, 2].max())


def has_clear_top(observation: Observation, detection: Detection) -> bool:
    """Whether the camera sees through the air right above the object, all over it."""
    corners = detection.X_TO.apply(detection.object_class.corners)
    top = float(corners[:, 2].max())
    grid = _Grid.over(observation.tray_side)
    points = grid.points(top + _DEPTH_TOLERANCE)
    lines = ConvexHull(corners[:, :2]).equations
    over = (lines[:, :2] @ points[:, :2].T + lines[:, 2:]).max(axis=0) < 0
    return bool(seen_through(observation, points[over]).mean() > 0.98) if over.any() else True


def choose_placement(observation: Observation, move: Move, config: ExplorationConfig, rng: np.random.Generator) -> Pose | None:
    """The pose X_TO at which the picked object is let go, or None if no place is known to be free.

    The object keeps its orientation, or is turned by a quarter about the vertical if only that fits. A place counts as free
    where the camera sees through the air that the object will take up, its clearance included; what lies in shadow, or where
    the picked object itself still is, does not.
    On the tray the place furthest from the centre is taken, where an object hides least and leaves the most room; on an
    object, the place nearest to the middle of what is seen of its top, with the centre of mass over that top.

    Args:
        observation: what the camera sees before the pick.
        move: what to pick and where to put it.
        config: clearance and height of release.
        rng: decides between places that are equally good.

    Raises:
        KeyError: the move names an object that is not in view.
    """
    picked = observation[move.pick]
    grid = _Grid.over(observation.tray_side)
    if move.place == TRAY:
        floor, support = 0.0, np.ones((len(grid.centres),) * 2, bool)
        middle = np.zeros(2)
    else:
        target = observation[move.place]
        floor = top_height(target)
        rows, columns = _pixels(observation, grid.points(floor))
        at_top = np.abs(observation.depth[rows, columns] - (observation.camera.altitude - floor)) < _DEPTH_TOLERANCE
        top = grid.square(at_top & target.mask[rows, columns])
        if not top.any():
            return None
        support = distance_transform_edt(np.pad(top, 1))[1:-1, 1:-1] * CELL > _SUPPORT_MARGIN
        middle = grid.centres[np.argwhere(top)].mean(axis=0)

    for yaw in _YAWS:
        R_TO = _turned(picked.X_TO, yaw)
        corners = picked.object_class.corners @ R_TO.T
        height = float(np.ptp(corners[:, 2]))
        levels = floor + _DEPTH_TOLERANCE + np.arange(0, height + config.release_height, _LEVEL_STEP)
        free = np.all([grid.square(seen_through(observation, grid.points(z))) for z in levels], axis=0)
        fits = _clear_of(~free, _footprint(corners[:, :2], config.clearance)) & support
        if not fits.any():
            continue
        places = grid.centres[np.argwhere(fits)]
        cost = -np.abs(places).max(axis=1) if move.place == TRAY else np.linalg.norm(places - middle, axis=1)
        best = places[cost <= cost.min() + 1e-9]
        x, y = best[rng.integers(len(best))]
        return Pose.of(R_TO, (x, y, floor + config.release_height - float(corners[:, 2].min())))
    return None
