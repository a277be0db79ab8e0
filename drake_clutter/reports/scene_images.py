"""Pictures of scenes for people: from above and at an angle, with shadows; and with what matters marked."""

import re
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import LightParameter, RenderEngineVtkParams
from scipy.ndimage import find_objects

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.reports.canvas import Canvas, Rectangle, TextLabel, innermost_point
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer, RenderedImages
from drake_clutter.simulation.scene_plant import pose_from_transform

OVERHEAD_SIZE = (720, 720)
OBLIQUE_SIZE = (960, 720)
"""Width and height, pixels."""
# Pictures are rendered and drawn larger and scaled down, which smooths the edges.
_OVERSAMPLING = 2
_FOV_Y_DEG = 30.0
# For a tray of 0.7 m, that is, with room for a stack at its rim; pictures of other trays are taken from farther or nearer.
_CAMERA_HEIGHT, _REFERENCE_SIDE = 1.60, 0.70
_CAMERA_POSITION, _CAMERA_TARGET = (0.45, -1.30, 1.05), (0.0, -0.02, 0.08)


def _make_light(
    kind: str, position: tuple[float, float, float], intensity: float, frame: str = "world"
) -> LightParameter:
    return LightParameter(
        type=kind,
        position=position,
        direction=[-v for v in position] if any(position) else [0, 0, 1],
        frame=frame,
        intensity=intensity,
        attenuation_values=[1, 0, 0],
        cone_angle=16,
    )


# Only the spot casts shadows: point lights cannot, and directional ones would also shine through what is parked out of sight.
RENDER_ENGINE = RenderEngineVtkParams(
    backend="EGL",
    default_clear_color=[0.95, 0.955, 0.96],
    lights=[
        _make_light("spot", (-0.75, -0.85, 2.6), 2.0),
        _make_light("point", (0.0, 0.0, 0.0), 0.7, "camera"),
        _make_light("point", (1.2, -1.8, 1.2), 0.5),
        _make_light("point", (-1.5, 1.2, 1.2), 0.4),
    ],
    cast_shadows=True,
    shadow_map_size=2048,
)


class Highlight(Enum):
    """What a colour says in annotated pictures; the value is sRGB."""

    VISIBLE = "#1f2630"
    MOVED = "#0b5cd6"
    FOUND = "#0c7c45"
    HIDDEN = "#c2187e"
    OCCLUDED = "#5a6270"
    FALLEN = "#c8360b"


@dataclass(frozen=True)
class Annotations:
    """What an annotated picture points out; objects are given by name.

    Attributes:
        hidden: out of view and not found yet: dashed where they are.
        occluded: out of view, but found before: dashed.
        found: newly found.
        fallen: did not stay.
        moved: the object that a move is about, or None.
        X_T_placed: X_TO of `moved` where the move puts it: an arrow leads there; None for no arrow.
    """

    hidden: tuple[str, ...] = ()
    occluded: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    fallen: tuple[str, ...] = ()
    moved: str | None = None
    X_T_placed: Pose | None = None

    def highlight(self, name: str) -> Highlight:
        """The mark of an object."""
        groups = (
            (Highlight.FALLEN, self.fallen),
            (Highlight.MOVED, (self.moved,)),
            (Highlight.FOUND, self.found),
            (Highlight.HIDDEN, self.hidden),
            (Highlight.OCCLUDED, self.occluded),
        )
        return next((mark for mark, names in groups if name in names), Highlight.VISIBLE)


def display_name(name: str) -> str:
    """A name of an object, or a key, as people write it: "sugar_box_3" is "Sugar box 3"."""
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def _short_name(name: str) -> str:
    """The number at a name's end, if it has one: pictures of many objects have no room for more."""
    number = re.search(r"\d+$", name)
    return number.group() if number else display_name(name)


def look_at_pose(position: NDArray[np.float64], target: NDArray[np.float64]) -> Pose:
    """X_TC of a camera at `position` (3,) m that looks at `target` (3,) m, upright."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Pose.from_rotation(np.column_stack([x, np.cross(z, x), z]), position)


class SceneRenderer:
    """Takes pictures of scenes."""

    def __init__(self) -> None:
        self._latest: tuple[Scene, RenderedImages] | None = None

    def render_overhead(self, scene: Scene) -> NDArray[np.uint8]:
        """The tray from straight above, (720, 720, 3) uint8."""
        return _downsample(Image.fromarray(self._render_overhead_images(scene).color))

    def render_oblique(self, scene: Scene) -> NDArray[np.uint8]:
        """The tray from the front, at an angle, (720, 960, 3) uint8."""
        scale = max(scene.support.size) / _REFERENCE_SIDE
        images = self._oblique.render(
            scene,
            look_at_pose(scale * np.array(_CAMERA_POSITION), scale * np.array(_CAMERA_TARGET)),
        )
        return _downsample(Image.fromarray(images.color))

    def render_annotated(self, scene: Scene, annotations: Annotations) -> NDArray[np.uint8]:
        """`overhead`, with the objects outlined and named, (720, 720, 3) uint8.

        What is in view and not marked bears only the number of its name.
        """
        images = self._render_overhead_images(scene)
        canvas = Canvas(Image.fromarray(images.color))
        areas = find_objects(images.label + 1, max_label=len(scene.objects))
        dashed: list[tuple[NDArray[np.float64], Highlight]] = []
        labels, subtle_labels, arrows = [], [], []
        for index, (scene_object, area) in enumerate(zip(scene.objects, areas, strict=True)):
            name, highlight = scene_object.name, annotations.highlight(scene_object.name)
            if highlight in (Highlight.HIDDEN, Highlight.OCCLUDED) or area is None:
                if highlight is Highlight.VISIBLE:  # it has left the picture
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
    def _overhead(self) -> CameraRenderer:
        return CameraRenderer(_camera_above(default_cell().support, OVERHEAD_SIZE), RENDER_ENGINE)

    @cached_property
    def _oblique(self) -> CameraRenderer:
        return CameraRenderer(_camera_above(default_cell().support, OBLIQUE_SIZE), RENDER_ENGINE)

    def _render_overhead_images(self, scene: Scene) -> RenderedImages:
        # One move's picture "after" shows the same scene as the next one's "before".
        if self._latest is None or self._latest[0] is not scene:
            self._latest = (
                scene,
                self._overhead.render(
                    scene, pose_from_transform(_camera_above(scene.support).X_TC)
                ),
            )
        return self._latest[1]

    def _project(self, scene: Scene, p_T: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) in the picture from above, before it is scaled down, of points (N, 3) m in the tray frame."""
        camera = _camera_above(scene.support)
        # Nothing reaches the camera, save what a collapse has flung there.
        return camera.project(
            np.minimum(p_T, [np.inf, np.inf, camera.X_TC.translation()[2] - 0.05])
        )


def _camera_above(support: Support, size: tuple[int, int] = OVERHEAD_SIZE) -> Camera:
    """A camera for pictures of a size from above a support."""
    width, height = (_OVERSAMPLING * pixels for pixels in size)
    return Camera.overhead(
        _CAMERA_HEIGHT * max(support.size) / _REFERENCE_SIDE,
        width=width,
        height=height,
        fov_y_deg=_FOV_Y_DEG,
    )


def _bounds(points: NDArray[np.float64]) -> Rectangle:
    left, top, right, bottom = (float(v) for v in (*points.min(axis=0), *points.max(axis=0)))
    return left, top, right, bottom


def _center(rectangle: Rectangle) -> tuple[float, float]:
    return (rectangle[0] + rectangle[2]) / 2, (rectangle[1] + rectangle[3]) / 2


def _downsample(picture: Image.Image) -> NDArray[np.uint8]:
    return np.asarray(
        picture.resize(
            (picture.width // _OVERSAMPLING, picture.height // _OVERSAMPLING),
            Image.Resampling.LANCZOS,
        )
    )
