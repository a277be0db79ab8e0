"""The exported work cell is that of Drake's plant: kinematics, masses, springs and control."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from conftest import DEFAULT_CELL, resting, scene_of
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.files import InputError
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.simulation.cell_plant import Arm, add_work_cell, set_joint_angles
from drake_clutter.simulation.scene_plant import add_scene_plant

CELLS = ("ur10_epick_tray", "ur10_2f85_tray", "iiwa14_epick_tray", "ur3e_epick_tray")


def export(cell: WorkCell, folder: Path, *, objects: bool = False) -> mujoco.MjModel:
    """Return the model of an exported cell; a warning is an error."""
    scene = scene_of(*([resting("sugar_box")] if objects else []), side=cell.support.size[0])
    path = export_scene(scene, ExportFormat.MJCF, folder, cell=cell)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return mujoco.MjModel.from_xml_path(str(path))


def build_plant(cell: WorkCell) -> tuple[MultibodyPlant, Arm, Context]:
    """Return Drake's plant of a cell."""
    builder = DiagramBuilder()
    scene_plant = add_scene_plant(builder, [], cell.support, 0.001, visuals=False)
    plant = scene_plant.plant
    arm = add_work_cell(plant, scene_plant.scene_graph, cell, compliant=True, visuals=False)
    plant.Finalize()
    return plant, arm, plant.GetMyMutableContextFromRoot(builder.Build().CreateDefaultContext())


@pytest.mark.parametrize("name", CELLS)
def test_kinematics_and_dynamics_are_those_of_drake(name: str, tmp_path: Path) -> None:
    cell = load_cell(resource_path(f"models/cells/{name}.yaml"))
    model = export(cell, tmp_path)
    data = mujoco.MjData(model)
    plant, arm, context = build_plant(cell)
    parts = {arm.robot: "robot", arm.gripper: "gripper"}

    def mujoco_name(element: RigidBody) -> str:
        return f"{parts[element.model_instance()]}/{element.name()}"

    joints = [j for i in plant.GetJointIndices() if (j := plant.get_joint(i)).num_positions()]
    assert model.nq == model.nv == len(joints)
    order = [model.joint(mujoco_name(joint)).qposadr[0] for joint in joints]
    rng = np.random.default_rng(0)
    limits = [
        np.clip([j.position_lower_limits()[0], j.position_upper_limits()[0]], -1, 1) for j in joints
    ]
    for low, high in [(0 * np.array(limits)).T, *[np.array(limits).T] * 3]:
        q, v = rng.uniform(low, high), rng.uniform(-1, 1, len(joints))
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        data.qpos[order], data.qvel[order] = q, v
        mujoco.mj_forward(model, data)
        for body in arm.bodies:
            X_TB = body.EvalPoseInWorld(context).GetAsMatrix34()
            found = data.body(mujoco_name(body))
            assert found.xpos == pytest.approx(X_TB[:, 3], abs=1e-9)
            assert found.xmat.reshape(3, 3) == pytest.approx(X_TB[:, :3], abs=1e-9)
        for tool, frame in arm.tools.items():
            p_TG = frame.CalcPoseInWorld(context).translation()
            assert data.site(f"gripper/{tool}").xpos == pytest.approx(p_TG, abs=1e-9)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        assert inertia[np.ix_(order, order)] == pytest.approx(
            plant.CalcMassMatrix(context), rel=1e-7, abs=1e-9
        )
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        assert data.qfrc_bias[order] == pytest.approx(bias, abs=1e-6)
        # Springs, and gravity; the joints' damping counts as one of Drake's force elements.
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        passive = plant.CalcGeneralizedForces(context, forces)
        passive = passive - plant.CalcGravityGeneralizedForces(context)
        assert data.qfrc_passive[order] == pytest.approx(passive, abs=1e-6)
    for body in arm.bodies:
        assert float(model.body(mujoco_name(body)).mass[0]) == pytest.approx(
            body.default_mass(), abs=1e-9
        )


def depths_in_drake(
    plant: MultibodyPlant, arm: Arm, context: Context
) -> dict[frozenset[str], float]:
    """Return penetration depths [m] by the names of the two bodies."""
    parts = {arm.robot: "robot", arm.gripper: "gripper"}
    query = plant.get_geometry_query_input_port().Eval(context)
    inspector = query.inspector()
    depths = dict[frozenset[str], float]()
    for contact in query.ComputePointPairPenetration():
        names = []
        for geometry in (contact.id_A, contact.id_B):
            body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            part = parts.get(body.model_instance())
            is_tray = body.name() == "tray"
            solid = inspector.GetName(geometry).split("::")[-1]
            fixed = "tray" if is_tray else f"cell/{solid}"
            names.append(f"{part}/{body.name()}" if part else fixed)
        pair = frozenset(names)
        depths[pair] = max(depths.get(pair, 0.0), contact.depth)
    return depths


@pytest.mark.parametrize("name", ["ur10_epick_tray", "ur10_2f85_tray"])
def test_bodies_collide_as_in_drake(name: str, tmp_path: Path) -> None:
    cell = load_cell(resource_path(f"models/cells/{name}.yaml"))
    model = export(cell, tmp_path)
    data = mujoco.MjData(model)
    plant, arm, context = build_plant(cell)
    addresses = [int(model.joint(f"robot/{joint}").qposadr[0]) for joint in arm.joints]
    lower, upper = model.jnt_range[[model.joint(f"robot/{j}").id for j in arm.joints]].T
    rng = np.random.default_rng(0)
    seen = set[frozenset[str]]()
    for _ in range(40):
        q = rng.uniform(lower, upper)
        set_joint_angles(plant, context, arm, q.tolist())
        data.qpos[addresses] = q
        mujoco.mj_forward(model, data)
        pairs = {
            frozenset(model.body(model.geom(k).bodyid[0]).name for k in contact.geom)
            for contact in data.contact
        }
        depths = depths_in_drake(plant, arm, context)
        assert pairs <= set(depths)
        # MuJoCo overlooks a capsule whose axis passes through a thin box.
        assert {pair for pair, depth in depths.items() if 1e-4 < depth < 0.1} <= pairs
        seen |= pairs
    assert len(seen) > 10
    assert any("cell/pedestal" in pair for pair in seen)


def test_actuators_are_those_of_the_station(tmp_path: Path) -> None:
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    model = export(cell, tmp_path)
    assert [model.actuator(k).name for k in range(model.nu)] == [
        *(f"robot/{name}" for name in load_robot(cell.robot).joint_names),
        *("gripper/left_jaw_guide", "gripper/right_jaw_guide"),
    ]
    gains = [1e5] * 6 + [4e4] * 2
    assert model.actuator_gainprm[:, 0].tolist() == gains
    assert model.actuator_biasprm[:, 1].tolist() == [-gain for gain in gains]
    assert model.actuator_biasprm[:, 2].tolist() == [-2e3] * 6 + [-200.0] * 2
    limits = [*load_robot(cell.robot).torque_limits, 60.0, 60.0]
    assert model.actuator_forcerange[:, 1].tolist() == limits
    # The jaws share a linkage: a force on one of them moves both.
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    model.actuator_gainprm[7, 0] = 0.0
    model.actuator_biasprm[7] = 0.0
    data.ctrl[6] = 0.02
    mujoco.mj_step(model, data, 300)
    for name in ("left_jaw_guide", "right_jaw_guide"):
        assert data.joint(f"gripper/{name}").qpos == pytest.approx(0.02, abs=1e-3)


def test_meshes_of_models_are_exported(tmp_path: Path) -> None:
    trimesh.creation.box((100.0, 200.0, 300.0)).export(tmp_path / "block.obj")
    mesh = "<geometry><mesh><uri>block.obj</uri><scale>.001 .001 .001</scale></mesh></geometry>"
    inertial = "<inertial><mass>2</mass></inertial>"
    link = (
        f"<link name='block'>{inertial}<collision name='c'><pose>0 0 0.15 0 0 0</pose>{mesh}"
        f"</collision><visual name='v'>{mesh}</visual></link>"
    )
    (tmp_path / "block.sdf").write_text(
        f"<sdf version='1.10'><model name='m'>{link}</model></sdf>", encoding="utf-8"
    )
    pose = PoseSpec(translation=(0.6, 0.6, 0.0), rpy_deg=(0.0, 0.0, 90.0))
    block = Fixture(name="block", pose=pose, model=str(tmp_path / "block.sdf"))
    cell = DEFAULT_CELL.model_copy(update={"fixtures": (*DEFAULT_CELL.fixtures, block)})
    (tmp_path / "out").mkdir()
    model = export(cell, tmp_path / "out")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = model.body("cell/block/block")
    visual, collision = range(body.geomadr[0], body.geomadr[0] + 2)
    assert (model.geom(visual).group[0], model.geom(collision).group[0]) == (2, 3)
    mesh_id = model.geom(collision).dataid[0]
    first = model.mesh_vertadr[mesh_id]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh_id]]
    geom = data.geom(collision)
    world = vertices @ geom.xmat.reshape(3, 3).T + geom.xpos
    assert world.min(axis=0) == pytest.approx([0.5, 0.55, 0.0], abs=1e-6)
    assert world.max(axis=0) == pytest.approx([0.7, 0.65, 0.3], abs=1e-6)


def test_arm_rests_at_home(tmp_path: Path) -> None:
    model = export(DEFAULT_CELL, tmp_path, objects=True)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    home = np.array(DEFAULT_CELL.robot.home)
    joints = [model.joint(model.actuator(k).trnid[0]) for k in range(model.nu)]
    addresses = [int(joint.qposadr[0]) for joint in joints]
    assert data.qpos[addresses] == pytest.approx(home)
    mujoco.mj_step(model, data, 200)
    assert data.qpos[addresses] == pytest.approx(home, abs=1e-5)
    assert data.body("sugar_box").xpos == pytest.approx(
        resting("sugar_box").X_TO.translation, abs=5e-4
    )
    camera = model.camera("overhead")
    assert float(camera.fovy[0]) == DEFAULT_CELL.camera.fov_y_deg
    look = -data.camera("overhead").xmat.reshape(3, 3)[:, 2]
    assert look == pytest.approx([0, 0, -1], abs=1e-9)
    assert data.camera("overhead").xpos == pytest.approx([0, 0, 1.6])
    X_TF = RigidTransform(RotationMatrix(data.site("robot/flange").xmat.reshape(3, 3)))
    X_TF.set_translation(data.site("robot/flange").xpos)
    X_TC = X_TF @ DEFAULT_CELL.wrist_camera.pose.transform
    wrist = data.camera("robot/wrist")
    assert wrist.xpos == pytest.approx(X_TC.translation(), abs=1e-9)
    assert -wrist.xmat.reshape(3, 3)[:, 2] == pytest.approx(X_TC.rotation().matrix()[:, 2])
    assert -wrist.xmat.reshape(3, 3)[:, 1] == pytest.approx(X_TC.rotation().matrix()[:, 1])


def test_only_some_formats_hold_a_cell(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sdf cannot hold the cell; expected one of mjcf, usd"):
        export_scene(scene_of(resting("sugar_box")), ExportFormat.SDF, tmp_path, cell=DEFAULT_CELL)
    assert not list(tmp_path.iterdir())
