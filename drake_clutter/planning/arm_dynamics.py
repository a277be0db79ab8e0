"""Dynamics of the arm with gripper and load.

Frames: B is the robot's base, F is the flange, J is the frame of a joint with its own motion, z
along the axis, W is the world.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, SpatialInertia, UnitInertia

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.robots.chain_dynamics import ChainDynamics
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.robot_plant import add_robot

LOAD_RADIUS = 0.05
"""Radius of the solid sphere whose inertia stands for that of a load [m]."""


def dynamics_plant(cell: WorkCell, payload: Payload) -> MultibodyPlant:
    """Return a plant of arm, rigid gripper and load alone."""
    plant = MultibodyPlant(0.0)
    robot = add_robot(plant, load_robot(cell.robot), visuals=False)
    sdf = cell.gripper.model_sdf(compliant=False, actuated=False)
    (tool,) = Parser(plant).AddModelsFromString(sdf, "sdf")
    flange = plant.GetFrameByName(cell.robot.tool_frame, robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", tool))
    if payload.mass:
        inertia = SpatialInertia(payload.mass, np.zeros(3), UnitInertia.SolidSphere(LOAD_RADIUS))
        load = plant.AddRigidBody("load", robot, inertia)
        plant.WeldFrames(flange, load.body_frame(), RigidTransform(list(payload.p_FCm)))
    plant.Finalize()
    return plant


def arm_dynamics(cell: WorkCell, payload: Payload) -> ChainDynamics:
    """Return the dynamics of arm, rigid gripper and load, those of `dynamics_plant`.

    Args:
        cell: Work cell with robot and gripper.
        payload: Load of the gripper.
    """
    arm = _unloaded_dynamics(cell)
    if not payload.mass:
        return arm
    X_JF = arm.chain.fixed[-1]
    load = X_JF[:3, :3] @ payload.p_FCm + X_JF[:3, 3]
    last = arm.p_JCm[-1]
    masses, p_JCm, inertias = (values.copy() for values in (arm.masses, arm.p_JCm, arm.inertias))
    masses[-1] += payload.mass
    p_JCm[-1] += payload.mass / masses[-1] * (load - last)
    # Inertia of two point masses about their common center, and of the sphere.
    reduced_mass = payload.mass * arm.masses[-1] / masses[-1]
    r = load - last
    inertias[-1] += reduced_mass * (r @ r * np.eye(3) - np.outer(r, r))
    inertias[-1] += 0.4 * payload.mass * LOAD_RADIUS**2 * np.eye(3)
    return replace(arm, masses=masses, p_JCm=p_JCm, inertias=inertias)


@lru_cache(maxsize=32)
def _unloaded_dynamics(cell: WorkCell) -> ChainDynamics:
    """Return the dynamics of arm and gripper."""
    plant = dynamics_plant(cell, Payload())
    robot = load_robot(cell.robot)
    n = robot.num_joints
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(n))
    instance = plant.GetFrameByName(cell.robot.tool_frame).model_instance()
    names = robot.joint_names
    joints = [plant.GetJointByName(name, instance) for name in names]
    # Bodies that move with each joint but not with the next.
    moved = [
        {int(index) for index in plant.GetBodiesKinematicallyAffectedBy([joint.index()])}
        for joint in joints
    ] + [set[int]()]
    actuators = {
        actuator.joint().name(): actuator
        for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
    }
    X_WB = robot.X_TB.GetAsMatrix4()
    X_BJ = robot.chain.joint_frames(np.zeros(n))
    masses, p_JCm, inertias = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(n):
        indices = [BodyIndex(index) for index in sorted(moved[k] - moved[k + 1])]
        M = plant.CalcSpatialInertia(context, plant.world_frame(), indices)
        X_WJ = X_WB @ X_BJ[k]
        R_WJ, p_WJ = X_WJ[:3, :3], X_WJ[:3, 3]
        masses[k] = M.get_mass()
        p_JCm[k] = R_WJ.T @ (M.get_com() - p_WJ)
        about_com = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        inertias[k] = R_WJ.T @ about_com @ R_WJ
    return ChainDynamics(
        chain=robot.chain,
        gravity=X_WB[:3, :3].T @ plant.gravity_field().gravity_vector(),
        masses=masses,
        p_JCm=p_JCm,
        inertias=inertias,
        damping=np.array([joint.default_damping_vector()[0] for joint in joints]),
        rotor_inertias=np.array([actuators[name].default_reflected_inertia() for name in names]),
    )
