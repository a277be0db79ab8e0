"""An episode as it is recorded: attempted moves with samples and images.

Frames: T is the support and the world W of every simulation, G is a tool of the gripper, C is a
camera, z along its optical axis, y down.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import POSE_COLUMNS, ActionSamples
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.station.motion_recorder import DEFAULT_RATE

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraImages:
    """Images of one camera during an action.

    Attributes:
        time: Time of each of the f images since the start of the action [s]. Shape (f,).
        X_TC: Pose of the camera, as `POSE_COLUMNS`. Shape (f, 7).
        intrinsics: Focal lengths fx and fy and principal point cx, cy [px].
        rgb: Color images, or None. Shape (f, height, width, 3), uint8.
        depth: Distance along the optical axis, 0 where nothing is seen: float32 [m], or uint16
            [mm]; or None. Shape (f, height, width).
        segmentation: Index of the object + 1, 0 for anything else; or None. Shape
            (f, height, width), uint8 or uint16.
    """

    time: Floats
    X_TC: Floats
    intrinsics: tuple[float, float, float, float]
    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | NDArray[np.uint16] | None = None
    segmentation: NDArray[np.uint8] | NDArray[np.uint16] | None = None


@dataclass(frozen=True, eq=False)
class RecordedAction:
    """An attempted move.

    Attributes:
        move: The move, with the names of the scene.
        result: How it ended.
        detail: Reason why no plan was found, or a remark on the execution.
        failure_reason: Value of the `PlanningFailureReason` of a move without a plan; "" with one.
        instability: Object that fell and how; "" for none.
        tool: Name of the tool that the plan uses; "" without a plan.
        X_TO_place: Pose at which the object was to be released; None without a plan.
        samples: Samples; None if nothing was executed.
        images: Images by name of the camera.
        believed: Poses X_TO that the policy assumed when it chose the move, by name of its belief;
            empty if unknown.
    """

    move: Move
    result: MoveResult
    detail: str = ""
    failure_reason: str = ""
    instability: str = ""
    tool: str = ""
    X_TO_place: Pose | None = None
    samples: ActionSamples | None = field(default=None, repr=False)
    images: Mapping[str, CameraImages] = field(default_factory=dict, repr=False)
    believed: Mapping[str, Pose] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class EpisodeHeader:
    """What is known of an episode before it is recorded.

    Attributes:
        policy: Name of the policy.
        seed: Seed of the data set or of the episode.
        index: Number of the episode in the data set.
        scene_name: Name of the scene.
        rate: Samples per second [Hz].
    """

    policy: str
    seed: int
    index: int = 0
    scene_name: str = ""
    rate: float = DEFAULT_RATE


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode with the arm.

    Attributes:
        initial_scene: Scene before the first action, at rest.
        cell: Work cell, with the support of the scene.
        actions: Attempted moves in order.
        policy: Name of the policy.
        termination: Value of the `TerminationReason`.
        seed: Seed of the data set; -1 if unknown.
        index: Number of the episode in the data set.
        scene_name: Name of the scene, such as its file or its place in a scene set.
        rate: Samples per second [Hz].
        package_version: Version of this package.
        drake_version: Version of Drake.
        error: Message of the exception with which the policy ended the episode; "" for none.
        variation: What was randomized, as plain values.
    """

    initial_scene: Scene = field(repr=False)
    cell: WorkCell = field(repr=False)
    actions: tuple[RecordedAction, ...]
    policy: str
    termination: str
    seed: int
    index: int
    scene_name: str
    rate: float
    package_version: str
    drake_version: str
    error: str = ""
    variation: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def axes(self) -> dict[str, tuple[str, ...]]:
        """Names along each axis of `Channel.axes`."""
        gripper = self.cell.gripper
        tools = tuple(gripper.tools)
        joints = load_robot(self.cell.robot).joint_names
        actuators = gripper.joint_names[: gripper.num_actuated_joints]
        kinds = ("position", "velocity", "torque")
        return {
            "joints": joints,
            "commands": (*(f"{name} {kind}" for kind in kinds for name in joints), *actuators),
            "tools": tools,
            "cups": tools if isinstance(gripper, SuctionGripper) else (),
            "gripper_joints": gripper.joint_names,
            "gripper_actuators": actuators,
            "objects": self.initial_scene.names,
            "pose": POSE_COLUMNS,
        }

    @property
    def object_classes(self) -> tuple[str, ...]:
        """Name of each object's class."""
        return tuple(o.object_class.name for o in self.initial_scene.objects)
