"""Random light, textures, colors and camera poses of training images.

Ranges are assumed, unless a source is given: they are wider than what a work cell shows (domain
randomization, Tobin et al. 2017).
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.compilation import njit
from drake_clutter.rendering.lighting import Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.visual_mesh import VisualMesh

MAX_LAMP_DISTANCE = 1.5
"""Largest distance of a room's lamp from the tray along x and y [m]."""
LAMP_HEIGHTS = (1.7, 2.8)
"""Smallest and largest height of a room's lamp above the tray [m]."""
POSITION_SPREAD = 0.003
"""Standard deviation of each coordinate of the camera's position [m]."""
ROTATION_SPREAD_DEG = 0.2
"""Standard deviation of each angle of the camera's rotation [deg]."""
MAX_PATCH_CONTRAST = 0.25
"""Largest standard deviation of the patches on textures, as a factor."""
PLAIN_TEXTURE_SIDE = 64
"""Side of the texture with patches of a surface without a larger one [px]."""
PRINT_SIDE = 256
"""Side of a random print [px]."""
PRINT_PROBABILITY = 0.15
"""Probability that the texture of a class is a random print, such as that of a new package."""


class TextureSet(Enum):
    """Textures of the objects.

    Attributes:
        TRAINING: The class's own texture, or a random print.
        UNSEEN: A random print of a kind that no training image shows.
    """

    TRAINING = "training"
    UNSEEN = "unseen"


Print = Callable[[np.random.Generator], NDArray[np.uint8]]
"""Returns a random picture. Shape (PRINT_SIDE, PRINT_SIDE, 3)."""


def _random_color(rng: np.random.Generator) -> tuple[int, int, int]:
    red, green, blue = rng.integers(256, size=3).tolist()
    return red, green, blue


def _stripes(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return stripes of three colors in a random direction."""
    y, x = np.mgrid[:PRINT_SIDE, :PRINT_SIDE]
    angle = rng.uniform(0, np.pi)
    band = (x * np.cos(angle) + y * np.sin(angle)) / rng.uniform(6, 50)
    colors = rng.integers(256, size=(3, 3), dtype=np.uint8)
    return np.asarray(colors[np.floor(band).astype(int) % 3])


def _panels(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return rectangles of random colors, such as labels and pictures of a package."""
    picture = Image.new("RGB", (PRINT_SIDE, PRINT_SIDE), _random_color(rng))
    draw = ImageDraw.Draw(picture)
    for _ in range(rng.integers(6, 30)):
        x, y = rng.integers(PRINT_SIDE, size=2).tolist()
        width, height = rng.integers(8, 90, size=2).tolist()
        draw.rectangle((x, y, x + width, y + height), _random_color(rng))
    return np.asarray(picture)


def _blotches(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return smooth blotches of random colors."""
    cells = rng.integers(256, size=(*rng.integers(3, 20, 2), 3), dtype=np.uint8)
    size = (PRINT_SIDE, PRINT_SIDE)
    return np.asarray(Image.fromarray(cells).resize(size, Image.Resampling.BICUBIC))


def _checks(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a chessboard of two colors."""
    y, x = np.mgrid[:PRINT_SIDE, :PRINT_SIDE]
    width, height = rng.uniform(6, 40, 2)
    field = (np.floor(x / width) + np.floor(y / height)).astype(int) % 2
    return np.asarray(rng.integers(256, size=(2, 3), dtype=np.uint8)[field])


def _disks(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return disks of random colors."""
    picture = Image.new("RGB", (PRINT_SIDE, PRINT_SIDE), _random_color(rng))
    draw = ImageDraw.Draw(picture)
    for _ in range(rng.integers(10, 60)):
        x, y = rng.integers(PRINT_SIDE, size=2).tolist()
        radius = int(rng.integers(4, 40))
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), _random_color(rng))
    return np.asarray(picture)


def _lines_of_text(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return rows of short bars, which look like text from afar."""
    picture = Image.new("RGB", (PRINT_SIDE, PRINT_SIDE), _random_color(rng))
    draw = ImageDraw.Draw(picture)
    ink = _random_color(rng)
    height = int(rng.integers(3, 14))
    for top in range(2, PRINT_SIDE, 2 * height):
        left = 0
        while left < PRINT_SIDE:
            width = int(rng.integers(height, 5 * height))
            draw.rectangle((left, top, left + width, top + height), ink)
            left += width + height
    return np.asarray(picture)


PRINTS: Mapping[TextureSet, tuple[Print, ...]] = {
    TextureSet.TRAINING: (_stripes, _panels, _blotches),
    TextureSet.UNSEEN: (_checks, _disks, _lines_of_text),
}
"""Kinds of random prints of each set."""


def sample_lights(rng: np.random.Generator) -> Lighting:
    """Return two to four random directional lamps beside the camera, without shadows."""
    count = rng.integers(2, 5)
    intensities = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(2.0, 4.5)
    lamps = []
    for intensity in intensities.tolist():
        x, y = rng.uniform(-0.9, 0.9, 2).tolist()
        warmth = rng.uniform(-0.12, 0.12)
        color = min(1.0, 1 + warmth), 1 - abs(warmth) / 2, min(1.0, 1 - warmth)
        lamps.append(Lamp(LampKind.DIRECTIONAL, (x, y, 1.0), intensity, color, is_on_camera=True))
    return Lighting(tuple(lamps))


def sample_room_lighting(rng: np.random.Generator) -> Lighting:
    """Return one to three random lamps of a room with shadows, ambient light and an exposure.

    Point lamps hang beside the camera or above it, and directional ones are windows.
    """
    count = int(rng.integers(1, 4))
    irradiances = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(1.5, 4.0)
    lamps = []
    for irradiance in irradiances.tolist():
        x, y = rng.uniform(-MAX_LAMP_DISTANCE, MAX_LAMP_DISTANCE, 2).tolist()
        height = float(rng.uniform(*LAMP_HEIGHTS))
        warmth = float(rng.uniform(-0.12, 0.12))
        color = min(1.0, 1 + warmth), 1 - abs(warmth) / 2, min(1.0, 1 - warmth)
        squared_distance = x**2 + y**2 + height**2
        if rng.random() < 0.5:
            lamp = Lamp(
                LampKind.POINT,
                (x, y, height),
                irradiance * squared_distance,
                color,
                casts_shadows=True,
            )
        else:
            lamp = Lamp(
                LampKind.DIRECTIONAL, (-x, -y, -height), irradiance, color, casts_shadows=True
            )
        lamps.append(lamp)
    ambient = float(rng.uniform(0.05, 0.4))
    return Lighting(tuple(lamps), ambient=ambient, exposure=float(rng.uniform(0.7, 1.3)))


@dataclass(frozen=True)
class TextureVariation:
    """Replaces textures by random prints, and adds smooth patches such as stains and faded print.

    Attributes:
        seed: Seed of prints and patches; those of a name are always the same.
        textures: Set of the textures.
    """

    seed: int
    textures: TextureSet = TextureSet.TRAINING

    def __call__(self, name: str, mesh: VisualMesh) -> VisualMesh:
        """Return a mesh with another texture.

        Args:
            name: Name of the class, or of the part of the tray.
            mesh: The mesh.
        """
        rng = np.random.default_rng([self.seed, zlib.crc32(name.encode())])
        patches = rng.normal(
            1.0, rng.uniform(0.0, MAX_PATCH_CONTRAST), (*rng.integers(2, 12, 2), 3)
        )
        height, width, _ = mesh.texture.shape
        size = max(width, PLAIN_TEXTURE_SIDE), max(height, PLAIN_TEXTURE_SIDE)
        bytes_of_patches = (128 * patches).clip(0, 255).astype(np.uint8)
        factor = np.asarray(
            Image.fromarray(bytes_of_patches).resize(size, Image.Resampling.BICUBIC), float
        )
        has_print = self.textures is TextureSet.UNSEEN or rng.random() < PRINT_PROBABILITY
        prints = PRINTS[self.textures]
        picture = prints[int(rng.integers(len(prints)))](rng) if has_print else mesh.texture
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.NEAREST))
        texture = (picture * factor / 128).clip(0, 255).astype(np.uint8)
        return replace(mesh, texture=texture)


def sample_camera(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return a camera whose pose differs by what a calibration leaves."""
    translation = np.array(camera.pose.translation) + rng.normal(0.0, POSITION_SPREAD, 3)
    rpy_deg = np.array(camera.pose.rpy_deg) + rng.normal(0.0, ROTATION_SPREAD_DEG, 3)
    pose = PoseSpec(translation=tuple(translation.tolist()), rpy_deg=tuple(rpy_deg.tolist()))
    return camera.model_copy(update={"pose": pose})


@njit(cache=True)
def _map_colors(color, label, color_maps):  # type: ignore[no-untyped-def]
    """Return an image whose colors undergo the affine map of their instance.

    Args:
        color: The image. Shape (H, W, 3), uint8.
        label: Instance number of each pixel; -1 for the tray. Shape (H, W).
        color_maps: Affine map of the tray and of each instance. Shape (1 + N, 3, 4), float32.
    """
    mapped = np.empty_like(color)
    for row in range(color.shape[0]):
        for column in range(color.shape[1]):
            A = color_maps[label[row, column] + 1]
            red, green, blue = color[row, column]
            for k in range(3):
                value = A[k, 0] * red + A[k, 1] * green + A[k, 2] * blue + A[k, 3]
                mapped[row, column, k] = np.uint8(min(max(value, 0.0), 255.0))
    return mapped


def randomize_colors(
    images: RenderedImages, num_objects: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the color image with random colors and background.

    The colors of each instance and of the tray undergo a random affine map: a rotation of the hue
    about the gray axis, a gain and an offset.

    Args:
        images: Color, depth and label image of a scene.
        num_objects: Number of objects in the scene.
        rng: Random generator.

    Returns:
        The color image. Shape (H, W, 3).
    """
    is_background = ~np.isfinite(images.depth)
    color_maps = np.empty((num_objects + 1, 3, 4), np.float32)
    for instance in range(-1, num_objects):  # -1 is the tray.
        hue_angle = rng.uniform(-np.pi, np.pi) if instance < 0 else rng.normal(0, 0.15)
        hue_rotation = Rotation.from_rotvec(np.full(3, hue_angle / np.sqrt(3))).as_matrix()
        gain = rng.uniform(0.75, 1.25) * rng.uniform(0.93, 1.07, 3)
        color_maps[instance + 1, :, :3] = gain[:, None] * hue_rotation
        color_maps[instance + 1, :, 3] = rng.uniform(-15, 15)
    color = _map_colors(images.color, images.label, color_maps)
    patches = rng.uniform(0, 255, 3) + rng.normal(
        0, rng.uniform(0, 50), (*rng.integers(2, 24, 2), 3)
    )
    height, width = is_background.shape
    background = Image.fromarray(patches.clip(0, 255).astype(np.uint8)).resize(
        (width, height), Image.Resampling.BICUBIC
    )
    return np.where(is_background[:, :, None], np.asarray(background), color)
