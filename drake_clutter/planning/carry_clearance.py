"""Clearance of a carried object from what stands below the places where it is picked and placed.

What is below may be unknown: objects hide what they stand on. It is as high as the bottom of the
object at its pose, and hardly wider than the object, because an image shows what projects. The
space that it may occupy is a *column*. Above a column the object keeps a clearance; beside it, seen
from above, it may be lower. At the pose itself it touches the column, so that it leaves and reaches
the pose on a straight line along the axis of the tool.

Frames: T is the support, G is the tool, O is the carried object.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.catalog import ObjectClass
from drake_clutter.compilation import njit
from drake_clutter.planning.tool_kinematics import departure_axis
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.validation import NonNegative, config_class

Floats = NDArray[np.float64]

_CORNER_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_MAX_SIDESTEP = 0.01
"""Overlap seen from above up to which a violated clearance is one beside the column [m]."""
_MIN_SIDE_LENGTH = 0.5
"""Horizontal length of an axis of a box above which the sides across it separate [unit vector]."""
_TOLERANCE = 1e-4
"""Largest violation of a column's clearance [m]: joint positions of endpoints are not exact."""


@config_class
class CarryClearance:
    """Errors for which a carried object keeps a distance in addition to `min_distance`.

    The displacement by the tool's bellows is added; it follows from the load.

    Attributes:
        tracking_error: Largest distance of a moving object from where it would hang at rest on the
            planned trajectory [m]. Assumed: corners of 27 simulated loads were up to 2.1 mm lower,
            as a load swings and stretches the bellows.
        position_uncertainty: Horizontal error of object poses [m].
        height_uncertainty: Vertical error of object poses [m].
        hidden_margin: Largest distance by which something unknown projects from below an object
            [m]. Depth points up to 8 mm beside an object count as its surface, and two pixels of
            the default camera are 5 mm.
        max_drift: Largest distance from the axis of the tool at an endpoint at which the object may
            still be as low as at the endpoint [m].
    """

    tracking_error: NonNegative = 0.0025
    position_uncertainty: NonNegative = 0.0
    height_uncertainty: NonNegative = 0.0
    hidden_margin: NonNegative = 0.013
    max_drift: NonNegative = 0.001

    def of_load(self, displacement: float) -> float:
        """Return the additional distance of an object from obstacles [m].

        Args:
            displacement: Largest displacement of a corner of the object at rest, as its weight
                stretches and bends the bellows [m].
        """
        return (
            displacement
            + self.tracking_error
            + max(self.position_uncertainty, self.height_uncertainty)
        )


def box_corners(object_class: ObjectClass) -> Floats:
    """Return the corners of the bounding box of a class in O [m]. Shape (8, 3)."""
    return np.asarray(_CORNER_SIGNS * np.asarray(object_class.size) / 2)


@dataclass(frozen=True)
class CarriedBox:
    """Bounding box of a carried object at configurations of a path.

    Attributes:
        corners: Corners in T [m]. Shape (m, 8, 3).
        axes: Horizontal parts of the axes of the box in T. Shape (m, 3, 2).
        p_TG: Position of the tool [m]. Shape (m, 3).
    """

    corners: Floats
    axes: Floats
    p_TG: Floats

    @staticmethod
    def along(object_class: ObjectClass, X_OG: RigidTransform, X_TG: Floats) -> "CarriedBox":
        """Return the box at poses of the tool.

        Args:
            object_class: Class of the object.
            X_OG: Pose of the tool in the object.
            X_TG: Poses of the tool. Shape (m, 4, 4).
        """
        X_TO = X_TG @ X_OG.inverse().GetAsMatrix4()
        corners = box_corners(object_class) @ X_TO[:, :3, :3].swapaxes(1, 2) + X_TO[:, None, :3, 3]
        axes = np.ascontiguousarray(X_TO[:, :2, :3].swapaxes(1, 2))
        return CarriedBox(corners, axes, np.ascontiguousarray(X_TG[:, :3, 3]))


@dataclass(frozen=True)
class ColumnSlack:
    """How far a carried object is from violating the clearance of a column.

    Attributes:
        values: Distance beyond the required one, above the column or beside it [m]; negative where
            the clearance is violated. Shape (m,).
        directions: Direction in which a corner of the box increases the distance. Shape (m, 3).
        points: That corner in T [m]. Shape (m, 3).
    """

    values: Floats
    directions: Floats
    points: Floats


@dataclass(frozen=True)
class Column:
    """Space that whatever stands below an object at a pose may occupy: a prism up to its bottom.

    At an anchor, the object may touch the column.

    Attributes:
        center: Center of the rectangular base in T [m]. Shape (2,).
        axes: Axes of the base in T. Shape (2, 2).
        half_size: Half the extents along the axes [m]. Shape (2,).
        top: Height of the object's bottom [m].
        anchors: Position of the tool in T, and direction in which the object leaves, at each
            anchor. Shape (k, 2, 3).
    """

    center: Floats
    axes: Floats
    half_size: Floats
    top: float
    anchors: Floats

    @staticmethod
    def below(scene_object: SceneObject, X_TG: Floats) -> "Column":
        """Return the column below an object, no wider than the object.

        Args:
            scene_object: The object at its pose.
            X_TG: Pose of the tool that holds it there. Shape (4, 4).
        """
        R = scene_object.X_TO.rotation
        half = np.asarray(scene_object.object_class.size) / 2
        corners = scene_object.X_TO.apply(_CORNER_SIGNS * half)
        x, y = R[:2, np.linalg.norm(R[:2], axis=0).argmax()]
        length = math.hypot(x, y)
        axes = np.array([[x, y], [-y, x]]) / length
        projections = corners[:, :2] @ axes.T
        lower, upper = projections.min(axis=0), projections.max(axis=0)
        return Column(
            center=(lower + upper) / 2 @ axes,
            axes=axes,
            half_size=(upper - lower) / 2,
            top=float(corners[:, 2].min()),
            anchors=np.array([[X_TG[:3, 3], departure_axis(X_TG)]]),
        )

    def fitted(self, margin: float, box: CarriedBox, anchor: Floats) -> "Column | None":
        """Return the column beside the object at the other end of its path.

        Args:
            margin: Distance by which what is below may project, if there is room for it [m].
            box: Box of the object at the other end, at one configuration.
            anchor: Position and direction at the other end. Shape (2, 3).

        Returns:
            The column, or None if the object is placed where the column would be: what stands below
            is narrower, and known.
        """
        room, normal = self._separate(box)
        if room >= 0:
            # The reach of a wider base grows in both axes where the normal is oblique to them.
            growth = float(np.abs(self.axes @ normal).sum())
            return replace(self, half_size=self.half_size + min(margin, room / growth))
        if box.corners[0, :, 2].min() < self.top - _TOLERANCE:
            return None
        return replace(self, anchors=np.array([self.anchors[0], anchor]))

    def slack(self, box: CarriedBox, clearance: float, max_drift: float) -> ColumnSlack:
        """Return how far a carried object is from violating a clearance above the column.

        The clearance above grows with the distance of the tool from its axis at an anchor.

        Args:
            box: Box of the object.
            clearance: Required clearance above the column [m].
            max_drift: Distance from the axis at which it is required in full; 0: everywhere [m].
        """
        m = len(box.p_TG)
        slack = ColumnSlack(np.empty(m), np.zeros((m, 3)), np.empty((m, 3)))
        _calc_slack(
            box.corners,
            box.axes,
            box.p_TG,
            self.center,
            self.axes,
            self.half_size,
            self.top,
            self.anchors,
            clearance,
            max_drift,
            slack.values,
            slack.directions,
            slack.points,
        )
        return slack

    def _separate(self, box: CarriedBox) -> tuple[float, Floats]:
        """Return the largest separation of the column and a box seen from above, see `_separate`.

        Args:
            box: Box at one configuration.

        Returns:
            Separation [m] and normal, shape (2,), away from the column.
        """
        separation, x, y, _ = _separate(
            box.corners[0], box.axes[0], self.center, self.axes, self.half_size
        )
        return separation, np.array([x, y])


@njit(cache=True, nogil=True)
def _separate(corners, axes, center, column_axes, half_size):  # type: ignore[no-untyped-def]
    """Return the largest separation of a column and a box seen from above.

    The separation along the normal of any side is a lower bound of the distance.

    Args:
        corners: Corners of the box. Shape (8, 3).
        axes: Horizontal parts of its axes. Shape (3, 2).
        center: Center of the column. Shape (2,).
        column_axes: Axes of the column. Shape (2, 2).
        half_size: Half the extents of the column. Shape (2,).

    Returns:
        Separation [m], x and y of the normal away from the column, index of the nearest corner.
    """
    best, best_x, best_y, nearest = -np.inf, 0.0, 0.0, 0
    for sign in (1.0, -1.0):
        for side in range(5):
            if side < 2:
                x, y = column_axes[side, 0], column_axes[side, 1]
            else:
                x, y = axes[side - 2, 0], axes[side - 2, 1]
                length = math.sqrt(x * x + y * y)
                if length <= _MIN_SIDE_LENGTH:
                    continue
                x, y = x / length, y / length
            x, y = sign * x, sign * y
            reach = x * center[0] + y * center[1]
            for k in range(2):
                along = x * column_axes[k, 0] + y * column_axes[k, 1]
                reach += abs(along) * half_size[k]
            lowest, corner = np.inf, 0
            for k in range(len(corners)):
                projection = x * corners[k, 0] + y * corners[k, 1]
                if projection < lowest:
                    lowest, corner = projection, k
            if lowest - reach > best:
                best, best_x, best_y, nearest = lowest - reach, x, y, corner
    return best, best_x, best_y, nearest


@njit(cache=True, nogil=True)
def _calc_slack(  # type: ignore[no-untyped-def]
    corners,
    axes,
    p_TG,
    center,
    column_axes,
    half_size,
    top,
    anchors,
    clearance,
    max_drift,
    values,
    directions,
    points,
):
    """Write values (m,), directions (m, 3) and points (m, 3) of `Column.slack`."""
    for row in range(len(corners)):
        required = clearance
        if max_drift > 0:
            drift = np.inf
            for anchor in range(len(anchors)):
                rx = p_TG[row, 0] - anchors[anchor, 0, 0]
                ry = p_TG[row, 1] - anchors[anchor, 0, 1]
                rz = p_TG[row, 2] - anchors[anchor, 0, 2]
                ax, ay, az = anchors[anchor, 1]
                x, y, z = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
                drift = min(drift, math.sqrt(x * x + y * y + z * z))
            required *= min(drift / max_drift, 1.0)
        lowest = 0
        for k in range(len(corners[row])):
            if corners[row, k, 2] < corners[row, lowest, 2]:
                lowest = k
        above = corners[row, lowest, 2] - top - required
        beside, x, y, nearest = _separate(corners[row], axes[row], center, column_axes, half_size)
        if above >= beside or beside < -_MAX_SIDESTEP:
            values[row] = above
            directions[row, 2] = 1.0
            nearest = lowest
        else:
            values[row] = beside
            directions[row, 0], directions[row, 1] = x, y
        for i in range(3):
            points[row, i] = corners[row, nearest, i]


def columns_below(
    picked: SceneObject,
    placed: SceneObject,
    X_OG: RigidTransform,
    X_TG: Floats,
    errors: CarryClearance,
) -> tuple[Column | None, Column | None]:
    """Return the columns below the pick and the place pose, see `Column.fitted`.

    Args:
        picked: The object at its pick pose.
        placed: The object at its place pose.
        X_OG: Pose of the tool in the object.
        X_TG: Poses of the tool at the pick and the place pose. Shape (2, 4, 4).
        errors: Errors and margins.
    """
    margin = errors.hidden_margin + errors.position_uncertainty
    ends = (picked, placed)
    columns = [Column.below(end, X) for end, X in zip(ends, X_TG, strict=True)]
    boxes = [CarriedBox.along(picked.object_class, X_OG, X[None]) for X in X_TG]
    return (
        columns[0].fitted(margin, boxes[1], columns[1].anchors[0]),
        columns[1].fitted(margin, boxes[0], columns[0].anchors[0]),
    )


def worst_slack(
    columns: tuple[Column, ...], box: CarriedBox, clearance: float, max_drift: float
) -> float:
    """Return the smallest slack of a path above columns [m]; 0 or more if all are kept clear of.

    Args:
        columns: Columns below the pick and the place pose.
        box: Box of the object along the path.
        clearance: See `Column.slack`.
        max_drift: See `Column.slack`.
    """
    slacks = [column.slack(box, clearance, max_drift).values.min() for column in columns]
    return float(min(slacks, default=math.inf)) + _TOLERANCE
