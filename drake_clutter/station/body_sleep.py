"""Body sleeping: lock objects that take no part in the current motion of the arm.

Sleeping bodies are standard in physics engines; Drake has none, so their free joints are locked.
"""

from collections import deque
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, FilterId, GeometrySet
from pydrake.systems.framework import Context

from drake_clutter.planning.motion_plan import Plan
from drake_clutter.scenes.geometry import find_piles, pairs_within, transport_pose
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.scene_plant import get_support_body
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.command_schedule import CommandSchedule
from drake_clutter.station.gripper_actuator import GraspStatus

Floats = NDArray[np.float64]

CONTACT_MARGIN = 0.001
"""Objects at rest that are farther apart than this do not touch [m].

What is hit although it was not expected to be is woken when it is hit.
"""
WAKE_BEFORE_CONTACT = 0.05
"""Time before the gripper grasps or releases an object at which its neighbors are woken [s]; two
steps of the simulation."""
SLEEP_AFTER_DWELL = 0.15
"""Time after a dwell until which the neighbors stay awake [s]. Objects that still move stay awake
longer."""


def nearest_object(objects: Sequence[SceneObject], X_TO: Pose) -> SceneObject:
    """Return the object whose origin is closest to that of a pose."""
    return min(objects, key=lambda o: float(np.linalg.norm(o.X_TO.p - X_TO.p)))


def affected_bodies(objects: Sequence[SceneObject], plan: Plan) -> tuple[frozenset[str], ...]:
    """Return the names of the objects that each step of a plan may disturb.

    These are the piles that touch the object that is grasped or released. Poses of the plan may be
    estimates: the object is the one closest to its pose at the start of the plan.

    Args:
        objects: Objects at their actual poses.
        plan: Plan to execute.

    Returns:
        Names for each step, which include the object; empty for steps that touch nothing.
    """
    start_poses = {o.name: o.X_TO for o in plan.start.objects}
    actual = {
        name: nearest_object(objects, start_poses[name])
        for name in {step.object_name for step in plan.steps} - {""}
    }
    current = {o.name: o for o in objects}
    affected = []
    for step in plan.steps:
        if not step.touched:
            affected.append(frozenset[str]())
            continue
        moved = actual[step.object_name]
        copies = [
            replace(moved, X_TO=transport_pose(start_poses[step.object_name], X_TO, moved.X_TO))
            for X_TO in step.touched
        ]
        affected.append(_names_near(copies, [*current.values()]))
        current[moved.name] = copies[-1]
    return tuple(affected)


def _names_near(copies: Sequence[SceneObject], objects: Sequence[SceneObject]) -> frozenset[str]:
    """Return the names of the piles that an object touches at one of its poses.

    Args:
        copies: The object at these poses.
        objects: All objects.
    """
    name = copies[0].name
    others = [o for o in objects if o.name != name]
    touched = {o.name for _, o in pairs_within(copies, others, TOUCHING_MARGIN)}
    piles = ({o.name for o in pile} for pile in find_piles(objects, CONTACT_MARGIN))
    return frozenset({name}).union(*(pile for pile in piles if not touched.isdisjoint(pile)))


def bodies_to_wake(
    schedule: CommandSchedule, affected: Sequence[Set[str]], time: float
) -> frozenset[str]:
    """Return the names of the objects that must be awake at a time.

    Args:
        schedule: Command schedule of the plan.
        affected: Names of the objects affected by each step, see `affected_bodies`.
        time: Time since the start of the plan [s].
    """
    ends = (*schedule.starts[1:], schedule.end_time)
    return frozenset().union(
        *(
            names
            for names, start, end in zip(affected, schedule.starts, ends, strict=True)
            if start - WAKE_BEFORE_CONTACT <= time <= end + SLEEP_AFTER_DWELL
        )
    )


class BodySleepManager:
    """Lock objects that take no part in the current motion.

    This makes the simulation about ten times faster.

    Attributes:
        awake: Names of the objects that may move.
        woken_fixed_objects: Names of the fixed objects of the station that had to be woken since
            the last reset. In reality they might have moved.
    """

    MAX_SLEEP_SPEED = 0.002
    """Mean speed over `WINDOW` updates below which an object may be locked [m/s]. Averaging rejects
    contact chatter."""
    WINDOW = 4
    """Number of updates over which speeds are averaged and contacts are remembered."""

    def __init__(self, station: ClutterStation) -> None:
        """Create a manager; call `reset` before `update`.

        Args:
            station: Station whose objects are locked.
        """
        self._station = station
        self._locked_filter: FilterId | None = None

    def reset(self, root: Context) -> None:
        """Lock all objects in a new context.

        Args:
            root: Context of the root diagram.
        """
        self.awake = set[str]()
        self.woken_fixed_objects = set[str]()
        self._position_history = deque[tuple[float, dict[str, Floats]]](maxlen=self.WINDOW)
        self._contact_history = deque[set[str]](maxlen=self.WINDOW)
        self._locked_filter = None
        self._lock_all_but(root, self.awake)

    def update(
        self, root: Context, required: Set[str], grasp: GraspStatus, *, expects_grasp: bool
    ) -> None:
        """Wake required, grasped, moving and recently hit objects, and lock the others.

        Args:
            root: Context of the root diagram.
            required: Names of objects that must be awake.
            grasp: Status of the gripper.
            expects_grasp: Whether the gripper should hold an object. If it does not, all objects
                are woken, because a falling object may hit any of them.
        """
        moving = {name for name, v in self._speeds(root).items() if v > self.MAX_SLEEP_SPEED}
        lost_object = grasp.lost_object or (expects_grasp and not grasp.has_held)
        # A locked object that is hit must be woken, otherwise it acts as a fixed obstacle. It stays
        # awake for `WINDOW` updates, so that its mean speed is known before it may be locked.
        context = self._station.plant_context(root)
        self._contact_history.append(
            self._station.objects_in_contact(context) - self.awake if self.awake else set()
        )
        awake = {*required, *moving, *({grasp.held} - {""})}.union(*self._contact_history)
        if lost_object:
            awake = set(self._station.object_classes)
        fixed = awake & self._station.fixed_bodies.keys()
        self.woken_fixed_objects |= fixed
        awake -= fixed
        if awake != self.awake:
            self._lock_all_but(root, awake)
            self.awake = awake

    def _speeds(self, root: Context) -> dict[str, float]:
        """Return the mean speeds of the awake objects, by name [m/s].

        Objects that were not awake for the whole window have their current speed.
        """
        scene_plant = self._station.scene_plant
        context = self._station.plant_context(root)
        speeds = scene_plant.speeds(context, self.awake)
        positions = scene_plant.positions(context, self.awake)
        if len(self._position_history) == self.WINDOW:
            earlier_time, earlier_positions = self._position_history[0]
            duration = root.get_time() - earlier_time
            for name, p in positions.items():
                if name in earlier_positions:
                    distance = float(np.linalg.norm(p - earlier_positions[name]))
                    speeds[name] = distance / duration
        self._position_history.append((root.get_time(), positions))
        return speeds

    def _lock_all_but(self, root: Context, awake: Set[str]) -> None:
        """Lock all objects except some; newly locked ones are stopped.

        Collisions of locked objects with fixed bodies and with each other are filtered out: Drake
        fails at penetrations between bodies that cannot move.

        Args:
            root: Context of the root diagram.
            awake: Names of the objects that may move.
        """
        station = self._station
        plant = station.plant
        context = station.plant_context(root)
        locked = GeometrySet()
        fixed = GeometrySet()
        for body in (
            *station.arm.fixed,
            *station.fixed_bodies.values(),
            get_support_body(plant),
        ):
            fixed.Add(plant.GetCollisionGeometriesForBody(body))
        for name, joint in station.free_joints.items():
            if name in awake:
                continue
            locked.Add(plant.GetCollisionGeometriesForBody(station.scene_plant.bodies[name]))
            if not joint.is_locked(context):
                velocities = plant.GetVelocities(context)
                start = joint.velocity_start()
                velocities[start : start + 6] = 0.0
                plant.SetVelocities(context, velocities)
                joint.Lock(context)
        scene_graph = station.scene_plant.scene_graph
        filters = scene_graph.collision_filter_manager(
            scene_graph.GetMyMutableContextFromRoot(root)
        )
        previous_filter = self._locked_filter
        self._locked_filter = filters.ApplyTransient(
            CollisionFilterDeclaration().ExcludeBetween(locked, fixed).ExcludeWithin(locked)
        )
        if previous_filter is not None:
            filters.RemoveDeclaration(previous_filter)
        for name in awake & station.free_joints.keys():
            if station.free_joints[name].is_locked(context):
                station.free_joints[name].Unlock(context)
