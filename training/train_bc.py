"""Clone a policy that reaches for a pick from recorded moves, and play it back in the station.

    drake-clutter record --scenes random --nodes 12 --cell models/cells/ur10_single_cup_tray.yaml \
        --policy random --episodes 250 --rate 30 --cameras overhead --channels depth,segmentation \
        --resolution 320x240 --image-rate 0.1 --workers 2 --out runs/moves
    python training/train_bc.py train --set observation=state --out runs/bc_state
    python training/train_bc.py train --set observation=depth --out runs/bc_depth
    python training/train_bc.py evaluate runs/bc_state runs/bc_depth --out runs/bc.json

The policy sees the joint angles and a target: the top of the picked object, and how far its
neighbors rise above it, from the state of the scene or from the overhead depth image with the mask
of the object. Its action is a waypoint: the change of the joint angles within `LOOKAHEAD`.
Demonstrations are the recorded commands between home and the grasp. States next to them are
sampled, too, and lead to the same waypoints, so that the policy returns to its way. The angle of
the last joint, about the cup's axis, is left as it is.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from torch import Tensor, nn
from torch.nn import functional

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_checkpoint,
    load_tensors,
    restore_learner,
    save_tensors,
)
from drake_clutter.learning.training_run import TrainingRun
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.recording.hdf5_file import load_episode
from drake_clutter.recording.recorded_episode import RecordedAction
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import PHASES
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.seeding import item_rng
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import Count, Flag, Positive, Seed, config_class, load_config_as
from training.results_file import ResultsFile, Row, collect_records
from training.script import (
    ConfigOption,
    ResultsOption,
    SettingsOption,
    WorkersOption,
    print_table,
    run_script,
)
from training.training_loop import Metrics, OutOption, train_to_end

Floats = NDArray[np.float64]

CHECKPOINT = "policy.safetensors"
"""File name of the trained policy in the folder of a run."""
CHECKPOINT_KIND = "reaching policy"
"""Kind of the checkpoint."""
CAMERA = "overhead"
"""Camera of the recorded images."""
LOOKAHEAD = 0.2
"""Time to the waypoint that the policy predicts [s]."""
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
NEIGHBORHOOD = 0.15
"""Horizontal distance from the target within which objects are its neighbors [m]."""
MAX_DISPLACEMENT = 0.010
"""Largest displacement of the picked object in a playback that reaches it [m]."""
STATES_PER_MOVE = 8
"""States of a demonstration in a batch."""
TIME_STEP = 0.0025
"""Time step of the plant [s]."""
CROP = 64
"""Side of the part of the depth image around the mask of the object [px]."""
PERTURBATIONS = (0.002, 0.15)
"""Range of the standard deviation of sampled offsets from demonstrated joint angles [rad]."""


@config_class
class CloningConfig:
    """Configuration of a training.

    Attributes:
        data: Folder that `drake-clutter record` wrote.
        observation: Where the target comes from: `state` or `depth`.
        held_out: Number of moves, of the last episodes, that are not learned from.
        seed: Random seed.
        steps: Number of batches.
        batch_size: States in a batch.
        learning_rate: Learning rate of Adam at the start; it decreases to 0 as a cosine.
        perturb: Whether to sample states next to the demonstrations.
        evaluate_every: Steps between two evaluations.
    """

    data: str = "runs/moves"
    observation: Literal["state", "depth"] = "state"
    held_out: Count = 100
    seed: Seed = 0
    steps: Count = 6000
    batch_size: Count = 256
    learning_rate: Positive = 1e-3
    perturb: Flag = True
    evaluate_every: Count = 500


CONFIG = CloningConfig()
"""Default configuration."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Recorded move up to its grasp.

    Attributes:
        name: Episode and number of the action.
        cell: Work cell.
        scene: Scene at the start.
        pick: Name of the picked object.
        tool: Name of the tool.
        time: Times of the commands [s]. Shape (m,).
        q: Commanded joint angles [rad]. Shape (m, n).
        target: Top of the object and rise of its neighbors [m], see `object_target`. Shape (4,).
        image: Points of the depth image around the object, relative to `window`, their height, and
            the mask of the object. None without images. Shape (4, CROP, CROP), see `crop_image`.
    """

    name: str
    cell: WorkCell
    scene: Scene
    pick: str
    tool: str
    time: Floats
    q: Floats
    target: Floats
    image: NDArray[np.float32] | None


def object_target(scene: Scene, name: str) -> Floats:
    """Return the target of a pick: where it is, and how far its neighbors rise above it.

    Args:
        scene: Scene.
        name: Name of the picked object.

    Returns:
        Center of the object with the height of its highest point, and the height of the highest
        object within `NEIGHBORHOOD` above that, at least 0 [m]. Shape (4,).
    """
    picked = scene[name]
    center = picked.X_TO.p[:2]
    rise = 0.0
    for other in scene.objects:
        low, high = other.bounds_T
        gap = np.maximum(np.maximum(low[:2] - center, center - high[:2]), 0.0)
        if other.name != name and np.linalg.norm(gap) <= NEIGHBORHOOD:
            rise = max(rise, other.top_height - picked.top_height)
    return np.array([*center, picked.top_height, rise])


def crop_image(action: RecordedAction, cell: WorkCell, index: int) -> NDArray[np.float32] | None:
    """Return the first image of an action around the picked object.

    Args:
        action: Action.
        cell: Work cell.
        index: Index of the picked object in the segmentation.

    Returns:
        Positions x, y and z in T of the points that the camera sees [m], and the mask of the
        object. None if the object is not in an image. Shape (4, CROP, CROP).
    """
    images = action.images.get(CAMERA)
    if images is None or images.depth is None or images.segmentation is None:
        return None
    mask = images.segmentation[0] == index + 1
    if not mask.any():
        return None
    depth = images.depth[0].astype(float)
    depth = depth / 1000 if images.depth.dtype == np.uint16 else depth
    height, width = depth.shape
    fx, fy, cx, cy = images.intrinsics
    row, column = np.indices(depth.shape)
    p_C = np.stack([(column - cx) / fx * depth, (row - cy) / fy * depth, depth])
    X_TC = Pose(tuple(images.X_TC[0, 4:].tolist()), tuple(images.X_TC[0, :4].tolist()))
    p_T = np.einsum("ij,jhw->ihw", X_TC.rotation, p_C) + X_TC.p[:, None, None]
    p_T[:, depth == 0] = 0.0
    rows, columns = np.nonzero(mask)
    top = int(np.clip(rows.mean() - CROP / 2, 0, height - CROP))
    left = int(np.clip(columns.mean() - CROP / 2, 0, width - CROP))
    window = np.s_[:, top : top + CROP, left : left + CROP]
    return np.concatenate([p_T, mask[None]])[window].astype(np.float32)


def read_demonstrations(folder: Path) -> list[Demonstration]:
    """Return the moves of a data set that grasped their object, in order.

    Raises:
        InputError: The folder has no episodes, or they are of several cells.
    """
    paths = sorted((folder / "episodes").glob("*.h5"))
    catalog = load_catalog()
    demonstrations = list[Demonstration]()
    for path in paths:
        episode = load_episode(path, catalog)
        for number, action in enumerate(episode.actions):
            samples = action.samples
            names = list(episode.initial_scene.names)
            index = names.index(action.move.pick) if action.move.pick in names else -1
            if samples is None or index < 0 or index not in samples.held_object:
                continue
            grasp = np.flatnonzero(samples.phase == PHASES.index("grasp"))
            if not len(grasp):
                continue
            poses = {
                name: Pose(tuple(row[4:].tolist()), tuple(row[:4].tolist()))
                for name, row in zip(names, samples.X_TO[0], strict=True)
            }
            scene = episode.initial_scene.with_poses(poses)
            demonstrations.append(
                Demonstration(
                    name=f"{path.stem} {number}",
                    cell=episode.cell,
                    scene=scene,
                    pick=action.move.pick,
                    tool=action.tool,
                    time=samples.time[: grasp[0] + 1],
                    q=samples.q_commanded[: grasp[0] + 1],
                    target=object_target(scene, action.move.pick),
                    image=crop_image(action, episode.cell, index),
                )
            )
    if not demonstrations or len({d.cell for d in demonstrations}) > 1:
        raise InputError(f"data: {folder}; expected recorded moves of one cell, with grasps")
    return demonstrations


def split(
    demonstrations: Sequence[Demonstration], num_held_out: int
) -> tuple[list[Demonstration], list[Demonstration]]:
    """Return training and held-out moves; no episode is in both.

    Raises:
        InputError: There are not enough moves.
    """
    if len(demonstrations) < 2 * num_held_out:
        found = f"held_out: {num_held_out} of {len(demonstrations)} moves"
        raise InputError(f"{found}; expected at most half of them")
    first = demonstrations[-num_held_out].name.partition(" ")[0]
    held_out = [d for d in demonstrations if d.name.partition(" ")[0] >= first]
    return [d for d in demonstrations if d not in held_out], held_out[-num_held_out:]


class ToolKinematics:
    """Position and axis of a tool from joint angles."""

    def __init__(self, cell: WorkCell, tool: str) -> None:
        """Load the robot.

        Args:
            cell: Work cell.
            tool: Name of the tool.
        """
        self.robot = load_robot(cell.robot)
        self._X_TB = self.robot.X_TB.GetAsMatrix4()
        self._X_FG = cell.gripper.tools[tool].X_FG.GetAsMatrix4()

    def pose(self, q: Floats) -> tuple[Floats, Floats]:
        """Return p_TG [m] and the z axis of G in T, shapes (..., 3), at angles (..., n)."""
        X_TG = self._X_TB @ self.robot.forward_kinematics(np.ascontiguousarray(q)) @ self._X_FG
        return X_TG[..., :3, 3], X_TG[..., :3, 2]


class ReachingPolicy(nn.Module):
    """Network from joint angles, tool pose and target to the change of the joint angles.

    Attributes:
        observation: `state` or `depth`.
    """

    def __init__(self, observation: str, num_joints: int) -> None:
        """Create the network.

        Args:
            observation: `state` or `depth`.
            num_joints: Number of joints of the arm.
        """
        super().__init__()
        self.observation = observation
        self.attention = nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(8, 8, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(8, 1, 1),
        )
        size = 256
        self.head = nn.Sequential(
            nn.Linear(num_joints - 1 + 4 + 3 * 3 + 2 * 2, size),
            nn.SiLU(),
            nn.Linear(size, size),
            nn.SiLU(),
            nn.Linear(size, size),
            nn.SiLU(),
            nn.Linear(size, num_joints - 1),
        )
        self.action_scale: Tensor
        self.register_buffer("action_scale", torch.full((num_joints - 1,), 0.1))

    def find_target(self, images: Tensor) -> Tensor:
        """Return the target, of which the point is attended to. Shape (b, 4).

        Args:
            images: See `crop_image`. Shape (b, 4, CROP, CROP).
        """
        points, mask = images[:, :3], images[:, 3:]
        visible = mask > 0
        height = points[:, 2:]
        lowest = torch.where(visible, height, torch.inf).amin(dim=(2, 3), keepdim=True)
        highest = torch.where(visible, height, -torch.inf).amax(dim=(2, 3), keepdim=True)
        shown = torch.cat([10 * (height - highest), 10 * (height - lowest), mask], dim=1)
        logits = self.attention(shown).masked_fill(~visible, -torch.inf)
        weights = logits.flatten(2).softmax(dim=2)
        target = (points.flatten(2) * weights).sum(dim=2)
        offsets = points - target.detach()[:, :, None, None]
        is_near = ~visible & (offsets[:, :2].norm(dim=1, keepdim=True) <= NEIGHBORHOOD)
        rise = torch.where(is_near, offsets[:, 2:], 0.0).amax(dim=(2, 3))
        return torch.cat([target, rise], dim=1)

    def forward(self, q: Tensor, p_TG: Tensor, axis: Tensor, target: Tensor) -> Tensor:
        """Return the change of all joints but the last within `LOOKAHEAD` [rad].

        Args:
            q: Joint angles [rad]. Shape (b, n).
            p_TG: Position of the tool [m]. Shape (b, 3).
            axis: Axis of the tool in T. Shape (b, 3).
            target: Point to reach and rise of its neighbors [m]. Shape (b, 4).
        """
        offset = target[:, :3] - p_TG
        tilt = axis[:, :2]
        features = [
            q[:, :-1] / 2,
            target / 0.3,
            offset / 0.5,
            torch.tanh(offset / 0.05),
            torch.tanh(offset / 0.01),
            tilt,
            torch.tanh(tilt / 0.05),
        ]
        change: Tensor = self.head(torch.cat(features, dim=1)) * self.action_scale
        return change

    @staticmethod
    def load(path: Path) -> "ReachingPolicy":
        """Read a checkpoint."""
        checkpoint = load_checkpoint(path)
        if checkpoint.kind != CHECKPOINT_KIND:
            raise InputError(f"{path}: kind: {checkpoint.kind}; expected {CHECKPOINT_KIND}")
        policy = ReachingPolicy(
            str(checkpoint.metadata["observation"]), int(checkpoint.metadata["num_joints"])
        )
        policy.load_state_dict(checkpoint.weights)
        policy.eval()
        return policy


class CloningLearner:
    """Network and optimizer of a training.

    Attributes:
        step: Number of batches so far.
        network: The policy.
        losses: Losses of the latest batch.
    """

    def __init__(
        self,
        network: ReachingPolicy,
        demonstrations: Sequence[Demonstration],
        config: CloningConfig,
    ) -> None:
        """Start a training.

        Args:
            network: Policy.
            demonstrations: Moves to learn from.
            config: Configuration.
        """
        self.step = 0
        self.network = network
        self.losses = dict[str, float]()
        self._config = config
        self._sampler = StateSampler(demonstrations, perturb=config.perturb)
        self._optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
        if config.observation == "depth":
            images = [d.image for d in demonstrations if d.image is not None]
            self._images = torch.from_numpy(np.stack(images))

    def train_iteration(self) -> None:
        """Learn from one batch."""
        config = self._config
        progress = self.step / config.steps
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 + math.cos(math.pi * progress)) / 2
        batch = self._sampler.sample(config.batch_size, item_rng(config.seed, self.step))
        if config.observation == "depth":
            chosen, inverse = torch.unique(batch.index, return_inverse=True)
            target = self.network.find_target(self._images[chosen])[inverse]
        else:
            target = batch.target
        change = self.network(batch.q, batch.p_TG, batch.axis, target)
        loss = relative_error(change, batch.change).mean()
        self.losses = {"waypoint": loss.item()}
        if config.observation == "depth":
            # Where the demonstration ends, its tool is at the point to be found.
            point_loss = functional.l1_loss(target[:, :3], batch.end)
            self.losses["target_mm"] = 1000 * point_loss.item()
            loss = loss + 10 * point_loss
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        self.step += 1

    def save(self, path: Path) -> None:
        """Write the state from which `load` continues the training."""
        save_tensors(path, learner_tensors(self.network, self._optimizer), {"step": self.step})

    def load(self, path: Path) -> None:
        """Continue a training of the same config and seed where `save` was called."""
        tensors, state = load_tensors(path)
        restore_learner(self.network, self._optimizer, tensors)
        self.step = state["step"]


def relative_error(change: Tensor, expected: Tensor) -> Tensor:
    """Return the error of waypoints relative to their distance, shape (b,), from (b, n - 1).

    Close to the target, where waypoints are close, errors of milliradians count.
    """
    scale = expected.abs().amax(dim=1) + 0.01
    return (change - expected).abs().mean(dim=1) / scale


@dataclass(frozen=True, eq=False)
class StateBatch:
    """States with the waypoints of their demonstrations.

    Attributes:
        index: Index of the demonstration. Shape (b,).
        q: Joint angles [rad]. Shape (b, n).
        p_TG: Position of the tool [m]. Shape (b, 3).
        axis: Axis of the tool. Shape (b, 3).
        target: Target, see `object_target` [m]. Shape (b, 4).
        end: Position of the tool at the end of the demonstration [m]. Shape (b, 3).
        change: Change of the joint angles to the waypoint [rad]. Shape (b, n - 1).
    """

    index: Tensor
    q: Tensor
    p_TG: Tensor
    axis: Tensor
    target: Tensor
    end: Tensor
    change: Tensor


class StateSampler:
    """Samples states of demonstrations and next to them."""

    def __init__(self, demonstrations: Sequence[Demonstration], *, perturb: bool) -> None:
        """Compute waypoints.

        Args:
            demonstrations: Demonstrations.
            perturb: Whether to sample states next to them.
        """
        self._perturb = perturb
        self._kinematics = ToolKinematics(demonstrations[0].cell, demonstrations[0].tool)
        q, waypoints, index = list[Floats](), list[Floats](), list[int]()
        for k, d in enumerate(demonstrations):
            # The arm waits at the end, so that the policy learns to stop.
            period = float(np.median(np.diff(d.time)))
            times = np.arange(d.time[0], d.time[-1] + LOOKAHEAD, period)
            for array, shift in ((q, 0.0), (waypoints, LOOKAHEAD)):
                columns = [np.interp(times + shift, d.time, column) for column in d.q.T]
                array.append(np.column_stack(columns))
            index += [k] * len(times)
        self._q = np.concatenate(q)
        self._waypoints = np.concatenate(waypoints)
        self._index = np.array(index)
        self._first = np.searchsorted(self._index, np.arange(len(demonstrations) + 1))
        self._targets = np.array([d.target for d in demonstrations])
        self._ends = self._kinematics.pose(np.array([d.q[-1] for d in demonstrations]))[0]

    @property
    def action_scale(self) -> Floats:
        """Standard deviation of the changes of the joint angles [rad]. Shape (n - 1,)."""
        return np.asarray((self._waypoints - self._q)[:, :-1].std(axis=0))

    def sample(self, size: int, rng: np.random.Generator) -> StateBatch:
        """Return random states."""
        # Few demonstrations in a batch, because each has an image.
        moves = rng.integers(len(self._first) - 1, size=max(1, size // STATES_PER_MOVE))
        moves = np.repeat(moves, STATES_PER_MOVE)
        chosen = rng.integers(self._first[moves], self._first[moves + 1])
        size = len(chosen)
        q = self._q[chosen]
        if self._perturb:
            low, high = np.log(PERTURBATIONS)
            scale = np.exp(rng.uniform(low, high, (size, 1)))
            q = q + scale * rng.standard_normal(q.shape)
        return self._batch(chosen, q)

    def all_states(self) -> StateBatch:
        """Return all demonstrated states."""
        return self._batch(np.arange(len(self._q)), self._q)

    def _batch(self, chosen: NDArray[np.int64], q: Floats) -> StateBatch:
        index = self._index[chosen]
        p_TG, axis = self._kinematics.pose(q)
        change = (self._waypoints[chosen] - q)[:, :-1]
        arrays = (q, p_TG, axis, self._targets[index], self._ends[index], change)
        tensors = [torch.from_numpy(array.astype(np.float32)) for array in arrays]
        return StateBatch(torch.from_numpy(index), *tensors)


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
        p_TG, axis = self._kinematics.pose(q)
        target = self._seen
        if target is None:
            target = torch.from_numpy(object_target(scene, self._pick)[None].astype(np.float32))
        inputs = [torch.from_numpy(x[None].astype(np.float32)) for x in (q, p_TG, axis)]
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
    end, _ = ToolKinematics(d.cell, d.tool).pose(d.q[-1])
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


def train(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
) -> None:
    """Clone a policy and write policy.safetensors."""
    training = load_config_as(CONFIG, config, settings or ())
    torch.manual_seed(training.seed)
    demonstrations = read_demonstrations(Path(training.data))
    learned, held_out = split(_usable(demonstrations, training), training.held_out)
    num_joints = learned[0].q.shape[1]
    network = ReachingPolicy(training.observation, num_joints)
    learner = CloningLearner(network, learned, training)
    scale = StateSampler(learned, perturb=False).action_scale
    network.action_scale.copy_(torch.from_numpy(scale))
    run = TrainingRun(out, training, learner, training.steps)
    shown = StateSampler(held_out, perturb=False).all_states()
    images = [d.image for d in held_out if d.image is not None]

    def evaluate() -> tuple[Metrics, Metrics]:
        with torch.inference_mode():
            target = shown.target
            if training.observation == "depth":
                target = network.find_target(torch.from_numpy(np.stack(images)))[shown.index]
            change = network(shown.q, shown.p_TG, shown.axis, target)
            error = relative_error(change, shown.change).mean()
            distance = (target[:, :3] - shown.end).norm(dim=1).median()
        return {"held_out": float(error), "target_mm": 1000 * float(distance)}, learner.losses

    train_to_end(
        run,
        learner,
        training.steps,
        train_iteration=learner.train_iteration,
        evaluate=evaluate,
        evaluate_every=training.evaluate_every,
        save_every=training.evaluate_every,
    )
    metadata = {
        "kind": CHECKPOINT_KIND,
        "observation": training.observation,
        "num_joints": num_joints,
        "moves": len(learned),
    }
    run.finish(CHECKPOINT, network, metadata)


def _usable(
    demonstrations: Sequence[Demonstration], training: CloningConfig
) -> list[Demonstration]:
    """Return the moves that have what a policy observes."""
    return [d for d in demonstrations if training.observation == "state" or d.image is not None]


def load_run(folder: Path) -> tuple[ReachingPolicy, CloningConfig, Mapping[str, Any]]:
    """Return policy, configuration and metadata of a finished run."""
    metadata = load_checkpoint(folder / CHECKPOINT).metadata
    settings = load_config_as(CONFIG, folder / "config.yaml")
    return ReachingPolicy.load(folder / CHECKPOINT), settings, metadata


class Player:
    """Plays held-out moves; a worker for `map_ordered`."""

    def __init__(self, folder: Path) -> None:
        """Load policy and moves.

        Args:
            folder: Folder of a run.
        """
        torch.set_num_threads(1)
        self._policy, config, _ = load_run(folder)
        demonstrations = _usable(read_demonstrations(Path(config.data)), config)
        self._held_out = split(demonstrations, config.held_out)[1]

    def __call__(self, number: int) -> Playback:
        """Return the record of a held-out move."""
        return play(self._policy, self._held_out[number])


def evaluate(
    runs: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of runs.")],
    out: ResultsOption = None,
    workers: WorkersOption = 1,
) -> None:
    """Play the held-out moves in the station and write how many reach their pick."""
    rows = list[Row]()
    for folder in runs:
        _, config, metadata = load_run(folder)
        records = collect_records(
            folder / "playbacks.jsonl",
            {"policy": metadata["commits"], "steps": config.steps, "seed": config.seed},
            partial(Player, folder),
            range(config.held_out),
            schema=Playback,
            workers=workers,
        )
        reached = sum(record["reached"] for record in records)
        rows.append(
            {
                "observation": config.observation,
                "seed": config.seed,
                "moves": metadata["moves"],
                "held_out": len(records),
                "reached": reached / len(records),
                "reached_ci95": wilson_interval(reached, len(records)),
                "duration_s": float(np.median([record["duration"] for record in records])),
                "playbacks": records,
                "software_version": records[-1]["software_version"],
                "commit": records[-1]["commit"],
            }
        )
    header = {
        "lookahead_s": LOOKAHEAD,
        "control_period_s": CONTROL_PERIOD,
        "time_limit_s": TIME_LIMIT,
        "max_displacement_mm": 1000 * MAX_DISPLACEMENT,
    }
    if out:
        ResultsFile(out, header, ("observation", "seed")).add(*rows)
    print_table(
        [
            {
                "observation": row["observation"],
                "moves": row["moves"],
                "reached": f"{row['reached']:.2f} of {row['held_out']}",
                "median duration": f"{row['duration_s']:.1f} s",
            }
            for row in rows
        ]
    )


if __name__ == "__main__":
    run_script(train, evaluate)
