"""Bellows of suction cups: deflection, tilt and swing of a load, beside closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from scipy.optimize import brentq

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.station_simulation import COARSE_TIME_STEP, TIME_STEP

assert isinstance(DEFAULT_CELL.gripper, SuctionGripper)
CUP = DEFAULT_CELL.gripper.cups[0]
JOINT = DEFAULT_CELL.gripper.tools[CUP.name].compliant_joint or 0
BOX = resting("sugar_box")
GAP = 5e-4
"""Distance of the box from the lip [m]."""
DEPTH = GAP + BOX.X_TO.p[2]
"""Distance of the center of the box from the lip [m]."""
DOWN = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.05, 0.1, 0.4])
"""X_TG of a cup that points down."""


def hanging(
    offset: float,
    time_step: float,
    X_TG: RigidTransform = DOWN,
    *,
    attached: bool = True,
) -> tuple[ClutterStation, Context, SceneObject]:
    """Return a station at rest whose arm holds the box, its context, and the box.

    Args:
        offset: Offset of the center of mass from the axis of the cup along y of G [m].
        time_step: Time step of the plant [s].
        X_TG: Pose of the cup.
        attached: Whether the box is attached to the cup.
    """
    solutions = ToolKinematics(DEFAULT_CELL, CUP.name).solve_ik(X_TG.GetAsMatrix4())
    q = solutions[~np.isnan(solutions).any(axis=1)][0]
    zero = np.zeros((1, 6))
    torques = arm_dynamics(DEFAULT_CELL, Payload()).inverse_dynamics(q[None], zero, zero)[0]
    station = ClutterStation(DEFAULT_CELL, [(BOX.name, BOX.object_class)], time_step=time_step)
    root = station.CreateDefaultContext()
    R_GO = X_TG.rotation().inverse() @ RotationMatrix(BOX.X_TO.rotation)
    X_TO = X_TG @ RigidTransform(R_GO, [0.0, offset, DEPTH])
    box = replace(BOX, X_TO=pose_from_transform(X_TO))
    station.set_state(root, q, [box])
    station.GetInputPort("command").FixValue(root, np.concatenate([q, np.zeros(6), torques]))
    gripper = station.GetInputPort("gripper_command")
    gripper.FixValue(root, np.zeros(gripper.size()))
    assert station.grasp is not None
    if attached:
        station.grasp.attach(
            station.plant_context(root), CUP.name, station.scene_plant.bodies[BOX.name]
        )
    return station, root, box


def bellows(station: ClutterStation, root: Context) -> np.ndarray:
    """Return extension [m] and angles about x and y [rad] of the bellows. Shape (3,)."""
    return np.asarray(station.GetOutputPort("gripper_state").Eval(root)[JOINT : JOINT + 3])


@pytest.mark.parametrize("time_step", [TIME_STEP, COARSE_TIME_STEP])
@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_a_load_deflects_and_tilts_the_bellows(offset: float, time_step: float) -> None:
    """F / k along the axis; the tilt balances the moment of the weight about the hinge."""
    station, root, _ = hanging(offset, time_step)
    Simulator(station, root).AdvanceTo(1.5)
    weight = GRAVITY * BOX.object_class.mass

    def moment(tilt: float) -> float:
        lever = offset * math.cos(tilt) - (CUP.hinge_distance + DEPTH) * math.sin(tilt)
        return float(weight * lever - CUP.hinge_stiffness * tilt)

    tilt = float(brentq(moment, -0.5, 0.5))
    extension, about_x, about_y = bellows(station, root)
    assert extension == pytest.approx((weight + GRAVITY * CUP.mass) / CUP.stiffness, rel=0.005)
    assert about_x == pytest.approx(tilt, rel=0.02, abs=1e-4)
    assert about_y == pytest.approx(0.0, abs=1e-4)
    assert tilt == pytest.approx(offset * weight / CUP.hinge_stiffness, rel=0.05)


def test_the_load_on_the_lip_is_that_of_the_tilted_object() -> None:
    station, root, box = hanging(0.02, TIME_STEP)
    Simulator(station, root).AdvanceTo(1.5)
    context = station.plant_context(root)
    assert station.grasp is not None
    force, moment = station.grasp.load(context, CUP.name)
    X_TG = station.arm.tools[CUP.name].CalcPoseInWorld(context)
    X_TO = station.scene_plant.bodies[box.name].EvalPoseInWorld(context)
    expected = X_TG.rotation().inverse() @ np.array([0, 0, -GRAVITY * box.object_class.mass])
    p_GCm = X_TG.inverse() @ (X_TO @ np.asarray(box.object_class.center_of_mass))
    assert force == pytest.approx(expected, abs=0.01)
    assert moment == pytest.approx(np.cross(p_GCm, expected), abs=0.001)
    assert abs(moment[0]) > 0.09


def test_a_load_swings_with_its_natural_frequency_and_comes_to_rest() -> None:
    """A damped pendulum on a torsion spring, released without tilt beside its axis of rest."""
    station, root, box = hanging(0.02, TIME_STEP)
    simulator = Simulator(station, root)
    times = np.arange(1, 101) * 0.01
    tilts = list[float]()
    for time in times:
        simulator.AdvanceTo(time + TIME_STEP / 2)
        tilts.append(float(bellows(station, root)[1]))
    body = station.scene_plant.bodies[box.name]
    inertia_O = body.CalcSpatialInertiaInBodyFrame(station.plant_context(root))
    R_GO = DOWN.rotation().inverse().matrix() @ box.X_TO.rotation
    about_x = float((R_GO @ inertia_O.CalcRotationalInertia().CopyToFullMatrix3() @ R_GO.T)[0, 0])
    depth = CUP.hinge_distance + DEPTH
    inertia = about_x + box.object_class.mass * (depth**2 + 0.02**2)
    stiffness = CUP.hinge_stiffness + GRAVITY * box.object_class.mass * depth
    frequency = math.sqrt(stiffness / inertia)
    ratio = CUP.bending_damping / (2 * math.sqrt(stiffness * inertia))
    peak = math.pi / (frequency * math.sqrt(1 - ratio**2))
    assert times[int(np.argmax(np.abs(tilts)))] == pytest.approx(peak, abs=0.02)
    assert np.abs(tilts).max() > 1.05 * abs(tilts[-1]), "it swings"
    assert np.ptp(tilts[-10:]) < 0.05 * abs(tilts[-1])
