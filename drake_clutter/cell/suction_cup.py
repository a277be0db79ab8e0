"""Suction cup on a tube of the gripper's body, as data.

Frames: F is the flange, z out of the arm; G is the cup, its origin at the center of the lip, z out
of the tool, into the object.
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.validation import InRange, StrictModel

Floats = NDArray[np.float64]

_REFERENCE_DIAMETER = 0.025
"""Diameter of the cup for which masses and the reference load are assumed [m]."""
_REFERENCE_CUP_MASS = 0.02
"""Mass of a cup of that diameter [kg]; an assumption."""
_REFERENCE_LOAD = 0.5
"""Load of a cup of that diameter for which the damping ratio holds [kg]; about a sugar box."""
_DAMPING_RATIO = 2.0
"""Damping ratio of the bellows with the reference load: overdamped, as rubber is."""
_BENDING_DAMPING_RATIO = 0.3
"""Damping ratio of the bending bellows with the reference load at `_REFERENCE_DISTANCE`: rubber and
the friction between folds; an assumption."""
_RUBBER_MODULUS = 3.6e6
"""Modulus of elasticity of the rubber [Pa]: NBR of 60 Shore A by the relation of Gent (1958), from
memory."""
_BORE_FRACTION = 1 / 3
"""Bore of the folded bellows as a fraction of the lip's diameter; assumed."""
_REFERENCE_DISTANCE = 0.1
"""Distance of the reference load from the bellows [m]."""
_NUM_MOVING_LINKS = 3
"""Links that share the mass of a cup whose bellows move: they slide, bend about x, and about y."""
_TUBE_MASS_PER_VOLUME = 0.05 / (0.100 * 0.010**2)
"""Mass of a tube divided by length and squared radius [kg/m^3]; assumed, 50 g for a tube of 100 mm
length and 10 mm radius."""


class SuctionCup(StrictModel):
    """Bellows suction cup on a tube.

    Attributes:
        name: Name of the tool: letters, digits and _.
        diameter: Diameter of the lip [m].
        length: Length of the cup without load [m].
        X_FG: Pose of the lip in the flange; z points into the object.
        extension: Length of the tube behind the cup [m].
        tube_radius: Radius of the tube [m].
        stroke: Largest compression, and largest extension, of the bellows [m].
        stiffness: Axial stiffness of the bellows [N/m].
        bending_stiffness: Stiffness of the evacuated bellows against tilt of the lip [N m/rad].
            None: that of a beam of solid rubber, see `hinge_stiffness`.
    """

    name: Annotated[str, Field(strict=True, pattern=r"^[A-Za-z]\w*$")]
    diameter: Annotated[float, InRange(0.005, 0.1)] = 0.025
    length: Annotated[float, InRange(0.005, 0.1)] = 0.020
    X_FG: PoseSpec
    extension: Annotated[float, InRange(0.0, 0.5)] = 0.100
    tube_radius: Annotated[float, InRange(0.001, 0.05)] = 0.010
    stroke: Annotated[float, InRange(0.001, 0.05)] = 0.006
    stiffness: Annotated[float, InRange(100.0, 1e5)] = 2_000.0
    bending_stiffness: Annotated[float, InRange(1e-3, 1e3)] | None = None

    @property
    def link(self) -> str:
        """Link of the SDF model, with frame G."""
        return f"{self.name}_cup"

    @property
    def bellows(self) -> str:
        """Joint of the SDF model along which the bellows give."""
        return f"{self.name}_bellows"

    @property
    def bending_joints(self) -> tuple[str, str]:
        """Joints of the SDF model about x and y of G; the lip is the child of the second."""
        return f"{self.name}_bend_x", f"{self.name}_bend_y"

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of the SDF model between body and lip, in the order of the model."""
        return self.bellows, *self.bending_joints

    @property
    def hinge_distance(self) -> float:
        """Distance of the axes of bending, in the middle of the bellows, from the lip [m]."""
        return self.length / 2

    @property
    def mass(self) -> float:
        """Mass of the cup [kg], proportional to the area of the lip."""
        return _REFERENCE_CUP_MASS * self._relative_area

    @property
    def link_mass(self) -> float:
        """Mass of each link of a cup whose bellows move [kg]."""
        return self.mass / _NUM_MOVING_LINKS

    @property
    def tube_mass(self) -> float:
        """Mass of the tube [kg]."""
        return _TUBE_MASS_PER_VOLUME * self.extension * self.tube_radius**2

    @property
    def damping(self) -> float:
        """Damping of the bellows [N s/m]; overdamped for loads that the cup may hold."""
        reference_load = _REFERENCE_LOAD * self._relative_area
        return _DAMPING_RATIO * 2 * math.sqrt(self.stiffness * reference_load)

    @property
    def hinge_stiffness(self) -> float:
        """Stiffness against tilt of the lip [N m/rad].

        By default it is E I / h of a hollow cylinder: the vacuum folds the bellows to solid rubber
        of the height h, their length without the stroke.
        """
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        bore = _BORE_FRACTION * self.diameter
        second_moment = math.pi / 64 * (self.diameter**4 - bore**4)
        return _RUBBER_MODULUS * second_moment / max(self.length - self.stroke, self.stroke)

    @property
    def bending_damping(self) -> float:
        """Damping of the bending bellows [N m s/rad]."""
        inertia = _REFERENCE_LOAD * self._relative_area * _REFERENCE_DISTANCE**2
        return 2 * _BENDING_DAMPING_RATIO * math.sqrt(self.hinge_stiffness * inertia)

    @property
    def _relative_area(self) -> float:
        return (self.diameter / _REFERENCE_DIAMETER) ** 2

    @property
    def p_FTube(self) -> tuple[Floats, Floats]:
        """Upper and lower end of the tube in the flange [m]. Shapes (3,)."""
        X_FG = self.X_FG.transform
        axis = X_FG.rotation().matrix()[:, 2]
        lower = X_FG.translation() - self.length * axis
        return lower - self.extension * axis, lower
