"""Search policy that uncovers the largest part of the area in which the target can lie.

The policy follows X-Ray (Danielczuk et al. 2020, "X-Ray: Mechanical Search for an Occluded Object
by Minimizing Support of Learned Occupancy Distributions"), which removes the object that covers
most of the distribution of the target's possible places, and the distribution area reduction of
LAX-RAY (Huang et al. 2021, "Mechanical Search on Shelves using Lateral Access X-RAY"). They predict
the distribution from a depth image by a network. Here it is computed from the occluded space, as
the poses of the objects in view are known.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.lip_seal import piece_half_spaces
from drake_clutter.compilation import njit
from drake_clutter.config import ExplorationConfig
from drake_clutter.grammar import Orientation, resting_rotation
from drake_clutter.scenes.free_space import CELL_SIZE, Grid, occluding_pixel
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import find_free_placements, has_clear_top
from drake_clutter.scenes.release_orientation import OrientedObject, orient_object
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject
from drake_clutter.tasks.belief import Belief, Decision

LAYER_HEIGHT = 0.01
"""Height of the layers into which the occluded space is cut [m]."""
_YAWS_DEG = range(0, 180, 30)
"""Turns of the target about the vertical [deg], as the grammar has them."""
_RESTS = (Orientation.FLAT_0, Orientation.UPRIGHT_0, Orientation.SIDE_0)
"""Faces on which the target can rest."""
_VISIBLE = -1
"""Occluder of a voxel that the camera sees through, or that a known object takes."""
_UNIDENTIFIED = -2
"""Occluder of a voxel behind a surface of no detected object."""


@njit(cache=True)
def _find_occluders(depth, label, camera, x, y, z, occluder):  # type: ignore[no-untyped-def]
    """Find what hides the center of each voxel from the camera.

    Args:
        depth: Depth image [m]. Shape (height, width).
        label: Index of the detection at each pixel, or `_UNIDENTIFIED`. Shape (height, width).
        camera: `Pinhole` of the camera.
        x: Centers along x [m]. Shape (n,).
        y: Centers along y [m]. Shape (m,).
        z: Centers along z [m]. Shape (l,).
        occluder: Output: index of the detection, `_UNIDENTIFIED` or `_VISIBLE`. Shape (l, n, m).
    """
    for k in range(len(z)):
        for i in range(len(x)):
            for j in range(len(y)):
                row, column = occluding_pixel(depth, camera, x[i], y[j], z[k])
                occluder[k, i, j] = _VISIBLE if row < 0 else label[row, column]


@njit(cache=True)
def _hidden_heights(occluder, run):  # type: ignore[no-untyped-def]
    """Count the hidden voxels from each one upwards, up to the first that is not.

    Args:
        occluder: See `_find_occluders`. Shape (l, n, m).
        run: Output. Shape (l, n, m).
    """
    num_layers, n, m = occluder.shape
    for k in range(num_layers - 1, -1, -1):
        for i in range(n):
            for j in range(m):
                above = run[k + 1, i, j] if k + 1 < num_layers else 0
                run[k, i, j] = above + 1 if occluder[k, i, j] != _VISIBLE else 0


@njit(cache=True)
def _mark_uncovered(occluder, run, rows, num_layers, threshold, counts, covered):  # type: ignore[no-untyped-def]
    """Mark where an oriented target can lie so that one object's removal uncovers it.

    Args:
        occluder: See `_find_occluders`. Shape (l, n, m).
        run: See `_hidden_heights`. Shape (l, n, m).
        rows: Rows of the target's footprint, see `Footprint`. Shape (r, 3).
        num_layers: Number of layers that the target takes.
        threshold: Fraction of the top that the camera must see.
        counts: Buffer. Shape (d,).
        covered: Output: cells over which the target can lie, by the detection whose removal
            uncovers it; marks are added. Shape (d, n, m).
    """
    _, n, m = occluder.shape
    for k in range(occluder.shape[0] - num_layers + 1):
        for i in range(n):
            for j in range(m):
                if run[k, i, j] < num_layers:
                    continue
                fits = True
                for r in range(len(rows)):
                    a, first, last = i + rows[r, 0], j + rows[r, 1], j + rows[r, 2]
                    if a < 0 or first < 0 or a >= n or last >= m:
                        fits = False
                        break
                    for b in range(first, last + 1):
                        if run[k, a, b] < num_layers:
                            fits = False
                            break
                    if not fits:
                        break
                if not fits:
                    continue
                counts[:] = 0
                total = 0
                for r in range(len(rows)):
                    a = i + rows[r, 0]
                    for b in range(j + rows[r, 1], j + rows[r, 2] + 1):
                        total += 1
                        what = occluder[k + num_layers - 1, a, b]
                        if what >= 0:
                            counts[what] += 1
                for d in range(len(counts)):
                    if counts[d] > 0 and counts[d] >= threshold * total:
                        for r in range(len(rows)):
                            a = i + rows[r, 0]
                            covered[d, a, j + rows[r, 1] : j + rows[r, 2] + 1] = True


@lru_cache(maxsize=64)
def _target_orientations(target: ObjectClass) -> tuple[OrientedObject, ...]:
    """Return the orientations in which a target can lie, with outlines one cell smaller."""
    oriented: dict[tuple[bytes, float], OrientedObject] = {}
    for rest in _RESTS:
        quaternion = Pose.from_rotation(resting_rotation(target, rest), (0.0, 0.0, 0.0)).quaternion
        for yaw in _YAWS_DEG:
            candidate = orient_object(target, quaternion, yaw, -CELL_SIZE)
            key = (candidate.footprint.rows.tobytes(), round(candidate.height, 6))
            oriented.setdefault(key, candidate)
    return tuple(oriented.values())


def uncovered_areas(
    target: ObjectClass, known_objects: Sequence[SceneObject], observation: Observation
) -> dict[str, float]:
    """Return the area over possible places of a target that each object in view covers [m^2].

    The target can be where nothing contradicts it: in space that the camera does not see and that
    no known object takes, on any of its faces, turned by multiples of 30 degrees. A place counts
    for an object whose removal would show enough of the target's top, if nothing unknown lies in
    between.

    Args:
        target: Class of the target.
        known_objects: Objects that have been in view, at their current poses.
        observation: Latest observation.

    Returns:
        Areas by name of the objects in view.
    """
    detections = observation.detections
    grid = Grid.over(observation.support)
    top = max((o.top_height for o in known_objects), default=0.0)
    z = np.array([(k + 0.5) * LAYER_HEIGHT for k in range(math.ceil(top / LAYER_HEIGHT))])
    label = np.full(observation.depth.shape, _UNIDENTIFIED, np.int64)
    for k, detection in enumerate(detections):
        label[detection.mask] = k
    occluder = np.empty((len(z), len(grid.x), len(grid.y)), np.int64)
    _find_occluders(
        observation.depth, label, observation.camera.pinhole, grid.x, grid.y, z, occluder
    )
    for o in known_objects:
        _remove_solid(o, grid, z, occluder)
    run = np.zeros(occluder.shape, np.int64)
    _hidden_heights(occluder, run)
    covered = np.zeros((len(detections), len(grid.x), len(grid.y)), np.bool_)
    counts = np.zeros(len(detections), np.int64)
    for oriented in _target_orientations(target):
        num_layers = max(1, int(oriented.height / LAYER_HEIGHT))
        _mark_uncovered(
            occluder,
            run,
            oriented.footprint.rows,
            num_layers,
            observation.camera.visibility_threshold,
            counts,
            covered,
        )
    areas = covered.sum(axis=(1, 2)) * CELL_SIZE**2
    return {d.name: float(area) for d, area in zip(detections, areas, strict=True)}


def _remove_solid(
    o: SceneObject, grid: Grid, z: NDArray[np.float64], occluder: NDArray[np.int64]
) -> None:
    """Mark the voxels whose centers are in an object as places where nothing else can be.

    Args:
        o: The object.
        grid: Cells along x and y.
        z: Centers of the layers [m]. Shape (l,).
        occluder: See `_find_occluders`; it is changed. Shape (l, n, m).
    """
    lower, upper = o.bounds_T
    box = tuple(
        slice(*np.searchsorted(axis, (low, high)).tolist())
        for axis, low, high in zip(
            (z, grid.x, grid.y), np.roll(lower, 1), np.roll(upper, 1), strict=True
        )
    )
    zs, xs, ys = np.meshgrid(z[box[0]], grid.x[box[1]], grid.y[box[2]], indexing="ij")
    p_OP = (np.stack([xs, ys, zs], axis=-1) - o.X_TO.p) @ o.X_TO.rotation
    for piece in piece_half_spaces(o.object_class):
        inside = (p_OP @ piece[:, :3].T + piece[:, 3] <= 0).all(axis=-1)
        occluder[box][inside] = _VISIBLE


class AreaReductionExplorer:
    """Policy that removes the object over the largest area in which the target can lie.

    Of the objects with a clear top, those picked least often come first, and of these those that
    cover an area. The object is placed on the tray; if the tray has no free placement for any of
    them, on the object that covers the smallest area.
    """

    def __init__(self, target: ObjectClass, config: ExplorationConfig) -> None:
        """Create the policy.

        Args:
            target: Class of the target.
            config: Clearances of placements.
        """
        self._target = target
        self._config = config

    def __call__(
        self, belief: Belief, observation: Observation, rng: np.random.Generator
    ) -> Decision:
        """Choose the next move; see `Policy`."""
        areas = uncovered_areas(self._target, belief.objects, observation)
        picks = [move.pick for move in belief.history]
        clear = [d for d in observation.detections if has_clear_top(observation, d)]
        places = sorted(areas, key=lambda name: (areas[name], name))
        candidates = sorted(
            clear or observation.detections,
            key=lambda d: (picks.count(d.name), -areas[d.name], -int(d.mask.sum()), d.name),
        )
        for _, group in groupby(candidates, key=lambda d: (picks.count(d.name), areas[d.name] > 0)):
            names = [d.name for d in group]
            moves = [Move(name, TRAY) for name in names]
            moves += [Move(name, place) for name in names for place in places if place != name]
            for move in moves:
                if (
                    move not in belief.invalid_moves
                    and find_free_placements(observation, move, self._config) is not None
                ):
                    return Decision(move)
        return Decision(None)
