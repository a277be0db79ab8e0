"""Renderer of color, depth and labels of textured meshes.

Frames: W is the world, C the camera: z along the optical axis, x to the right of the image, y down;
G is the frame of a mesh, L the view frame of a lamp.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import MAX_DEPTH
from drake_clutter.rendering.antialiasing import smooth_edges
from drake_clutter.rendering.lighting import Lamp, LampKind, Lighting
from drake_clutter.rendering.rasterizer import NUM_COEFFICIENTS, View, draw, pack_meshes, resolve
from drake_clutter.rendering.shading import (
    LampArrays,
    make_decoding_table,
    make_encoding_table,
    shade,
)
from drake_clutter.rendering.visual_mesh import VisualMesh

Floats = NDArray[np.float64]
"""An array of floats."""

NEAR_DEPTH = 0.05
"""Depth in front of which nothing is drawn, that of the VTK engine [m]."""
MIN_SENSOR_DEPTH = 0.1
"""Depth below which a depth image holds 0, that of the VTK engine [m]."""
SHADOW_MAP_SIZE = 1024
"""Width and height of a shadow map [px]: about 2 mm a pixel for a work cell."""
MAX_LAMP_TANGENT = 4.0
"""Tangent of the largest half angle of a point lamp's shadow map; light beyond is unshadowed."""


class MeshInstances(NamedTuple):
    """Meshes at poses.

    Attributes:
        mesh_ids: Index of each mesh. Shape (n,), int64.
        X_WG: Poses, rotation and translation [m]. Shape (n, 3, 4).
        labels: Label of each instance. Shape (n,), int64.
    """

    mesh_ids: NDArray[np.int64]
    X_WG: Floats
    labels: NDArray[np.int64]


@dataclass(frozen=True)
class RenderedImages:
    """Rendered images of a scene.

    Attributes:
        color: sRGB image, uint8. Shape (height, width, 3).
        depth: Depth along the camera's axis [m]; inf where nothing is seen within `MAX_DEPTH`, 0
            where it is below `MIN_SENSOR_DEPTH`. Shape (height, width).
        label: Index of the object in the scene, or label of the instance; -1 for the support and
            the background. Shape (height, width).
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    label: NDArray[np.int64]


class _Drawing(NamedTuple):
    """What is seen from a camera, see `drake_clutter.rendering.rasterizer.draw`."""

    X_CG: Floats
    view: View
    nearest: NDArray[np.float32]
    hit: NDArray[np.int32]
    surfaces: NDArray[np.float32]
    owner: NDArray[np.int64]


def _multiply(A: Floats, B: Floats) -> Floats:
    """Return the product of matrices (..., l, m) and (..., m, n).

    It rounds alike on every machine, unlike that of BLAS.
    """
    return np.asarray((A[..., :, :, None] * B[..., None, :, :]).sum(axis=-2))


def _compose(X_AB: Floats, X_BC: Floats) -> Floats:
    """Return X_AC for X_AB (3, 4) and X_BC (n, 3, 4) [m]."""
    X_AC = _multiply(X_AB[:, :3], X_BC)
    X_AC[..., 3] += X_AB[:, 3]
    return np.ascontiguousarray(X_AC)


def _invert(X_AB: Floats) -> Floats:
    """Return X_BA for X_AB (3, 4) [m]."""
    R_BA = X_AB[:, :3].T
    return np.column_stack([R_BA, -_multiply(R_BA, X_AB[:, 3:])])


def _rotation_along(direction: Floats) -> Floats:
    """Return R_CL (3, 3) of a view frame whose z axis is a direction (3,)."""
    z = direction / math.hypot(*direction)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= math.hypot(*x)
    return np.column_stack([x, np.cross(z, x), z])


class MeshRenderer:
    """Renders instances of meshes that are prepared once.

    Nothing but scratch memory is kept from one image to the next.
    """

    def __init__(self, meshes: Sequence[VisualMesh]) -> None:
        """Prepare meshes.

        Args:
            meshes: The meshes, at least one; an instance names one by its index.
        """
        self._arrays = pack_meshes(meshes)
        bounds = [np.array([mesh.points.min(axis=0), mesh.points.max(axis=0)]) for mesh in meshes]
        choice = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
        self._corners = np.array([b[choice, np.arange(3)] for b in bounds])
        self._num_triangles = np.array([len(mesh.triangles) for mesh in meshes])
        self._tables = make_decoding_table(), make_encoding_table()
        self._scratch = dict[str, NDArray[Any]]()

    def render(
        self, camera: Camera, X_WC: Floats, instances: MeshInstances, lighting: Lighting
    ) -> RenderedImages:
        """Return the images of a view.

        Args:
            camera: Size and intrinsics of the images.
            X_WC: Pose of the camera, rotation and translation [m]. Shape (3, 4).
            instances: What is seen.
            lighting: Light of the color image.
        """
        drawing = self._draw(camera, X_WC, instances)
        size = camera.height, camera.width
        color = self._memory("color", (*size, 3), np.uint8)
        shade(
            self._arrays,
            instances.mesh_ids,
            drawing.view,
            drawing.hit,
            drawing.surfaces,
            drawing.owner,
            self._lamp_arrays(lighting, _invert(X_WC), instances.mesh_ids, drawing.X_CG),
            np.float32(lighting.ambient * lighting.exposure),
            self._tables,
            lighting.background,
            color,
        )
        depth, label = _resolve_images(drawing, instances.labels)
        return RenderedImages(
            smooth_edges(color, self._memory("luminosity", size, np.float32)), depth, label
        )

    def render_depth_and_label(
        self, camera: Camera, X_WC: Floats, instances: MeshInstances
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the depth and label images, see `render`."""
        drawing = self._draw(camera, X_WC, instances)
        return _resolve_images(drawing, instances.labels)

    def _draw(self, camera: Camera, X_WC: Floats, instances: MeshInstances) -> _Drawing:
        """Return what is seen from a camera, see `render`."""
        X_CG = _compose(_invert(X_WC), instances.X_WG)
        view = View(camera.focal_length, *camera.principal_point, True, NEAR_DEPTH)
        size = camera.height, camera.width
        nearest = self._memory("nearest", size, np.float32)
        hit = self._memory("hit", size, np.int32)
        nearest[:] = 0.0
        hit[:] = -1
        count = max(int(self._num_triangles[instances.mesh_ids].sum()), 1)
        surfaces = np.empty((count, NUM_COEFFICIENTS), np.float32)
        owner = np.zeros(count, np.int64)
        draw(self._arrays, instances.mesh_ids, X_CG, view, nearest, hit, surfaces, owner)
        return _Drawing(X_CG, view, nearest, hit, surfaces, owner)

    def _lamp_arrays(
        self, lighting: Lighting, X_CW: Floats, mesh_ids: NDArray[np.int64], X_CG: Floats
    ) -> LampArrays:
        """Return the lamps in the frame of the camera, with their shadow maps."""
        count = len(lighting.lamps)
        vectors = np.zeros((count, 3))
        shadow_map = np.full(count, -1)
        num_maps = sum(lamp.casts_shadows for lamp in lighting.lamps) if len(mesh_ids) else 0
        size = SHADOW_MAP_SIZE
        maps = self._memory("maps", (num_maps, size, size), np.float32)
        poses = list[Floats]()
        views = list[View]()
        for k, lamp in enumerate(lighting.lamps):
            vector = np.array(lamp.vector)
            rotated = _multiply(X_CW[:, :3], vector[:, None])[:, 0]
            if lamp.kind is LampKind.DIRECTIONAL:
                direction = vector if lamp.is_on_camera else rotated
                vectors[k] = -direction / math.hypot(*direction)
            else:
                vectors[k] = vector if lamp.is_on_camera else rotated + X_CW[:, 3]
            if lamp.casts_shadows and len(mesh_ids):
                X_LC, view = self._lamp_view(lamp, vectors[k], mesh_ids, X_CG)
                nearest = maps[len(poses)]
                nearest[:] = 0.0 if view.is_perspective else -np.inf
                nothing = np.empty((0, NUM_COEFFICIENTS), np.float32)
                X_LG = _compose(X_LC, X_CG)
                hit = self._memory("map_hit", (size, size), np.int32)
                draw(
                    self._arrays, mesh_ids, X_LG, view, nearest, hit, nothing, np.empty(0, np.int64)
                )
                shadow_map[k] = len(poses)
                poses.append(X_LC)
                views.append(view)
        colors = [
            lighting.exposure * lamp.intensity * np.array(lamp.color) for lamp in lighting.lamps
        ]
        return LampArrays(
            vectors.astype(np.float32),
            np.array(colors, np.float32).reshape(-1, 3),
            np.array([lamp.kind is LampKind.POINT for lamp in lighting.lamps], np.bool_),
            shadow_map,
            maps,
            np.array(poses, np.float32).reshape(-1, 3, 4),
            np.array([view[:4] for view in views], np.float32).reshape(-1, 4),
        )

    def _memory(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """Return memory with undefined content, which is kept.

        New memory for each image would cost more than the image.
        """
        if name not in self._scratch or self._scratch[name].shape != shape:
            self._scratch[name] = np.empty(shape, dtype)
        return self._scratch[name]

    def _lamp_view(
        self, lamp: Lamp, vector: Floats, mesh_ids: NDArray[np.int64], X_CG: Floats
    ) -> tuple[Floats, View]:
        """Return X_LC of a lamp's view frame, and a view that contains all instances.

        Args:
            lamp: The lamp.
            vector: Its unit vector or position in C, see `LampArrays`. Shape (3,).
            mesh_ids: Mesh of each instance. Shape (n,).
            X_CG: Pose of each instance. Shape (n, 3, 4).
        """
        R_GC = X_CG[:, :, :3].transpose(0, 2, 1)
        p_C = _multiply(self._corners[mesh_ids], R_GC) + X_CG[:, None, :, 3]
        p_C = p_C.reshape(-1, 3)
        middle = (p_C.min(axis=0) + p_C.max(axis=0)) / 2
        center = (SHADOW_MAP_SIZE - 1) / 2
        # A pixel at the border stays empty, so that the interpolation has both neighbors.
        room = SHADOW_MAP_SIZE / 2 - 2
        if lamp.kind is LampKind.DIRECTIONAL:
            R_CL = _rotation_along(-vector)
            p_L = _multiply(p_C - middle, R_CL)
            scale = room / np.abs(p_L[:, :2]).max()
            X_CL = np.column_stack([R_CL, middle])
            return _invert(X_CL), View(float(scale), center, center, False, -np.inf)
        axis = middle - vector
        R_CL = _rotation_along(axis if math.hypot(*axis) > NEAR_DEPTH else np.array([0, 0, 1.0]))
        p_L = _multiply(p_C - vector, R_CL)
        depth = np.maximum(p_L[:, 2], NEAR_DEPTH)
        tangent = min(float((np.abs(p_L[:, :2]).max(axis=1) / depth).max()), MAX_LAMP_TANGENT)
        X_CL = np.column_stack([R_CL, vector])
        return _invert(X_CL), View(room / tangent, center, center, True, NEAR_DEPTH)


def _resolve_images(
    drawing: _Drawing, labels: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return depth and label images for the labels of instances (n,); see `RenderedImages`."""
    depth = np.empty(drawing.hit.shape, np.float32)
    label = np.empty(drawing.hit.shape, np.int64)
    limits = np.float32(MIN_SENSOR_DEPTH), np.float32(MAX_DEPTH)
    resolve(drawing.nearest, drawing.hit, drawing.owner, labels, limits, depth, label)
    return depth, label
