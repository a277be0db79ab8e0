"""Target of a search: the object, or any object of a class, that an episode has to reveal."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_clutter.catalog import ObjectClass
from drake_clutter.files import InputError
from drake_clutter.scenes.scene import Scene

RANDOM_HIDDEN = "random-hidden"
"""Target that is drawn among the hidden objects of a scene."""


@dataclass(frozen=True)
class SearchTarget:
    """Target of a search.

    Policies that search know the class. The names are ground truth, for the evaluation and for
    privileged policies.

    Attributes:
        text: The target as it was given: a class, the name of an object, or `RANDOM_HIDDEN`.
        object_class: Class of the target, which the policy knows.
        names: Names of the objects of which one must be revealed.
    """

    text: str
    object_class: ObjectClass
    names: frozenset[str]


def find_target(
    text: str, scene: Scene, in_view: Collection[str], rng: np.random.Generator
) -> SearchTarget | None:
    """Return the target of a search in a scene; None if the scene has no such object.

    The target is any object of a class, or one object. For `RANDOM_HIDDEN`, it is an object that is
    drawn uniformly among the hidden ones.

    Args:
        text: Name of a class, name of an object, or `RANDOM_HIDDEN`.
        scene: The scene.
        in_view: Names of the objects in view.
        rng: Draws the object for `RANDOM_HIDDEN`.
    """
    if text == RANDOM_HIDDEN:
        hidden = [o for o in scene.objects if o.name not in in_view]
        objects = [hidden[rng.integers(len(hidden))]] if hidden else []
    else:
        objects = [o for o in scene.objects if o.object_class.name == text]
        objects = objects or [o for o in scene.objects if o.name == text]
    if not objects:
        return None
    return SearchTarget(text, objects[0].object_class, frozenset(o.name for o in objects))


def require_target(
    text: str, scene: Scene, in_view: Collection[str], rng: np.random.Generator
) -> SearchTarget:
    """Return the target of a search, see `find_target`.

    Raises:
        InputError: The scene has no such object.
    """
    target = find_target(text, scene, in_view, rng)
    if target is None:
        raise missing_target_error(text, scene)
    return target


def missing_target_error(text: str, scene: Scene) -> InputError:
    """Return the error of a target that a scene lacks."""
    if text == RANDOM_HIDDEN:
        return InputError(
            f"target: {text}: every object is in view; expected a scene that hides one"
        )
    classes = sorted({o.object_class.name for o in scene.objects})
    allowed = ", ".join(dict.fromkeys([*classes, *scene.names, RANDOM_HIDDEN]))
    return InputError(f"target: {text}: is not in the scene; expected {allowed}")


def no_target_error(agent: str | Path) -> InputError:
    """Return the error of a policy that looks for one object in an episode without a target."""
    return InputError(f"--agent {agent}: looks for one object; expected a target")
