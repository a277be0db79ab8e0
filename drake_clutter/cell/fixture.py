"""What stands in the cell beside robot and support, and counts as an obstacle."""

from typing import Annotated, Self

from pydantic import model_validator

from drake_clutter.cell.model_file import MaybeModelFile
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.validation import Fraction, InRange, NonEmptyText, StrictModel, allowed_error

Extent = Annotated[float, InRange(0.001, 10.0)]


class Fixture(StrictModel):
    """A box, or a model of a file, that does not move.

    Attributes:
        name: As it is called in reasons and pictures; unique in the cell.
        pose: X_TF, of the box's center, or of the model's frame.
        box: Extents of a box [m]; or None.
        model: File of an SDF or URDF model; "" for a box.
        color: Red, green, blue and opacity, 0 to 1; None: it is not drawn.
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
