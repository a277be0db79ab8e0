"""Opposed faces of an object of any shape between the pads of parallel jaws.

Frames: T is the support; G is the tool, midway between the pads, y from the right to the left jaw,
z into the object; O is the object; N is a viewer, z towards it.

Rays from both pads find where each touches the object first, as the pads close. Friction holds the
object if the line between the two places is inside both friction cones (Nguyen 1988, "Constructing
force-closure grasps", theorem 3).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.lip_seal import grid_points, piece_depths, viewer_rotation

Floats = NDArray[np.float64]

PAD_COMPLIANCE = 0.001
"""Depth to which the rubber of a pad yields [m]: what is nearer than this to the first contact
touches the pad, too; an assumption."""
MIN_CONTACT_LENGTH = 0.008
"""Least extent of what touches a pad [m]; the object turns about a shorter contact."""
SLOPE_RADIUS = 0.008
"""Distance from a contact within which the slope of the surface is found [m]."""
_RAY_COUNTS = (5, 9)
"""Rays along the width and the height of a pad."""
_NUM_BINS = 36
"""Number of intervals of closing directions, of 5 deg each."""
_MAX_DIRECTIONS = 6
"""Largest number of closing directions of an object."""
_MIN_SHARE = 0.1
"""Least area of faces across a closing direction, as a share of that across the best one."""
_MIN_FACING = 0.9
"""Least cosine between a face's normal and the plane in which jaws close."""


@dataclass(frozen=True)
class PadContact:
    """Where two pads touch an object.

    Attributes:
        X_TG: Pose of the tool, midway between the contacts.
        width: Distance of the contacts [m].
    """

    X_TG: RigidTransform
    width: float


def find_pad_contact(
    object_class: ObjectClass,
    X_TO: RigidTransform,
    X_TG: RigidTransform,
    pad: Floats,
    stroke: float,
    friction: float,
) -> PadContact | float:
    """Return where pads hold an object as they close.

    Args:
        object_class: Class of the object.
        X_TO: Pose of the object.
        X_TG: Pose of the tool. It is moved along y to the middle between the contacts.
        pad: Width and height of a pad, along x and z of G [m]. Shape (2,).
        stroke: Opening of the jaws [m].
        friction: Friction coefficient between pads and object.

    Returns:
        The contacts, or the distance of what is between the pads where friction does not hold it
        [m]; infinite where nothing is.
    """
    X_OG = X_TO.InvertAndCompose(X_TG)
    x, z = np.meshgrid(
        *(np.linspace(-side / 2, side / 2, n) for side, n in zip(pad, _RAY_COUNTS, strict=True))
    )
    xz = np.column_stack([x.ravel(), z.ravel()])
    surfaces = list[Floats]()
    for side in (1.0, -1.0):
        # z of a pad is its closing direction.
        R_GP = RotationMatrix(np.array([[1.0, 0, 0], [0, 0, -side], [0, side, 0]]))
        X_OP = X_OG @ RigidTransform(R_GP, [0.0, side * stroke / 2, 0.0])
        points = np.column_stack([xz[:, 0], side * xz[:, 1], np.zeros(len(xz))])
        surfaces.append(side * (stroke / 2 - piece_depths(object_class, X_OP, points)))
    left, right = surfaces
    hits = np.isfinite(left) & np.isfinite(right)
    if not hits.any():
        return math.inf
    xz, left, right = xz[hits], left[hits], right[hits]
    ends = float(left.max()), float(right.min())
    width = ends[0] - ends[1]
    touched = xz[left >= ends[0] - PAD_COMPLIANCE], xz[right <= ends[1] + PAD_COMPLIANCE]
    centers = [part.mean(axis=0) for part in touched]
    # Slopes of the line between the contacts against the normals of the surfaces there.
    line = (centers[0] - centers[1]) / max(width, 1e-6)
    for part, center, y in zip(touched, centers, (left, right), strict=True):
        is_short = np.ptp(part, axis=0).max() < MIN_CONTACT_LENGTH
        if is_short or np.linalg.norm(_slope(xz - center, y) + line) > friction:
            return width
    return PadContact(X_TG @ RigidTransform([0.0, (ends[0] + ends[1]) / 2, 0.0]), width)


def _slope(xz: Floats, y: Floats) -> Floats:
    """Return the slopes along x and z of the plane that fits a surface best around a contact.

    Args:
        xz: Positions relative to the contact [m]. Shape (m, 2).
        y: Heights of the surface [m]. Shape (m,).

    Returns:
        Slopes; 0 if there are too few points. Shape (2,).
    """
    is_near = np.linalg.norm(xz, axis=1) <= SLOPE_RADIUS
    design = np.column_stack([xz[is_near], np.ones(is_near.sum())])
    return np.asarray(np.linalg.lstsq(design, y[is_near], rcond=None)[0][:2])


def closing_poses(
    object_class: ObjectClass, X_TO: RigidTransform, normal: Floats, spacing: float
) -> Iterator[RigidTransform]:
    """Yield poses of jaws that close across faces of an object, closest to its center first.

    Their origin is at the side of the object's bounding box from which it is seen.

    Args:
        object_class: Class of the object.
        X_TO: Pose of the object.
        normal: Direction from the object to the viewer, in T. Shape (3,).
        spacing: Distance of neighboring poses [m].
    """
    R_TN = viewer_rotation(normal)
    X_NO = RigidTransform(R_TN.inverse(), np.zeros(3)) @ X_TO
    corners = X_NO.multiply(object_class.corners.T).T
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    p_NCm = X_NO @ object_class.center_of_mass
    directions = _closing_directions(object_class, X_NO.rotation().matrix())
    poses = list[tuple[float, RigidTransform]]()
    for xy in grid_points(lower[:2], upper[:2], p_NCm[:2], spacing):
        for angle in directions:
            # Along y the pads find the object themselves: one position is enough.
            along = np.array([math.cos(angle), math.sin(angle)])
            offset = xy - p_NCm[:2]
            if abs(float(offset @ along)) > spacing / 2:
                continue
            y = np.array([*along, 0.0])
            z = np.array([0.0, 0.0, -1.0])
            R_NG = RotationMatrix(np.column_stack([np.cross(y, z), y, z]))
            X_NG = RigidTransform(R_NG, [*xy, upper[2]])
            poses.append((float(np.linalg.norm(offset)), RigidTransform(R_TN, np.zeros(3)) @ X_NG))
    poses.sort(key=lambda pose: round(pose[0], 6))
    yield from (X_TG for _, X_TG in poses)


def _closing_directions(object_class: ObjectClass, R_NO: Floats) -> list[float]:
    """Return angles in N of the directions across the largest faces, modulo half a turn [rad].

    Args:
        object_class: Class of the object.
        R_NO: Orientation of the object. Shape (3, 3).
    """
    normals, areas = _faces(object_class)
    x, y, _ = R_NO @ normals.T
    facing = np.hypot(x, y)
    weights = np.where(facing > _MIN_FACING, areas, 0.0)
    angles = np.arctan2(y, x) % math.pi
    width = math.pi / _NUM_BINS
    found = list[float]()
    largest = 0.0
    while len(found) < _MAX_DIRECTIONS:
        bins = np.bincount((angles / width).astype(int) % _NUM_BINS, weights, _NUM_BINS)
        best = int(bins.argmax())
        largest = max(largest, float(bins[best]))
        if bins[best] <= _MIN_SHARE * largest or not largest:
            break
        difference = (angles - (best + 0.5) * width + math.pi / 2) % math.pi - math.pi / 2
        near = np.abs(difference) < 1.5 * width
        mean = float((weights[near] * difference[near]).sum() / weights[near].sum())
        found.append(((best + 0.5) * width + mean) % math.pi)
        weights = np.where(near, 0.0, weights)
    return found


@lru_cache(maxsize=256)
def _faces(object_class: ObjectClass) -> tuple[Floats, Floats]:
    """Return outward normals, shape (F, 3), and areas [m^2] of the faces of all convex pieces."""
    normals, areas = list[Floats](), list[Floats]()
    for piece in object_class.convex_pieces:
        hull = ConvexHull(piece)
        a, b, c = (piece[hull.simplices[:, k]] for k in range(3))
        normals.append(hull.equations[:, :3])
        areas.append(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    return np.vstack(normals), np.concatenate(areas)
