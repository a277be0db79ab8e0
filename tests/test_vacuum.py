"""Vacuum of suction cups: its course beside closed forms, lift, loss and a second grip."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator
from test_bellows import BOX, CUP, DOWN, hanging

from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.suction import ATMOSPHERIC_PRESSURE, SuctionGripper
from drake_clutter.station.gripper_actuator import (
    GRIPPER_UPDATE_PERIOD,
    GraspStatus,
    SuctionActuator,
)
from drake_clutter.station.station_simulation import TIME_STEP
from drake_clutter.station.vacuum_system import VacuumSystem

FULL = 0.8 * ATMOSPHERIC_PRESSURE


def gripper_of() -> SuctionGripper:
    assert isinstance(DEFAULT_CELL.gripper, SuctionGripper)
    return DEFAULT_CELL.gripper


def test_the_vacuum_builds_up_and_is_lost_exponentially() -> None:
    """1 - exp(-t / 50 ms) while the pump is on, exp(-t / 20 ms) through the valve."""
    system = VacuumSystem(gripper_of())
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.set_leak_rates(context, np.zeros(2))
    port = system.GetOutputPort("vacuum")
    assert port.Eval(context) == pytest.approx([0.0, 0.0])
    system.GetInputPort("hold").FixValue(context, [1.0, 0.0])
    simulator.AdvanceTo(0.101)
    assert port.Eval(context) == pytest.approx([FULL * (1 - math.exp(-0.1 / 0.05)), 0.0])
    simulator.AdvanceTo(1.001)
    assert port.Eval(context)[0] == pytest.approx(FULL, rel=1e-6)
    system.GetInputPort("hold").FixValue(context, [0.0, 0.0])
    simulator.AdvanceTo(1.026)
    assert port.Eval(context)[0] == pytest.approx(FULL * math.exp(-0.025 / 0.02))


def test_a_leak_lowers_the_vacuum_that_the_pump_reaches() -> None:
    """The pump and a leak in balance: (FULL - p) / 50 ms = p / 1 s; the time constants add up."""
    gripper = gripper_of()
    rate = 1 / 0.05 + 1.0
    final = FULL / (1 + 0.05 / 1.0)
    for duration in (0.03, 10.0):
        reached = gripper.next_vacuum(0.0, is_on=True, leak_rate=1.0, duration=duration)
        assert reached == pytest.approx(final * (1 - math.exp(-rate * duration)))
    halves = gripper.next_vacuum(0.0, is_on=True, leak_rate=1.0, duration=0.015)
    halves = gripper.next_vacuum(halves, is_on=True, leak_rate=1.0, duration=0.015)
    whole = gripper.next_vacuum(0.0, is_on=True, leak_rate=1.0, duration=0.03)
    assert halves == pytest.approx(whole)


def test_the_leak_grows_with_the_unevenness_of_the_surface() -> None:
    """The lip of 6 mm on the ridge of a marker of 9 mm radius leaves a gap of 0.51 mm."""
    gripper = gripper_of()
    box, marker = (resting(name).object_class for name in ("cracker_box", "large_marker"))
    radius = marker.size[0] / 2
    on_ridge = RigidTransform(RotationMatrix.MakeYRotation(-math.pi / 2), [radius, 0.0, 0.0])
    gap = radius - math.sqrt(radius**2 - 0.003**2)
    leak_rate = gripper.leak_rate("small", marker, on_ridge)
    assert leak_rate == pytest.approx(gap / 0.001 / 1.0, abs=0.15)  # of a prism of 32 sides
    down = RotationMatrix.MakeXRotation(math.pi)
    on_top = RigidTransform(down, [0.0, 0.0, box.size[2] / 2])
    assert gripper.leak_rate("small", box, on_top) == pytest.approx(0.0, abs=1e-9)
    beside = RigidTransform(down, [0.5, 0.0, box.size[2] / 2])
    assert gripper.leak_rate("small", box, beside) == math.inf


@dataclass(frozen=True)
class Sample:
    """State at an update of the gripper."""

    time: float
    vacuum: float
    held: bool


def hold_box(
    duration: float,
    *,
    push: Callable[[float], float] = lambda _: 0.0,
    pump: Callable[[float], float] = lambda _: 1.0,
    X_TG: RigidTransform = DOWN,
) -> tuple[list[Sample], SuctionActuator]:
    """Hold the box below the cup, commanded on from the start; return samples and actuator.

    Args:
        duration: Simulated time [s].
        push: Downward force on the box at a time [N].
        pump: 1 if the pump runs at a time, else 0.
        X_TG: Pose of the cup.
    """
    station, root, box = hanging(0.0, TIME_STEP, X_TG, attached=False)
    context = station.plant_context(root)
    actuator = SuctionActuator(station, gripper_of(), lambda _: CUP.name)
    simulator = Simulator(station, root)
    samples = list[Sample]()
    force = ExternallyAppliedSpatialForce()
    force.body_index = station.scene_plant.bodies[box.name].index()
    port = station.plant.get_applied_spatial_force_input_port()
    for k in range(round(duration / GRIPPER_UPDATE_PERIOD)):
        time = k * GRIPPER_UPDATE_PERIOD
        station.GetInputPort("hold").FixValue(root, [pump(time), 0.0])
        force.F_Bq_W = SpatialForce(np.zeros(3), np.array([0.0, 0.0, -push(time)]))
        port.FixValue(context, Value[list[ExternallyAppliedSpatialForce]]([force]))
        simulator.AdvanceTo(time + 1e-3)
        vacuum = float(station.GetOutputPort("vacuum").Eval(root)[0])
        actuator.update(root)
        samples.append(Sample(time, vacuum, bool(actuator.status.held)))
    return samples, actuator


WEIGHT = GRAVITY * BOX.object_class.mass


def test_a_box_is_held_from_the_detection_vacuum_on() -> None:
    samples, actuator = hold_box(0.3)
    for sample in samples[1:]:
        assert sample.vacuum == pytest.approx(FULL * (1 - math.exp(-sample.time / 0.05)), rel=1e-6)
    assert [sample.held for sample in samples] == [sample.vacuum >= 1e4 for sample in samples]
    assert actuator.status.max_load_ratio < 1
    assert not actuator.status.lost_object


def test_an_overload_opens_the_lip_until_the_vacuum_is_lost() -> None:
    """The cup bears 40 N; the box with 40 N more comes off after 20 ms ln(81 kPa / 10 kPa)."""
    samples, actuator = hold_box(0.5, push=lambda time: 40.0 if time >= 0.3 else 0.0)
    opened = next(k for k, s in enumerate(samples) if s.time > 0.3 and s.vacuum < 0.9 * FULL) - 1
    for sample in samples[opened:]:
        elapsed = sample.time - samples[opened].time
        assert sample.vacuum == pytest.approx(samples[opened].vacuum * math.exp(-elapsed / 0.02))
    lost = samples[opened].time + 0.02 * math.log(samples[opened].vacuum / 1e4)
    assert lost <= actuator.status.release_time <= lost + 2 * GRIPPER_UPDATE_PERIOD
    assert actuator.status.last_held == BOX.name
    assert actuator.status.max_load_ratio > 1
    assert not samples[-1].held
    actuator.reset()
    assert actuator.status == GraspStatus()


def test_the_lip_closes_after_a_short_overload() -> None:
    samples, actuator = hold_box(0.6, push=lambda time: 40.0 if 0.3 <= time < 0.325 else 0.0)
    assert min(sample.vacuum for sample in samples if sample.time > 0.3) < 0.6 * FULL
    assert samples[-1].held
    assert samples[-1].vacuum > 0.95 * FULL
    assert not actuator.status.lost_object


@pytest.mark.parametrize(("largest", "is_held"), [(33.0, True), (36.0, False)])
def test_a_box_is_held_if_the_vacuum_suffices(largest: float, is_held: bool) -> None:
    """The push grows slowly; the cup bears 39.8 N, of which the box weighs 5 N."""
    assert (WEIGHT + largest < gripper_of().holding_force(CUP.name)) == is_held
    _, actuator = hold_box(0.9, push=lambda time: largest * min(max(time - 0.2, 0.0) / 0.4, 1.0))
    assert bool(actuator.status.held) == is_held
    assert actuator.status.lost_object != is_held


def test_a_lost_box_that_is_still_in_its_place_is_held_again_once() -> None:
    """The pump fails twice while the box stands on the tray below the lip."""
    pump = [(0.3, 1.0), (0.6, 0.0), (0.9, 1.0), (1.2, 0.0), (1.5, 1.0)]
    top = 2 * BOX.X_TO.p[2]
    on_tray = RigidTransform(DOWN.rotation(), [0.05, 0.1, top + 1e-3])
    samples, actuator = hold_box(
        1.5, pump=lambda time: next(on for end, on in pump if time < end), X_TG=on_tray
    )
    held = {end: samples[round((end - 0.05) / GRIPPER_UPDATE_PERIOD)].held for end, _ in pump}
    assert held == {0.3: True, 0.6: False, 0.9: True, 1.2: False, 1.5: False}
    assert actuator.status.num_regrips == 1
    assert actuator.status.lost_object
