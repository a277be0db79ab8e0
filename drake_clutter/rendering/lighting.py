"""Lamps, ambient light, exposure and background of rendered color images.

Frames: W is the world, C the camera: z along the optical axis, x to the right of the image, y down.
"""

from dataclasses import dataclass
from enum import Enum

Vector = tuple[float, float, float]


class LampKind(Enum):
    """Kind of a lamp.

    Attributes:
        DIRECTIONAL: Parallel light, such as that of a distant lamp.
        POINT: Light from a point, whose irradiance falls with the squared distance.
    """

    DIRECTIONAL = "directional"
    POINT = "point"


@dataclass(frozen=True)
class Lamp:
    """A lamp.

    Attributes:
        kind: Kind of the lamp.
        vector: Direction in which the light travels, or position of a point lamp [m]. Shape (3,).
        intensity: Irradiance of a surface that faces the light; of a point lamp, at 1 m. A matte
            surface of albedo a has then the radiance a * intensity / pi, and 1 is white.
        color: Red, green and blue, linear. Shape (3,).
        is_on_camera: Whether the vector is in the frame of the camera, and not in that of the
            world.
        casts_shadows: Whether surfaces occlude the light.
    """

    kind: LampKind
    vector: Vector
    intensity: float
    color: Vector = (1.0, 1.0, 1.0)
    is_on_camera: bool = False
    casts_shadows: bool = False


@dataclass(frozen=True)
class Lighting:
    """Light and exposure of a color image.

    Attributes:
        lamps: The lamps.
        ambient: Radiance of a white surface that no lamp reaches.
        exposure: Factor on all radiances before they are encoded and clipped.
        background: sRGB color where nothing is seen, in [0, 255]. Shape (3,).
    """

    lamps: tuple[Lamp, ...]
    ambient: float = 0.0
    exposure: float = 1.0
    background: tuple[int, int, int] = (204, 229, 255)


CAMERA_LIGHTING = Lighting(
    (
        Lamp(LampKind.DIRECTIONAL, (0.2, 0.1, 1.0), 2.4, is_on_camera=True),
        Lamp(LampKind.DIRECTIONAL, (-0.8, -0.5, 1.0), 0.9, is_on_camera=True),
    )
)
"""Two lamps beside the camera.

The second lamp keeps faces that are turned away from the first one from being black.
"""
