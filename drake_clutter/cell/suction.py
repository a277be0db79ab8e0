"""Suction gripper: where its cups seal on an object, and which loads they hold.

Frames: F is the flange; G is a cup, its origin at the center of the lip, z out of the tool, into
the object; O is the object.

Sources: Body dimensions as in PickNik's `epick_description` (BSD). The vacuum of 80 % of the
atmospheric pressure is an assumption, close to the specification of the Robotiq EPick. So is the
tilt that the bellows follow: the shipped cups reach 13 and 18 degrees with their whole stroke. The
lip model is the ring contact of Mahler et al. 2018, "Dex-Net 3.0", section III: the vacuum loads
the lip uniformly, and the lip opens where tension and bending cancel that load.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.epick import EPICK_LENGTH, epick_mass, epick_sdf
from drake_clutter.cell.gripper import (
    Grasp,
    GraspFailure,
    GraspFailureReason,
    GraspSampling,
    LazyGrasps,
    Payload,
    Tool,
)
from drake_clutter.cell.lip_seal import (
    face_poses,
    lip_flatness_deviation,
    lip_surface_profile,
    profile_deviation,
    profile_tilt,
)
from drake_clutter.cell.payload_limits import GRAVITY, max_payload_acceleration
from drake_clutter.cell.suction_cup import SuctionCup
from drake_clutter.validation import InRange, StrictModel, rejected_error

Floats = NDArray[np.float64]

ATMOSPHERIC_PRESSURE = 101_325.0
"""Standard atmospheric pressure [Pa]."""
MAX_SEAL_GAP = 0.005
"""Largest lip-to-surface gap at which the vacuum can build up [m]."""
_Mismatch = tuple[bool, float]
"""Of a profile that does not seal: whether it is uneven, and its deviation or gap [m]."""


class SuctionGripper(StrictModel):
    """Robotiq EPick vacuum gripper with bellows suction cups on tubes.

    The vacuum of each cup is switched separately.

    Attributes:
        kind: Kind of the gripper in a cell file.
        cups: Suction cups; the first that has a grasp is preferred.
        vacuum: Pressure difference as a fraction of the atmospheric pressure.
        friction: Friction coefficient of the lip on cardboard, tin and plastic.
        unevenness: Largest deviation of the surface under the lip from a plane at which the lip
            seals [m].
        max_tilt_deg: Largest angle between that plane and the plane of the unloaded lip which the
            bellows follow [deg].
        safety: Safety factor of the load capacity in planning.
        pump_time_constant: Time constant with which the pump evacuates a sealed cup [s].
        leak_time_constant: Time constant with which the vacuum is lost through a lip on a surface
            at the limit of `unevenness` [s]; the rate of the leak grows with the unevenness.
        loss_time_constant: Time constant with which the vacuum is lost through a lifted lip, and
            through the valve that releases an object [s].
        detection_vacuum: Vacuum from which on a cup holds an object [Pa].
        lift_vacuum: Share of `vacuum` at which the arm lifts an object.
        grip_timeout: Largest time for which the arm waits for that vacuum beyond the dwell [s].
    """

    kind: Literal["suction"] = "suction"
    cups: Annotated[tuple[SuctionCup, ...], Field(min_length=1)]
    vacuum: Annotated[float, InRange(0.01, 1.0)] = 0.8
    friction: Annotated[float, InRange(0.01, 10.0)] = 0.5
    unevenness: Annotated[float, InRange(0.0, 0.01)] = 0.001
    max_tilt_deg: Annotated[float, InRange(0.0, 45.0)] = 6.0
    safety: Annotated[float, InRange(1.0, 100.0)] = 1.5
    pump_time_constant: Annotated[float, InRange(0.001, 10.0)] = 0.05
    leak_time_constant: Annotated[float, InRange(0.001, 100.0)] = 1.0
    loss_time_constant: Annotated[float, InRange(0.001, 10.0)] = 0.02
    detection_vacuum: Annotated[float, InRange(1.0, 1e5)] = 10_000.0
    lift_vacuum: Annotated[float, InRange(0.0, 1.0)] = 0.8
    grip_timeout: Annotated[float, InRange(0.0, 10.0)] = 0.5

    @model_validator(mode="before")
    @classmethod
    def _take_single_cup(cls, document: Any) -> Any:
        """Accept the fields of the single cup of earlier files in place of `cups`."""
        return _with_cups(document) if isinstance(document, dict) else document

    @field_validator("cups")
    @classmethod
    def _check_names(cls, cups: tuple[SuctionCup, ...]) -> tuple[SuctionCup, ...]:
        names = [cup.name for cup in cups]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise rejected_error(f"{twice[0]}: a cup's name; expected names that differ")
        return cups

    @property
    def description(self) -> str:
        """Kind and diameters of the cups."""
        diameters = ", ".join(f"{1000 * cup.diameter:g} mm" for cup in self.cups)
        return f"suction, {diameters}"

    @property
    def mass(self) -> float:
        """Mass of body, tubes and cups, which counts towards the payload of the robot [kg]."""
        return epick_mass(self.cups)

    @property
    def tools(self) -> Mapping[str, Tool]:
        """Cups by name."""
        return {
            cup.name: Tool(cup.name, cup.link, cup.X_FG.transform, (cup.link,), k * len(cup.joints))
            for k, cup in enumerate(self.cups)
        }

    def cup(self, name: str) -> SuctionCup:
        """Return the cup with a name."""
        return next(cup for cup in self.cups if cup.name == name)

    def holding_force(self, tool: str) -> float:
        """Return the force of the atmosphere on a cup [N].

        Args:
            tool: Name of the cup.
        """
        return self.full_vacuum * self._lip_area(tool)

    @property
    def full_vacuum(self) -> float:
        """Largest pressure difference of the pump [Pa]."""
        return self.vacuum * ATMOSPHERIC_PRESSURE

    def _lip_area(self, tool: str) -> float:
        """Return the area inside the lip of a cup [m^2]."""
        return math.pi * self.cup(tool).diameter ** 2 / 4

    def leak_rate(self, tool: str, object_class: ObjectClass, X_OG: RigidTransform) -> float:
        """Return the rate at which the vacuum of a cup at a pose leaks through the lip [1/s].

        It is infinite if the lip does not seal.

        Args:
            tool: Name of the cup.
            object_class: Class of the object below the lip.
            X_OG: Pose of the cup in the object.
        """
        if not self.can_attach(tool, object_class, X_OG):
            return math.inf
        diameter = self.cup(tool).diameter
        deviation = lip_flatness_deviation(object_class, X_OG, diameter)
        share = deviation / self.unevenness if self.unevenness > 0 else 0.0
        return share / self.leak_time_constant

    def next_vacuum(
        self, vacuum: float, *, is_on: bool, leak_rate: float, duration: float
    ) -> float:
        """Return the vacuum of a cup after a time.

        The pump takes away a volume per time that falls linearly to zero at `full_vacuum`; the leak
        lets in air in proportion to the vacuum. The solution is an exponential. A lip that does not
        seal short-circuits the pump.

        Args:
            vacuum: Vacuum at the start [Pa].
            is_on: Whether the pump evacuates the cup; else the valve vents it.
            leak_rate: See `leak_rate` [1/s].
            duration: Time [s].
        """
        if is_on and math.isfinite(leak_rate):
            pump_rate = 1 / self.pump_time_constant
            rate = pump_rate + leak_rate
            final_vacuum = self.full_vacuum * pump_rate / rate
        else:
            rate, final_vacuum = 1 / self.loss_time_constant, 0.0
        return final_vacuum + (vacuum - final_vacuum) * math.exp(-rate * duration)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Extension of the bellows and two angles of bending, of each cup."""
        return tuple(joint for cup in self.cups for joint in cup.joints)

    @property
    def num_joints(self) -> int:
        """Three of each cup."""
        return len(self.joint_names)

    @property
    def num_actuated_joints(self) -> int:
        """None: a vacuum holds the objects."""
        return 0

    def model_sdf(self, *, compliant: bool, actuated: bool) -> str:
        """Return the SDF model, see `epick_sdf`; no part is actuated."""
        return epick_sdf(self.cups, compliant=compliant)

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> Sequence[Grasp] | GraspFailure:
        """Return grasps at which a lip seals and holds, see `Gripper`.

        Those of the first cup come first, and those of a cup in the order of their distances from
        the center of mass.
        """
        mismatches = {cup.name: (True, math.inf) for cup in self.cups}
        grasps = LazyGrasps(
            grasp
            for cup in self.cups
            for grasp in islice(
                self._iterate_grasps(cup, object_class, X_TO, sampling, mismatches),
                sampling.max_grasps,
            )
        )
        if next(iter(grasps), None):
            return grasps
        if len(mismatches) == len(self.cups):
            return GraspFailure(GraspFailureReason.NO_SEAL, min(mismatches.values())[1])
        return GraspFailure(GraspFailureReason.TOO_HEAVY, object_class.mass)

    def _iterate_grasps(
        self,
        cup: SuctionCup,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
        mismatches: dict[str, _Mismatch],
    ) -> Iterator[Grasp]:
        """Yield the grasps of a cup.

        Args:
            cup: The cup.
            object_class: Class of the object.
            X_TO: Pose of the object.
            sampling: Parameters of the sampling.
            mismatches: Closest mismatch of each cup by its name, which is updated; that of a cup
                that seals is removed.
        """
        p_TCm = X_TO @ object_class.center_of_mass
        normal = np.array(sampling.normal)
        for X_TG in face_poses(object_class, X_TO, normal, cup.diameter, sampling.spacing):
            X_OG = X_TO.InvertAndCompose(X_TG)
            profile = lip_surface_profile(object_class, X_OG, cup.diameter) + sampling.lip_gap
            if not self._seals(profile, cup.diameter):
                if cup.name in mismatches:
                    mismatch = self._mismatch(profile, cup.diameter)
                    mismatches[cup.name] = min(mismatches[cup.name], mismatch)
                continue
            mismatches.pop(cup.name, None)
            payload = self._payload(cup, object_class, X_TG.inverse() @ p_TCm, X_TG)
            if payload.max_acceleration >= sampling.min_payload_acceleration:
                yield Grasp(cup.name, X_TG, payload)

    def _payload(
        self, cup: SuctionCup, object_class: ObjectClass, p_GCm: Floats, X_TG: RigidTransform
    ) -> Payload:
        """Return the load of an object with its center of mass at p_GCm [m], shape (3,)."""
        down_G = -X_TG.rotation().matrix()[2]
        acceleration = self.max_acceleration(cup.name, object_class.mass, p_GCm, down_G)
        # The offset of the load from the axis depends on the yaw, and is neglected.
        on_axis = np.array([0.0, 0.0, round(float(p_GCm[2]), 2)])
        a, b, c = (cup.X_FG.transform @ on_axis).tolist()
        return Payload(object_class.mass, (a, b, c), acceleration)

    def _mismatch(self, profile: Floats, diameter: float) -> _Mismatch:
        """Return the mismatch of a profile that does not seal, see `_Mismatch`."""
        deviation = profile_deviation(profile, diameter)
        is_uneven = deviation > self.unevenness
        return is_uneven, deviation if is_uneven else float(profile.min())

    def make_grasp(
        self,
        tool: str,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        X_TG: RigidTransform,
        sampling: GraspSampling,
    ) -> Grasp | GraspFailure:
        """Return the grasp at a given pose of a cup, see `Gripper`."""
        cup = self.cup(tool)
        X_OG = X_TO.InvertAndCompose(X_TG)
        profile = lip_surface_profile(object_class, X_OG, cup.diameter) + sampling.lip_gap
        is_inside = bool(profile.min() < -MAX_SEAL_GAP)
        if is_inside or not self._seals(profile, cup.diameter):
            value = self._mismatch(profile, cup.diameter)[1]
            return GraspFailure(GraspFailureReason.NO_SEAL, abs(value))
        p_GCm = X_TG.inverse() @ (X_TO @ object_class.center_of_mass)
        payload = self._payload(cup, object_class, p_GCm, X_TG)
        if payload.max_acceleration < sampling.min_payload_acceleration:
            return GraspFailure(GraspFailureReason.TOO_WEAK, payload.max_acceleration)
        return Grasp(tool, X_TG, payload, num_angles=1)

    def can_attach(self, tool: str, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether the lip seals on the surface at a pose, see `Gripper`."""
        diameter = self.cup(tool).diameter
        return self._seals(lip_surface_profile(object_class, X_OG, diameter), diameter)

    def _seals(self, profile: Floats, diameter: float) -> bool:
        """Return whether the lip seals at distances to the surface, see `lip_surface_profile`."""
        return bool(
            profile_deviation(profile, diameter) <= self.unevenness
            and math.degrees(profile_tilt(profile, diameter)) <= self.max_tilt_deg
            and profile.min() <= MAX_SEAL_GAP
        )

    def max_acceleration(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> float:
        """Return the largest acceleration of a load on a cup, see `Gripper`."""
        return max_payload_acceleration(
            mass, p_GCm, down_G, partial(self.load_ratio, tool), 1 / self.safety
        )

    def deflection(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> RigidTransform:
        """Return the extension and the tilt of the bellows under a load, see `Gripper`."""
        cup = self.cup(tool)
        force = mass * GRAVITY * down_G
        extension = float(np.clip(force[2] / cup.stiffness, -cup.stroke, cup.stroke))
        p_GHinge = np.array([0.0, 0.0, -cup.hinge_distance])
        tilt = np.cross(p_GCm - p_GHinge, force) / cup.hinge_stiffness
        rotation = RotationMatrix(Rotation.from_rotvec([tilt[0], tilt[1], 0.0]).as_matrix())
        return RigidTransform(rotation, p_GHinge - rotation @ p_GHinge + [0.0, 0.0, extension])

    def load_ratio(
        self, tool: str, force: Floats, moment: Floats, vacuum: float | None = None
    ) -> Floats:
        """Return the ratio of a load to the load capacity of a cup; it detaches above 1.

        Args:
            tool: Name of the cup.
            force: Force of the object on the cup, in G [N]. Shape (..., 3).
            moment: Moment of the object about G, in G [N m]. Shape (..., 3).
            vacuum: Vacuum of the cup [Pa]; None for `full_vacuum`.

        Returns:
            The larger of the ratios of opening and of sliding. Shape (...).
        """
        radius = self.cup(tool).diameter / 2
        vacuum = self.full_vacuum if vacuum is None else vacuum
        holding_force = max(vacuum * self._lip_area(tool), 1e-9)
        bending = np.hypot(moment[..., 0], moment[..., 1])
        opening = np.maximum(force[..., 2] + 2 * bending / radius, 0.0) / holding_force
        normal_force = np.maximum(holding_force - force[..., 2], 1e-9)
        # A torsional moment acts as tangential force at the radius of the lip, a thin ring.
        tangential = np.hypot(np.hypot(force[..., 0], force[..., 1]), moment[..., 2] / radius)
        return np.asarray(np.maximum(opening, tangential / (self.friction * normal_force)))


_CUP_FIELDS = {
    "cup_diameter": "diameter",
    "cup_length": "length",
    "extension": "extension",
    "stroke": "stroke",
    "stiffness": "stiffness",
}
"""Fields of a cup by those of the gripper's only cup in earlier files."""


def _with_cups(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document of a gripper with the fields of an only cup as `cups`.

    They change the cup of a gripper that has one, and replace the cups of any other.
    """
    given = {_CUP_FIELDS[key]: value for key, value in document.items() if key in _CUP_FIELDS}
    if not given and "cups" in document:
        return document
    rest = {key: value for key, value in document.items() if key not in _CUP_FIELDS}
    cups = rest.get("cups")
    is_only = isinstance(cups, tuple) and len(cups) == 1 and isinstance(cups[0], SuctionCup)
    cup: dict[str, Any] = {"name": "single", "extension": 0.100, "length": 0.020}
    cup |= {**(dict(cups[0]) if is_only and cups else {}), **given}
    if "X_FG" not in cup or given.keys() & {"extension", "length"}:
        extension, length = cup["extension"], cup["length"]
        is_valid = isinstance(extension, int | float) and isinstance(length, int | float)
        z = EPICK_LENGTH + extension + length if is_valid else 0.0
        cup["X_FG"] = {"translation": [0.0, 0.0, z]}
    return {**rest, "cups": [cup]}
