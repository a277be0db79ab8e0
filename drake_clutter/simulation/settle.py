"""Settling objects in Drake until they have fallen, come to rest, or the time is up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.catalog import Shape
from drake_clutter.cell.support import Support
from drake_clutter.config import SettleConfig
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, MotionSample
from drake_clutter.scenes.scene import Pose, SceneObject, tilt_between
from drake_clutter.simulation.scene_plant import add_scene_plant

SAMPLE_PERIOD = 0.05
"""s between two looks at whether the objects have come to rest; at every second one, at whether they have fallen."""
REST_SAMPLES = 10
"""Samples over which what is at rest may not drift: half a second."""


@dataclass(frozen=True)
class SettleResult:
    """How objects settled.

    Attributes:
        instability: None if they stayed.
        poses: X_TO by name at the end.
        motion: frames at 40 Hz, if asked for.
    """

    instability: Instability | None
    poses: dict[str, Pose]
    motion: tuple[MotionSample, ...]


def find_instability(
    before: SceneObject, after: Pose, support: Support, config: SettleConfig
) -> Instability | None:
    """How an object has fallen that was before, and is now; None if it stayed within the limits."""
    displacement = _distance(after, before.X_TO)
    tilt = tilt_between(before.object_class, before.X_TO, after)
    x, y, z = after.translation
    if not support.contains(x, y) or z < 0:
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
) -> SettleResult:
    """Simulates objects alone on the tray, from rest where they are.

    Ends when an object has fallen, when all have been calm or still for a while, or when the config's time is up. A single lying
    cylinder that carries something starts to roll slowly: it must be still for longer.

    Args:
        objects: what to settle.
        support: what they stand on.
        config: time step and limits.
        record: whether to keep the motion.
        simulate_collapse: go on after an object has fallen, until everything is calm or the time is up.
    """
    builder = DiagramBuilder()
    scene_plant = add_scene_plant(
        builder,
        [(o.name, o.object_class) for o in objects],
        support,
        config.time_step,
        visuals=False,
    )
    scene_plant.plant.Finalize()
    simulator = Simulator(builder.Build())
    context = scene_plant.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    scene_plant.set_poses(context, objects)
    simulator.Initialize()

    history = [{o.name: o.X_TO for o in objects}]
    motion = [MotionSample(0.0, history[0])] if record else []
    may_roll_slowly = _may_roll_slowly(objects)
    num_window_samples = REST_SAMPLES * (2 if may_roll_slowly else 1)
    num_calm_samples, instability = 0, None
    last = math.ceil(config.max_time / SAMPLE_PERIOD)
    for sample in range(1, last + 1):
        if record:
            simulator.AdvanceTo((sample - 0.5) * SAMPLE_PERIOD)
            motion.append(
                MotionSample(simulator.get_context().get_time(), scene_plant.poses(context))
            )
        # Half a step is added so that rounding never leaves a step out.
        simulator.AdvanceTo(sample * SAMPLE_PERIOD + config.time_step / 2)
        poses, speeds = scene_plant.poses(context), scene_plant.speeds(context, scene_plant.bodies)
        history.append(poses)
        if record:
            motion.append(MotionSample(sample * SAMPLE_PERIOD, poses))
        # Every second time: by then what topples has turned so far that it is not taken for something that slides.
        if instability is None and (sample % 2 == 0 or sample == last):
            instabilities = [
                found
                for o in objects
                if (found := find_instability(o, poses[o.name], support, config)) is not None
            ]
            instability = max(instabilities, key=lambda f: f.displacement, default=None)
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
    """Whether all objects have been close to where they are now."""
    *earlier, now = history
    return all(
        _distance(poses[o.name], now[o.name]) < config.chatter_displacement
        and tilt_between(o.object_class, poses[o.name], now[o.name])
        < math.radians(config.early_stop_tilt_deg)
        for poses in earlier
        for o in objects
    )


def _distance(X_TA: Pose, X_TB: Pose) -> float:
    return float(np.linalg.norm(X_TA.p - X_TB.p))


def _find_motion(
    objects: Sequence[SceneObject],
    poses: dict[str, Pose],
    earlier: dict[str, Pose],
    config: SettleConfig,
) -> Instability | None:
    """The object that went furthest since the earlier poses, if further than the config allows one at rest."""
    furthest = max(objects, key=lambda o: _distance(poses[o.name], earlier[o.name]))
    pose = poses[furthest.name]
    if _distance(pose, earlier[furthest.name]) <= config.max_rest_displacement:
        return None
    tilt = tilt_between(furthest.object_class, furthest.X_TO, pose)
    return Instability(
        InstabilityReason.NOT_AT_REST, furthest.name, _distance(pose, furthest.X_TO), tilt
    )


def _may_roll_slowly(objects: Sequence[SceneObject]) -> bool:
    """Whether a lying cylinder may carry something: its axis is level and something reaches higher above it."""
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
