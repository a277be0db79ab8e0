"""Compiled rendering of scenes: color, depth and labels of objects on a support.

Frames: T is the support and the world, O an object, G a mesh, C the camera.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.cell.support_sdf import support_boxes, support_color
from drake_clutter.rendering.lighting import CAMERA_LIGHTING, Lighting
from drake_clutter.rendering.mesh_renderer import (
    Floats,
    MeshInstances,
    MeshRenderer,
    RenderedImages,
)
from drake_clutter.rendering.visual_mesh import VisualMesh, box_visual, load_visual_meshes
from drake_clutter.scenes.scene import Pose, Scene

_NO_OBJECT = -1


def _pose_matrix(X_AB: Pose) -> Floats:
    """Return rotation and translation of a pose [m]. Shape (3, 4)."""
    return np.column_stack([X_AB.rotation, X_AB.p])


class SceneRasterizer:
    """Renders scenes with the compiled rasterizer.

    Meshes are prepared when a scene shows their class for the first time.

    Attributes:
        camera: The camera.
        lighting: Light of color images.
    """

    def __init__(
        self,
        camera: Camera,
        lighting: Lighting = CAMERA_LIGHTING,
        vary_mesh: Callable[[str, VisualMesh], VisualMesh] | None = None,
    ) -> None:
        """Create a renderer.

        Args:
            camera: The camera.
            lighting: Light of color images.
            vary_mesh: Returns what is drawn instead of a mesh, such as one with another texture;
                or None. Args: name of the class, or of the part of the support; the mesh.
        """
        self.camera = camera
        self.lighting = lighting
        self._X_TC = np.asarray(camera.X_TC.GetAsMatrix34())
        self._vary_mesh = vary_mesh
        self._support: Support | None = None
        self._support_poses = list[Floats]()
        self._mesh_ids = dict[ObjectClass, range]()

    def render(self, scene: Scene, X_TC: Pose | None = None) -> RenderedImages:
        """Return the images of a scene.

        Args:
            scene: The scene.
            X_TC: Another pose of the camera, or None for its own.
        """
        renderer, instances = self._prepare(scene, range(len(scene.objects)))
        X = self._X_TC if X_TC is None else _pose_matrix(X_TC)
        return renderer.render(self.camera, X, instances, self.lighting)

    def render_depth_and_label(self, scene: Scene) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the depth and label images, see `RenderedImages`."""
        renderer, instances = self._prepare(scene, range(len(scene.objects)))
        return renderer.render_depth_and_label(self.camera, self._X_TC, instances)

    def silhouettes(self, scene: Scene) -> NDArray[np.bool_]:
        """Return the pixels that each object covers alone on the support. Shape (N, H, W)."""
        masks = np.zeros((len(scene.objects), self.camera.height, self.camera.width), np.bool_)
        for index in range(len(scene.objects)):
            renderer, instances = self._prepare(scene, [index])
            _, label = renderer.render_depth_and_label(self.camera, self._X_TC, instances)
            masks[index] = label == index
        return masks

    def _prepare(self, scene: Scene, indices: Sequence[int]) -> tuple[MeshRenderer, MeshInstances]:
        """Return the renderer, and the support and the objects of some indices as instances."""
        shown = dict.fromkeys(o.object_class for o in scene.objects)
        new = [object_class for object_class in shown if object_class not in self._mesh_ids]
        if new or scene.support != self._support:
            self._prepare_meshes(scene.support, [*self._mesh_ids, *new])
        mesh_ids = list(range(len(self._support_poses)))
        poses = list(self._support_poses)
        labels = [_NO_OBJECT] * len(poses)
        for index in indices:
            scene_object = scene.objects[index]
            parts = self._mesh_ids[scene_object.object_class]
            mesh_ids += parts
            poses += [_pose_matrix(scene_object.X_TO)] * len(parts)
            labels += [index] * len(parts)
        return self._renderer, MeshInstances(
            np.array(mesh_ids, np.int64), np.array(poses), np.array(labels, np.int64)
        )

    def _prepare_meshes(self, support: Support, classes: Sequence[ObjectClass]) -> None:
        """Prepare the meshes of a support and of classes."""
        meshes = list[VisualMesh]()
        self._support_poses = []
        for name, size, p_TG in support_boxes(support):
            meshes.append(self._varied(name, box_visual(size, support_color(name))))
            self._support_poses.append(np.column_stack([np.eye(3), p_TG]))
        for object_class in classes:
            parts = load_visual_meshes(object_class.folder / "visual.gltf")
            self._mesh_ids[object_class] = range(len(meshes), len(meshes) + len(parts))
            meshes += (self._varied(object_class.name, part) for part in parts)
        self._support = support
        self._renderer = MeshRenderer(meshes)

    def _varied(self, name: str, mesh: VisualMesh) -> VisualMesh:
        return mesh if self._vary_mesh is None else self._vary_mesh(name, mesh)
