"""Compiled rasterization of triangle meshes into a depth buffer.

The view frame V is that of a camera or of a lamp: z along its axis, x to the right of the image, y
down. The nearness of a point, which is linear in the pixel, is 1 / z in a perspective view and -z
in a parallel one.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit
from drake_clutter.rendering.polygon_fill import fill_polygon
from drake_clutter.rendering.visual_mesh import VisualMesh

NUM_COEFFICIENTS = 20
"""Numbers that describe a drawn triangle, see `draw`."""


class View(NamedTuple):
    """Projection of the view frame onto an image.

    Attributes:
        scale: Focal length of a perspective view [px]; pixels per meter of a parallel one [px/m].
        u0: Column of the view's axis [px].
        v0: Row of the view's axis [px].
        is_perspective: Whether the view is perspective.
        near: Depth in front of which nothing is drawn [m].
    """

    scale: float
    u0: float
    v0: float
    is_perspective: bool
    near: float


class MeshArrays(NamedTuple):
    """Arrays of several meshes, one after the other.

    Attributes:
        points: Vertices in the frame of their mesh [m]. Shape (V, 3).
        normals: Unit normals of the vertices. Shape (V, 3).
        uv: Position in the texture; integers are centers of its pixels [px]. Shape (V, 2).
        triangles: Vertex indices. Shape (F, 3).
        first_triangle: Index of the first triangle of each mesh, and of the end. Shape (m + 1,).
        texels: Pixels of all textures: red in the lowest 8 bits, then green, then blue. Shape (t,),
            uint32.
        texture: Start in `texels`, width and height of each texture, and whether it repeats. Shape
            (m, 4).
        color: Linear factor on the texture of each mesh. Shape (m, 3), float32.
        roughness: Roughness of each mesh. Shape (m,), float32.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    uv: NDArray[np.float64]
    triangles: NDArray[np.int64]
    first_triangle: NDArray[np.int64]
    texels: NDArray[np.uint32]
    texture: NDArray[np.int64]
    color: NDArray[np.float32]
    roughness: NDArray[np.float32]


def pack_meshes(meshes: Sequence[VisualMesh]) -> MeshArrays:
    """Return the arrays of at least one mesh; meshes with the same picture share it."""
    first_vertex = np.cumsum([0] + [len(mesh.points) for mesh in meshes])
    first_triangle = np.cumsum([0] + [len(mesh.triangles) for mesh in meshes])
    starts = dict[int, int]()
    texels = list[NDArray[np.uint32]]()
    texture = list[tuple[int, ...]]()
    size = 0
    for mesh in meshes:
        if id(mesh.texture) not in starts:
            starts[id(mesh.texture)] = size
            channels = mesh.texture.reshape(-1, 3).astype(np.uint32)
            texels.append((channels << [0, 8, 16]).sum(axis=1, dtype=np.uint32))
            size += len(channels)
        height, width, _ = mesh.texture.shape
        repeats = mesh.uv.min(initial=0.0) < 0.0 or mesh.uv.max(initial=1.0) > 1.0
        texture.append((starts[id(mesh.texture)], width, height, int(repeats)))
    texture_array = np.array(texture, np.int64)
    uv = [mesh.uv * row[1:3] - 0.5 for mesh, row in zip(meshes, texture_array, strict=True)]
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, first_vertex, strict=False)]

    def stack(rows: list[Any], dtype: type) -> NDArray[Any]:
        return np.ascontiguousarray(np.concatenate(rows), dtype)

    return MeshArrays(
        stack([mesh.points for mesh in meshes], np.float64),
        stack([mesh.normals for mesh in meshes], np.float64),
        stack(uv, np.float64),
        stack(triangles, np.int64),
        first_triangle,
        stack(texels, np.uint32),
        texture_array,
        np.array([mesh.color for mesh in meshes], np.float32),
        np.array([mesh.roughness for mesh in meshes], np.float32),
    )


@njit(cache=True, nogil=True)
def _clip_near(p, near, clipped):  # type: ignore[no-untyped-def]
    """Cut off the part of a triangle in front of the near plane.

    Args:
        p: Corners in V [m]. Shape (3, 3).
        near: Depth of the plane [m].
        clipped: Output: corners of the remaining polygon [m]. Shape (4, 3).

    Returns:
        Number of its corners.
    """
    count = 0
    for c in range(3):
        d = c + 1 if c < 2 else 0
        if p[c, 2] >= near:
            clipped[count] = p[c]
            count += 1
        if (p[c, 2] >= near) != (p[d, 2] >= near):
            # From the corner behind the plane, so that both triangles of an edge cut it alike.
            a, b = (c, d) if p[c, 2] >= near else (d, c)
            t = (p[a, 2] - near) / (p[a, 2] - p[b, 2])
            for axis in range(2):
                clipped[count, axis] = p[a, axis] + t * (p[b, axis] - p[a, axis])
            clipped[count, 2] = near
            count += 1
    return count


@njit(cache=True, nogil=True)
def _weights(p, view, w):  # type: ignore[no-untyped-def]
    """Find the weights of a triangle's corners as linear functions of the pixel.

    In a perspective view they are the barycentric coordinates divided by z.

    Args:
        p: Corners in V [m]. Shape (3, 3).
        view: `View`.
        w: Output: slope along a row, slope along a column, and value at pixel (0, 0), for each
            corner. Shape (3, 3).

    Returns:
        False if the triangle is seen edge-on.
    """
    determinant = 0.0
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        if view.is_perspective:
            x = p[a, 1] * p[b, 2] - p[a, 2] * p[b, 1]
            y = p[a, 2] * p[b, 0] - p[a, 0] * p[b, 2]
            z = p[a, 0] * p[b, 1] - p[a, 1] * p[b, 0]
        else:
            x = p[a, 1] - p[b, 1]
            y = p[b, 0] - p[a, 0]
            z = p[a, 0] * p[b, 1] - p[a, 1] * p[b, 0]
        w[c, 0], w[c, 1], w[c, 2] = x, y, z
        if view.is_perspective:
            if c == 0:
                determinant = x * p[0, 0] + y * p[0, 1] + z * p[0, 2]
        else:
            determinant += z
    if determinant == 0.0:
        return False
    for c in range(3):
        x, y, z = w[c, 0] / determinant, w[c, 1] / determinant, w[c, 2] / determinant
        x, y = x / view.scale, y / view.scale
        w[c, 0], w[c, 1], w[c, 2] = x, y, z - x * view.u0 - y * view.v0
    return True


@njit(cache=True, nogil=True)
def _describe(mesh, corners, R, w, plane, u, v, surface):  # type: ignore[no-untyped-def]
    """Describe a drawn triangle for shading, see `draw`."""
    surface[0], surface[1] = u, v
    surface[2] = plane[0]
    surface[3] = plane[1]
    surface[4] = plane[0] * u + plane[1] * v + plane[2]
    for k in range(5):
        along = down = start = 0.0
        for c in range(3):
            if k < 3:
                n = mesh.normals[corners[c]]
                value = R[k, 0] * n[0] + R[k, 1] * n[1] + R[k, 2] * n[2]
            else:
                value = mesh.uv[corners[c], k - 3]
            along += value * w[c, 0]
            down += value * w[c, 1]
            start += value * w[c, 2]
        surface[5 + 3 * k] = along
        surface[6 + 3 * k] = down
        surface[7 + 3 * k] = along * u + down * v + start


@njit(cache=True, nogil=True)
def draw(meshes, mesh_ids, X_VG, view, nearest, hit, surfaces, owner):  # type: ignore[no-untyped-def]
    """Draw instances of meshes.

    Args:
        meshes: `MeshArrays`.
        mesh_ids: Mesh of each instance. Shape (n,).
        X_VG: Pose of each instance, rotation and translation [m]. Shape (n, 3, 4).
        view: `View`.
        nearest: Nearness of what is seen, to be initialized with that of the background. Shape
            (height, width), float32.
        hit: Number of the triangle that is seen, to be initialized with -1. Shape (height, width).
        surfaces: Output: for each triangle, a pixel (u, v), then slope along a row, slope along a
            column and value at (u, v) of: 1 / z; the three components of the normal in V, divided
            by z; the position in the texture, divided by z [px]. Shape (t, 20), float32; t = 0 if
            it is not needed.
        owner: Output: instance of each triangle. Shape (t,).

    Returns:
        Number of triangles.
    """
    begin = np.empty(nearest.shape[0], np.int64)
    end = np.empty(nearest.shape[0], np.int64)
    p, polygon, w = np.empty((3, 3)), np.empty((4, 3)), np.empty((3, 3))
    u, v = np.empty(4), np.empty(4)
    count = 0
    for i in range(len(mesh_ids)):
        X = X_VG[i]
        first, last = meshes.first_triangle[mesh_ids[i]], meshes.first_triangle[mesh_ids[i] + 1]
        for triangle in range(first, last):
            corners = meshes.triangles[triangle]
            lowest, highest = np.inf, -np.inf
            for c in range(3):
                q = meshes.points[corners[c]]
                for axis in range(3):
                    p[c, axis] = (
                        X[axis, 0] * q[0] + X[axis, 1] * q[1] + X[axis, 2] * q[2] + X[axis, 3]
                    )
                lowest, highest = min(lowest, p[c, 2]), max(highest, p[c, 2])
            if highest < view.near:
                continue
            if lowest >= view.near:
                num_corners = 3
                polygon[:3] = p
            else:
                num_corners = _clip_near(p, view.near, polygon)
            left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
            for c in range(num_corners):
                scale = view.scale / polygon[c, 2] if view.is_perspective else view.scale
                u[c], v[c] = view.u0 + scale * polygon[c, 0], view.v0 + scale * polygon[c, 1]
                left, right = min(left, u[c]), max(right, u[c])
                top, bottom = min(top, v[c]), max(bottom, v[c])
            if (
                right < 0.0
                or bottom < 0.0
                or left > nearest.shape[1] - 1.0
                or top > nearest.shape[0] - 1.0
            ):
                continue
            area = 0.0
            for c in range(1, num_corners - 1):
                area += (u[c] - u[0]) * (v[c + 1] - v[0]) - (u[c + 1] - u[0]) * (v[c] - v[0])
            if area == 0.0 or not _weights(p, view, w):
                continue
            if area > 0.0:  # clockwise in the image
                for c in range(1, (num_corners + 1) // 2):
                    u[c], u[num_corners - c] = u[num_corners - c], u[c]
                    v[c], v[num_corners - c] = v[num_corners - c], v[c]
            if view.is_perspective:
                plane = (
                    w[0, 0] + w[1, 0] + w[2, 0],
                    w[0, 1] + w[1, 1] + w[2, 1],
                    w[0, 2] + w[1, 2] + w[2, 2],
                )
            else:
                plane = (
                    -(w[0, 0] * p[0, 2] + w[1, 0] * p[1, 2] + w[2, 0] * p[2, 2]),
                    -(w[0, 1] * p[0, 2] + w[1, 1] * p[1, 2] + w[2, 1] * p[2, 2]),
                    -(w[0, 2] * p[0, 2] + w[1, 2] * p[1, 2] + w[2, 2] * p[2, 2]),
                )
            label = np.int32(count)
            drawn = fill_polygon(u, v, num_corners, plane, label, nearest, hit, begin, end)
            if drawn and len(surfaces):
                at_u = min(max(left, 0.0), nearest.shape[1] - 1.0)
                at_v = min(max(top, 0.0), nearest.shape[0] - 1.0)
                _describe(meshes, corners, X, w, plane, at_u, at_v, surfaces[count])
                owner[count] = i
                count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def resolve(nearest, hit, owner, labels, limits, depth, label):  # type: ignore[no-untyped-def]
    """Write depth and labels of what was drawn.

    Args:
        nearest: Nearness of a perspective view, 0 where there is nothing. Shape (height, width).
        hit: Triangle in each pixel, -1 where there is none. Shape (height, width).
        owner: Instance of each triangle. Shape (t,).
        labels: Label of each instance. Shape (n,).
        limits: Depths below which the image holds 0, and above which it is infinite [m].
        depth: Output: depth; infinite where there is nothing [m]. Shape (height, width).
        label: Output: label; -1 where there is nothing. Shape (height, width).
    """
    lowest, highest = limits
    one, zero, nothing = np.float32(1.0), np.float32(0.0), np.float32(np.inf)
    for row in range(hit.shape[0]):
        for column in range(hit.shape[1]):
            value = one / nearest[row, column]
            value = zero if value < lowest else value
            depth[row, column] = nothing if value > highest else value
        for column in range(hit.shape[1]):
            triangle = hit[row, column]
            label[row, column] = labels[owner[triangle]] if triangle >= 0 else -1
