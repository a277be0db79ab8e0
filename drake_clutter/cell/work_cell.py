"""Work cell: robot, gripper, support, cameras and fixtures of one YAML file.

Frames: T is the support and the world, B is the robot's base.
"""

import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationInfo, field_validator
from pydrake.math import RigidTransform

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.parallel_jaw import ParallelJawGripper
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.robot_spec import RobotSpec
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.support import Support
from drake_clutter.resources import resource_path
from drake_clutter.validation import (
    NonEmptyText,
    StrictModel,
    load_config_as,
    rejected_error,
    validate,
)
from drake_clutter.yaml_io import read_yaml

GripperSpec = Annotated[SuctionGripper | ParallelJawGripper, Field(discriminator="kind")]
"""Gripper of a cell file: a model that satisfies `Gripper`."""
DEFAULT_CELL = "models/cells/ur10_epick_tray.yaml"
"""Resource path of the default cell file."""
DEFAULT_WRIST_CAMERA = Camera(
    pose=PoseSpec(translation=(0.0, -0.10, 0.04), rpy_deg=(-15.0, 0.0, 0.0))
)
"""RealSense D435 beside the flange that is tilted towards the tool; an assumed mounting."""
DEFAULT_HANDOVER = PoseSpec(translation=(-0.15, 0.55, -0.011))
"""Place on the table beside the tray of the default cell."""
_RESERVED_NAMES = ("tray", "camera", "pedestal", "robot", "gripper")
"""Names that fixtures may not have: those of the other parts of a cell."""


class WorkCell(StrictModel):
    """Work cell without objects.

    Attributes:
        robot: Robot with its mounting and limits.
        gripper: Gripper of the robot.
        support: Tray or shelf board on which the objects stand.
        cameras: Cameras by name; explorers observe the scene with the first one.
        fixtures: Fixed obstacles.
        wrist_camera: Camera on the flange, whose images are recorded; its `pose` is X_FC. It is a
            sensor without a body.
        handover: Pose X_TH of the place where a retrieved object is put, beside the support: H is
            level, and the object's bottom comes to rest at its origin. The default is on the table
            beside a tray of 0.7 m. None if there is none.
    """

    robot: RobotSpec
    gripper: GripperSpec
    support: Support
    cameras: Annotated[dict[NonEmptyText, Camera], Field(min_length=1)]
    fixtures: tuple[Fixture, ...] = ()
    wrist_camera: Camera = DEFAULT_WRIST_CAMERA
    handover: PoseSpec | None = DEFAULT_HANDOVER

    @field_validator("gripper", mode="before")
    @classmethod
    def _set_default_kind(cls, gripper: Any) -> Any:
        """Complete the kind, which earlier files may leave out."""
        if isinstance(gripper, dict) and "kind" not in gripper:
            return {"kind": "suction", **gripper}
        return gripper

    @field_validator("fixtures")
    @classmethod
    def _check_fixture_names(cls, fixtures: tuple[Fixture, ...], info: ValidationInfo) -> Any:
        taken = [*_RESERVED_NAMES, *info.data.get("cameras", ())]
        for fixture in fixtures:
            if fixture.name in taken:
                others = ", ".join(taken)
                raise rejected_error(
                    f"{fixture.name}: is taken; expected names that differ, also from {others}"
                )
            taken.append(fixture.name)
        return fixtures

    @field_validator("cameras")
    @classmethod
    def _check_cameras(cls, cameras: dict[str, Camera], info: ValidationInfo) -> dict[str, Camera]:
        invalid = [name for name in cameras if not name.isidentifier()]
        if invalid:
            raise rejected_error(f"{invalid[0]}: a camera's name; expected letters, digits and _")
        if taken := [name for name in cameras if name in _RESERVED_NAMES and name != "camera"]:
            reserved = ", ".join(_RESERVED_NAMES)
            raise rejected_error(
                f"{taken[0]}: a camera's name; expected names that differ from {reserved}"
            )
        name, camera = next(iter(cameras.items()))
        if "support" in info.data and not camera.is_support_visible(info.data["support"]):
            allowed = "a pose from which its floor is in the image"
            raise rejected_error(f"{name}: does not see the support; expected {allowed}")
        return cameras

    @property
    def camera(self) -> Camera:
        """First camera, with which explorers observe the scene."""
        return next(iter(self.cameras.values()))

    @property
    def table_height(self) -> float:
        """Height of the table under support and pedestal, in T [m]."""
        return self.support.table_height

    @property
    def pedestal(self) -> tuple[RigidTransform, tuple[float, float, float]] | None:
        """Pose in T and extents [m] of the box under the base; None without pedestal.

        It is upright, with the yaw of the base.
        """
        side = self.robot.pedestal_side
        x, y, z = self.robot.X_TB.translation()
        height = z - self.table_height
        if not side or height <= 0.01:
            return None
        X_TS = RigidTransform(self._upright_base.rotation(), [x, y, height / 2 + self.table_height])
        return X_TS, (side, side, height - 0.002)

    @property
    def _upright_base(self) -> RigidTransform:
        """Rotation of the base about the vertical only."""
        return PoseSpec(rpy_deg=(0.0, 0.0, self.robot.base.rpy_deg[2])).transform

    @property
    def pedestal_overlaps_support(self) -> bool:
        """Whether the pedestal, or the base without pedestal, overlaps the support.

        Both are rectangles seen from above: they overlap unless one of their edge directions is a
        separating axis.
        """
        side = self.robot.pedestal_side
        p_TB = self.robot.X_TB.translation()
        if not side and p_TB[2] > self.support.wall_height:
            return False  # The robot is mounted on a ceiling or a wall.
        edges = self._upright_base.rotation().matrix()[:2, :2].T
        support = self.support.half_size + self.support.wall_thickness
        axes = np.vstack([np.eye(2), edges])
        extents = np.abs(axes) @ support + np.abs(axes @ edges.T).sum(axis=1) * side / 2
        return bool((np.abs(axes @ p_TB[:2]) < extents).all())

    def with_support(self, support: Support) -> "WorkCell":
        """Return the cell with another support."""
        return self if support == self.support else self.model_copy(update={"support": support})

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal, including the order of the cameras."""
        return (
            super().__eq__(other)
            and isinstance(other, WorkCell)
            and [*self.cameras] == [*other.cameras]
        )

    def __hash__(self) -> int:
        """Return the hash of all fields, so that cells can be keys of caches."""
        return hash(self.model_dump_json())


@lru_cache(maxsize=1)
def default_cell() -> WorkCell:
    """Return the cell of `models/cells/ur10_epick_tray.yaml`."""
    return load_cell(resource_path(DEFAULT_CELL))


def load_cell(path: Path, settings: Sequence[str] = ()) -> WorkCell:
    """Load a work cell.

    Args:
        path: YAML file with the fields of `WorkCell`.
        settings: Fields that override those of the file, such as "robot.base.z=0.4".

    Raises:
        InputError: The file is invalid; names the field and what is allowed.
    """
    document = read_yaml(path, "a mapping with robot, gripper, support and cameras")
    cell = validate(WorkCell, _with_absolute_paths(document, path.parent), str(path))
    return load_config_as(cell, settings=settings)


def _with_absolute_paths(document: Any, folder: Path) -> Any:
    """Return a cell document with model paths relative to `folder` made absolute."""
    if not isinstance(document, dict):
        return document
    absolute = dict(document)
    if isinstance(robot := document.get("robot"), dict):
        absolute["robot"] = _with_absolute_path(robot, folder)
    if isinstance(fixtures := document.get("fixtures"), list):
        absolute["fixtures"] = [
            _with_absolute_path(f, folder) if isinstance(f, dict) else f for f in fixtures
        ]
    return absolute


def _with_absolute_path(part: dict[str, Any], folder: Path) -> dict[str, Any]:
    model = part.get("model")
    if isinstance(model, str) and model and not model.startswith("package://"):
        return {**part, "model": os.path.abspath(folder / model)}
    return part
