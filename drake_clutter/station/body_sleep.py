"""Which objects are simulated: those that take no part in the current motion are locked."""

import math
from collections import deque
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, FilterId, GeometrySet
from pydrake.systems.framework import Context

from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.scenes.geometry import group_touching_objects, transport_pose
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.scene_plant import get_support_body
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.command_schedule import DWELL_TIME, CommandSchedule
from drake_clutter.station.gripper_actuator import GraspStatus

Floats = NDArray[np.float64]

WAKE_BEFORE_CONTACT = 0.05
"""Before the gripper meets an object or lets it go, from when objects around are free [s]."""
SLEEP_AFTER_DWELL = 0.15
"""After the dwell, until when the objects around are free; what does move stays free [s]."""
_DESCENT_STEP = 0.01
"""Between the heights of a descent at which contacts are looked for [m]."""


def nearest_object(objects: Sequence[SceneObject], X_TO: Pose) -> SceneObject:
    """Return the object whose origin is nearest to a pose: what is there in truth."""
    return min(objects, key=lambda o: float(np.linalg.norm(o.X_TO.p - X_TO.p)))


def affected_bodies(
    objects: Sequence[SceneObject], plan: PickPlacePlan
) -> tuple[set[str], set[str]]:
    """Return the names of what picking, and of what placing may disturb.

    These are the stacks that are taken from, put on, or come close to. The picked object is in
    both.
    """
    picked = nearest_object(objects, plan.X_TO_pick)
    X_TO_place = transport_pose(plan.X_TO_pick, plan.X_TO_place, picked.X_TO)
    lowered = np.linspace(0.0, plan.max_descent, math.ceil(plan.max_descent / _DESCENT_STEP) + 1)
    placed = [
        replace(picked, X_TO=X_TO_place.translated((0.0, 0.0, -height)))
        for height in lowered.tolist()
    ]
    groups = group_touching_objects(objects, TOUCHING_MARGIN)

    def near(ends: Sequence[SceneObject]) -> set[str]:
        def close(o: SceneObject) -> bool:
            together = (group_touching_objects([end, o], TOUCHING_MARGIN) for end in ends)
            return o is not picked and any(len(groups) == 1 for groups in together)

        touched = (o.name for group in groups if any(close(o) for o in group) for o in group)
        return {picked.name, *touched}

    return near([picked]), near(placed)


def bodies_to_wake(
    schedule: CommandSchedule, at_pick: Set[str], at_place: Set[str], time: float
) -> set[str]:
    """Return the names of what may move at a time since a plan began [s].

    Args:
        schedule: Of the plan.
        at_pick: What picking may disturb, see `affected_bodies`.
        at_place: What placing may disturb.
        time: Since the plan began [s].
    """
    pick_start = schedule.suction_on_time - WAKE_BEFORE_CONTACT
    place_start = schedule.descent_start_time - WAKE_BEFORE_CONTACT
    woken = set[str]()
    if pick_start <= time <= schedule.suction_on_time + DWELL_TIME + SLEEP_AFTER_DWELL:
        woken |= at_pick
    if place_start <= time <= schedule.suction_off_time + DWELL_TIME + SLEEP_AFTER_DWELL:
        woken |= at_place
    return woken


class BodySleepManager:
    """Locks objects that take no part, which makes the simulation about ten times faster.

    Attributes:
        awake: Names of the objects that may move.
    """

    MAX_SLEEP_SPEED = 0.002
    """Of an object that falls asleep, on average over some updates [m/s]: contact may make it
    tremble without getting anywhere."""
    WINDOW = 4

    def __init__(self, station: ClutterStation) -> None:
        """Make a manager; see `reset`."""
        self._station = station
        self._locked_filter: FilterId | None = None

    def reset(self, root: Context) -> None:
        """Lock all objects in a new context."""
        self.awake = set[str]()
        self._position_history = deque[tuple[float, dict[str, Floats]]](maxlen=self.WINDOW)
        self._contact_history = deque[set[str]](maxlen=self.WINDOW)
        self._locked_filter = None
        self._lock_all_but(root, self.awake)

    def update(
        self, root: Context, required: Set[str], grasp: GraspStatus, *, expects_grasp: bool
    ) -> None:
        """Wake what is wanted, what is held, and what still moves; lock the rest.

        Args:
            root: Of the simulation.
            required: Names.
            grasp: What the gripper holds.
            expects_grasp: Whether the gripper should hold something; if it does not, what falls may
                hit anything, and all are woken.
        """
        moving = {name for name, v in self._speeds(root).items() if v > self.MAX_SLEEP_SPEED}
        lost = grasp.lost_object or (expects_grasp and not grasp.has_held)
        # What is run into is woken for long enough to see whether it moves, else it would stand
        # like a rock.
        context = self._station.plant_context(root)
        self._contact_history.append(
            self._station.objects_in_contact(context) - self.awake if self.awake else set()
        )
        awake = {*required, *moving, *({grasp.held} - {""})}.union(*self._contact_history)
        if lost:
            awake = set(self._station.object_classes)
        if awake != self.awake:
            self._lock_all_but(root, awake)
            self.awake = awake

    def _speeds(self, root: Context) -> dict[str, float]:
        """Return speeds of what is awake, by name [m/s]."""
        scene, context = self._station.scene_plant, self._station.plant_context(root)
        speeds = scene.speeds(context, self.awake)
        places = {name: X_TO.p for name, X_TO in scene.poses(context, self.awake).items()}
        if len(self._position_history) == self.WINDOW:
            then, earlier = self._position_history[0]
            time = root.get_time() - then
            for name, p in places.items():
                if name in earlier:
                    speeds[name] = float(np.linalg.norm(p - earlier[name])) / time
        self._position_history.append((root.get_time(), places))
        return speeds

    def _lock_all_but(self, root: Context, awake: Set[str]) -> None:
        """Lock all objects but some. Those that were free must be at rest: they are stopped.

        What is locked does not collide with the surroundings or other locked objects: Drake crashes
        where it would penetrate them.
        """
        station, plant = self._station, self._station.plant
        context = station.plant_context(root)
        locked, fixed = GeometrySet(), GeometrySet()
        for body in (*station.arm.fixed, get_support_body(plant)):
            fixed.Add(plant.GetCollisionGeometriesForBody(body))
        for name, joint in station.free_joints.items():
            if name in awake:
                continue
            locked.Add(plant.GetCollisionGeometriesForBody(station.scene_plant.bodies[name]))
            if not joint.is_locked(context):
                velocities, start = plant.GetVelocities(context), joint.velocity_start()
                velocities[start : start + 6] = 0.0
                plant.SetVelocities(context, velocities)
                joint.Lock(context)
        scene_graph = station.scene_plant.scene_graph
        filters = scene_graph.collision_filter_manager(
            scene_graph.GetMyMutableContextFromRoot(root)
        )
        before = self._locked_filter
        self._locked_filter = filters.ApplyTransient(
            CollisionFilterDeclaration().ExcludeBetween(locked, fixed).ExcludeWithin(locked)
        )
        if before is not None:
            filters.RemoveDeclaration(before)
        for name in awake & station.free_joints.keys():
            if station.free_joints[name].is_locked(context):
                station.free_joints[name].Unlock(context)
