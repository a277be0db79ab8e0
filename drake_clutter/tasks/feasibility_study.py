"""Feasibility study: moves that an arm can execute in a work cell, and reasons of failures.

Frames: T the support (tray), O an object, G the gripper.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.catalog import Shape
from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.time_parameterization import sample_path
from drake_clutter.scenes.interfaces import Move, PickPlaceCommand
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.tasks.belief import legal_moves

PLANNED = "planned"
"""Result of a move with a plan; all other results are values of `PlanningFailureReason`."""
POSE_ERRORS = (0.002, 0.005, 0.010, 0.020, 0.040)
"""Standard deviations of the errors of estimated positions along x and along y [m]."""
YAW_ERROR_PER_METER = 500
"""Standard deviation of the yaw error per standard deviation of the position error [deg/m].

Half a degree per millimeter: both errors displace the ends of a 25 cm long object about equally.
"""
MAX_NOISY_MOVES = 6
"""Maximum number of planned moves per scene that are planned again with pose errors."""
CONTACT_TOLERANCE = 0.002
"""Penetration beyond the pose error that is tolerated between objects in contact [m]."""
BELOW_TOLERANCE = 0.004
"""Largest overlap in height of an object that is below another one [m]."""


@dataclass(frozen=True)
class MoveRecord:
    """One legal move in one scene with one arm; a row of `moves.csv`.

    Attributes:
        setup: Name of the work cell.
        scene: Name of the scene file.
        pick: Name of the picked object.
        place: Name of the object on which it is placed, or `tray`.
        object_class: Class of the picked object.
        resting_side: See `resting_side`.
        pick_x: x of the center of the picked object's top in T [m].
        pick_y: y of the center of the picked object's top in T [m].
        pick_top: Height of the picked object's top above the support [m].
        num_below: Number of objects below the picked one.
        place_x: x of p_TO where the object is released [m]; NaN without a free placement.
        place_y: y of p_TO where the object is released [m]; NaN without a free placement.
        place_z: z of p_TO where the object is released [m]; NaN without a free placement.
        result: `PLANNED`, or the value of a `PlanningFailureReason`.
        detail: See `PlanningFailure.detail`; without a free placement, the place.
        failure_value: Quantity that the failure refers to [m, kg or s]; NaN without one.
        planning_s: Planning time [s].
        motion_s: Duration of the motion from home to home [s].
        num_attempts: Number of candidates (grasps and IK solutions) that were checked.
        clearance: Smallest distance between two bodies on the path [m]; infinite if all are above
            3 cm.
        nearest_pair: Names of the two bodies at the smallest distance.
        manipulability: Smaller of the manipulabilities at the grasp and at the release [m^3].
        tool: Name of the gripper's tool that holds the object; "" without a plan.
    """

    setup: str
    scene: str
    pick: str
    place: str
    object_class: str
    resting_side: str
    pick_x: float
    pick_y: float
    pick_top: float
    num_below: int
    place_x: float = math.nan
    place_y: float = math.nan
    place_z: float = math.nan
    result: str = PlanningFailureReason.NO_FREE_PLACEMENT.value
    detail: str = ""
    failure_value: float = math.nan
    planning_s: float = 0.0
    motion_s: float = math.nan
    num_attempts: int = 0
    clearance: float = math.nan
    nearest_pair: str = ""
    manipulability: float = math.nan
    tool: str = ""


MOVE_RECORD_FIELDS = tuple(field.name for field in fields(MoveRecord))
"""Columns of `moves.csv`."""


@dataclass(frozen=True)
class PoseErrorRecord:
    """A plan for poses with errors, checked with the true poses; a row of `pose_errors.csv`.

    Attributes:
        setup: Name of the work cell.
        scene: Name of the scene file.
        pick: Name of the picked object.
        place: Name of the object on which it is placed, or `tray`.
        error: Standard deviation of the position error [m]; one of `POSE_ERRORS`.
        result: `holds` if the plan is valid with the true poses; otherwise `no plan`, `no seal`,
            or `hits NAME` with the name of the body in collision.
    """

    setup: str
    scene: str
    pick: str
    place: str
    error: float
    result: str


class FeasibilityStudy:
    """Plans the legal moves of scenes with one arm.

    Equal seeds give equal results, except for the planning times.
    """

    def __init__(
        self, setup: str, config: ClutterConfig, planner_config: PlannerConfig, seed: int
    ) -> None:
        """Create a study.

        Args:
            setup: Name of the work cell in the records.
            config: Configuration of the simulated world with the work cell.
            planner_config: Configuration of the planner.
            seed: Seed of the placements and the pose errors.
        """
        self._setup = setup
        self._config = config
        self._planner_config = planner_config
        self._seed = seed
        self._detector = LabelDetector(config.cell.camera)
        self._planner: PickPlacePlanner | None = None

    def plan_all_moves(self, name: str, index: int, scene: Scene) -> list[MoveRecord]:
        """Plan every legal move in a scene.

        Args:
            name: Name of the scene in the records.
            index: Index of the scene, from which the placements are seeded.
            scene: The scene, at rest.
        """
        observation = self._detector.perceive(scene).observation
        records = []
        for k, move in enumerate(legal_moves(observation)):
            rng = self._rng(index, k)
            command = resolve_placement(move, observation, self._config.exploration, rng)
            records.append(self._plan_move(name, scene, move, command))
        return records

    def _rng(self, *path: int) -> np.random.Generator:
        return item_rng(self._seed, *path)

    def planner(self, support: Support) -> PickPlacePlanner:
        """Return the planner for a support; the planner of the latest support is cached."""
        if self._planner is None or self._planner.cell.support != support:
            cell = self._config.cell.with_support(support)
            self._planner = PickPlacePlanner(cell, self._planner_config)
        return self._planner

    def _plan_move(
        self,
        name: str,
        scene: Scene,
        move: Move,
        command: PickPlaceCommand | None,
    ) -> MoveRecord:
        """Return the record of a move; `command` is None without a free placement."""
        picked = scene[move.pick]
        lower, upper = picked.bounds_T
        x, y = (lower[:2] + upper[:2]) / 2
        record = MoveRecord(
            setup=self._setup,
            scene=name,
            pick=move.pick,
            place=move.place,
            object_class=picked.object_class.name,
            resting_side=resting_side(picked),
            pick_x=round(float(x), 6),
            pick_y=round(float(y), 6),
            pick_top=round(picked.top_height, 6),
            num_below=len(objects_below(picked, scene.objects)),
        )
        if command is None:
            return replace(record, detail=move.place)
        X_TO = command.X_TO_place
        place_x, place_y, place_z = (round(v, 6) for v in X_TO.translation)
        planner = self.planner(scene.support)
        plan = planner.plan(scene.objects, move.pick, X_TO)
        record = replace(
            record,
            place_x=place_x,
            place_y=place_y,
            place_z=place_z,
            planning_s=round(plan.planning_time, 4),
        )
        if isinstance(plan, PlanningFailure):
            return replace(
                record, result=plan.reason.value, detail=plan.detail, failure_value=plan.value
            )
        carry = plan.segments[1].trajectory
        endpoints = carry.vector_values([0.0, carry.end_time()]).T
        nearest = min(
            (segment.min_distance for segment in plan.segments),
            key=lambda signed_distance: signed_distance.distance,
        )
        return replace(
            record,
            result=PLANNED,
            motion_s=round(plan.duration, 4),
            num_attempts=plan.num_attempts,
            clearance=round(nearest.distance, 6),
            nearest_pair=" and ".join(nearest.pair) if math.isfinite(nearest.distance) else "",
            manipulability=float(planner.robot.manipulability(endpoints).min()),
            tool=plan.tool,
        )

    def evaluate_pose_errors(
        self, name: str, index: int, scene: Scene, records: Sequence[MoveRecord]
    ) -> list[PoseErrorRecord]:
        """Plan moves again with pose errors, and check the plans with the true poses.

        At most `MAX_NOISY_MOVES` of the planned moves are drawn at random.

        Args:
            name: Name of the scene in the records.
            index: Index of the scene, from which the errors are seeded.
            scene: The scene, at rest.
            records: Result of `plan_all_moves`.
        """
        planned = [record for record in records if record.result == PLANNED]
        rng = self._rng(index, 1_000_000)
        planner = self.planner(scene.support)
        error_records = []
        for k in sorted(rng.permutation(len(planned))[:MAX_NOISY_MOVES].tolist()):
            record = planned[k]
            for error in POSE_ERRORS:
                estimated = [_with_pose_error(o, error, rng) for o in scene.objects]
                picked = next(o for o in estimated if o.name == record.pick)
                X_TO = Pose(
                    (record.place_x, record.place_y, record.place_z), picked.X_TO.quaternion
                )
                plan = planner.plan(estimated, record.pick, X_TO)
                result = "no plan"
                if isinstance(plan, PickPlacePlan):
                    result = self._check_plan(plan, scene, planner, error)
                error_records.append(
                    PoseErrorRecord(self._setup, name, record.pick, record.place, error, result)
                )
        return error_records

    def _check_plan(
        self, plan: PickPlacePlan, scene: Scene, planner: PickPlacePlanner, error: float
    ) -> str:
        """Return the result of a plan for estimated poses when it is executed with the true ones.

        Args:
            plan: The plan.
            scene: The scene with the true poses.
            planner: The planner.
            error: Standard deviation of the position error [m].
        """
        q_pick = plan.segments[1].trajectory.value(0.0).ravel()
        picked = scene[plan.pick]
        gripper = self._config.cell.gripper
        X_TG = RigidTransform(planner.tools[plan.tool].pose(q_pick))
        X_OG = rigid_transform(picked.X_TO).InvertAndCompose(X_TG)
        if not gripper.can_attach(plan.tool, picked.object_class, X_OG):
            return PlanningFailureReason.NO_SEAL.value
        collision_model = planner.collision_model(scene.objects)
        contact_bodies = (*gripper.tools[plan.tool].contact_links, plan.pick)
        for segment in plan.segments:
            collision_model.set_object_poses(scene.objects)
            holds = segment.name == "carry"
            collision_model.set_gripper_joints(plan.joints_held if holds else plan.joints_open)
            if holds:
                collision_model.attach_object(plan.pick, plan.tool, X_OG)
            else:
                collision_model.set_object_pose(
                    plan.pick, picked.X_TO if segment.name == "approach" else plan.X_TO_place
                )
            for q in sample_path(CubicSpline.from_trajectory(segment.trajectory)):
                for contact in collision_model.distances_below(q, 0.0):
                    # Expected contacts: of the gripper with the picked object, and of that object
                    # with its neighbors, whose poses have errors.
                    is_expected = plan.pick in contact.pair and contact.pair[0] in contact_bodies
                    if not is_expected or contact.distance < -error - CONTACT_TOLERANCE:
                        return f"hits {contact.pair[1]}"
        return "holds"


def _with_pose_error(o: SceneObject, error: float, rng: np.random.Generator) -> SceneObject:
    """Return an object with a random error of its pose.

    Args:
        o: The object.
        error: Standard deviation of the errors along x and along y [m].
        rng: Random generator.
    """
    dx, dy = rng.normal(0.0, error, 2)
    half_yaw = math.radians(rng.normal(0.0, YAW_ERROR_PER_METER * error)) / 2
    w, i, j, k = o.X_TO.quaternion
    c = math.cos(half_yaw)
    s = math.sin(half_yaw)
    # Quaternion product (c, 0, 0, s) * (w, i, j, k): a rotation about the vertical.
    quaternion = (
        c * w - s * k,
        c * i - s * j,
        c * j + s * i,
        c * k + s * w,
    )
    x, y, z = o.X_TO.translation
    return replace(o, X_TO=Pose((x + dx, y + dy, z), quaternion))


def resting_side(o: SceneObject) -> str:
    """Return how an object rests.

    Returns:
        For a cylinder `upright` or `lying`; otherwise `flat`, `side` or `upright`, if its shortest,
        middle or longest axis points up.
    """
    if o.object_class.shape is Shape.CYLINDER:
        return "upright" if abs(o.X_TO.rotation[2, 2]) > 0.5 else "lying"
    vertical_axis = int(np.argmax(np.abs(o.X_TO.rotation[2])))
    size_rank = int(np.argsort(np.argsort(o.object_class.size))[vertical_axis])
    return ("flat", "side", "upright")[size_rank]


def objects_below(picked: SceneObject, objects: Sequence[SceneObject]) -> list[str]:
    """Return the names of the objects below a picked object.

    The bounding box of such an object overlaps that of the picked object in x and y, and ends at
    most `BELOW_TOLERANCE` above its lower face.

    Args:
        picked: The picked object.
        objects: All objects of the scene.
    """
    lower, upper = picked.bounds_T
    names = []
    for other in objects:
        other_lower, other_upper = other.bounds_T
        overlap: NDArray[np.float64] = (
            np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
        )
        if (
            other is not picked
            and overlap.min() > 0
            and other_upper[2] < lower[2] + BELOW_TOLERANCE
        ):
            names.append(other.name)
    return names
