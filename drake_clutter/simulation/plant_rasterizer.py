"""Compiled rendering of what a Drake scene graph shows: robots, grippers, objects and fixtures.

Frames: W is the world, C the camera, G a geometry.
"""

from collections.abc import Hashable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    QueryObject,
    RenderLabel,
    Rgba,
    Role,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform

from drake_clutter.cell.camera import Camera
from drake_clutter.files import InputError
from drake_clutter.rendering.lighting import Lighting
from drake_clutter.rendering.mesh_renderer import MeshInstances, MeshRenderer, RenderedImages
from drake_clutter.rendering.visual_mesh import (
    VisualMesh,
    box_visual,
    capsule_visual,
    cylinder_visual,
    load_visual_meshes,
    scaled_visual,
)

Color = tuple[float, float, float]
"""Linear red, green and blue."""

TINT = ("drake_clutter", "tint")
"""Group and name of a perception property: linear factor on the colors of a mesh file, `Rgba`."""
_NO_TINT = Rgba(1.0, 1.0, 1.0, 1.0)
_DEFAULT_COLOR = Rgba(0.9, 0.9, 0.9, 1.0)
"""Color of geometry that has none, that of Drake's VTK engine."""


def _visuals_of(shape: Shape, color: Color, tint: Color, name: str) -> tuple[VisualMesh, ...]:
    """Return the meshes of a shape in its frame.

    Args:
        shape: The shape.
        color: Red, green and blue in [0, 1], of shapes without a material of their own.
        tint: Factors on red, green and blue of the materials of files.
        name: Name of the geometry for messages.

    Raises:
        InputError: Shapes of this kind, or this file, cannot be drawn.
    """
    if isinstance(shape, Box):
        return (box_visual(shape.size(), color),)
    if isinstance(shape, Cylinder):
        return (cylinder_visual(shape.radius(), shape.length(), color),)
    if isinstance(shape, Sphere):
        return (capsule_visual(shape.radius(), 0.0, color),)
    if isinstance(shape, Capsule):
        return (capsule_visual(shape.radius(), shape.length(), color),)
    if isinstance(shape, Ellipsoid):
        return (scaled_visual(capsule_visual(1.0, 0.0, color), (shape.a(), shape.b(), shape.c())),)
    if isinstance(shape, Mesh | Convex) and shape.source().is_path():
        parts = load_visual_meshes(Path(shape.source().path()))
        return tuple(_tinted(scaled_visual(part, shape.scale3()), tint) for part in parts)
    raise InputError(f"{name}: the compiled renderer draws no {type(shape).__name__}")


def _tinted(mesh: VisualMesh, tint: Color) -> VisualMesh:
    """Return a mesh whose color is multiplied by a tint."""
    red, green, blue = (a * b for a, b in zip(mesh.color, tint, strict=True))
    return replace(mesh, color=(red, green, blue))


def _shape_key(shape: Shape, color: Color, tint: Color) -> Hashable:
    """Return what is equal for shapes with the same meshes."""
    return repr(shape), color, tint


class PlantRasterizer:
    """Renders the geometry of a scene graph that has the perception role.

    The meshes are prepared once; for each image, only poses are read.
    """

    def __init__(self, inspector: SceneGraphInspector) -> None:
        """Prepare the meshes.

        Args:
            inspector: Inspector of the scene graph, with all geometry.

        Raises:
            InputError: A geometry cannot be drawn.
        """
        meshes = list[VisualMesh]()
        by_shape = dict[Hashable, range]()
        mesh_ids = list[int]()
        labels = list[int]()
        self._geometries = []
        for geometry in inspector.GetAllGeometryIds(Role.kPerception):
            properties = inspector.GetPerceptionProperties(geometry)
            rgba = properties.GetPropertyOrDefault("phong", "diffuse", _DEFAULT_COLOR)
            if rgba.a() == 0.0:
                continue
            color = rgba.r(), rgba.g(), rgba.b()
            shape = inspector.GetShape(geometry)
            factors = properties.GetPropertyOrDefault(*TINT, _NO_TINT)
            tint = factors.r(), factors.g(), factors.b()
            key = _shape_key(shape, color, tint)
            if key not in by_shape:
                parts = _visuals_of(shape, color, tint, inspector.GetName(geometry))
                by_shape[key] = range(len(meshes), len(meshes) + len(parts))
                meshes += parts
            label = properties.GetPropertyOrDefault("label", "id", RenderLabel.kUnspecified)
            for mesh in by_shape[key]:
                self._geometries.append(geometry)
                mesh_ids.append(mesh)
                labels.append(int(label))
        self._mesh_ids = np.array(mesh_ids, np.int64)
        self._labels = np.array(labels, np.int64)
        self._renderer = MeshRenderer(meshes)

    def render(
        self, camera: Camera, X_WC: RigidTransform, query: QueryObject, lighting: Lighting
    ) -> RenderedImages:
        """Return the images of a view; labels are Drake's render labels, -1 where nothing is seen.

        Args:
            camera: Size and intrinsics of the images.
            X_WC: Pose of the camera.
            query: Query object with the poses of the geometry.
            lighting: Light of the color image.
        """
        poses = [query.GetPoseInWorld(geometry).GetAsMatrix34() for geometry in self._geometries]
        instances = MeshInstances(self._mesh_ids, np.array(poses), self._labels)
        return self._renderer.render(camera, X_WC.GetAsMatrix34(), instances, lighting)
