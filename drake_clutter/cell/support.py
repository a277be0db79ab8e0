"""Support of the objects: a rectangular floor with walls on some of its sides.

Frame T: origin at the center of the floor's upper surface, z up. It is the world frame of all
plants.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from drake_clutter.validation import InRange, StrictModel

Side = Annotated[float, InRange(0.1, 2.0)]
"""Inner side of a support [m]."""


class Support(StrictModel):
    """Tray or shelf board.

    Attributes:
        size: Inner extents along x and y [m].
        wall_height: Height of the walls above the floor [m].
        wall_thickness: Thickness of the walls [m].
        walls: Sides with a wall.
        floor_thickness: Thickness of the floor [m].
        floor_height: Height of the floor's lower surface above the table [m].
    """

    size: tuple[Side, Side]
    wall_height: Annotated[float, InRange(0.0, 1.0)] = 0.025
    wall_thickness: Annotated[float, InRange(0.001, 0.1)] = 0.008
    walls: tuple[Literal["+x", "-x", "+y", "-y"], ...] = ("+x", "-x", "+y", "-y")
    floor_thickness: Annotated[float, InRange(0.001, 0.1)] = 0.010
    floor_height: Annotated[float, InRange(0.0, 2.0)] = 0.0

    @property
    def half_size(self) -> NDArray[np.float64]:
        """Half the inner extents along x and y [m]. Shape (2,)."""
        return np.array(self.size) / 2

    @property
    def table_height(self) -> float:
        """Height of the table under the support, in T [m]."""
        return -self.floor_thickness - self.floor_height

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point (x, y) [m] is within the inner extents."""
        return bool(abs(x) <= self.size[0] / 2 and abs(y) <= self.size[1] / 2)

    def carries(self, p_TP: Sequence[float] | NDArray[np.float64]) -> bool:
        """Return whether a point is over the floor and not below it.

        Args:
            p_TP: Point, such as the origin of an object [m]. Shape (3,).
        """
        x, y, z = p_TP
        return self.contains(x, y) and bool(z >= 0)

    @property
    def area(self) -> float:
        """Area of the floor [m^2]."""
        return self.size[0] * self.size[1]
