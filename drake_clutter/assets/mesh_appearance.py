"""Visual geometry of a user's mesh with the textures and colors of its file."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from drake_clutter.assets.textured_mesh import TexturedMesh
from drake_clutter.files import InputError
from drake_clutter.mesh_file import MeshPart, ObjectMesh
from drake_clutter.visual_mesh import obj_companions

Floats = NDArray[np.float64]
"""An array of floats."""

MAX_TEXTURE_SIDE = 1024
"""Largest side of a texture; larger ones are reduced [pixels].

At the distance of the camera, a pixel of the image covers several of its pixels.
"""
MAX_VISUAL_TRIANGLES = 40_000
"""Largest number of visible triangles of a mesh; finer meshes are simplified.

Those of an object of 0.2 m are then 1 to 2 mm large, less than a pixel of the image, and take less
than 2 MB in the file.
"""
_CELL_GROWTH = 1.1
"""Factor between two sizes of cells that are tried."""
_SMOOTH_ANGLE = np.radians(30)
"""Faces whose normals differ by less are shaded as one smooth surface [rad]."""
_COLOR_BITS = 6
"""Bits of each channel of a vertex color: the palette has 512 x 512 pixels."""
_PALETTE_SIDE = 2 ** (3 * _COLOR_BITS // 2)


def has_appearance(mesh: ObjectMesh) -> bool:
    """Return whether a mesh file has textures, materials or vertex colors."""
    return any(part.visual.defined for part in mesh.parts if part.visual.kind is not None)


def _corner_normals(points: Floats, triangles: NDArray[np.int64]) -> Floats:
    """Return unit normals at the corners of triangles, smooth but for edges. Shape (F, 3, 3).

    Args:
        points: Vertices [m]. Shape (V, 3).
        triangles: Vertex indices. Shape (F, 3).
    """
    # Vertices that are split at seams share their normals.
    place = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)[triangles]
    corners = points[triangles]
    area_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-20)
    normals = area_normals / lengths
    face = np.repeat(np.arange(len(triangles)), 3)
    at_place = csr_array((np.ones(len(face)), (place.reshape(-1), face)))
    # Corners (rows) and the faces that meet at their place (columns).
    meeting = at_place[place.reshape(-1)].tocoo()
    row, other = meeting.coords
    smooth = (normals[face[row]] * normals[other]).sum(axis=1) > np.cos(_SMOOTH_ANGLE)
    total = np.zeros((len(face), 3))
    np.add.at(total, row[smooth], area_normals[other[smooth]])
    # A triangle without area has no normal; any unit vector will do.
    total[np.linalg.norm(total, axis=1) < 1e-20] = [0.0, 0.0, 1.0]
    unit = total / np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(unit.reshape(-1, 3, 3))


def _check_obj_companions(path: Path) -> None:
    """Raise an error if a material file or a texture of an OBJ file is missing.

    trimesh ignores missing textures.
    """
    for file in obj_companions(path):
        if not file.is_file():
            raise InputError(f"{path}: file {file.name} is missing; put it beside the mesh")


def _material_image(material: Any) -> Image.Image | None:
    """Return the color texture of a material, or None."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None:
        return None
    pixels: Image.Image = image.convert("RGB")
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None:
        scale = np.asarray(factor, float)[:3] / 255
        pixels = Image.fromarray(np.asarray(np.asarray(pixels) * scale, np.uint8))
    pixels.thumbnail((MAX_TEXTURE_SIDE, MAX_TEXTURE_SIDE), Image.Resampling.LANCZOS)
    return pixels


def _encode(image: Image.Image) -> bytes:
    """Return an image as a PNG file with all its colors."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _palette_uv(colors: NDArray[np.uint8]) -> tuple[Floats, Image.Image]:
    """Return texture coordinates of colors (F, 3) in a palette, and the palette."""
    levels = colors.astype(np.int64) >> (8 - _COLOR_BITS)
    index = (levels << np.array([2 * _COLOR_BITS, _COLOR_BITS, 0])).sum(axis=1)
    palette = np.zeros((_PALETTE_SIDE**2, 3), np.uint8)
    palette[index] = colors
    uv = np.column_stack([index % _PALETTE_SIDE, index // _PALETTE_SIDE])
    image = Image.fromarray(palette.reshape(_PALETTE_SIDE, _PALETTE_SIDE, 3))
    return (uv + 0.5) / _PALETTE_SIDE, image


def simplify_surface(
    points: Floats, triangles: NDArray[np.int64], values: Floats, max_triangles: int
) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Return a surface with fewer triangles, by clustering of vertices in cubic cells.

    The vertices of a cell become their mean (Rossignac and Borrel 1993, "Multi-resolution 3D
    approximations for rendering complex scenes"). Values of both sides of a seam stay apart.

    Args:
        points: Vertices [m]. Shape (V, 3).
        triangles: Vertex indices. Shape (F, 3).
        values: Texture coordinates or colors at the corners of the triangles. Shape (F, 3, k).
        max_triangles: Largest number of triangles.

    Returns:
        The same three of the new surface.
    """
    if len(triangles) <= max_triangles:
        return points, triangles, values
    corners = points[triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ).sum()
    edges = np.vstack([triangles[:, :2], triangles[:, 1:]]).T
    links = coo_array((np.ones(edges.shape[1], bool), edges), shape=(len(points),) * 2)
    chart = connected_components(links, directed=False)[1]
    size = np.sqrt(area / max_triangles) / _CELL_GROWTH
    kept = np.ones(len(triangles), bool)
    while kept.sum() > max_triangles:
        size *= _CELL_GROWTH
        cell = np.unique(np.floor(points / size), axis=0, return_inverse=True)[1].reshape(-1)
        a, b, c = cell[triangles].T
        kept = (a != b) & (b != c) & (c != a)

    def mean_by(group: NDArray[np.int64], of_corners: Floats) -> Floats:
        counts = np.maximum(np.bincount(group), 1)
        columns = [np.bincount(group, each) / counts for each in of_corners.T]
        return np.column_stack(columns) if columns else np.zeros((len(counts), 0))

    # Means over the same corners keep textures that are linear in the position undistorted.
    side = np.unique(np.column_stack([cell, chart]), axis=0, return_inverse=True)[1].reshape(-1)
    new_points = mean_by(cell[triangles].reshape(-1), corners.reshape(-1, 3))
    new_values = mean_by(side[triangles].reshape(-1), values.reshape(-1, values.shape[2]))
    return new_points, cell[triangles[kept]], new_values[side[triangles[kept]]]


def _texture_part(part: MeshPart, max_triangles: int) -> tuple[TexturedMesh, bytes]:
    """Return a part with its texture as a PNG file.

    Args:
        part: The part.
        max_triangles: Largest number of triangles.
    """
    visual = part.visual
    values = np.full((len(part.triangles), 3, 2), 0.5)
    image: Image.Image | None = None
    has_colors = visual.kind in ("vertex", "face")
    if visual.kind == "texture":
        image = _material_image(visual.material)
        if image is not None and visual.uv is not None:
            # trimesh counts v from the lower edge, glTF from the upper one.
            values = np.asarray(visual.uv, float)[part.triangles] * [1, -1] + [0, 1]
        else:
            color = tuple(int(value) for value in visual.material.main_color[:3])
            image = Image.new("RGB", (2, 2), color)
    elif visual.kind == "vertex":
        values = np.asarray(visual.vertex_colors, float)[part.triangles, :3]
    elif visual.kind == "face":
        colors = np.asarray(visual.face_colors, float)[part.triangle_ids, :3]
        values = np.repeat(colors[:, None], 3, axis=1)
    else:
        image = Image.new("RGB", (2, 2), "#b0b7bf")
    points, triangles, uv = simplify_surface(part.points, part.triangles, values, max_triangles)
    if has_colors:
        color_uv, image = _palette_uv(uv.mean(axis=1).astype(np.uint8))
        uv = np.repeat(color_uv[:, None], 3, axis=1)
    assert image is not None
    normals = _corner_normals(points, triangles)
    vertices = np.concatenate([points[triangles], normals, uv], axis=2).reshape(-1, 8)
    vertices, index = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    surface = TexturedMesh(
        vertices[:, :3], vertices[:, 3:6], vertices[:, 6:], index.reshape(-1, 3).astype(np.int64)
    )
    return surface, _encode(image)


def textured_parts(mesh: ObjectMesh, path: Path) -> list[tuple[TexturedMesh, bytes]]:
    """Return the parts of a mesh and their textures as PNG files.

    They have at most `MAX_VISUAL_TRIANGLES` triangles together, and textures of at most
    `MAX_TEXTURE_SIDE` pixels a side.

    Args:
        mesh: The mesh.
        path: Its file.

    Raises:
        InputError: A texture or a material file is missing.
    """
    if path.suffix.lower() == ".obj":
        _check_obj_companions(path)
    total = sum(len(part.triangles) for part in mesh.parts)
    share = min(1.0, MAX_VISUAL_TRIANGLES / total)
    return [_texture_part(part, math.ceil(share * len(part.triangles))) for part in mesh.parts]
