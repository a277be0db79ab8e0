"""Types of fields of a cell file that name a model file."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from drake_clutter.validation import NonEmptyText


def _absolute(model: str) -> str:
    return str(Path(model).absolute()) if model and not model.startswith("package://") else model


ModelFile = Annotated[NonEmptyText, AfterValidator(_absolute)]
"""SDF or URDF file: a path, which becomes absolute, or a `package://` URI."""
MaybeModelFile = Annotated[str, Field(strict=True), AfterValidator(_absolute)]
"""Optional `ModelFile`; "" for none."""
