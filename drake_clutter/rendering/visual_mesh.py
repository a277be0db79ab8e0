"""Textured triangle meshes of one material, from files and of primitive shapes.

Texture coordinates follow glTF: (0, 0) is the upper left corner of the picture.
"""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from drake_clutter.files import reading_file
from drake_clutter.mesh_file import Y_UP_TO_Z_UP

Floats = NDArray[np.float64]
"""An array of floats."""

PRIMITIVE_ROUGHNESS = 0.525
"""Roughness of surfaces without a material, that of Drake's VTK engine (fitted to its images)."""
NUM_SEGMENTS = 50
"""Segments of the circumference of a primitive shape, those of Drake's VTK engine."""
_DEFAULT_GRAY = 0.9
"""Linear color of surfaces whose file names none, that of Drake's VTK engine."""


@dataclass(frozen=True, eq=False)
class VisualMesh:
    """A triangle mesh of one material in its frame G.

    Attributes:
        points: Vertices [m]. Shape (V, 3).
        normals: Unit normals of the vertices. Shape (V, 3).
        uv: Texture coordinates of the vertices. Shape (V, 2).
        triangles: Vertex indices. Shape (F, 3).
        texture: sRGB picture, uint8, of at least one pixel. Shape (h, w, 3).
        color: Linear factor on the texture. Shape (3,).
        roughness: Roughness of the surface, from 0 (mirror) to 1 (matte).
    """

    points: Floats
    normals: Floats
    uv: Floats
    triangles: NDArray[np.int64]
    texture: NDArray[np.uint8]
    color: tuple[float, float, float]
    roughness: float


_WHITE = np.full((1, 1, 3), 255, np.uint8)


def _plain_mesh(
    points: Floats,
    normals: Floats,
    uv: Floats,
    triangles: NDArray[np.int64],
    color: Sequence[float],
) -> VisualMesh:
    """Return a mesh with a texture of one white pixel."""
    red, green, blue = (float(value) for value in color[:3])
    return VisualMesh(
        points, normals, uv, triangles, _WHITE, (red, green, blue), PRIMITIVE_ROUGHNESS
    )


def box_visual(size: Sequence[float], color: Sequence[float]) -> VisualMesh:
    """Return a box with its center at the origin; each face shows the whole texture.

    Args:
        size: Extents [m]. Shape (3,).
        color: Linear red, green and blue; more components are ignored. Shape (3,).
    """
    points = list[Floats]()
    normals = list[Floats]()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            right = np.roll(normal, 1)
            up = np.cross(normal, right)
            for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                points.append(normal + i * right + j * up)
                normals.append(normal)
    first = 4 * np.arange(6)[:, None]
    triangles = np.vstack([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    uv = np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (6, 1))
    half = np.asarray(size) / 2
    return _plain_mesh(np.array(points) * half, np.array(normals), uv, triangles, color)


def revolved_visual(
    radii: Sequence[float],
    heights: Sequence[float],
    normals: Sequence[tuple[float, float]],
    color: Sequence[float],
) -> VisualMesh:
    """Return a surface of revolution about z.

    Args:
        radii: Radii of the profile, from one end to the other [m]. Shape (m,).
        heights: Heights of the profile [m]. Shape (m,).
        normals: Radial and vertical components of the unit normal at both ends of each segment of
            the profile. Shape (2 m - 2, 2).
        color: Linear red, green and blue. Shape (3,).
    """
    angle = 2 * np.pi * np.arange(NUM_SEGMENTS + 1) / NUM_SEGMENTS
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    points = list[Floats]()
    point_normals = list[Floats]()
    triangles = list[NDArray[np.int64]]()
    low = np.arange(NUM_SEGMENTS)
    quads = np.vstack(
        [
            np.column_stack([low, low + 1, low + len(ring) + 1]),
            np.column_stack([low, low + len(ring) + 1, low + len(ring)]),
        ]
    )
    for segment in range(len(radii) - 1):
        triangles.append(quads + 2 * segment * len(ring))
        for end in range(2):
            k = segment + end
            radial, vertical = normals[2 * segment + end]
            points.append(np.column_stack([radii[k] * ring, np.full(len(ring), heights[k])]))
            point_normals.append(np.column_stack([radial * ring, np.full(len(ring), vertical)]))
    all_points = np.vstack(points)
    uv = np.full((len(all_points), 2), 0.5)
    all_triangles = np.vstack(triangles).astype(np.int64)
    return _plain_mesh(all_points, np.vstack(point_normals), uv, all_triangles, color)


def cylinder_visual(radius: float, length: float, color: Sequence[float]) -> VisualMesh:
    """Return a cylinder along z with its center at the origin, sizes in m."""
    half = length / 2
    normals = [(0.0, -1.0)] * 2 + [(1.0, 0.0)] * 2 + [(0.0, 1.0)] * 2
    return revolved_visual((0.0, radius, radius, 0.0), (-half, -half, half, half), normals, color)


def capsule_visual(radius: float, length: float, color: Sequence[float]) -> VisualMesh:
    """Return a capsule along z with its center at the origin.

    Args:
        radius: Radius [m].
        length: Length of the cylindrical part; 0 for a sphere [m].
        color: Linear red, green and blue. Shape (3,).
    """
    angles = np.pi * (np.arange(NUM_SEGMENTS + 1) / NUM_SEGMENTS - 0.5)
    middle = NUM_SEGMENTS // 2
    angles = np.insert(angles, middle, angles[middle])
    shift = np.where(np.arange(len(angles)) <= middle, -length / 2, length / 2)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    normals = np.repeat(directions, 2, axis=0)[1:-1]
    return revolved_visual(
        (radius * directions[:, 0]).tolist(),
        (radius * directions[:, 1] + shift).tolist(),
        [(float(r), float(z)) for r, z in normals],
        color,
    )


def scaled_visual(mesh: VisualMesh, scale: Sequence[float]) -> VisualMesh:
    """Return a mesh whose coordinates are multiplied by factors along the axes. Shape (3,)."""
    factors = np.asarray(scale, float)
    normals = mesh.normals / factors
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return VisualMesh(
        mesh.points * factors,
        normals,
        mesh.uv,
        mesh.triangles,
        mesh.texture,
        mesh.color,
        mesh.roughness,
    )


@lru_cache(maxsize=128)
def load_visual_meshes(path: Path) -> tuple[VisualMesh, ...]:
    """Return the meshes of a glTF or OBJ file, one for each part, with z up.

    Metallic surfaces are treated as matte ones: there is nothing that they could reflect.

    Args:
        path: The file.

    Raises:
        InputError: The file cannot be read.
    """
    meshes = []
    with reading_file(path, "a mesh with its textures"):
        scene = trimesh.load_scene(path, process=False)
        is_gltf = path.suffix.lower() in (".gltf", ".glb")
        for node in sorted(scene.graph.nodes_geometry):
            X_GN, geometry = scene.graph[node]
            part = scene.geometry[geometry].copy()
            part.apply_transform(Y_UP_TO_Z_UP @ X_GN if is_gltf else X_GN)
            meshes.append(_mesh_of_part(part))
    return tuple(meshes)


def _mesh_of_part(part: Any) -> VisualMesh:
    """Return a part of a file as `trimesh` reads it."""
    texture = _WHITE
    color = np.full(3, _DEFAULT_GRAY)
    roughness = PRIMITIVE_ROUGHNESS
    uv = None
    if part.visual.kind == "texture":
        material = part.visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        factor = getattr(material, "baseColorFactor", None)
        if factor is None:
            factor = None if image is not None else material.main_color
        color = np.ones(3) if factor is None else np.asarray(factor, float)[:3] / 255
        if getattr(material, "roughnessFactor", None) is not None:
            roughness = float(material.roughnessFactor)
        if image is not None and part.visual.uv is not None:
            texture = np.asarray(image.convert("RGB"))
            # trimesh counts v from the lower edge.
            uv = np.asarray(part.visual.uv, float) * [1, -1] + [0, 1]
    points = np.asarray(part.vertices, float)
    red, green, blue = color.tolist()
    return VisualMesh(
        points,
        np.asarray(part.vertex_normals, float),
        np.full((len(points), 2), 0.5) if uv is None else uv,
        np.asarray(part.faces, np.int64),
        texture,
        (red, green, blue),
        roughness,
    )
