"""What both gymnasium environments share: pictures, and checks of actions and options."""

import operator
from collections.abc import Collection, Mapping
from typing import Any, TypeVar

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, format_value
from drake_clutter.scenes.scene import Scene

Kind = TypeVar("Kind")

RENDER_METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1}
"""Metadata of the environments for gymnasium: render modes, and pictures per second of a video."""


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode.

    Raises:
        InputError: The environments do not have the mode.
    """
    if render_mode not in (None, *RENDER_METADATA["render_modes"]):
        raise InputError(f"render_mode: {format_value(render_mode)}; expected 'rgb_array' or None")
    return render_mode


def check_instance(value: Kind | None, kind: type[Kind], name: str) -> Kind | None:
    """Return an argument that is of a kind or None.

    Args:
        value: The argument.
        kind: The kind.
        name: Name of the argument.

    Raises:
        InputError: It is something else, such as a dict.
    """
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{name}: {format_value(value)}; expected a {kind.__name__} or None")
    return value


def check_reset_options(
    options: Mapping[str, Any] | None, names: Collection[str]
) -> Mapping[str, Any]:
    """Return the options of a reset.

    Args:
        options: The options, or None.
        names: Names of the options that there are.

    Raises:
        InputError: Another option is given.
    """
    if options is None:
        return {}
    expected = ", ".join(map(repr, names)) or "none"
    if not isinstance(options, Mapping):
        raise InputError(f"options: {format_value(options)}; expected a dict with {expected}")
    for name in options:
        if name not in names:
            raise InputError(f"options: {format_value(name)}; expected {expected}")
    return options


def check_is_reset(environment: object, attribute: str) -> None:
    """Check that an environment has an episode.

    Args:
        environment: The environment.
        attribute: Name of an attribute that only `reset` sets.

    Raises:
        gymnasium.error.ResetNeeded: It has none.
    """
    if not hasattr(environment, attribute):
        raise ResetNeeded("there is no episode; call reset() first")


def index_type(largest: int) -> np.dtype[Any]:
    """Return the smallest type of signed integers that holds those up to a number."""
    return np.min_scalar_type(-largest - 1)


def check_index(value: Any, count: int, name: str) -> int:
    """Return an integer in [0, count).

    Args:
        value: An integer, or an array with one integer.
        count: Number of allowed integers.
        name: What the value is, for the message.

    Raises:
        InputError: The value is not such an integer.
    """
    try:
        scalar = value.item() if np.shape(value) in ((), (1,)) else value
        index = scalar if isinstance(scalar, bool) else operator.index(scalar)
    except AttributeError:  # an integer of Python
        index = value
    except TypeError:
        index = -1
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < count:
        raise InputError(f"{name}: {format_value(value)}; expected an integer in [0, {count - 1}]")
    return index


def render_picture(scene: Scene, config: ClutterConfig) -> NDArray[np.uint8]:
    """Return the color image of a scene. Shape (height, width, 3).

    Args:
        scene: The scene.
        config: The simulated world, with the camera.
    """
    # Drake's rendering is imported when it is needed, because trainings do not.
    from drake_clutter.simulation.camera_renderer import CameraRenderer

    return CameraRenderer(config.cell.camera).render(scene).color
