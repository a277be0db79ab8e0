"""Where a model of a cell is."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from drake_clutter.validation import NonEmptyText


def _absolute(model: str) -> str:
    return str(Path(model).absolute()) if model and not model.startswith("package://") else model


ModelFile = Annotated[NonEmptyText, AfterValidator(_absolute)]
"""SDF or URDF file: a path, which becomes absolute, or package://..."""
MaybeModelFile = Annotated[str, Field(strict=True), AfterValidator(_absolute)]
"""The same, or "" for none."""
