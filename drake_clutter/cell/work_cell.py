"""The work cell as data: robot, gripper, support, cameras and fixtures, in one file."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationInfo, field_validator
from pydrake.math import RigidTransform

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.fixture import Fixture
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

GripperSpec = SuctionGripper
"""Gripper of a cell's file. With a second kind it is the union of both, by `kind`:
`Annotated[SuctionGripper | Other, Field(discriminator="kind")]`; each satisfies `Gripper`."""
DEFAULT_CELL = "models/cells/ur10_epick_tray.yaml"
_RESERVED_NAMES = ("tray", "camera", "pedestal", "robot", "gripper")
"""Names of what stands in a cell besides fixtures."""


class WorkCell(StrictModel):
    """Everything that stands in the cell but the objects.

    Attributes:
        robot: Which arm, and where.
        gripper: Its tool.
        support: What the objects stand on.
        cameras: By name; the explorer sees through the first.
        fixtures: Obstacles.
    """

    robot: RobotSpec
    gripper: GripperSpec
    support: Support
    cameras: Annotated[dict[NonEmptyText, Camera], Field(min_length=1)]
    fixtures: tuple[Fixture, ...] = ()

    @field_validator("fixtures")
    @classmethod
    def _check_fixture_names(cls, fixtures: tuple[Fixture, ...], info: ValidationInfo) -> Any:
        taken = [*_RESERVED_NAMES, *info.data.get("cameras", ())]
        for fixture in fixtures:
            if fixture.name in taken:
                what = f"names that differ, also from {', '.join(taken)}"
                raise rejected_error(f"{fixture.name}: is taken; allowed are {what}")
            taken.append(fixture.name)
        return fixtures

    @field_validator("cameras")
    @classmethod
    def _check_cameras(cls, cameras: dict[str, Camera], info: ValidationInfo) -> dict[str, Camera]:
        if unfit := [name for name in cameras if not name.isidentifier()]:
            raise rejected_error(f"{unfit[0]}: a camera's name; allowed are letters, digits and _")
        if taken := [name for name in cameras if name in _RESERVED_NAMES and name != "camera"]:
            raise rejected_error(
                f"{taken[0]}: a camera's name; allowed are names that differ from {', '.join(_RESERVED_NAMES)}"
            )
        name, camera = next(iter(cameras.items()))
        if "support" in info.data and not camera.sees_support(info.data["support"]):
            raise rejected_error(
                f"{name}: sees nothing of the support; allowed is a pose from which its floor is in the image"
            )
        return cameras

    @property
    def camera(self) -> Camera:
        """The camera that the explorer sees through."""
        return next(iter(self.cameras.values()))

    @property
    def table_height(self) -> float:
        """Of the table on which support and pedestal stand, in T [m]."""
        return -self.support.floor_thickness - self.support.floor_height

    @property
    def pedestal(self) -> tuple[RigidTransform, tuple[float, float, float]] | None:
        """Pose X_TS and extents [m] of the box under the robot's base; None if it has none.

        It is upright, and turned as far about the vertical as the base.
        """
        side, (x, y, z) = self.robot.pedestal_side, self.robot.X_TB.translation()
        height = z - self.table_height
        if not side or height <= 0.01:
            return None
        X_TS = RigidTransform(self._upright_base.rotation(), [x, y, height / 2 + self.table_height])
        return X_TS, (side, side, height - 0.002)

    @property
    def _upright_base(self) -> RigidTransform:
        """The turn of the base about the vertical alone."""
        return PoseSpec(rpy_deg=(0.0, 0.0, self.robot.base.rpy_deg[2])).transform

    @property
    def pedestal_overlaps_support(self) -> bool:
        """Whether the pedestal, or the base if it has none, would stand in the support."""
        side, p_TB = self.robot.pedestal_side, self.robot.X_TB.translation()
        if not side and p_TB[2] > self.support.wall_height:
            return False  # from a ceiling, or a wall
        edges = self._upright_base.rotation().matrix()[:2, :2].T
        support = self.support.half_size + self.support.wall_thickness
        axes = np.vstack([np.eye(2), edges])  # across each edge of either
        reach = np.abs(axes) @ support + np.abs(axes @ edges.T).sum(axis=1) * side / 2
        return bool((np.abs(axes @ p_TB[:2]) < reach).all())

    def with_support(self, support: Support) -> "WorkCell":
        """Return the cell with another support."""
        return self if support == self.support else self.model_copy(update={"support": support})

    def __eq__(self, other: object) -> bool:
        """Whether all is the same, the order of the cameras included."""
        return (
            super().__eq__(other)
            and isinstance(other, WorkCell)
            and [*self.cameras] == [*other.cameras]
        )

    def __hash__(self) -> int:
        """Hash of the whole content, so that what is derived from a cell can be kept."""
        return hash(self.model_dump_json())


@lru_cache(maxsize=1)
def default_cell() -> WorkCell:
    """Return the cell of `models/cells/ur10_epick_tray.yaml`."""
    return load_cell(resource_path(DEFAULT_CELL))


def load_cell(path: Path, settings: Sequence[str] = ()) -> WorkCell:
    """Read a cell.

    Args:
        path: YAML with the fields of `WorkCell`.
        settings: Single fields over those of the file, such as "robot.base.z=0.4".

    Raises:
        InputError: The file, the field and what is allowed.
    """
    given = read_yaml(path, "a mapping with robot, gripper, support and cameras")
    cell = validate(WorkCell, _with_absolute_paths(given, path.parent), str(path))
    return load_config_as(cell, settings=settings)


def _with_absolute_paths(given: Any, folder: Path) -> Any:
    """Return the document with its models' paths made absolute, as they are relative to the cell's file."""
    if not isinstance(given, dict):
        return given
    absolute = dict(given)
    if isinstance(robot := given.get("robot"), dict):
        absolute["robot"] = _with_absolute_path(robot, folder)
    if isinstance(fixtures := given.get("fixtures"), list):
        absolute["fixtures"] = [
            _with_absolute_path(f, folder) if isinstance(f, dict) else f for f in fixtures
        ]
    return absolute


def _with_absolute_path(part: dict[str, Any], folder: Path) -> dict[str, Any]:
    model = part.get("model")
    if isinstance(model, str) and model and not model.startswith("package://"):
        return {**part, "model": str((folder / model).resolve())}
    return part
