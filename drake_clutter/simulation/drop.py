"""Heaps: objects that were dropped on the tray."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.support import Support
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.scene_plant import add_scene_plant

_START_RANGE = 0.3
"""Of the tray's side: objects start this far from its middle, each way; the tray's rim alone does not keep them."""
_MIN_START_GAP, _MAX_START_GAP = 0.01, 0.06
"""m, between an object and what it starts above."""


def sample_drop_scene(
    classes: Sequence[ObjectClass], support: Support, rng: np.random.Generator
) -> Scene:
    """Objects of the classes in the air over the tray, turned at random, each above those whose way down it shares."""
    objects = list[SceneObject]()
    for number, object_class in enumerate(classes):
        R_TO = Rotation.random(rng=rng).as_matrix()
        x, y = rng.uniform(-_START_RANGE, _START_RANGE, 2) * support.size
        loose = SceneObject(
            f"{object_class.name}_{number}", object_class, Pose.from_rotation(R_TO, (x, y, 0.0))
        )
        lower, upper = loose.bounds_T
        below = [
            top[2]
            for bottom, top in (o.bounds_T for o in objects)
            if (np.minimum(upper, top)[:2] > np.maximum(lower, bottom)[:2]).all()
        ]
        z = max(below, default=0.0) + rng.uniform(_MIN_START_GAP, _MAX_START_GAP) - lower[2]
        objects.append(SceneObject(loose.name, object_class, Pose.from_rotation(R_TO, (x, y, z))))
    return Scene(tuple(objects), support)


def simulate_drop(scene: Scene, time_step: float, times: Sequence[float]) -> list[Scene]:
    """What Drake makes of objects that are let go where they are: at each moment (s), those that are on the tray.

    Args:
        scene: objects at rest in the air.
        time_step: s.
        times: s after they were let go, increasing.
    """
    builder = DiagramBuilder()
    names = [(o.name, o.object_class) for o in scene.objects]
    scene_plant = add_scene_plant(builder, names, scene.support, time_step, visuals=False)
    scene_plant.plant.Finalize()
    simulator = Simulator(builder.Build())
    context = scene_plant.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    scene_plant.set_poses(context, scene.objects)
    simulator.Initialize()
    scenes = []
    for moment in times:
        simulator.AdvanceTo(moment)
        snapshot = scene.with_poses(scene_plant.poses(context))
        scenes.append(
            Scene(tuple(o for o in snapshot.objects if _on_tray(o, scene.support)), scene.support)
        )
    return scenes


def _on_tray(scene_object: SceneObject, support: Support) -> bool:
    x, y, z = scene_object.X_TO.translation
    return support.contains(x, y) and z > 0
