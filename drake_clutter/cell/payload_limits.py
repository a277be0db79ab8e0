"""Largest acceleration at which a tool holds a load, at any direction of gravity.

Frames: G is the tool, z out of it, into the object.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
DOWN_G = np.array([0.0, 0.0, 1.0])
"""Direction of gravity in G of a tool that points down. Shape (3,)."""
MAX_PAYLOAD_ACCELERATION = 50.0
"""Largest acceleration that is considered [m/s^2]."""
_ACCELERATION_RESOLUTION = 0.01
"""Resolution of the largest acceleration [m/s^2]."""
_ACCELERATION_DIRECTIONS = np.array(
    [
        [math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)]
        for e in (-0.8, 0.0, 0.8)
        for a in np.arange(8) * math.pi / 4
    ]
    + [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
)
"""Unit vectors that sample all directions of an acceleration. Shape (26, 3)."""


def payload_wrench(
    mass: float, p_GCm: Floats, down_G: Floats, acceleration: Floats
) -> tuple[Floats, Floats]:
    """Return force and moment of an accelerated load on a tool.

    Args:
        mass: Mass of the load [kg].
        p_GCm: Center of mass of the load [m]. Shape (3,).
        down_G: Direction of gravity in G, unit vectors; z for a tool that points down. Shape
            (..., 3).
        acceleration: Acceleration of the center of mass in G, without rotation [m/s^2]. Shape
            (..., 3).

    Returns:
        Force [N] and moment about G [N m]. Shapes (..., 3).
    """
    force = mass * (GRAVITY * down_G - acceleration)
    return force, np.cross(np.broadcast_to(p_GCm, force.shape), force)


def max_payload_acceleration(
    mass: float,
    p_GCm: Floats,
    down_G: Floats,
    load_ratio: Callable[[Floats, Floats], Floats],
    max_load_ratio: float,
) -> float:
    """Return the largest acceleration of a load in any direction on a tool.

    Args:
        mass: Mass of the load [kg].
        p_GCm: Center of mass of the load [m]. Shape (3,).
        down_G: Direction of gravity, see `payload_wrench`. Shape (3,).
        load_ratio: Ratio, shape (...), of a load to the load capacity, from its force [N] and its
            moment about G [N m], both in G and of shape (..., 3).
        max_load_ratio: Largest ratio.

    Returns:
        Acceleration [m/s^2]; negative if the load cannot be held at rest.
    """

    def is_feasible(accelerations: Floats) -> NDArray[np.bool_]:
        force, moment = payload_wrench(
            mass, p_GCm, down_G, accelerations[:, None, None] * _ACCELERATION_DIRECTIONS
        )
        return np.asarray(load_ratio(force, moment).max(axis=1) <= max_load_ratio)

    low, high = 0.0, MAX_PAYLOAD_ACCELERATION
    while high - low > _ACCELERATION_RESOLUTION:
        candidates = np.linspace(low, high, 9)
        largest = int(np.argmin(np.append(is_feasible(candidates), False))) - 1
        if largest < 0:
            return -1.0
        low = float(candidates[largest])
        high = float(candidates[min(largest + 1, 8)])
    return low
