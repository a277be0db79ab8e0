"""Moves that an arm can execute in scenes, with margins, and reasons of failures.

Frames: T the support (tray), O an object, G the gripper.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import Shape
from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.margins import compute_margins
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.interfaces import Move, PickPlaceCommand
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.station.command_schedule import build_command_schedule
from drake_clutter.tasks.belief import legal_moves

PLANNED = "planned"
"""Result of a move with a plan; all other results are values of `PlanningFailureReason`."""
IMPOSSIBLE_RESULTS = frozenset(
    reason.value
    for reason in (
        PlanningFailureReason.NO_FREE_PLACEMENT,
        PlanningFailureReason.CARRIES_OTHERS,
        PlanningFailureReason.NO_SEAL,
        PlanningFailureReason.NO_OPPOSED_FACES,
        PlanningFailureReason.PLACE_IN_COLLISION,
        PlanningFailureReason.PLACE_TILTED,
        PlanningFailureReason.PLACE_UNSUPPORTED,
        PlanningFailureReason.PLACE_OFF_BALANCE,
    )
)
"""Results that no arm changes: no room, objects on top, or no tool that holds the object."""
MAX_OPTIMIZED_MOVES = 5
"""Number of moves of a scene whose motions are optimized, for their cycle times."""
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
        place_qw: w of the quaternion of R_TO where the object is released; NaN without a place.
        place_qx: x of it.
        place_qy: y of it.
        place_qz: z of it.
        possible: Whether the scene and the tools allow the move, see `IMPOSSIBLE_RESULTS`.
        result: `PLANNED`, or the value of a `PlanningFailureReason`.
        detail: See `PlanningFailure.detail`; without a free placement, the place.
        failure_value: Quantity that the failure refers to [m, kg or s]; NaN without one.
        planning_s: Planning time [s].
        cycle_s: Duration of the optimized motion from home to home with the dwells of the gripper
            [s]; NaN for moves beyond the first of a random order.
        unoptimized_s: Duration of the motion before trajectory optimization, likewise [s].
        num_attempts: Number of candidates (grasps and IK solutions) that were checked.
        clearance: Smallest distance between two bodies on the path [m]; infinite if all are above
            3 cm.
        nearest_pair: Names of the two bodies at the smallest distance.
        joint_margin: See `MoveMargins`; as the five columns that follow.
        singular_value: See `MoveMargins`.
        manipulability: See `MoveMargins`.
        torque_share: See `MoveMargins`.
        load_share: See `MoveMargins`.
        num_ik_solutions: See `MoveMargins`.
        num_connected: See `MoveMargins`.
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
    place_qw: float = math.nan
    place_qx: float = math.nan
    place_qy: float = math.nan
    place_qz: float = math.nan
    possible: bool = False
    result: str = PlanningFailureReason.NO_FREE_PLACEMENT.value
    detail: str = ""
    failure_value: float = math.nan
    planning_s: float = 0.0
    cycle_s: float = math.nan
    unoptimized_s: float = math.nan
    num_attempts: int = 0
    clearance: float = math.nan
    nearest_pair: str = ""
    joint_margin: float = math.nan
    singular_value: float = math.nan
    manipulability: float = math.nan
    torque_share: float = math.nan
    load_share: float = math.nan
    num_ik_solutions: int = 0
    num_connected: int = 0
    tool: str = ""


MOVE_RECORD_FIELDS = {field.name: field.type for field in fields(MoveRecord)}
"""Columns of `moves.csv`, with their types."""


@dataclass(frozen=True)
class LegalMove:
    """A legal move of a scene with its place.

    Attributes:
        move: What to pick, and on what to place it.
        command: The move with its poses; None without a free placement.
    """

    move: Move
    command: PickPlaceCommand | None


class FeasibilityStudy:
    """Plans the legal moves of scenes with one arm.

    Equal seeds give equal results, except for the planning times.
    """

    def __init__(self, setup: str, config: ClutterConfig, seed: int) -> None:
        """Create a study.

        Args:
            setup: Name of the work cell in the records.
            config: Configuration of the simulated world with the work cell.
            seed: Seed of the placements.
        """
        self._setup = setup
        self._config = config
        self._seed = seed
        self._detector = LabelDetector(config.cell.camera)
        self._planners: dict[bool, PickPlacePlanner] = {}

    def plan_all_moves(self, name: str, index: int, scene: Scene) -> list[MoveRecord]:
        """Plan every legal move in a scene; of a few, the motions are optimized.

        Args:
            name: Name of the scene in the records.
            index: Index of the scene, from which the placements are seeded.
            scene: The scene, at rest.
        """
        legal = find_legal_moves(scene, self._detector, self._config, self._seed, index)
        return self.plan_moves(name, index, scene, legal, MAX_OPTIMIZED_MOVES)

    def plan_moves(
        self, name: str, index: int, scene: Scene, legal: Sequence[LegalMove], num_optimized: int
    ) -> list[MoveRecord]:
        """Plan legal moves of a scene.

        Args:
            name: Name of the scene in the records.
            index: Index of the scene.
            scene: The scene, at rest.
            legal: The moves.
            num_optimized: Largest number of moves whose motions are optimized.
        """
        records = [self._plan_move(name, scene, move) for move in legal]
        # The same moves in every setup in which the same moves are possible.
        order = item_rng(self._seed, index, len(legal)).permutation(len(legal)).tolist()
        for k in [k for k in order if records[k].possible][:num_optimized]:
            if records[k].result == PLANNED:
                records[k] = replace(records[k], cycle_s=self._cycle_time(scene, legal[k]))
        return records

    def planner(self, scene: Scene, *, optimize: bool) -> PickPlacePlanner:
        """Return the planner for the support of a scene; that of the latest support is cached.

        Args:
            scene: The scene.
            optimize: Whether motions are optimized.
        """
        planner = self._planners.get(optimize)
        if planner is None or planner.cell.support != scene.support:
            cell = self._config.cell.with_support(scene.support)
            planner = PickPlacePlanner(cell, PlannerConfig(optimize=optimize))
            self._planners[optimize] = planner
        return planner

    def _cycle_time(self, scene: Scene, legal: LegalMove) -> float:
        """Return the duration of the optimized motion of a planned move with the dwells [s]."""
        assert legal.command is not None
        planner = self.planner(scene, optimize=True)
        plan = planner.plan(scene.objects, legal.move.pick, legal.command.X_TO_place)
        if isinstance(plan, PlanningFailure):
            return math.nan
        return round(build_command_schedule(plan, planner.cell).end_time, 4)

    def _plan_move(self, name: str, scene: Scene, legal: LegalMove) -> MoveRecord:
        """Return the record of a move."""
        move, command = legal.move, legal.command
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
        place_x, place_y, place_z = (round(v, 6) for v in command.X_TO_place.translation)
        qw, qx, qy, qz = command.X_TO_place.quaternion
        planner = self.planner(scene, optimize=False)
        plan = planner.plan(scene.objects, move.pick, command.X_TO_place)
        record = replace(
            record,
            place_x=place_x,
            place_y=place_y,
            place_z=place_z,
            place_qw=qw,
            place_qx=qx,
            place_qy=qy,
            place_qz=qz,
            planning_s=round(plan.planning_time, 4),
        )
        if isinstance(plan, PlanningFailure):
            result = plan.reason.value
            return replace(
                record,
                possible=result not in IMPOSSIBLE_RESULTS,
                result=result,
                detail=plan.detail,
                failure_value=plan.value,
            )
        return replace(record, **_plan_columns(plan, planner))


def _plan_columns(plan: PickPlacePlan, planner: PickPlacePlanner) -> dict[str, Any]:
    """Return the columns of a record that describe a plan."""
    nearest = min(
        (segment.min_distance for segment in plan.segments),
        key=lambda signed_distance: signed_distance.distance,
    )
    margins = asdict(compute_margins(plan, planner.cell, planner.tools[plan.tool]))
    return {
        "possible": True,
        "result": PLANNED,
        "unoptimized_s": round(build_command_schedule(plan, planner.cell).end_time, 4),
        "num_attempts": plan.num_attempts,
        "clearance": round(nearest.distance, 6),
        "nearest_pair": " and ".join(nearest.pair) if math.isfinite(nearest.distance) else "",
        "tool": plan.tool,
        **{
            name: round(value, 6) if isinstance(value, float) else value
            for name, value in margins.items()
        },
    }


def find_legal_moves(
    scene: Scene, detector: LabelDetector, config: ClutterConfig, seed: int, index: int
) -> tuple[LegalMove, ...]:
    """Return the legal moves of a scene with their places.

    They depend on the scene and the first camera, but not on the arm.

    Args:
        scene: The scene, at rest.
        detector: Detector with the first camera.
        config: Configuration of the simulated world.
        seed: Seed of the placements.
        index: Index of the scene, from which the placements are seeded.
    """
    observation = detector.perceive(scene).observation
    return tuple(
        LegalMove(
            move,
            resolve_placement(move, observation, config.exploration, item_rng(seed, index, k)),
        )
        for k, move in enumerate(legal_moves(observation))
    )


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
