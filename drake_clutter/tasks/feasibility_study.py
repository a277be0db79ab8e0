"""Kinematic feasibility: which moves an arm could carry out in which cell, and if not, why.

Frames: T the tray, O an object, G the cup.
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
"""The result of a move that has a plan; any other is a `PlanningFailureReason`'s value."""
POSE_ERRORS = (0.002, 0.005, 0.010, 0.020, 0.040)
"""m, standard deviations of the error of a pose along x and along y; its yaw has half a degree for each mm."""
MAX_NOISY_MOVES = 6
"""Planned moves per scene that are tried with wrong poses."""


@dataclass(frozen=True)
class MoveRecord:
    """One legal move in one scene with one arm: a row of `moves.csv`.

    Attributes:
        setup: name of the arm's config.
        scene: name of the scene file.
        pick, place: names of what is picked, and on what it is put.
        object_class: of the picked object. rest: which of its axes points up: flat, side, upright, or lying for a cylinder.
        pick_x, pick_y: m, middle of its top in T. pick_top: m, height of it. below: objects that lie under it.
        place_x, place_y, place_z: m, p_TO where it is let go; NaN if no place is free.
        result: `planned`, or why not. about: what is in the way, or out of reach.
        number: that stands behind the reason (m, kg, s), or NaN.
        planning_s: s to find out. motion_s: s from home to home.
        attempts: grasps and branches that were looked at.
        clearance: m, the least of the way; infinite if nothing is within 3 cm. between: what is so close.
        manipulability: m^3, the least at the grasp and at the place.
    """

    setup: str
    scene: str
    pick: str
    place: str
    object_class: str
    rest: str
    pick_x: float
    pick_y: float
    pick_top: float
    below: int
    place_x: float = math.nan
    place_y: float = math.nan
    place_z: float = math.nan
    result: str = PlanningFailureReason.NO_FREE_SPOT.value
    about: str = ""
    number: float = math.nan
    planning_s: float = 0.0
    motion_s: float = math.nan
    attempts: int = 0
    clearance: float = math.nan
    between: str = ""
    manipulability: float = math.nan


MOVE_RECORD_FIELDS = tuple(field.name for field in fields(MoveRecord))


@dataclass(frozen=True)
class PoseErrorRecord:
    """A planned move, planned again from wrong poses and checked against the right ones: a row of `noise.csv`.

    Attributes:
        setup, scene, pick, place: as in `MoveRow`.
        error: m, the standard deviation. result: `holds`, `no plan`, `no seal`, or what is hit.
    """

    setup: str
    scene: str
    pick: str
    place: str
    error: float
    result: str


class FeasibilityStudy:
    """Asks an arm about every legal move of scenes; the same answers for the same seed, but for the times."""

    def __init__(self, setup: str, world: ClutterConfig, planner: PlannerConfig, seed: int) -> None:
        """Of one arm, called `setup`."""
        self._setup, self._world, self._config, self._seed = setup, world, planner, seed
        self._detector = LabelDetector(world.cell.camera)
        self._planner: PickPlacePlanner | None = None

    def plan_all_moves(self, name: str, number: int, scene: Scene) -> list[MoveRecord]:
        """Every legal move in a scene at rest.

        Args:
            name: of the scene.
            number: of the scene: with the seed it decides where on the tray or on an object things are put.
            scene: at rest.
        """
        observation = self._detector.perceive(scene).observation
        return [
            self._row(
                name,
                scene,
                move,
                resolve_placement(move, observation, self._world.exploration, self._rng(number, k)),
            )
            for k, move in enumerate(legal_moves(observation))
        ]

    def _rng(self, *path: int) -> np.random.Generator:
        return item_rng(self._seed, *path)

    def planner(self, support: Support) -> PickPlacePlanner:
        """For a tray; kept."""
        if self._planner is None or self._planner.cell.support != support:
            self._planner = PickPlacePlanner(self._world.cell.with_support(support), self._config)
        return self._planner

    def _row(
        self,
        name: str,
        scene: Scene,
        move: Move,
        command: PickPlaceCommand | None,
    ) -> MoveRecord:
        picked = scene[move.pick]
        lower, upper = picked.bounds_T
        x, y = (lower[:2] + upper[:2]) / 2
        row = MoveRecord(
            self._setup,
            name,
            move.pick,
            move.place,
            picked.object_class.name,
            resting_side(picked),
            round(float(x), 6),
            round(float(y), 6),
            round(picked.top_height, 6),
            len(objects_below(picked, scene.objects)),
        )
        if command is None:
            return replace(row, about=move.place)
        X_TO = command.X_TO_place
        px, py, pz = (round(v, 6) for v in X_TO.translation)
        row = replace(row, place_x=px, place_y=py, place_z=pz)
        planner = self.planner(scene.support)
        found, robot = planner.plan(scene.objects, move.pick, X_TO), planner.tool.robot
        row = replace(row, planning_s=round(found.planning_time, 4))
        if isinstance(found, PlanningFailure):
            return replace(row, result=found.reason.value, about=found.detail, number=found.value)
        carry = found.segments[1].trajectory
        ends = carry.vector_values([0.0, carry.end_time()]).T
        nearest = min(
            (phase.min_distance for phase in found.segments),
            key=lambda clearance: clearance.distance,
        )
        return replace(
            row,
            result=PLANNED,
            motion_s=round(found.duration, 4),
            attempts=found.num_attempts,
            clearance=round(nearest.distance, 6),
            between=" and ".join(nearest.pair) if math.isfinite(nearest.distance) else "",
            manipulability=float(robot.manipulability(ends).min()),
        )

    def test_pose_errors(
        self, name: str, number: int, scene: Scene, rows: Sequence[MoveRecord]
    ) -> list[PoseErrorRecord]:
        """Some of the planned moves, planned from wrong poses: do the plans hold where the objects really are?"""
        planned = [row for row in rows if row.result == PLANNED]
        rng, planner, found = (
            self._rng(number, 1_000_000),
            self.planner(scene.support),
            list[PoseErrorRecord](),
        )
        for k in sorted(rng.permutation(len(planned))[:MAX_NOISY_MOVES].tolist()):
            row = planned[k]
            for error in POSE_ERRORS:
                believed = [_misjudged(o, error, rng) for o in scene.objects]
                picked = next(o for o in believed if o.name == row.pick)
                X_TO = Pose((row.place_x, row.place_y, row.place_z), picked.X_TO.quaternion)
                plan = planner.plan(believed, row.pick, X_TO)
                result = (
                    "no plan"
                    if isinstance(plan, PlanningFailure)
                    else self._holds(plan, scene, planner, error)
                )
                found.append(PoseErrorRecord(self._setup, name, row.pick, row.place, error, result))
        return found

    def _holds(
        self, plan: PickPlacePlan, scene: Scene, planner: PickPlacePlanner, error: float
    ) -> str:
        """Whether a plan that was made for other poses works with the right ones; else what goes wrong."""
        q = plan.segments[1].trajectory.value(0.0).ravel()
        picked, gripper = scene[plan.pick], self._world.cell.gripper
        X_TG = RigidTransform(planner.tool.pose(q))
        X_OG = rigid_transform(picked.X_TO).InvertAndCompose(X_TG)
        if not gripper.can_attach(picked.object_class, X_OG):
            return PlanningFailureReason.NO_SEAL.value
        around = planner.collision_model(scene.objects)
        touching = (*gripper.contact_links, plan.pick)
        for phase in plan.segments:
            around.set_object_poses(scene.objects)
            if phase.name == "carry":
                around.attach_object(plan.pick, X_OG)
            else:
                around.set_object_pose(
                    plan.pick, picked.X_TO if phase.name == "approach" else plan.X_TO_place
                )
            for at in sample_path(phase.trajectory):
                for here in around.distances_below(at, 0.0):
                    # The cup is pressed on; what the object leaves or comes to it may graze by as much as it is misjudged.
                    grazed = plan.pick in here.pair and here.pair[0] in touching
                    if not grazed or here.distance < -error - 0.002:
                        return f"hits {here.pair[1]}"
        return "holds"


def _misjudged(o: SceneObject, error: float, rng: np.random.Generator) -> SceneObject:
    x, y = rng.normal(0.0, error, 2)
    half = math.radians(rng.normal(0.0, 500 * error)) / 2
    w, i, j, k = o.X_TO.quaternion
    c, s = math.cos(half), math.sin(half)
    turned = (
        c * w - s * k,
        c * i - s * j,
        c * j + s * i,
        c * k + s * w,
    )  # about the vertical, on the left
    px, py, pz = o.X_TO.translation
    return replace(o, X_TO=Pose((px + x, py + y, pz), turned))


def resting_side(o: SceneObject) -> str:
    """Which of an object's axes points up."""
    if o.object_class.shape is Shape.CYLINDER:
        return "upright" if abs(o.X_TO.rotation[2, 2]) > 0.5 else "lying"
    up = int(np.argmax(np.abs(o.X_TO.rotation[2])))
    return ("flat", "side", "upright")[int(np.argsort(np.argsort(o.object_class.size))[up])]


def objects_below(picked: SceneObject, objects: Sequence[SceneObject]) -> list[str]:
    """The names of the objects under one, seen from above."""
    lower, upper = picked.bounds_T
    found = []
    for other in objects:
        other_lower, other_upper = other.bounds_T
        overlap: NDArray[np.float64] = (
            np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
        )
        if other is not picked and overlap.min() > 0 and other_upper[2] < lower[2] + 0.004:
            found.append(other.name)
    return found
