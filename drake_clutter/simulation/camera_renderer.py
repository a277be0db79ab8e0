"""Rendering in Drake: images of a scene, and visible fractions of objects."""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    FrameId,
    LightParameter,
    MakeRenderEngineVtk,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import MAX_DEPTH
from drake_clutter.cell.support import Support
from drake_clutter.files import reading_file
from drake_clutter.rendering.lighting import CAMERA_LIGHTING, Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import MIN_SENSOR_DEPTH, NEAR_DEPTH, RenderedImages
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.scene_plant import ScenePlant, add_scene_plant, rigid_transform

RENDERER_NAME = "vtk"
"""Name of the render engine in the scene graph."""

_BACKEND = "EGL"


def make_engine_params(lighting: Lighting) -> RenderEngineVtkParams:
    """Return the parameters of a render engine with some light.

    The engine draws neither ambient light nor shadows of these lamps.

    Args:
        lighting: Light without ambient light and shadows.
    """
    assert lighting.ambient == 0.0, "Drake's render engine has no ambient light"
    red, green, blue = (value / 255 for value in lighting.background)
    return RenderEngineVtkParams(
        backend=_BACKEND,
        default_clear_color=[red, green, blue],
        lights=[_light_parameter(lamp, lighting.exposure) for lamp in lighting.lamps],
    )


def _light_parameter(lamp: Lamp, exposure: float) -> LightParameter:
    """Return a lamp for the render engine."""
    assert not lamp.casts_shadows, "Drake's render engine draws no shadows of such lamps"
    is_point = lamp.kind is LampKind.POINT
    return LightParameter(
        type=lamp.kind.value,
        color=Rgba(*lamp.color),
        attenuation_values=[0, 0, 1] if is_point else [1, 0, 0],
        position=lamp.vector if is_point else (0.0, 0.0, 0.0),
        direction=(0.0, 0.0, 1.0) if is_point else lamp.vector,
        frame="camera" if lamp.is_on_camera else "world",
        intensity=lamp.intensity * exposure,
    )


RENDER_ENGINE_PARAMS = make_engine_params(CAMERA_LIGHTING)
"""Render engine with two lights beside the camera."""
_NO_OBJECT = -1


@dataclass(frozen=True)
class RenderCameras:
    """Drake's render cameras for one `Camera`.

    Attributes:
        color: Camera for color images.
        depth: Camera for depth images.
        label: Camera for label images of objects on the support.
        X_TC: Pose of the camera.
    """

    color: ColorRenderCamera
    depth: DepthRenderCamera
    label: ColorRenderCamera
    X_TC: RigidTransform

    @staticmethod
    def from_camera(config: Camera) -> "RenderCameras":
        """Return the render cameras of a camera."""
        info = CameraInfo(config.width, config.height, np.radians(config.fov_y_deg))
        anywhere = RenderCameraCore(
            RENDERER_NAME, info, ClippingRange(NEAR_DEPTH, 20.0), RigidTransform()
        )
        over_tray = RenderCameraCore(
            RENDERER_NAME, info, _tray_clipping_range(config.X_TC), RigidTransform()
        )
        depth = DepthRenderCamera(anywhere, DepthRange(MIN_SENSOR_DEPTH, MAX_DEPTH))
        return RenderCameras(
            ColorRenderCamera(anywhere, False),
            depth,
            ColorRenderCamera(over_tray, False),
            config.X_TC,
        )


def _tray_clipping_range(X_TC: RigidTransform) -> ClippingRange:
    """Return a narrow clipping range around everything on the support.

    Where two surfaces meet at the center of a pixel, the engine shows whichever it draws first,
    and its order differs between engines. A narrow range makes the depth buffer finer (0.1 um
    instead of 3 um) and such ties rare.
    """
    X_CT = X_TC.inverse()
    center = X_CT.translation()[2]
    tilt = float(np.hypot(*X_CT.rotation().matrix()[2, :2]))
    return ClippingRange(max(0.05, center - 0.7 - tilt), max(0.1, center + 0.5 + tilt))


class CameraRenderer:
    """Renders scenes with one persistent engine, in which the objects are moved.

    Attributes:
        camera: The camera.
    """

    def __init__(
        self, camera: Camera, engine: RenderEngineVtkParams = RENDER_ENGINE_PARAMS
    ) -> None:
        """Create a renderer.

        Args:
            camera: The camera.
            engine: Light, background and shadows.
        """
        self.camera = camera
        self._engine = engine
        self._counts: Counter[ObjectClass] = Counter()
        self._support: Support | None = None
        render_cameras = RenderCameras.from_camera(camera)
        self._color_camera = render_cameras.color
        self._depth_camera = render_cameras.depth
        self._label_camera = render_cameras.label
        self._X_TC = render_cameras.X_TC
        # Objects that are not shown are behind the camera.
        self._X_T_parked = RigidTransform(render_cameras.X_TC @ [0.0, 0.0, -5.0])

    def _build(self, counts: Counter[ObjectClass], support: Support) -> None:
        """Build the diagram for numbers of objects of each class."""
        builder = DiagramBuilder()
        # The classes are numbered, as variants of a class have the same name.
        self._class_numbers = {c: number for number, c in enumerate(counts)}
        names = [(self._body_name(c, k), c) for c, count in counts.items() for k in range(count)]
        self._scene_plant: ScenePlant = add_scene_plant(builder, names, support, 0.01, visuals=True)
        self._scene_plant.plant.Finalize()
        visuals = " or ".join(sorted({str(c.folder / "visual.gltf") for c in counts}))
        with reading_file(visuals, "models as `drake-clutter assets build` writes them"):
            self._scene_plant.scene_graph.AddRenderer(
                RENDERER_NAME, MakeRenderEngineVtk(self._engine)
            )
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._counts = counts
        self._support = support

    def _body_name(self, object_class: ObjectClass, index: int) -> str:
        """Return the name of one of the bodies of a class."""
        return f"{self._class_numbers[object_class]}.{object_class.name}.{index}"

    def _place_objects(self, scene: Scene, names: Collection[str]) -> dict[int, int]:
        """Show the named objects of the scene to the camera, and no others.

        Returns:
            Index in the scene of each shown object, by its render label.
        """
        needed = Counter(o.object_class for o in scene.objects)
        if scene.support != self._support or any(needed[c] > self._counts[c] for c in needed):
            # Half as many again are added, so that not every scene needs a new engine.
            grown = Counter({c: n + (n + 1) // 2 for c, n in needed.items() if n > self._counts[c]})
            self._build(self._counts | grown, scene.support)
        plant = self._scene_plant.plant
        context = plant.GetMyMutableContextFromRoot(self._context)
        free: dict[ObjectClass, int] = defaultdict(int)
        labels = {}
        poses = dict.fromkeys(self._scene_plant.bodies, self._X_T_parked)
        for index, scene_object in enumerate(scene.objects):
            name = self._body_name(scene_object.object_class, free[scene_object.object_class])
            free[scene_object.object_class] += 1
            if scene_object.name in names:
                poses[name] = rigid_transform(scene_object.X_TO)
                labels[int(self._scene_plant.bodies[name].index())] = index
        for name, X_TO in poses.items():
            plant.SetFreeBodyPose(context, self._scene_plant.bodies[name], X_TO)
        return labels

    def _label_image(self, labels: Mapping[int, int], X_TC: RigidTransform) -> NDArray[np.int64]:
        """Return the index in the scene of the object in each pixel, given the shown labels."""
        camera = self._label_camera if X_TC is self._X_TC else self._color_camera
        image = self._query().RenderLabelImage(camera, self._world_frame(), X_TC)
        lookup = np.full(2**15, _NO_OBJECT)
        lookup[list(labels)] = list(labels.values())
        return np.asarray(lookup[image.data[..., 0]])

    def _query(self) -> QueryObject:
        """Return the query object of the scene graph."""
        scene_graph = self._scene_plant.scene_graph
        return scene_graph.get_query_output_port().Eval(
            scene_graph.GetMyContextFromRoot(self._context)
        )

    def _world_frame(self) -> FrameId:
        """Return the frame of the world."""
        return self._scene_plant.scene_graph.world_frame_id()

    def render(self, scene: Scene, X_TC: Pose | None = None) -> RenderedImages:
        """Return the images of a scene.

        Args:
            scene: The scene.
            X_TC: Another pose of the camera, or None for its own.
        """
        labels = self._place_objects(scene, scene.names)
        X = self._X_TC if X_TC is None else rigid_transform(X_TC)
        color = self._query().RenderColorImage(self._color_camera, self._world_frame(), X)
        depth = self._query().RenderDepthImage(self._depth_camera, self._world_frame(), X)
        return RenderedImages(
            color.data[..., :3].copy(), depth.data[..., 0].copy(), self._label_image(labels, X)
        )

    def render_depth_and_label(self, scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the depth and label images, see `RenderedImages`.

        Rendering the color image would take longer than both.
        """
        labels = self._place_objects(scene, scene.names)
        depth = self._query().RenderDepthImage(self._depth_camera, self._world_frame(), self._X_TC)
        return depth.data[..., 0].copy(), self._label_image(labels, self._X_TC)

    def render_label(self, scene: Scene) -> NDArray[np.int64]:
        """Return the label image, see `RenderedImages`."""
        return self._label_image(self._place_objects(scene, scene.names), self._X_TC)

    def visible_fractions(
        self, scene: Scene, label: NDArray[np.int64] | None = None
    ) -> dict[str, float]:
        """Return the visible fraction of each object, by name.

        It is the fraction of the pixels that the object covers alone on the support which it also
        covers in the scene. Objects outside of the image have fraction 1.

        Args:
            scene: The scene.
            label: Label image of the scene, if it was rendered before.
        """
        visible = np.bincount(
            (self.render_label(scene) if label is None else label).ravel() + 1,
            minlength=len(scene.objects) + 1,
        )[1:]
        unoccluded = np.zeros(len(scene.objects), int)
        for group, group_label in self._group_labels(scene):
            counts = np.bincount(group_label.ravel() + 1, minlength=len(scene.objects) + 1)[1:]
            unoccluded[group] = counts[group]
        return {
            o.name: float(visible[i] / unoccluded[i]) if unoccluded[i] else 1.0
            for i, o in enumerate(scene.objects)
        }

    def silhouettes(self, scene: Scene) -> NDArray[np.bool_]:
        """Return the pixels that each object covers alone on the support. Shape (N, H, W)."""
        masks = np.zeros((len(scene.objects), self.camera.height, self.camera.width), np.bool_)
        for group, group_label in self._group_labels(scene):
            for index in group:
                masks[index] = group_label == index
        return masks

    def hidden_objects(self, fractions: Mapping[str, float]) -> tuple[str, ...]:
        """Return the names of the objects whose visible fraction is below the threshold."""
        return tuple(
            name
            for name, fraction in fractions.items()
            if fraction < self.camera.visibility_threshold
        )

    def _group_labels(self, scene: Scene) -> Iterator[tuple[list[int], NDArray[np.int64]]]:
        """Yield groups of objects that do not overlap, each with a label image of it alone."""
        for group in self._non_overlapping_groups(scene):
            labels = self._place_objects(scene, {scene.objects[i].name for i in group})
            yield group, self._label_image(labels, self._X_TC)

    def _non_overlapping_groups(self, scene: Scene) -> list[list[int]]:
        """Return groups of objects that do not overlap in the image."""
        corners = [self.camera.project(o.corners_T) for o in scene.objects]
        lower = [c.min(axis=0) - 2 for c in corners]
        upper = [c.max(axis=0) + 2 for c in corners]
        overlapping = nx.Graph()
        overlapping.add_nodes_from(range(len(corners)))
        for i in range(len(corners)):
            for j in range(i):
                if (np.minimum(upper[i], upper[j]) > np.maximum(lower[i], lower[j])).all():
                    overlapping.add_edge(i, j)
        groups: dict[int, list[int]] = defaultdict(list)
        for index, color in nx.greedy_color(overlapping).items():
            groups[color].append(index)
        return [sorted(group) for group in groups.values()]
