"""Fixture of a work cell: a fixed obstacle besides robot and support."""

from typing import Annotated, Self

from pydantic import model_validator

from drake_clutter.cell.model_file import MaybeModelFile
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.validation import Fraction, InRange, NonEmptyText, StrictModel, allowed_error

Extent = Annotated[float, InRange(0.001, 10.0)]
"""Extent of a box [m]."""


class Fixture(StrictModel):
    """Box, or rigid model of a file, that is welded to the world.

    Attributes:
        name: Unique name, used in failure reasons and images.
        pose: Pose in T of the center of the box, or of the frame of the model.
        box: Extents of the box along x, y and z [m]; None for a model.
        model: SDF or URDF file; "" for a box.
        color: Red, green, blue and opacity, 0 to 1; None for an invisible box.
    """

    name: NonEmptyText
    pose: PoseSpec = PoseSpec()
    box: tuple[Extent, Extent, Extent] | None = None
    model: MaybeModelFile = ""
    color: tuple[Fraction, Fraction, Fraction, Fraction] | None = None

    @model_validator(mode="after")
    def _box_or_model(self) -> Self:
        if (self.box is None) == (self.model == ""):
            raise allowed_error("either a box or a model")
        return self
