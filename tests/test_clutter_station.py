"""The station's diagram: state, feed-forward torques, visual geometry and contacts."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, scene_of
from numpy.typing import NDArray
from pydrake.geometry import Role
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.grammar import Orientation
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.grasp_constraint import WeldPair
from drake_clutter.station.station_simulation import TIME_STEP

SCENE = scene_of(
    resting("sugar_box", Orientation.UPRIGHT_0), resting("pudding_box", xy=(-0.15, 0.1))
)
HOME = np.array(DEFAULT_CELL.robot.home)
TOOL = next(iter(DEFAULT_CELL.gripper.tools))
NO_TORQUES = np.zeros(6)


def station_at_home(
    scene: Scene,
    weld: WeldPair | None = None,
    *,
    torques: NDArray[np.float64] = NO_TORQUES,
    visuals: bool = False,
    cell: WorkCell = DEFAULT_CELL,
) -> tuple[ClutterStation, Context]:
    """Return a station whose arm is commanded to stay at home, and its context at rest."""
    classes = [(o.name, o.object_class) for o in scene.objects]
    station = ClutterStation(cell, classes, time_step=TIME_STEP, weld=weld, visuals=visuals)
    root = station.CreateDefaultContext()
    station.set_state(root, HOME, scene.objects)
    command = np.concatenate([HOME, np.zeros(6), torques])
    station.GetInputPort("command").FixValue(root, command)
    gripper = station.GetInputPort("gripper_command")
    gripper.FixValue(root, np.zeros(gripper.size()))
    return station, root


@pytest.mark.parametrize("weld", [None, WeldPair("sugar_box", TOOL)])
def test_set_state_places_arm_and_objects(weld: WeldPair | None) -> None:
    station, root = station_at_home(SCENE, weld)
    context = station.plant_context(root)
    assert station.joint_positions(context) == pytest.approx(HOME)
    poses = station.scene_plant.poses(context)
    for o in SCENE.objects:
        assert poses[o.name].p == pytest.approx(o.X_TO.p, abs=1e-9)
        assert poses[o.name].rotation == pytest.approx(o.X_TO.rotation, abs=1e-9)


def test_feed_forward_torques_hold_the_arm() -> None:
    """Without them, the arm sags by the gravity torque over the stiffness: 0.3 mrad."""
    zero = np.zeros((1, 6))
    torques = arm_dynamics(DEFAULT_CELL, Payload()).inverse_dynamics(HOME[None], zero, zero)[0]
    assert np.abs(torques).max() > 30.0
    station, root = station_at_home(SCENE, torques=torques)
    Simulator(station, root).AdvanceTo(0.1)
    sag = station.joint_positions(station.plant_context(root)) - HOME
    assert sag == pytest.approx(np.zeros(6), abs=2e-5)


def test_cameras_see_arm_and_objects() -> None:
    station, root = station_at_home(SCENE, visuals=True)
    inspector = station.GetOutputPort("query").Eval(root).inspector()
    seen = {
        inspector.GetName(inspector.GetFrameId(geometry))
        for geometry in inspector.GetAllGeometryIds(Role.kPerception)
    }
    for o in SCENE.objects:
        assert any(name.startswith(f"{o.name}::") for name in seen)
    assert any("forearm" in name for name in seen)


def test_an_object_that_the_arm_touches_is_in_contact() -> None:
    station, root = station_at_home(SCENE)
    forearm = next(body for body in station.arm.bodies if "forearm" in body.name())
    p_TL = forearm.EvalPoseInWorld(station.plant_context(root)).translation()
    box, other = SCENE.objects
    inside = replace(box, X_TO=Pose(tuple(p_TL), box.X_TO.quaternion))
    station.set_state(root, HOME, [inside, other])
    simulator = Simulator(station, root)
    simulator.AdvanceTo(TIME_STEP)
    # The other box touches the tray.
    assert station.objects_in_contact(station.plant_context(root)) == {box.name, other.name}


@pytest.mark.parametrize("name", ["ur10_epick_tray", "ur10_2f85_tray"])
def test_joints_of_grippers_have_the_names_of_the_plant(name: str) -> None:
    cell = load_cell(resource_path(f"models/cells/{name}.yaml"))
    station = ClutterStation(cell, [], time_step=TIME_STEP)
    plant, instance = station.plant, station.arm.gripper
    names = plant.GetPositionNames(
        instance, add_model_instance_prefix=False, always_add_suffix=False
    )
    assert list(cell.gripper.joint_names) == names
    actuated = [
        plant.get_joint_actuator(k).joint().name() for k in plant.GetJointActuatorIndices(instance)
    ]
    assert list(cell.gripper.joint_names[: cell.gripper.num_actuated_joints]) == actuated


def test_forces_on_a_jaw_are_opposite_to_those_on_the_object() -> None:
    """The top of the box is 3 mm above the lowest corner of the tilted jaw.

    The force on the jaw is opposite to that which changes the momentum of the box.
    """
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    station, root = station_at_home(SCENE, cell=cell)
    context = station.plant_context(root)
    inspector = station.scene_plant.scene_graph.model_inspector()
    body = station.plant.GetBodyByName("left_jaw", station.arm.gripper)
    (geometry,) = station.plant.GetCollisionGeometriesForBody(body)
    shape = inspector.GetShape(geometry)
    half = np.array([shape.width(), shape.depth(), shape.height()]) / 2
    X_TJ = body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(geometry)
    x, y, z = X_TJ @ (-np.sign(X_TJ.rotation().matrix()[2]) * half)
    box, other = SCENE.objects
    below = replace(box, X_TO=Pose((x, y, z - box.X_TO.p[2] + 0.003), box.X_TO.quaternion))
    station.set_state(root, HOME, [below, other])
    Simulator(station, root).AdvanceTo(TIME_STEP)
    forces = station.contact_forces(station.plant_context(root), "left_jaw")
    assert forces.keys() == {box.name}
    assert forces[box.name][2] > 1.0
    velocity = station.scene_plant.bodies[box.name].EvalSpatialVelocityInWorld(context)
    acceleration = velocity.translational() / TIME_STEP + np.array([0.0, 0.0, GRAVITY])
    assert forces[box.name] == pytest.approx(-box.object_class.mass * acceleration, rel=1e-3)
    assert station.contact_forces(station.plant_context(root), "right_jaw") == {}
