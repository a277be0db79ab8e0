"""Columns below a carried object along configurations of the arm.

Frames: T is the support, G is the tool, O is the carried object.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_clutter.planning.carry_clearance import (
    CarriedBox,
    CarryClearance,
    columns_below,
    worst_slack,
)
from drake_clutter.planning.grasp_candidate import GraspCandidate
from drake_clutter.planning.spline_program import LinearizedDistances
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.planning.trajectory_optimization import INFLUENCE_DISTANCE
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]

COLUMN_MARGIN = 0.002
"""Distance that trajectory optimization keeps from columns in addition to the required one [m]."""


class CarryColumns:
    """What may stand below an object where it is picked and placed, see `carry_clearance`.

    Attributes:
        clearance: Height that the object keeps above it [m].
    """

    def __init__(
        self,
        picked: SceneObject,
        X_TO_place: Pose,
        candidate: GraspCandidate,
        tool: ToolKinematics,
        clearance: float,
        errors: CarryClearance,
        *,
        starts_at_rest: bool,
        ends_at_rest: bool,
    ) -> None:
        """Find the columns of a carry.

        Args:
            picked: The object at its pick pose.
            X_TO_place: Pose at which it is released.
            candidate: Grasp.
            tool: Kinematics of the tool.
            clearance: Height that the object keeps above columns [m].
            errors: Errors and margins.
            starts_at_rest: Whether the carry starts where the object stands.
            ends_at_rest: Whether it ends where the object is released.
        """
        self.clearance = clearance
        self._object_class = picked.object_class
        self._X_OG = candidate.X_OG
        self._tool = tool
        self._max_drift = errors.max_drift
        X_TG = np.array([candidate.X_TG_pick, candidate.X_TG_place])
        placed = replace(picked, X_TO=X_TO_place)
        below_pick, below_place = columns_below(picked, placed, candidate.X_OG, X_TG, errors)
        columns = (below_pick if starts_at_rest else None, below_place if ends_at_rest else None)
        self._columns = tuple(column for column in columns if column is not None)

    def _carried_box(self, path: Floats) -> CarriedBox:
        """Return the box of the carried object along a path. Shape (m, n)."""
        return CarriedBox.along(self._object_class, self._X_OG, self._tool.pose(path))

    def slack(self, path: Floats) -> float:
        """Return how far a path is from violating the clearance, see `worst_slack`.

        Args:
            path: Configurations with the object. Shape (m, n).
        """
        box = self._carried_box(path)
        return worst_slack(self._columns, box, self.clearance, self._max_drift)

    def distances(self, q: Floats) -> LinearizedDistances:
        """Return the distances of the carried object from columns, for the optimization.

        Args:
            q: Configurations. Shape (m, n).
        """
        box = self._carried_box(q)
        slacks = [column.slack(box, self.clearance, 0.0) for column in self._columns]
        J = self._tool.jacobians(q)
        moments = [np.cross(slack.points - box.p_TG, slack.directions) for slack in slacks]
        gradients = np.vstack(
            [
                np.einsum("mi,mij->mj", np.hstack([moment, slack.directions]), J)
                for moment, slack in zip(moments, slacks, strict=True)
            ]
        )
        values = np.concatenate([slack.values for slack in slacks]) - COLUMN_MARGIN
        is_near = values < INFLUENCE_DISTANCE
        rows = np.tile(np.arange(len(q)), len(slacks))
        return LinearizedDistances(rows[is_near], gradients[is_near], values[is_near])
