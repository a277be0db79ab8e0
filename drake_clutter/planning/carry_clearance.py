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
from drake_clutter.planning.tool_kinematics import departure_axis
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.validation import NonNegative, config_class

Floats = NDArray[np.float64]

_CORNER_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_MAX_SIDESTEP = 0.01
"""Overlap seen from above up to which a violated clearance is one beside the column [m]."""
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
        return CarriedBox(corners, X_TO[:, :2, :3].swapaxes(1, 2), X_TG[:, :3, 3])


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
        (room,), (normal,), _ = self._separate(box)
        if room >= 0:
            # The reach of a wider base grows in both axes where the normal is oblique to them.
            growth = float(np.abs(self.axes @ normal).sum())
            return replace(self, half_size=self.half_size + min(margin, float(room) / growth))
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
        required = np.full(len(box.p_TG), clearance)
        if max_drift:
            drifts = [
                np.linalg.norm(np.cross(box.p_TG - p_TG, axis), axis=1)
                for p_TG, axis in self.anchors
            ]
            required *= np.minimum(np.min(drifts, axis=0) / max_drift, 1.0)
        above = box.corners[:, :, 2].min(axis=1) - self.top - required
        lowest = box.corners[:, :, 2].argmin(axis=1)
        beside, normals, nearest = self._separate(box)
        is_above = (above >= beside) | (beside < -_MAX_SIDESTEP)
        directions = np.zeros((len(above), 3))
        directions[:, :2] = normals
        directions[is_above] = (0.0, 0.0, 1.0)
        index = np.where(is_above, lowest, nearest)
        points = np.take_along_axis(box.corners, index[:, None, None], axis=1)[:, 0]
        return ColumnSlack(np.where(is_above, above, beside), directions, points)

    def _separate(self, box: CarriedBox) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Return the largest separation of the column and a box seen from above.

        The separation along the normal of any side is a lower bound of the distance.

        Returns:
            Separations [m], shape (m,); normals, shape (m, 2), away from the column; and indices of
            the corners of the box that are nearest, shape (m,).
        """
        m = len(box.corners)
        lengths = np.linalg.norm(box.axes, axis=2)
        sides = np.where(
            (lengths > 0.5)[..., None], box.axes / np.maximum(lengths, 0.5)[..., None], 0.0
        )
        normals = np.concatenate([np.broadcast_to(self.axes, (m, 2, 2)), sides], axis=1)
        normals = np.concatenate([normals, -normals], axis=1)
        reach = np.abs(normals @ self.axes.T) @ self.half_size + normals @ self.center
        projections = normals @ box.corners[:, :, :2].swapaxes(1, 2)
        separations = projections.min(axis=2) - reach
        separations[~normals.any(axis=2)] = -np.inf
        best = separations.argmax(axis=1)
        rows = np.arange(m)
        return separations[rows, best], normals[rows, best], projections[rows, best].argmin(axis=1)


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
