"""Settling objects in Drake until they have fallen, come to rest, or the time is up."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.config import SettleConfig
from drake_clutter.scenes.scene import Pose, SceneObject, tilt_between
from drake_clutter.scenes.seams import Frame, Instability, InstabilityReason
from drake_clutter.simulation.plant import add_scene_plant

SAMPLE_PERIOD = 0.1
"""s between two looks at whether the objects have fallen or come to rest."""
FRAME_PERIOD = 1 / 30


@dataclass(frozen=True)
class Settled:
    """How objects settled.

    Attributes:
        instability: None if they stayed.
        poses: X_TO by name at the end.
        motion: frames at 30 Hz, if asked for.
    """

    instability: Instability | None
    poses: dict[str, Pose]
    motion: tuple[Frame, ...]


def jittered(objects: Sequence[SceneObject], radius: float, rng: np.random.Generator) -> list[SceneObject]:
    """The objects, each moved in the tray's plane by an offset drawn uniformly from a disc of the radius (m)."""
    found = []
    for scene_object in objects:
        distance, angle = radius * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
        offset = (distance * math.cos(angle), distance * math.sin(angle), 0.0)
        found.append(replace(scene_object, X_TO=scene_object.X_TO.moved(offset)))
    return found


def _fallen(before: SceneObject, after: Pose, tray_side: float, config: SettleConfig) -> Instability | None:
    displacement = float(np.linalg.norm(after.p - before.X_TO.p))
    tilt = tilt_between(before.object_class, before.X_TO, after)
    x, y, z = after.translation
    if max(abs(x), abs(y)) > tray_side / 2 or z < 0:
        reason = InstabilityReason.LEFT_TRAY
    elif tilt >= math.radians(config.max_tilt_deg):
        reason = InstabilityReason.TOPPLED
    elif displacement >= config.max_displacement:
        reason = InstabilityReason.SLID
    else:
        return None
    return Instability(reason, before.name, displacement, tilt)


def settle(
    objects: Sequence[SceneObject], tray_side: float, config: SettleConfig, *, record: bool = False, follow_falls: bool = False
) -> Settled:
    """Simulates objects alone on the tray, from rest where they are.

    Ends when an object has fallen, when all have been calm for a while (not for a single lying cylinder that carries
    something: it starts to roll too slowly for that), or when the config's time is up.

    Args:
        objects: what to settle.
        tray_side: m.
        config: time step and limits.
        record: whether to keep the motion.
        follow_falls: go on after an object has fallen, until everything is calm or the time is up.
    """
    builder = DiagramBuilder()
    scene_plant = add_scene_plant(
        builder, [(o.name, o.object_class) for o in objects], tray_side, config.time_step, visuals=False
    )
    scene_plant.plant.Finalize()
    simulator = Simulator(builder.Build())
    context = scene_plant.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    scene_plant.set_poses(context, objects)
    simulator.Initialize()

    motion = [Frame(0.0, {o.name: o.X_TO for o in objects})] if record else []
    # Half a step is added so that rounding never leaves a step out.
    half_step = config.time_step / 2
    calm_samples, instability = 0, None
    may_end_early = not _may_creep(objects)
    previous = {o.name: o.X_TO for o in objects}
    for sample in range(1, math.ceil(config.max_time / SAMPLE_PERIOD) + 1):
        if record:
            for part in range(1, round(SAMPLE_PERIOD / FRAME_PERIOD)):
                simulator.AdvanceTo((sample - 1) * SAMPLE_PERIOD + part * FRAME_PERIOD)
                motion.append(Frame(simulator.get_context().get_time(), scene_plant.poses(context)))
        simulator.AdvanceTo(sample * SAMPLE_PERIOD + half_step)
        poses, speeds = scene_plant.poses(context), scene_plant.speeds(context)
        if record:
            motion.append(Frame(sample * SAMPLE_PERIOD, poses))
        if instability is None:
            fallen = [found for o in objects if (found := _fallen(o, poses[o.name], tray_side, config)) is not None]
            instability = max(fallen, key=lambda f: f.displacement, default=None)
            if instability is not None and not follow_falls:
                return Settled(instability, poses, tuple(motion))
        reference = previous if instability else {o.name: o.X_TO for o in objects}
        calm = all(
            speeds[o.name] < config.calm_speed
            and float(np.linalg.norm(poses[o.name].p - reference[o.name].p)) < config.calm_displacement
            and tilt_between(o.object_class, reference[o.name], poses[o.name]) < math.radians(config.calm_tilt_deg)
            for o in objects
        )
        previous = poses
        calm_samples = calm_samples + 1 if calm else 0
        if calm_samples >= config.calm_samples and (may_end_early or instability):
            return Settled(instability, poses, tuple(motion))
    if instability is None and not all(speed < 10 * config.calm_speed for speed in speeds.values()):
        name = max(speeds, key=lambda n: speeds[n])
        start = next(o for o in objects if o.name == name)
        displacement = float(np.linalg.norm(poses[name].p - start.X_TO.p))
        instability = Instability(
            InstabilityReason.NOT_AT_REST, name, displacement, tilt_between(start.object_class, start.X_TO, poses[name])
        )
    return Settled(instability, poses, tuple(motion))


def _may_creep(objects: Sequence[SceneObject]) -> bool:
    """Whether a lying cylinder may carry something: its axis is level and something reaches higher above it."""
    for o in objects:
        if o.object_class.shape.value != "cylinder" or abs(o.X_TO.rotation[2, 2]) > 0.5:
            continue
        (lower, upper) = o.bounds_T
        for other in objects:
            other_lower, other_upper = other.bounds_T
            overlap = np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
            if other is not o and overlap.min() > 0 and other_upper[2] > upper[2] + 0.001:
                return True
    return False
