"""Moves planned from erroneous poses or masses, and simulated with the true ones.

Frames: T is the support, O is an object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import SpatialInertia

from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.move_study import PLANNED, MoveRecord
from drake_clutter.planning.pick_place_plan import PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import ANY_OVERLAP, PlannerConfig
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.scene_plant import pose_from_transform, rigid_transform
from drake_clutter.station.arm_executor import evaluate_outcome
from drake_clutter.station.station_simulation import StationSimulation

YAW_PER_METER = 500
"""Yaw error per position error of an object [deg/m]: half a degree per millimeter displaces the
ends of a 25 cm long object about as much as the position error."""
CALIBRATION_YAW_PER_METER = 100
"""Yaw error of a camera's calibration per position error [deg/m]."""
NO_PLAN = "no plan"
"""Result of a move without a plan from the erroneous data; all others are of `MoveResult`."""


class NoiseKind(Enum):
    """What the planner does not know exactly.

    Attributes:
        POSE: Pose of each object: position along x and y, and yaw.
        CALIBRATION: Pose of the camera: all objects are displaced and turned together, in height,
            too.
        MASS: Mass of the picked object.
    """

    POSE = "pose"
    CALIBRATION = "calibration"
    MASS = "mass"


NOISE_SIZES = {
    NoiseKind.POSE: (0.002, 0.005, 0.010, 0.020),
    NoiseKind.CALIBRATION: (0.002, 0.005, 0.010),
    NoiseKind.MASS: (0.1, 0.25, 0.5),
}
"""Standard deviations: of positions along each axis [m], of the mass as a fraction of it."""


@dataclass(frozen=True)
class NoiseRecord:
    """A move planned from erroneous data and simulated; a row of `noise.csv`.

    Attributes:
        setup: Name of the work cell.
        scene: Name of the scene file.
        pick: Name of the picked object.
        place: Name of the object on which it is placed, or `tray`.
        kind: Value of a `NoiseKind`.
        size: Standard deviation of the error, see `NOISE_SIZES` [m or 1].
        result: Value of the `MoveResult` in simulation, or `NO_PLAN`.
        detail: Why there is no plan, or how the object was placed.
    """

    setup: str
    scene: str
    pick: str
    place: str
    kind: str
    size: float
    result: str
    detail: str


NOISE_RECORD_FIELDS = {field.name: field.type for field in fields(NoiseRecord)}
"""Columns of `noise.csv`, with their types."""


class NoiseStudy:
    """Plans moves from erroneous data, and simulates them to the end with the true ones."""

    def __init__(self, setup: str, config: ClutterConfig, seed: int) -> None:
        """Create a study.

        Args:
            setup: Name of the work cell in the records.
            config: Configuration of the simulated world with the work cell.
            seed: Seed of the errors.
        """
        self._setup = setup
        self._config = config
        self._seed = seed

    def simulate_moves(
        self, name: str, index: int, scene: Scene, records: Sequence[MoveRecord], count: int
    ) -> list[NoiseRecord]:
        """Simulate some of the planned moves of a scene with errors of every kind and size.

        Args:
            name: Name of the scene in the records.
            index: Index of the scene, from which the errors are seeded.
            scene: The scene, at rest.
            records: Result of `FeasibilityStudy.plan_all_moves`.
            count: Largest number of moves.
        """
        planned = [k for k, record in enumerate(records) if record.result == PLANNED]
        order = item_rng(self._seed, index, 0).permutation(len(planned))[:count]
        cell = self._config.cell.with_support(scene.support)
        planner = PickPlacePlanner(cell, PlannerConfig(max_overlap=ANY_OVERLAP))
        return [
            self._simulate(planner, name, scene, records[k], kind, size, (index, 1, k, row))
            for k in sorted(planned[i] for i in order.tolist())
            for kind, sizes in NOISE_SIZES.items()
            for row, size in enumerate(sizes)
        ]

    def _simulate(
        self,
        planner: PickPlacePlanner,
        name: str,
        scene: Scene,
        record: MoveRecord,
        kind: NoiseKind,
        size: float,
        path: tuple[int, ...],
    ) -> NoiseRecord:
        rng = item_rng(self._seed, *path, [*NoiseKind].index(kind))
        believed = add_noise(scene.objects, kind, size, rng)
        picked = next(o for o in believed if o.name == record.pick)
        X_TO_place = _believed_place(scene[record.pick], picked, record)
        plan = planner.plan(believed, record.pick, X_TO_place)
        of_move = self._setup, name, record.pick, record.place, kind.value, size
        if isinstance(plan, PlanningFailure):
            return NoiseRecord(*of_move, NO_PLAN, str(plan))
        simulation = StationSimulation(planner.cell, scene)
        if kind is NoiseKind.MASS:
            scale_mass(simulation, record.pick, max(0.1, 1 + rng.normal(0.0, size)))
        result = simulation.execute(plan)
        if not result.has_ended:
            return NoiseRecord(*of_move, MoveResult.INCONCLUSIVE.value, str(result))
        # The gripper takes the object where it is, so it arrives with the error of its pose.
        X_moved = rigid_transform(X_TO_place) @ rigid_transform(picked.X_TO).inverse()
        X_TO_end = pose_from_transform(X_moved @ rigid_transform(scene[record.pick].X_TO))
        outcome = evaluate_outcome(
            scene,
            scene.with_poses(result.poses),
            record.pick,
            X_TO_end,
            result.lost_object,
            self._config.settle,
        )
        return NoiseRecord(*of_move, outcome.result.value, str(result))


def add_noise(
    objects: Sequence[SceneObject], kind: NoiseKind, size: float, rng: np.random.Generator
) -> list[SceneObject]:
    """Return objects at the poses that the planner believes.

    Args:
        objects: Objects at their true poses.
        kind: What is not known exactly; masses are believed to be those of the catalog.
        size: Standard deviation of the error.
        rng: Random generator.
    """
    match kind:
        case NoiseKind.POSE:
            return [
                _displace(o, _turn(rng.normal(0.0, YAW_PER_METER * size)), rng.normal(0.0, size, 2))
                for o in objects
            ]
        case NoiseKind.CALIBRATION:
            yaw = rng.normal(0.0, CALIBRATION_YAW_PER_METER * size)
            X_error = RigidTransform(_turn(yaw), rng.normal(0.0, size, 3))
            return [
                replace(o, X_TO=pose_from_transform(X_error @ rigid_transform(o.X_TO)))
                for o in objects
            ]
        case NoiseKind.MASS:
            return [*objects]


def _turn(yaw_deg: float) -> RotationMatrix:
    return RotationMatrix.MakeZRotation(math.radians(yaw_deg))


def _displace(o: SceneObject, turn: RotationMatrix, offset: np.ndarray) -> SceneObject:
    """Return an object turned about its own vertical and moved along x and y [m]."""
    X_TO = rigid_transform(o.X_TO)
    X = RigidTransform(turn @ X_TO.rotation(), X_TO.translation() + np.append(offset, 0.0))
    return replace(o, X_TO=pose_from_transform(X))


def _believed_place(true: SceneObject, believed: SceneObject, record: MoveRecord) -> Pose:
    """Return the place pose that turns the believed object as the move turns the true one."""
    quaternion = (record.place_qw, record.place_qx, record.place_qy, record.place_qz)
    place = Pose((record.place_x, record.place_y, record.place_z), quaternion)
    turn = rigid_transform(place).rotation() @ rigid_transform(true.X_TO).rotation().inverse()
    R = turn @ rigid_transform(believed.X_TO).rotation()
    return pose_from_transform(RigidTransform(R, place.translation))


def scale_mass(simulation: StationSimulation, name: str, factor: float) -> None:
    """Multiply the mass and the inertia of an object by a factor.

    Args:
        simulation: Simulation of the station.
        name: Name of the object.
        factor: The factor.
    """
    body = simulation.station.scene_plant.bodies[name]
    context = simulation.plant_context
    M = body.CalcSpatialInertiaInBodyFrame(context)
    scaled = SpatialInertia(factor * M.get_mass(), M.get_com(), M.get_unit_inertia())
    body.SetSpatialInertiaInBodyFrame(context, scaled)
