"""Checks of a place pose: penetration, tilt, support and balance of the released object.

Frames: T is the support, O is the placed object, Cm its center of mass.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.lip_seal import piece_half_spaces
from drake_clutter.compilation import njit
from drake_clutter.planning.collision_model import CollisionModel, SignedDistance
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.scenes.scene import SceneObject

Floats = NDArray[np.float64]

MAX_PLACE_PENETRATION = 0.0005
"""Largest depth to which a placed object may overlap a solid [m]. Objects at rest in Drake overlap
by about 0.01 mm."""
MAX_PLACE_TILT = math.radians(5.0)
"""Largest tilt of a placed object against its resting orientation [rad]. Placements keep the
orientation of objects that are tilted by less."""
MAX_RELEASE_HEIGHT = 0.005
"""Largest height above its support at which an object is released [m]. A fall of 5 mm ends at
0.3 m/s."""
CONTACT_BAND = 0.002
"""Points of the underside whose gaps exceed the smallest one by less than this carry the object
[m], as `MAX_CONTACT_GAP` of the static judge."""
_BALANCE_TOLERANCE = 0.001
"""Distance by which a center of mass may lie outside of the points that carry the object [m]; the
points are samples."""
_LINE_WIDTH = 1e-6
"""Points whose root sum of squared distances from a line is smaller lie on it [m]."""
_NUM_SAMPLES = (11, 61)
"""Samples of the underside along each axis, in addition to the edges of what is below. A pose that
fails with few samples is checked with more."""


@dataclass(frozen=True)
class ConvexSolid:
    """Convex part of an obstacle, in T.

    Attributes:
        half_spaces: Rows (n, d) of n . p + d <= 0 inside. Shape (F, 4).
        lower: Lower corner of the bounding box [m]. Shape (3,).
        upper: Upper corner of the bounding box [m]. Shape (3,).
    """

    half_spaces: Floats
    lower: Floats
    upper: Floats

    def vertical_range(self, xy: Floats) -> tuple[Floats, Floats]:
        """Return the lowest and highest points on vertical lines.

        Args:
            xy: Horizontal positions of the lines [m]. Shape (m, 2).

        Returns:
            Heights [m]; the lowest is above the highest where the line misses the solid. Shapes
            (m,).
        """
        slope = self.half_spaces[:, 2]
        offset = xy @ self.half_spaces[:, :2].T + self.half_spaces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -offset / slope
        bottom = np.where(slope < -1e-9, crossing, -np.inf).max(axis=1)
        top = np.where(slope > 1e-9, crossing, np.inf).min(axis=1)
        misses = (offset[:, np.abs(slope) <= 1e-9] > 1e-9).any(axis=1)
        return np.where(misses, np.inf, bottom), np.where(misses, -np.inf, top)


@lru_cache(maxsize=64)
def _fixed_solid(corners: bytes) -> ConvexSolid:
    """Return the convex hull of corners in T, given as the bytes of an array of shape (V, 3)."""
    points = np.frombuffer(corners).reshape(-1, 3)
    return ConvexSolid(ConvexHull(points).equations, points.min(axis=0), points.max(axis=0))


def _solids_of(o: SceneObject) -> Iterator[ConvexSolid]:
    """Yield the convex pieces of an object in T."""
    pieces = zip(piece_half_spaces(o.object_class), o.object_class.convex_pieces, strict=True)
    for half_spaces, corners in pieces:
        normals = half_spaces[:, :3] @ o.X_TO.rotation.T
        offsets = half_spaces[:, 3] - normals @ o.X_TO.p
        points = o.X_TO.apply(corners)
        yield ConvexSolid(
            np.column_stack([normals, offsets]), points.min(axis=0), points.max(axis=0)
        )


def resting_tilt(object_class: ObjectClass, rotation: Floats) -> float:
    """Return the angle of the smallest rotation that lays an object on a level plane [rad].

    A box rests on a face, a cylinder on an end or its side, a mesh on a face of its convex hull.

    Args:
        object_class: Class of the object.
        rotation: R_TO. Shape (3, 3).
    """
    up_O = rotation[2]
    if object_class.shape is Shape.BOX:
        return math.acos(min(1.0, float(np.abs(up_O).max())))
    if object_class.shape is Shape.CYLINDER:
        from_axis = math.acos(min(1.0, abs(float(up_O[2]))))
        return min(from_axis, math.pi / 2 - from_axis)
    cosine = float((-_hull_normals(object_class) @ up_O).max())
    return math.acos(min(1.0, cosine))


@lru_cache(maxsize=256)
def _hull_normals(object_class: ObjectClass) -> Floats:
    """Return the outward normals of the faces of a class's convex hull. Shape (F, 3)."""
    return np.asarray(ConvexHull(object_class.corners).equations[:, :3])


def check_place(
    placed: SceneObject,
    others: Sequence[SceneObject],
    model: CollisionModel,
    max_drop: float = 0.0,
) -> PlanningFailure | None:
    """Return why an object cannot be released at a pose, or None if it can.

    Occluded volumes count neither as solid nor as support.

    Args:
        placed: Object at its place pose.
        others: All other known objects.
        model: Collision model of the cell with all objects; the placed one is moved.
        max_drop: Distance by which a guarded descent can lower the object [m].
    """
    model.set_object_pose(placed.name, placed.X_TO)
    overlaps = model.object_distances(placed.name, 0.0)
    deepest = min(overlaps, key=lambda overlap: overlap.distance, default=SignedDistance(0.0))
    if deepest.distance < -MAX_PLACE_PENETRATION:
        reason = PlanningFailureReason.PLACE_IN_COLLISION
        return PlanningFailure(reason, deepest.pair[1], -deepest.distance)
    tilt = resting_tilt(placed.object_class, placed.X_TO.rotation)
    if tilt > MAX_PLACE_TILT:
        return PlanningFailure(PlanningFailureReason.PLACE_TILTED, placed.name, tilt)
    fixed = [_fixed_solid(corners.tobytes()) for corners in model.fixed_corners]
    near = [o for o in others if _may_carry(*o.bounds_T, placed)]
    solids = [*fixed, *(solid for o in near for solid in _solids_of(o))]
    center_of_mass = placed.X_TO.apply(placed.object_class.center_of_mass[None])[0, :2]
    # A slightly tilted object turns onto its face.
    lower, upper = placed.bounds_T
    band = CONTACT_BAND + math.sin(tilt) * float(np.linalg.norm((upper - lower)[:2]))
    failure: PlanningFailure | None = None
    for num_samples in _NUM_SAMPLES:
        xy, gaps = _gaps_below(placed, solids, num_samples)
        gap = float(gaps.min())
        if gap > MAX_RELEASE_HEIGHT + max_drop:
            failure = PlanningFailure(PlanningFailureReason.PLACE_UNSUPPORTED, placed.name, gap)
            continue
        overhang = _overhang(xy[gaps <= gap + band], center_of_mass)
        if overhang <= _BALANCE_TOLERANCE:
            return None
        failure = PlanningFailure(PlanningFailureReason.PLACE_OFF_BALANCE, placed.name, overhang)
    return failure


def _may_carry(lower: Floats, upper: Floats, placed: SceneObject) -> bool:
    """Return whether a bounding box reaches below that of a placed object. Shapes (3,)."""
    lower_placed, upper_placed = placed.bounds_T
    return bool((lower < upper_placed).all() and (upper[:2] > lower_placed[:2]).all())


def _gaps_below(
    placed: SceneObject, solids: Sequence[ConvexSolid], num_samples: int
) -> tuple[Floats, Floats]:
    """Return the heights of points of the underside over what is below them.

    Args:
        placed: Object at its place pose.
        solids: What may be below it.
        num_samples: Samples along each axis.

    Returns:
        Horizontal positions [m], shape (m, 2), and gaps [m], infinite with nothing below, shape
        (m,).
    """
    lower, upper = placed.bounds_T
    near = [solid for solid in solids if _may_carry(solid.lower, solid.upper, placed)]
    # Edges of what is below bound the contact: the axes have samples there.
    axes = []
    for k in range(2):
        edges = np.array([(solid.lower[k], solid.upper[k]) for solid in near]).ravel()
        within = edges[(edges > lower[k]) & (edges < upper[k])]
        axes.append(np.union1d(np.linspace(lower[k], upper[k], num_samples), within))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    xy = np.vstack([grid, placed.corners_T[:, :2]])
    underside = np.full(len(xy), np.inf)
    for piece in _solids_of(placed):
        bottom, top = piece.vertical_range(xy)
        underside = np.where(bottom <= top + 1e-9, np.minimum(underside, bottom), underside)
    is_under = np.isfinite(underside)
    xy, underside = xy[is_under], underside[is_under]
    gaps = np.full(len(xy), np.inf)
    for solid in near:
        bottom, top = solid.vertical_range(xy)
        is_below = (bottom <= top) & (bottom < underside)
        gaps = np.where(is_below, np.minimum(gaps, underside - top), gaps)
    return xy, gaps


def _overhang(points: Floats, p: Floats) -> float:
    """Return the distance of a point outside of the convex hull of others [m]; 0 inside.

    Args:
        points: Points [m]. Shape (m, 2), m > 0.
        p: The point [m]. Shape (2,).
    """
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    spread = points - points.mean(axis=0)
    xx, xy, yy = (float(spread[:, i] @ spread[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    least_variance = (xx + yy) / 2 - math.hypot((xx - yy) / 2, xy)
    if len(points) < 3 or least_variance < _LINE_WIDTH**2:
        direction = np.linalg.svd(spread)[2][0]
        along = spread @ direction
        offset = p - points.mean(axis=0)
        nearest = np.clip(offset @ direction, along.min(), along.max()) * direction
        return float(np.linalg.norm(offset - nearest))
    return max(0.0, float(_distance_outside(ordered, p)))


@njit(cache=True, nogil=True)
def _distance_outside(points, p):  # type: ignore[no-untyped-def]
    """Return the largest distance of a point outside of a side of the hull of others [m].

    The hull is found by Andrew's monotone chain.

    Args:
        points: Points in the order of x, then of y [m]. Shape (m, 2).
        p: The point [m]. Shape (2,).
    """
    largest = -np.inf
    chain = np.empty((len(points), 2))
    for direction in (1, -1):
        count = 0
        for k in range(len(points)):
            x, y = points[k if direction > 0 else len(points) - 1 - k]
            while count > 1:
                ax, ay = chain[count - 2]
                bx, by = chain[count - 1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                count -= 1
            chain[count, 0], chain[count, 1] = x, y
            count += 1
        for k in range(count - 1):
            dx, dy = chain[k + 1, 0] - chain[k, 0], chain[k + 1, 1] - chain[k, 1]
            outside = dy * (p[0] - chain[k, 0]) - dx * (p[1] - chain[k, 1])
            largest = max(largest, outside / math.sqrt(dx * dx + dy * dy))
    return largest
