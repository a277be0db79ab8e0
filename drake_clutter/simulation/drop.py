"""Random heaps: objects dropped on the support."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.support import Support
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.scene_plant import add_scene_plant, add_table

_START_RANGE = 0.3
"""Largest start distance from the center, as a fraction of the support's size.

The rim alone does not keep dropped objects on the support.
"""
_MIN_START_GAP = 0.01
"""Smallest gap between an object and those it starts above [m]."""
_MAX_START_GAP = 0.06
"""Largest gap between an object and those it starts above [m]."""


def sample_drop_scene(
    classes: Sequence[ObjectClass], support: Support, rng: np.random.Generator
) -> Scene:
    """Return objects in the air over the support, with random rotations and positions.

    Each object starts above those that it would meet on its way down.

    Args:
        classes: Class of each object.
        support: The support.
        rng: Random generator.
    """
    objects = list[SceneObject]()
    for number, object_class in enumerate(classes):
        R_TO = Rotation.random(rng=rng).as_matrix()
        x, y = rng.uniform(-_START_RANGE, _START_RANGE, 2) * support.size
        name = f"{object_class.name}_{number}"
        at_floor = SceneObject(name, object_class, Pose.from_rotation(R_TO, (x, y, 0.0)))
        lower, upper = at_floor.bounds_T
        below = [
            top[2]
            for bottom, top in (o.bounds_T for o in objects)
            if (np.minimum(upper, top)[:2] > np.maximum(lower, bottom)[:2]).all()
        ]
        z = max(below, default=0.0) + rng.uniform(_MIN_START_GAP, _MAX_START_GAP) - lower[2]
        objects.append(SceneObject(name, object_class, Pose.from_rotation(R_TO, (x, y, z))))
    return Scene(tuple(objects), support)


def simulate_drop(scene: Scene, time_step: float, times: Sequence[float]) -> list[Scene]:
    """Return the objects that are on the support at given times after their release.

    Args:
        scene: Objects at rest in the air.
        time_step: Time step of the simulation [s].
        times: Increasing times after the release [s].
    """
    builder = DiagramBuilder()
    names = [(o.name, o.object_class) for o in scene.objects]
    scene_plant = add_scene_plant(builder, names, scene.support, time_step, visuals=False)
    add_table(scene_plant.plant, scene.support)
    scene_plant.plant.Finalize()
    simulator = Simulator(builder.Build())
    context = scene_plant.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    scene_plant.set_poses(context, scene.objects)
    simulator.Initialize()
    scenes = []
    for time in times:
        simulator.AdvanceTo(time)
        snapshot = scene.with_poses(scene_plant.poses(context))
        on_tray = tuple(o for o in snapshot.objects if scene.support.carries(o.X_TO.translation))
        scenes.append(Scene(on_tray, scene.support))
    return scenes
