"""Sequences of scenes with one object less or moved, for the images of a dataset."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.scenes.scene import Pose, Scene, SceneObject

MOVE_PROBABILITY = 0.5
"""Probability that an object removed from a generated scene is placed elsewhere."""
TURN_PROBABILITY = 0.5
"""Probability that the stacks of a generated scene are turned."""
STACK_PROBABILITY = 0.3
"""Probability that an object that is placed elsewhere is put on another object."""
_PLACEMENT_TRIES = 50
_PLACEMENT_GAP = 0.005
"""Distance to other objects, seen from above, that a placement keeps [m]."""


def dismantle_heap(
    moments: Sequence[Scene], count: int, rng: np.random.Generator
) -> Iterator[Scene]:
    """Yield a heap with fewer and fewer objects, down to one, at random times of the drop.

    Args:
        moments: The heap at several times.
        count: Number of scenes.
        rng: Random generator.
    """
    remaining = moments[-1]
    for max_objects in np.linspace(len(remaining.objects), 1, count).round():
        while len(remaining.objects) > max_objects:
            remaining = remove_object(remaining, sample_top_object(remaining, rng))
        moment = moments[int(rng.integers(len(moments)))]
        yield replace(moment, objects=tuple(o for o in moment.objects if o.name in remaining.names))


def dismantle_generated(scene: Scene, count: int, rng: np.random.Generator) -> Iterator[Scene]:
    """Yield a generated scene, and the scene after each removal or move of some objects.

    Args:
        scene: The scene.
        count: Number of scenes.
        rng: Random generator.
    """
    if rng.random() < TURN_PROBABILITY:
        scene = turn_stacks(scene, rng)
    yield scene
    for _ in range(count - 1):
        for _ in range(rng.integers(1, 3)):
            top_object = sample_top_object(scene, rng)
            rest = remove_object(scene, top_object)
            moved = None
            if rng.random() < MOVE_PROBABILITY or not rest.objects:
                if rest.objects and rng.random() < STACK_PROBABILITY:
                    moved = place_on_object(top_object, rest, rng)
                else:
                    moved = place_on_tray(top_object, rest, rng)
            scene = rest if moved is None else replace(rest, objects=(*rest.objects, moved))
        yield scene


def turn_stacks(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a scene in which each stack is turned by a random yaw, as far as there is room."""
    stacks = list[list[SceneObject]]()
    for o in scene.objects:
        touching = [stack for stack in stacks if any(_overlap(o, other, 0.0) for other in stack)]
        stacks = [stack for stack in stacks if stack not in touching]
        stacks.append([o, *(other for stack in touching for other in stack)])
    for k, stack in enumerate(stacks):
        R_yaw = _random_yaw(rng)
        center = np.mean([o.X_TO.p for o in stack], axis=0)
        turned = [
            replace(
                o,
                X_TO=Pose.from_rotation(
                    R_yaw @ o.X_TO.rotation, center + R_yaw @ (o.X_TO.p - center)
                ),
            )
            for o in stack
        ]
        others = [other for stack in stacks[:k] + stacks[k + 1 :] for other in stack]
        bounds = np.array([o.bounds_T for o in turned])[:, :, :2]
        if (np.abs(bounds) < scene.support.half_size).all() and not any(
            _overlap(o, other, _PLACEMENT_GAP) for o in turned for other in others
        ):
            stacks[k] = turned
    by_name = {o.name: o for stack in stacks for o in stack}
    return replace(scene, objects=tuple(by_name[name] for name in scene.names))


def remove_object(scene: Scene, removed: SceneObject) -> Scene:
    """Return a scene without one of its objects."""
    return replace(scene, objects=tuple(o for o in scene.objects if o is not removed))


def sample_top_object(scene: Scene, rng: np.random.Generator) -> SceneObject:
    """Return a random object of a scene that no higher object covers, seen from above."""
    top_objects = [
        o
        for o in scene.objects
        if not any(
            over.top_height > o.top_height and _overlap(o, over, 0.0) for over in scene.objects
        )
    ]
    return top_objects[rng.integers(len(top_objects))]


def _random_yaw(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random rotation about the vertical. Shape (3, 3)."""
    return np.asarray(Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix())


def place_on_tray(
    removed: SceneObject, rest: Scene, rng: np.random.Generator
) -> SceneObject | None:
    """Return an object at a random free place of the tray, with a random yaw.

    Args:
        removed: The object in its earlier pose.
        rest: The scene without the object.
        rng: Random generator.

    Returns:
        The object; None if no free place was found.
    """
    for _ in range(_PLACEMENT_TRIES):
        R_TO = _random_yaw(rng) @ removed.X_TO.rotation
        rotated = replace(removed, X_TO=Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)))
        lower, upper = rotated.bounds_T
        half_size = rest.support.half_size
        lowest_xy = -half_size - lower[:2]
        highest_xy = half_size - upper[:2]
        if (lowest_xy < highest_xy).all():
            x, y = rng.uniform(lowest_xy, highest_xy)
            placed = replace(removed, X_TO=Pose.from_rotation(R_TO, (x, y, -lower[2])))
            if not any(_overlap(placed, other, _PLACEMENT_GAP) for other in rest.objects):
                return placed
    return None


def place_on_object(
    removed: SceneObject, rest: Scene, rng: np.random.Generator
) -> SceneObject | None:
    """Return an object on another one, off its center and with a random yaw.

    Args:
        removed: The object in its earlier pose.
        rest: The scene without the object, which has at least one.
        rng: Random generator.

    Returns:
        The object; None if no object has a top of sufficient width, free of others.
    """
    for _ in range(_PLACEMENT_TRIES):
        below = sample_top_object(rest, rng)
        R_TO = _random_yaw(rng) @ removed.X_TO.rotation
        rotated = replace(removed, X_TO=Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)))
        lower, upper = below.bounds_T
        x, y = below.X_TO.p[:2] + rng.uniform(-0.3, 0.3, 2) * (upper - lower)[:2]
        z = below.top_height - rotated.bounds_T[0][2]
        placed = replace(removed, X_TO=Pose.from_rotation(R_TO, (x, y, z)))
        if not any(
            other is not below
            and other.top_height > below.top_height - _PLACEMENT_GAP
            and _overlap(placed, other, _PLACEMENT_GAP)
            for other in rest.objects
        ):
            return placed
    return None


def _overlap(one: SceneObject, other: SceneObject, gap: float) -> bool:
    """Return whether the bounding boxes, seen from above, are closer than `gap` [m]."""
    lower, upper = one.bounds_T
    other_lower, other_upper = other.bounds_T
    return bool((np.minimum(upper, other_upper) > np.maximum(lower, other_lower) - gap)[:2].all())
