"""Images of scenes for pages: from above and from the front, plain or annotated."""

import re
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import find_objects

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.rendering.lighting import Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.reports.canvas import Canvas, Rectangle, TextLabel, innermost_point
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.scene_plant import pose_from_transform

OVERHEAD_SIZE = (720, 720)
"""Width and height of overhead images in pixels."""
OBLIQUE_SIZE = (960, 720)
"""Width and height of oblique images in pixels."""
_OVERSAMPLING = 2
"""Factor by which images are rendered and drawn larger, then downsampled to smooth edges."""
_FOV_Y_DEG = 30.0
_REFERENCE_SIDE = 0.70
"""Side of the support for which the camera poses are given; they scale with the support [m]."""
_CAMERA_HEIGHT = 1.60
"""Height of the overhead camera, with room for a stack at the rim of the support [m]."""
_CAMERA_POSITION = (0.45, -1.30, 1.05)
"""Position of the oblique camera in the tray frame [m]."""
_CAMERA_TARGET = (0.0, -0.02, 0.08)
"""Point that the oblique camera looks at [m]."""


PICTURE_LIGHTING = Lighting(
    (
        Lamp(LampKind.DIRECTIONAL, (0.75, 0.85, -2.6), 2.2, casts_shadows=True),
        Lamp(LampKind.DIRECTIONAL, (0.0, 0.0, 1.0), 0.7, is_on_camera=True),
        Lamp(LampKind.DIRECTIONAL, (-1.2, 1.8, -1.2), 0.5),
    ),
    ambient=0.18,
    background=(242, 244, 245),
)
"""Light of images for people: a main lamp with soft fill light from the camera and the front."""


class Highlight(Enum):
    """Meaning of a color in annotated images; the value is an sRGB color."""

    VISIBLE = "#1f2630"
    MOVED = "#0b5cd6"
    FOUND = "#0c7c45"
    HIDDEN = "#c2187e"
    OCCLUDED = "#5a6270"
    FALLEN = "#c8360b"


@dataclass(frozen=True)
class Annotations:
    """Objects to point out in an annotated image, by name.

    Attributes:
        hidden: Objects out of view and not found yet, drawn dashed.
        occluded: Objects out of view but found before, drawn dashed.
        found: Newly found objects.
        fallen: Objects that fell or slipped.
        moved: Object that is moved, or None.
        X_T_placed: Pose to which `moved` is moved, shown by an arrow; None for no arrow.
    """

    hidden: tuple[str, ...] = ()
    occluded: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    fallen: tuple[str, ...] = ()
    moved: str | None = None
    X_T_placed: Pose | None = None

    def highlight(self, name: str) -> Highlight:
        """Return the highlight of an object."""
        groups = (
            (Highlight.FALLEN, self.fallen),
            (Highlight.MOVED, (self.moved,)),
            (Highlight.FOUND, self.found),
            (Highlight.HIDDEN, self.hidden),
            (Highlight.OCCLUDED, self.occluded),
        )
        return next((mark for mark, names in groups if name in names), Highlight.VISIBLE)


def display_name(name: str) -> str:
    """Return an identifier as text: "sugar_box_3" is "Sugar box 3"."""
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def _short_name(name: str) -> str:
    """Return the number at the end of a name, or the name if there is none."""
    number = re.search(r"\d+$", name)
    return number.group() if number else display_name(name)


def look_at_pose(position: NDArray[np.float64], target: NDArray[np.float64]) -> Pose:
    """Return X_TC of an upright camera that looks at a point.

    Args:
        position: Position of the camera in the tray frame [m]. Shape (3,).
        target: Point that it looks at [m]. Shape (3,).
    """
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Pose.from_rotation(np.column_stack([x, np.cross(z, x), z]), position)


class SceneRenderer:
    """Renders images of scenes."""

    def __init__(self) -> None:
        self._latest: tuple[Scene, RenderedImages] | None = None

    def render_overhead(self, scene: Scene) -> NDArray[np.uint8]:
        """Return an RGB image from straight above. Shape (720, 720, 3)."""
        return _downsample(Image.fromarray(self._render_overhead_images(scene).color))

    def render_oblique(self, scene: Scene) -> NDArray[np.uint8]:
        """Return an RGB image from the front, at an angle. Shape (720, 960, 3)."""
        scale = max(scene.support.size) / _REFERENCE_SIDE
        images = self._oblique.render(
            scene,
            look_at_pose(scale * np.array(_CAMERA_POSITION), scale * np.array(_CAMERA_TARGET)),
        )
        return _downsample(Image.fromarray(images.color))

    def render_annotated(self, scene: Scene, annotations: Annotations) -> NDArray[np.uint8]:
        """Return the overhead image with outlined and named objects.

        Visible objects without an annotation are labeled with the number at the end of their name.

        Args:
            scene: The scene.
            annotations: Objects to point out.

        Returns:
            RGB image. Shape (720, 720, 3).
        """
        images = self._render_overhead_images(scene)
        canvas = Canvas(Image.fromarray(images.color))
        areas = find_objects(images.label + 1, max_label=len(scene.objects))
        dashed: list[tuple[NDArray[np.float64], Highlight]] = []
        labels = list[TextLabel]()
        subtle_labels = list[TextLabel]()
        arrows = list[tuple[tuple[float, float], tuple[float, float]]]()
        for index, (scene_object, area) in enumerate(zip(scene.objects, areas, strict=True)):
            name = scene_object.name
            highlight = annotations.highlight(name)
            if highlight in (Highlight.HIDDEN, Highlight.OCCLUDED) or area is None:
                if highlight is Highlight.VISIBLE:  # it is outside of the image
                    continue
                corners = self._project(scene, scene_object.corners_T)
                bounds = _bounds(corners)
                anchor = _center(bounds)
                if highlight in (Highlight.HIDDEN, Highlight.OCCLUDED):
                    dashed.append((corners, highlight))
            else:
                mask = images.label[area] == index
                bounds = (area[1].start, area[0].start, area[1].stop, area[0].stop)
                x, y = innermost_point(mask)
                anchor = (bounds[0] + x, bounds[1] + y)
                canvas.draw_outline(
                    mask,
                    (area[1].start, area[0].start),
                    highlight.value,
                    3 if highlight is Highlight.VISIBLE else 9,
                )
            if highlight is Highlight.VISIBLE:
                subtle_labels.append(
                    TextLabel(_short_name(name), anchor, bounds, highlight.value, 38, subtle=True)
                )
            else:
                labels.append(TextLabel(display_name(name), anchor, bounds, highlight.value, 46))
            if name == annotations.moved and annotations.X_T_placed is not None:
                placed_points = self._project(
                    scene, annotations.X_T_placed.apply(scene_object.object_class.corners)
                )
                dashed.append((placed_points, Highlight.MOVED))
                arrows.append((anchor, _center(_bounds(placed_points))))
        for corners, highlight in dashed:
            canvas.draw_dashed_hull(corners, highlight.value, 6)
        for start, end in arrows:
            canvas.draw_arrow(start, end, Highlight.MOVED.value, 12)
        canvas.draw_labels(labels + subtle_labels)
        return _downsample(canvas.image)

    @cached_property
    def _overhead(self) -> SceneRasterizer:
        return SceneRasterizer(_camera_above(default_cell().support), PICTURE_LIGHTING)

    @cached_property
    def _oblique(self) -> SceneRasterizer:
        camera = _camera_above(default_cell().support, OBLIQUE_SIZE)
        return SceneRasterizer(camera, PICTURE_LIGHTING)

    def _render_overhead_images(self, scene: Scene) -> RenderedImages:
        # The image after a move shows the same scene as the image before the next move.
        if self._latest is None or self._latest[0] is not scene:
            X_TC = pose_from_transform(_camera_above(scene.support).X_TC)
            self._latest = scene, self._overhead.render(scene, X_TC)
        return self._latest[1]

    def _project(self, scene: Scene, p_T: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels of points in the overhead image before downsampling.

        Args:
            scene: The scene.
            p_T: Points in the tray frame [m]. Shape (n, 3).

        Returns:
            Pixels (x, y). Shape (n, 2).
        """
        camera = _camera_above(scene.support)
        # A collapse may throw objects above the camera; their points are moved below it.
        max_height = camera.X_TC.translation()[2] - 0.05
        return camera.project(np.minimum(p_T, [np.inf, np.inf, max_height]))


def _camera_above(support: Support, size: tuple[int, int] = OVERHEAD_SIZE) -> Camera:
    """Return a camera above a support, for images of a size in pixels."""
    width, height = (_OVERSAMPLING * pixels for pixels in size)
    return Camera.overhead(
        _CAMERA_HEIGHT * max(support.size) / _REFERENCE_SIDE,
        width=width,
        height=height,
        fov_y_deg=_FOV_Y_DEG,
    )


def _bounds(points: NDArray[np.float64]) -> Rectangle:
    """Return the bounding rectangle of points. Shape (n, 2)."""
    left, top = points.min(axis=0)
    right, bottom = points.max(axis=0)
    return float(left), float(top), float(right), float(bottom)


def _center(rectangle: Rectangle) -> tuple[float, float]:
    return (rectangle[0] + rectangle[2]) / 2, (rectangle[1] + rectangle[3]) / 2


def _downsample(image: Image.Image) -> NDArray[np.uint8]:
    size = (image.width // _OVERSAMPLING, image.height // _OVERSAMPLING)
    return np.asarray(image.resize(size, Image.Resampling.LANCZOS))
