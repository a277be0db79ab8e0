"""Suction in a running simulation: attachment, overload and release."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import cell_with, resting, scene_of
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from test_clutter_station import HOME, TOOL, station_at_home

from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.station.gripper_actuator import (
    GRIPPER_UPDATE_PERIOD,
    OVERLOAD_RELEASE_TIME,
    GraspStatus,
    SuctionActuator,
)
from drake_clutter.station.station_simulation import TIME_STEP

BOX = resting("sugar_box")


def held_box(vacuum: float, duration: float) -> tuple[list[float], list[GraspStatus]]:
    """Attach a hanging box to a cup of the arm at home.

    Args:
        vacuum: Vacuum as a fraction of the atmospheric pressure.
        duration: Simulated time [s].

    Returns:
        Ratios of the load to the load capacity, and statuses, at all updates of the gripper.
    """
    cell = cell_with(f"gripper.vacuum={vacuum}")
    assert isinstance(cell.gripper, SuctionGripper)
    station, root = station_at_home(scene_of(BOX), cell=cell)
    context = station.plant_context(root)
    X_GO = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, BOX.X_TO.p[2] + 5e-4])
    X_TO = station.arm.tools[TOOL].CalcPoseInWorld(context) @ X_GO
    station.set_state(root, HOME, [replace(BOX, X_TO=pose_from_transform(X_TO))])
    assert station.grasp is not None
    actuator = SuctionActuator(station, cell.gripper, lambda _: TOOL)
    simulator = Simulator(station, root)
    ratios, statuses = list[float](), list[GraspStatus]()
    steps_per_update = round(GRIPPER_UPDATE_PERIOD / TIME_STEP)
    for k in range(round(duration / TIME_STEP)):
        simulator.AdvanceTo(k * TIME_STEP)
        if k % steps_per_update == 0:
            force, moment = station.grasp.load(context, TOOL)
            ratios.append(float(cell.gripper.load_ratio(TOOL, force, moment)))
            actuator.update(root)
            statuses.append(actuator.status)
    return ratios, statuses


@pytest.mark.parametrize("vacuum", [0.22, 0.08])
def test_an_object_comes_off_after_an_overload_of_a_duration(vacuum: float) -> None:
    """The box bounces on the bellows: with the larger vacuum, a shorter overload precedes."""
    ratios, statuses = held_box(vacuum, 0.2)
    assert statuses[0].held == BOX.name
    overloaded = [False, *(ratio > 1 for ratio in ratios[1:])]
    count = int(OVERLOAD_RELEASE_TIME / GRIPPER_UPDATE_PERIOD) + 1
    last = next(k for k in range(len(overloaded)) if all(overloaded[max(k - count + 1, 0) : k + 1]))
    assert (sum(overloaded[:last]) >= count) == (vacuum == 0.22)
    assert [status.held == BOX.name for status in statuses] == [
        k < last for k in range(len(statuses))
    ]
    assert statuses[-1].lost_object
    assert statuses[-1].release_time == pytest.approx(last * GRIPPER_UPDATE_PERIOD)
    assert statuses[-1].max_load_ratio == pytest.approx(max(ratios[1 : last + 1]))
