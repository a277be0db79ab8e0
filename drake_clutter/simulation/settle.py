"""Settling objects in Drake until they fall, come to rest, or the time is up."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.catalog import Shape
from drake_clutter.cell.support import Support
from drake_clutter.config import SettleConfig
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, MotionSample
from drake_clutter.scenes.scene import Pose, SceneObject, tilt_between
from drake_clutter.simulation.scene_plant import add_scene_plant, add_table

SAMPLE_PERIOD = 0.05
"""Time between two checks for rest [s]; every second check also looks for falls."""
REST_SAMPLES = 10
"""Samples (0.5 s) over which an object at rest must not move."""


@dataclass(frozen=True)
class SettleResult:
    """Result of settling objects.

    Attributes:
        instability: The object that fell or kept moving, or None.
        poses: X_TO at the end, by name.
        motion: Recorded motion at 40 Hz, if requested.
    """

    instability: Instability | None
    poses: dict[str, Pose]
    motion: tuple[MotionSample, ...]


def find_instability(
    before: SceneObject,
    after: Pose,
    support: Support,
    config: SettleConfig,
    *,
    is_beside: bool = False,
) -> Instability | None:
    """Return how an object fell, or None if it stayed within the limits.

    Args:
        before: The object at its initial pose.
        after: Its present pose.
        support: Support of the object.
        config: Limits of displacement and tilt.
        is_beside: Whether the object was placed beside the support on purpose.
    """
    displacement = _distance(after, before.X_TO)
    tilt = tilt_between(before.object_class, before.X_TO, after)
    if not is_beside and not support.carries(after.translation):
        reason = InstabilityReason.LEFT_TRAY
    elif tilt >= math.radians(config.max_tilt_deg):
        reason = InstabilityReason.TOPPLED
    elif displacement >= config.max_displacement:
        reason = InstabilityReason.SLID
    else:
        return None
    return Instability(reason, before.name, displacement, tilt)


def settle(
    objects: Sequence[SceneObject],
    support: Support,
    config: SettleConfig,
    *,
    record: bool = False,
    simulate_collapse: bool = False,
    beside: Collection[str] = (),
) -> SettleResult:
    """Simulate objects on a support from rest.

    The simulation ends when an object falls, when all have been calm or nearly motionless for a
    while, or when the time is up. A lying cylinder that carries something starts to roll slowly, so
    it must be motionless for longer.

    Args:
        objects: The objects to settle.
        support: Support of the objects.
        config: Time step and limits.
        record: Whether to record the motion.
        simulate_collapse: Whether to go on after a fall until all objects are at rest or the time
            is up.
        beside: Names of objects that were placed beside the support on purpose.
    """
    builder = DiagramBuilder()
    scene_plant = add_scene_plant(
        builder,
        [(o.name, o.object_class) for o in objects],
        support,
        config.time_step,
        visuals=False,
    )
    add_table(scene_plant.plant, support)
    scene_plant.plant.Finalize()
    simulator = Simulator(builder.Build())
    context = scene_plant.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    scene_plant.set_poses(context, objects)
    simulator.Initialize()

    history = [{o.name: o.X_TO for o in objects}]
    motion = [MotionSample(0.0, history[0])] if record else []
    may_roll_slowly = _may_roll_slowly(objects)
    num_window_samples = REST_SAMPLES * (2 if may_roll_slowly else 1)
    num_calm_samples = 0
    instability = None
    last = math.ceil(config.max_time / SAMPLE_PERIOD)
    for sample in range(1, last + 1):
        if record:
            simulator.AdvanceTo((sample - 0.5) * SAMPLE_PERIOD)
            motion.append(
                MotionSample(simulator.get_context().get_time(), scene_plant.poses(context))
            )
        # Half a step is added, so that rounding never skips a step.
        simulator.AdvanceTo(sample * SAMPLE_PERIOD + config.time_step / 2)
        poses = scene_plant.poses(context)
        speeds = scene_plant.speeds(context, scene_plant.bodies)
        history.append(poses)
        if record:
            motion.append(MotionSample(sample * SAMPLE_PERIOD, poses))
        # Every second sample: after 0.1 s, a toppling object has rotated far enough not to be
        # mistaken for a sliding one.
        if instability is None and (sample % 2 == 0 or sample == last):
            instabilities = [
                item
                for o in objects
                if (
                    item := find_instability(
                        o, poses[o.name], support, config, is_beside=o.name in beside
                    )
                )
                is not None
            ]
            instability = max(instabilities, key=lambda item: item.displacement, default=None)
            if instability is not None and not simulate_collapse:
                return SettleResult(instability, poses, tuple(motion))
        reference = history[-2] if instability else history[0]
        is_calm = all(
            speeds[o.name] < config.early_stop_speed
            and _distance(poses[o.name], reference[o.name]) < config.early_stop_displacement
            and tilt_between(o.object_class, reference[o.name], poses[o.name])
            < math.radians(config.early_stop_tilt_deg)
            for o in objects
        )
        num_calm_samples = num_calm_samples + 1 if is_calm else 0
        if num_calm_samples >= config.early_stop_samples and (instability or not may_roll_slowly):
            return SettleResult(instability, poses, tuple(motion))
        if (
            sample % 2 == 0
            and len(history) > num_window_samples
            and _stayed_close(objects, history[-1 - num_window_samples :], config)
        ):
            return SettleResult(instability, poses, tuple(motion))
    if instability is None:
        instability = _find_motion(
            objects, poses, history[max(0, len(history) - 1 - REST_SAMPLES)], config
        )
    return SettleResult(instability, poses, tuple(motion))


def _stayed_close(
    objects: Sequence[SceneObject], history: Sequence[dict[str, Pose]], config: SettleConfig
) -> bool:
    """Return whether all objects stayed close to their last poses."""
    *earlier, now = history
    return all(
        _distance(poses[o.name], now[o.name]) < config.chatter_displacement
        and tilt_between(o.object_class, poses[o.name], now[o.name])
        < math.radians(config.early_stop_tilt_deg)
        for poses in earlier
        for o in objects
    )


def _distance(X_TA: Pose, X_TB: Pose) -> float:
    """Return the distance between the origins of two frames [m]."""
    return float(np.linalg.norm(X_TA.p - X_TB.p))


def _find_motion(
    objects: Sequence[SceneObject],
    poses: dict[str, Pose],
    earlier: dict[str, Pose],
    config: SettleConfig,
) -> Instability | None:
    """Return the object that moved farthest since earlier poses, if it moved too far.

    Args:
        objects: The objects at their initial poses.
        poses: Present poses, by name.
        earlier: Poses half a second earlier, by name.
        config: Limits.
    """
    furthest = max(objects, key=lambda o: _distance(poses[o.name], earlier[o.name]))
    pose = poses[furthest.name]
    if _distance(pose, earlier[furthest.name]) <= config.max_rest_displacement:
        return None
    tilt = tilt_between(furthest.object_class, furthest.X_TO, pose)
    return Instability(
        InstabilityReason.NOT_AT_REST, furthest.name, _distance(pose, furthest.X_TO), tilt
    )


def _may_roll_slowly(objects: Sequence[SceneObject]) -> bool:
    """Return whether a lying cylinder may carry something.

    The cylinder's axis is level, and another object overlaps it seen from above and is higher.
    """
    for o in objects:
        if o.object_class.shape is not Shape.CYLINDER or abs(o.X_TO.rotation[2, 2]) > 0.5:
            continue
        (lower, upper) = o.bounds_T
        for other in objects:
            other_lower, other_upper = other.bounds_T
            overlap = np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
            if other is not o and overlap.min() > 0 and other_upper[2] > upper[2] + 0.001:
                return True
    return False
