"""Playback of a reaching policy in closed loop in the simulated station.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from torch import Tensor

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Scene
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.station_simulation import TIME_STEP
from training.reaching_demonstrations import Demonstration, object_target
from training.reaching_policy import LOOKAHEAD, ReachingPolicy

Floats = NDArray[np.float64]

CONTROL_PERIOD = 0.05
"""Period of the policy's actions [s]: 20 Hz."""
COMMAND_PERIOD = 0.01
"""Period of the interpolated commands between two actions [s]."""
TIME_LIMIT = 10.0
"""Largest time of a playback [s]."""
STOP_CHANGE = 0.003
"""Change of a joint below which a waypoint counts as reached [rad]."""
NUM_STOPS = 5
"""Number of successive actions below `STOP_CHANGE` at which the policy has stopped."""
MAX_DISPLACEMENT = 0.010
"""Largest displacement of the picked object in a playback that reaches it [m]."""


class Controller:
    """A policy that controls the arm towards the pick of one move."""

    def __init__(self, policy: ReachingPolicy, demonstration: Demonstration) -> None:
        """Look at the image, if the policy needs one.

        Args:
            policy: Policy.
            demonstration: Move, of which only scene, pick and image are used.
        """
        self._policy = policy
        self._pick = demonstration.pick
        self._kinematics = ToolKinematics(demonstration.cell, demonstration.tool)
        self._seen: Tensor | None = None
        if policy.observation == "depth":
            assert demonstration.image is not None
            with torch.inference_mode():
                self._seen = policy.find_target(torch.from_numpy(demonstration.image[None]))

    def waypoint_change(self, q: Floats, scene: Scene) -> Floats:
        """Return the change of the joint angles within `LOOKAHEAD` [rad]. Shape (n,).

        Args:
            q: Joint angles [rad]. Shape (n,).
            scene: Scene, for a policy that sees the state.
        """
        X_TG = self._kinematics.pose(q)
        target = self._seen
        if target is None:
            target = torch.from_numpy(object_target(scene, self._pick)[None].astype(np.float32))
        inputs = [
            torch.from_numpy(x[None].astype(np.float32)) for x in (q, X_TG[:3, 3], X_TG[:3, 2])
        ]
        with torch.inference_mode():
            change = self._policy(*inputs, target)[0].double().numpy()
        return np.append(change, 0.0)


@dataclass(frozen=True)
class Playback:
    """Record of a played move.

    Attributes:
        move: Episode and number of the action.
        object_class: Class of the picked object.
        reached: Whether the cup ends where it can attach to the object, which has not moved by more
            than `MAX_DISPLACEMENT`.
        duration: Time until the policy stopped [s].
        stopped: Whether it stopped before the time limit.
        distance_mm: Distance of the cup from the demonstrated grasp [mm].
        height_mm: Height of the cup above the top of the object [mm].
        tilt_deg: Tilt of the cup from the vertical [deg].
        displacement_mm: Displacement of the object [mm].
    """

    move: str
    object_class: str
    reached: bool
    duration: float
    stopped: bool
    distance_mm: float
    height_mm: float
    tilt_deg: float
    displacement_mm: float


def play(policy: ReachingPolicy, demonstration: Demonstration) -> Playback:
    """Return how a policy reaches for the pick of a move, in closed loop in the station."""
    d = demonstration
    scene_object = d.scene[d.pick]
    others = [o for o in d.scene.objects if o.name != d.pick]
    station = ClutterStation(
        d.cell,
        [(d.pick, scene_object.object_class)],
        time_step=TIME_STEP,
        fixed_objects=others,
    )
    simulator = Simulator(station)
    root = simulator.get_mutable_context()
    robot = load_robot(d.cell.robot)
    station.set_state(root, robot.home, [scene_object])
    num_actuated = d.cell.gripper.num_actuated_joints
    station.GetInputPort("gripper_command").FixValue(root, np.zeros(2 * num_actuated))
    if station.vacuum_system is not None:
        station.GetInputPort("hold").FixValue(root, np.zeros(len(d.cell.gripper.tools)))
    dynamics = arm_dynamics(d.cell, Payload())
    context = station.plant_context(root)
    controller = Controller(policy, d)
    commanded = robot.home.copy()
    num_stops = 0
    while simulator.get_context().get_time() < TIME_LIMIT and num_stops < NUM_STOPS:
        q = station.joint_positions(context)
        scene = d.scene.with_poses(station.scene_plant.poses(context))
        change = controller.waypoint_change(q, scene)
        num_stops = num_stops + 1 if np.abs(change).max() < STOP_CHANGE else 0
        velocity = (q + change * CONTROL_PERIOD / LOOKAHEAD - commanded) / CONTROL_PERIOD
        velocity = np.clip(velocity, -robot.velocity_limits, robot.velocity_limits)
        for _ in range(round(CONTROL_PERIOD / COMMAND_PERIOD)):
            commanded = commanded + velocity * COMMAND_PERIOD
            torque = dynamics.inverse_dynamics(
                commanded[None], velocity[None], np.zeros_like(velocity)[None]
            )[0]
            command = np.concatenate([commanded, velocity, torque])
            station.GetInputPort("command").FixValue(root, command)
            simulator.AdvanceTo(simulator.get_context().get_time() + COMMAND_PERIOD)
    X_OG = station.tool_pose_in_object(context, d.tool, d.pick)
    X_TG = station.arm.tools[d.tool].CalcPoseInWorld(context)
    end = ToolKinematics(d.cell, d.tool).pose(d.q[-1])[:3, 3]
    final = d.scene.with_poses(station.scene_plant.poses(context))
    offset = final[d.pick].X_TO.p - scene_object.X_TO.p
    axis = X_TG.rotation().matrix()[:, 2]
    values = {
        "duration": simulator.get_context().get_time(),
        "distance_mm": 1000 * np.linalg.norm(X_TG.translation() - end),
        "height_mm": 1000 * (X_TG.translation()[2] - final[d.pick].top_height),
        "tilt_deg": math.degrees(math.acos(min(1.0, -axis[2]))),
        "displacement_mm": 1000 * np.linalg.norm(offset),
    }
    return Playback(
        move=d.name,
        object_class=scene_object.object_class.name,
        reached=bool(
            d.cell.gripper.can_attach(d.tool, scene_object.object_class, X_OG)
            and np.linalg.norm(offset) <= MAX_DISPLACEMENT
        ),
        stopped=num_stops >= NUM_STOPS,
        **{name: round(float(value), 3) for name, value in values.items()},
    )
