"""The exported USD stage is valid, and holds the work cell of Drake's plant."""

import math
from pathlib import Path

import numpy as np
import pytest
from conftest import resting, scene_of
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdValidation
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import RevoluteJoint
from scipy.spatial.transform import Rotation
from test_export_cell import build_plant

from drake_clutter.cell.work_cell import load_cell
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.grammar import Orientation
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.simulation.cell_plant import set_joint_angles

Floats = NDArray[np.float64]
ARM = "/scene/arm"


def pose_of(prim: Usd.Prim) -> RigidTransform:
    """Return the pose of a prim in the world."""
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(matrix[:3, :3]), matrix[:3, 3])


def matrix_of(quaternion: Gf.Quatf) -> Floats:
    """Return the rotation matrix of a quaternion in single precision. Shape (3, 3)."""
    wxyz = [quaternion.GetReal(), *quaternion.GetImaginary()]
    return np.asarray(Rotation.from_quat(wxyz, scalar_first=True).as_matrix())


def joint_frame(joint: UsdPhysics.Joint, side: int) -> RigidTransform:
    """Return the pose in the world of a joint's frame on one of its bodies."""
    targets = (joint.GetBody0Rel(), joint.GetBody1Rel())[side].GetTargets()
    p = (joint.GetLocalPos0Attr(), joint.GetLocalPos1Attr())[side].Get()
    r = (joint.GetLocalRot0Attr(), joint.GetLocalRot1Attr())[side].Get()
    local = RigidTransform(RotationMatrix.ProjectToRotationMatrix(matrix_of(r)), list(p))
    if not targets:
        return local
    return pose_of(joint.GetPrim().GetStage().GetPrimAtPath(targets[0])) @ local


def inertia_of(prim: Usd.Prim) -> Floats:
    """Return the inertia of a body about its center of mass, in the body. Shape (3, 3)."""
    mass = UsdPhysics.MassAPI(prim)
    R = matrix_of(mass.GetPrincipalAxesAttr().Get())
    return np.asarray(R @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ R.T)


@pytest.mark.parametrize("name", ["ur10_epick_tray", "ur10_2f85_tray"])
def test_cell_is_that_of_drake(name: str, tmp_path: Path) -> None:
    cell = load_cell(resource_path(f"models/cells/{name}.yaml"))
    box = resting("sugar_box")
    path = export_scene(scene_of(box), ExportFormat.USD, tmp_path, cell=cell)
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    assert not UsdValidation.ValidationContext(validators).Validate(stage)
    plant, arm, context = build_plant(cell)
    set_joint_angles(plant, context, arm, cell.robot.home)
    parts = {arm.robot: "robot", arm.gripper: "gripper"}
    for body in arm.bodies:
        prim = stage.GetPrimAtPath(f"{ARM}/{parts[body.model_instance()]}/{body.name()}")
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI)
        assert pose_of(prim).IsNearlyEqualTo(body.EvalPoseInWorld(context), 1e-9)
        assert UsdPhysics.MassAPI(prim).GetMassAttr().Get() == pytest.approx(body.default_mass())
        com = body.default_spatial_inertia().get_com()
        assert list(UsdPhysics.MassAPI(prim).GetCenterOfMassAttr().Get()) == pytest.approx(com)
        expected = body.default_spatial_inertia().Shift(com).CalcRotationalInertia()
        assert inertia_of(prim) == pytest.approx(
            expected.CopyToFullMatrix3(), rel=1e-5, abs=1e-6 * inertia_of(prim).max()
        )
        colliders = [p for p in prim.GetChildren() if p.HasAPI(UsdPhysics.CollisionAPI)]
        assert len(colliders) == len(plant.GetCollisionGeometriesForBody(body))
    assert stage.GetPrimAtPath(ARM).HasAPI(UsdPhysics.ArticulationRootAPI)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    for joint in joints:
        if not joint.num_positions():
            continue
        prim = UsdPhysics.Joint(stage.GetPrimAtPath(f"{ARM}/joints/{joint.name()}"))
        X = joint_frame(prim, 0).inverse() @ joint_frame(prim, 1)
        q = joint.GetOnePosition(context)
        if isinstance(joint, RevoluteJoint):
            moved = RigidTransform(RotationMatrix.MakeZRotation(q))
        else:
            moved = RigidTransform([0.0, 0.0, q])
        assert X.IsNearlyEqualTo(moved, 1e-6)


def test_joints_have_limits_and_drives(tmp_path: Path) -> None:
    cell = load_cell(resource_path("models/cells/ur10_epick_tray.yaml"))
    stage = Usd.Stage.Open(str(export_scene(scene_of(), ExportFormat.USD, tmp_path, cell=cell)))
    robot = load_robot(cell.robot)
    for k, name in enumerate(robot.joint_names):
        joint = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"{ARM}/joints/{name}"))
        limits = [joint.GetLowerLimitAttr().Get(), joint.GetUpperLimitAttr().Get()]
        assert limits == pytest.approx(np.degrees(robot.position_limits[k]))
        drive = UsdPhysics.DriveAPI(joint.GetPrim(), "angular")
        assert math.radians(drive.GetTargetPositionAttr().Get()) == pytest.approx(robot.home[k])
        # Units of drives are N m/deg.
        assert drive.GetStiffnessAttr().Get() * 180 / math.pi == pytest.approx(1e5)
        assert drive.GetDampingAttr().Get() * 180 / math.pi == pytest.approx(2e3)
        assert drive.GetMaxForceAttr().Get() == robot.torque_limits[k]
    bellows = UsdPhysics.DriveAPI(stage.GetPrimAtPath(f"{ARM}/joints/large_bellows"), "linear")
    assert bellows.GetStiffnessAttr().Get() == pytest.approx(2000.0)
    assert bellows.GetTargetPositionAttr().Get() == 0.0
    pairs = UsdPhysics.FilteredPairsAPI(stage.GetPrimAtPath(f"{ARM}/robot/wrist_1"))
    assert f"{ARM}/robot/wrist_3" in map(str, pairs.GetFilteredPairsRel().GetTargets())
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/scene/cameras/overhead")).GetCamera(0)
    fov = camera.GetFieldOfView(camera.FOVVertical)
    assert fov == pytest.approx(cell.camera.fov_y_deg, abs=1e-4)
    assert list(camera.frustum.ComputeViewDirection()) == pytest.approx([0, 0, -1])
    X_TC = pose_of(stage.GetPrimAtPath(f"{ARM}/robot/wrist_3/camera_wrist"))
    flange = pose_of(stage.GetPrimAtPath(f"{ARM}/robot/wrist_3/frame_flange"))
    X_FC = flange.inverse() @ X_TC @ RigidTransform(RotationMatrix.MakeXRotation(math.pi))
    assert X_FC.IsNearlyEqualTo(cell.wrist_camera.pose.transform, 1e-9)


def test_objects_are_rigid_bodies(tmp_path: Path) -> None:
    objects = [
        resting("sugar_box", name="a box-1"),
        resting("sugar_box", xy=(0.0, 0.2), name="a box.1"),
        resting("tomato_soup_can", Orientation.UPRIGHT_0, (0.2, 0.0)),
    ]
    path = export_scene(scene_of(*objects), ExportFormat.USD, tmp_path)
    stage = Usd.Stage.Open(str(path))
    prims = [stage.GetPrimAtPath(f"/scene/objects/{name}") for name in ("a_box_1", "a_box_1_2")]
    prims.append(stage.GetPrimAtPath("/scene/objects/tomato_soup_can"))
    bounds = UsdGeom.BBoxCache(0, ["guide"])
    visuals = UsdGeom.BBoxCache(0, ["default"])
    for prim, scene_object in zip(prims, objects, strict=True):
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI)
        assert (prim.GetDisplayName() or prim.GetName()) == scene_object.name
        mass = UsdPhysics.MassAPI(prim).GetMassAttr().Get()
        assert mass == pytest.approx(scene_object.object_class.mass)
        p_TO = pose_of(prim).translation()
        assert p_TO == pytest.approx(scene_object.X_TO.translation)
        extents = bounds.ComputeWorldBound(prim).ComputeAlignedRange()
        assert list(extents.GetMin()) == pytest.approx(scene_object.bounds_T[0], abs=1e-6)
        assert list(extents.GetMax()) == pytest.approx(scene_object.bounds_T[1], abs=1e-6)
        visible = visuals.ComputeWorldBound(prim).ComputeAlignedRange()
        assert list(visible.GetMin()) == pytest.approx(scene_object.bounds_T[0], abs=1e-3)
    table = stage.GetPrimAtPath("/scene/tray/table")
    assert table.HasAPI(UsdPhysics.CollisionAPI)
    assert not table.HasAPI(UsdPhysics.RigidBodyAPI)
