"""Compiled dynamics of the arm against Drake's."""

from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, rng
from pydrake.multibody.tree import MultibodyForces

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.planning.arm_dynamics import arm_dynamics, dynamics_plant
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot

GANTRY = """<?xml version="1.0"?>
<robot name="gantry">
  <link name="base"/>
  <link name="slide">
    <inertial>
      <origin xyz="0.1 0 0.2"/>
      <mass value="3"/>
      <inertia ixx="0.2" ixy="0.01" ixz="0" iyy="0.3" iyz="0.02" izz="0.1"/>
    </inertial>
  </link>
  <link name="hand">
    <inertial>
      <origin xyz="0 0.05 0.1"/>
      <mass value="2"/>
      <inertia ixx="0.02" ixy="0" ixz="0.003" iyy="0.03" iyz="0" izz="0.01"/>
    </inertial>
  </link>
  <joint name="swing" type="revolute">
    <parent link="base"/><child link="slide"/>
    <origin xyz="0 0 0.4" rpy="0.3 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="2" effort="100"/>
    <dynamics damping="0.7"/>
  </joint>
  <joint name="reach" type="prismatic">
    <parent link="slide"/><child link="hand"/>
    <origin xyz="0.2 0 0.1" rpy="0 0.5 0"/><axis xyz="0.6 0 0.8"/>
    <limit lower="-1" upper="1" velocity="1" effort="100"/>
  </joint>
  <transmission>
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="swing"/>
    <actuator name="motor">
      <drake:rotor_inertia xmlns:drake="https://drake.mit.edu" value="0.001"/>
      <drake:gear_ratio xmlns:drake="https://drake.mit.edu" value="20"/>
    </actuator>
  </transmission>
</robot>
"""


def gantry(folder: Path) -> WorkCell:
    """Return a cell with a damped revolute joint below a prismatic one, on a tilted base."""
    (folder / "gantry.urdf").write_text(GANTRY)
    robot = DEFAULT_CELL.robot.model_copy(
        update={
            "model": str(folder / "gantry.urdf"),
            "base_link": "base",
            "tool_frame": "hand",
            "home": (0.1, 0.1),
            "ik": "numerical",
            "limits": DEFAULT_CELL.robot.limits.model_copy(
                update={"velocity": None, "acceleration": (4.0, 2.0), "jerk": None}
            ),
        }
    )
    return DEFAULT_CELL.model_copy(update={"robot": robot})


@pytest.mark.parametrize("payload", [Payload(), Payload(0.7, (0.01, -0.02, 0.08), 2.0)])
@pytest.mark.parametrize("name", ["default", "tilted", "iiwa14", "gantry"])
def test_compiled_dynamics_equal_drakes(name: str, payload: Payload, tmp_path: Path) -> None:
    if name == "gantry":
        cell = gantry(tmp_path)
    elif name == "iiwa14":
        cell = load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml"))
    else:
        cell = DEFAULT_CELL if name == "default" else cell_with("robot.base.pitch=10")
    robot = load_robot(cell.robot)
    dynamics = arm_dynamics(cell, payload)
    generator = rng(3)
    q, v, a = (generator.uniform(-1, 1, (5, robot.num_joints)) for _ in range(3))
    p_FC = np.array([[0.0, 0.0, 0.0], [0.1, -0.05, 0.3]])
    motion = dynamics.motion(q, v, a, p_FC)
    torques = motion.dynamic_torques + motion.gravity_torques
    assert dynamics.inverse_dynamics(q, v, a) == pytest.approx(torques, abs=0)
    rest = np.zeros_like(q)
    assert dynamics.inverse_dynamics(q, rest, rest) == pytest.approx(
        motion.gravity_torques, abs=1e-9
    )

    plant = dynamics_plant(cell, payload)
    context = plant.CreateDefaultContext()
    flange = plant.GetFrameByName(cell.robot.tool_frame)
    world = plant.world_frame()
    R_BW = robot.X_TB.rotation().inverse().matrix()
    forces = MultibodyForces(plant)
    for k in range(len(q)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        expected = plant.CalcInverseDynamics(context, a[k], forces)
        assert torques[k] == pytest.approx(expected, abs=1e-9)
        assert np.abs(expected).max() > 1.0
        spatial = flange.CalcSpatialVelocity(context, world, world)
        R_WF = flange.CalcPoseInWorld(context).rotation().matrix()
        for point in range(2):
            r = R_WF @ p_FC[point]
            velocity = spatial.translational() + np.cross(spatial.rotational(), r)
            assert motion.velocities[k, point] == pytest.approx(R_BW @ velocity, abs=1e-9)
        # Central differences of the velocity, in the direction of motion.
        step = 1e-5
        before, after = (
            dynamics.motion(
                (q[k] + t * v[k] + t * t / 2 * a[k])[None], (v[k] + t * a[k])[None], a[:1], p_FC
            ).velocities[0]
            for t in (-step, step)
        )
        assert motion.accelerations[k] == pytest.approx((after - before) / (2 * step), abs=1e-6)
