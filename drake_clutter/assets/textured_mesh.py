"""Visual geometry with texture coordinates, as a self-contained glTF 2.0 file.

Texture coordinates follow glTF: (0, 0) is the upper left corner of the picture, (1, 1) the lower
right one. A region (u0, v0, u1, v1) is a rectangle of the picture.
"""

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

Region = tuple[float, float, float, float]
"""A rectangle (u0, v0, u1, v1) of a picture."""
Floats = NDArray[np.float64]
"""An array of floats."""

_NUM_SEGMENTS = 48
"""Segments of a cylinder's circumference."""
# Axes in O along which a face's picture runs to the right and up. Their cross product is the
# outward normal.
_FACE_AXES = {
    "front": ((0, 1, 0), (0, 0, 1)),
    "back": ((0, -1, 0), (0, 0, 1)),
    "right": ((-1, 0, 0), (0, 0, 1)),
    "left": ((1, 0, 0), (0, 0, 1)),
    "top": ((0, 1, 0), (-1, 0, 0)),
    "bottom": ((0, 1, 0), (1, 0, 0)),
}


@dataclass(frozen=True)
class TexturedMesh:
    """A textured triangle mesh in O.

    Attributes:
        points: Vertices [m]. Shape (V, 3).
        normals: Unit normals of the vertices. Shape (V, 3).
        uv: Texture coordinates of the vertices. Shape (V, 2).
        triangles: Vertex indices, counter-clockwise seen from outside. Shape (F, 3).
    """

    points: Floats
    normals: Floats
    uv: Floats
    triangles: NDArray[np.int64]


def _concatenate(parts: list[TexturedMesh]) -> TexturedMesh:
    """Return several meshes as one."""
    starts = np.cumsum([0] + [len(part.points) for part in parts[:-1]])
    return TexturedMesh(
        np.vstack([part.points for part in parts]),
        np.vstack([part.normals for part in parts]),
        np.vstack([part.uv for part in parts]),
        np.vstack([part.triangles + start for part, start in zip(parts, starts, strict=True)]),
    )


def box_mesh(size: tuple[float, float, float], regions: dict[str, Region]) -> TexturedMesh:
    """Return a textured box.

    Args:
        size: Extents [m]. Shape (3,).
        regions: Regions for front (+x), back, right (+y), left, top (+z) and bottom.
    """
    half = np.asarray(size) / 2
    parts = []
    for face, (right, up) in _FACE_AXES.items():
        u0, v0, u1, v1 = regions[face]
        normal = np.cross(right, up)
        corners = np.array(
            [
                normal + i * np.array(right) + j * np.array(up)
                for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
            ]
        )
        uv = np.array([[u0, v1], [u1, v1], [u1, v0], [u0, v0]])
        parts.append(
            TexturedMesh(
                corners * half, np.tile(normal, (4, 1)), uv, np.array([[0, 1, 2], [0, 2, 3]])
            )
        )
    return _concatenate(parts)


def cylinder_mesh(size: tuple[float, float, float], regions: dict[str, Region]) -> TexturedMesh:
    """Return a textured cylinder.

    The picture of the side starts at -y and runs counter-clockwise seen from above, so that +x is
    at a quarter of its width.

    Args:
        size: Diameter, diameter and height [m].
        regions: Regions for side, top and bottom.
    """
    half = np.asarray(size) / 2
    turns = np.linspace(0, 1, _NUM_SEGMENTS + 1)
    angle = 2 * math.pi * (turns - 0.25)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    u0, v0, u1, v1 = regions["side"]
    u = u0 + (u1 - u0) * turns
    rings = [np.column_stack([ring, np.full(len(ring), z)]) for z in (-1.0, 1.0)]
    normals = np.column_stack([ring, np.zeros(len(ring))])
    uv = np.vstack([np.column_stack([u, np.full(len(u), v)]) for v in (v1, v0)])
    low = np.arange(_NUM_SEGMENTS)
    high = low + len(ring)
    quads = np.vstack(
        [np.column_stack([low, low + 1, high + 1]), np.column_stack([low, high + 1, high])]
    )
    parts = [TexturedMesh(np.vstack(rings) * half, np.vstack([normals, normals]), uv, quads)]
    for face in ("top", "bottom"):
        right, up = (np.array(axis) for axis in _FACE_AXES[face])
        u0, v0, u1, v1 = regions[face]
        disc = np.vstack([[0, 0], ring[:-1]])
        points = np.cross(right, up) + disc[:, :1] * right + disc[:, 1:] * up
        uv = np.column_stack(
            [u0 + (u1 - u0) * (1 + disc[:, 0]) / 2, v1 + (v0 - v1) * (1 + disc[:, 1]) / 2]
        )
        fan = np.array([[0, 1 + i, 1 + (i + 1) % _NUM_SEGMENTS] for i in range(_NUM_SEGMENTS)])
        parts.append(
            TexturedMesh(points * half, np.tile(np.cross(right, up), (len(points), 1)), uv, fan)
        )
    return _concatenate(parts)


def map_strip_texture(mesh: trimesh.Trimesh, region: Region) -> TexturedMesh:
    """Return a mesh in O whose texture coordinates follow the height.

    The bottom of the mesh has the color at the bottom of the region, its top that at the top.
    """
    shaded = trimesh.graph.smooth_shade(mesh, angle=math.radians(30))
    points = np.asarray(shaded.vertices, float)
    low, high = mesh.bounds[:, 2]
    u0, v0, u1, v1 = region
    v = v1 + (v0 - v1) * (points[:, 2] - low) / (high - low)
    uv = np.column_stack([np.full(len(points), (u0 + u1) / 2), v])
    return TexturedMesh(
        points, np.asarray(shaded.vertex_normals, float), uv, np.asarray(shaded.faces, np.int64)
    )


def _data_uri(kind: str, data: bytes) -> str:
    """Return data as a URI with base64 encoding."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def gltf_text(parts: Sequence[tuple[TexturedMesh, bytes]], *, repeat: bool = False) -> str:
    """Return the content of one glTF file with embedded PNG textures.

    Args:
        parts: Meshes and their textures.
        repeat: Whether textures repeat outside of [0, 1].
    """
    # The y axis of glTF points up; Drake rotates it back to z.
    y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    views = []
    accessors: list[dict[str, Any]] = []
    primitives = []
    buffer = b""
    for material, (surface, _) in enumerate(parts):
        first = len(accessors)
        arrays: list[tuple[NDArray[Any], str, int]] = [
            ((surface.points @ y_up.T).astype("<f4"), "VEC3", 34962),
            ((surface.normals @ y_up.T).astype("<f4"), "VEC3", 34962),
            (surface.uv.astype("<f4"), "VEC2", 34962),
            (surface.triangles.reshape(-1).astype("<u4"), "SCALAR", 34963),
        ]
        for index, (array, kind, target) in enumerate(arrays):
            data = array.tobytes()
            views.append(
                {"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data), "target": target}
            )
            accessor: dict[str, Any] = {
                "bufferView": first + index,
                "componentType": 5125 if kind == "SCALAR" else 5126,
                "count": len(array),
                "type": kind,
            }
            if index == 0:
                accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
            accessors.append(accessor)
            buffer += data
        primitives.append(
            {
                "attributes": {"POSITION": first, "NORMAL": first + 1, "TEXCOORD_0": first + 2},
                "indices": first + 3,
                "material": material,
            }
        )
    wrap = 10497 if repeat else 33071
    document = {
        "asset": {"version": "2.0", "generator": "drake_clutter"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": index},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.8,
                }
            }
            for index in range(len(parts))
        ],
        "textures": [{"sampler": 0, "source": index} for index in range(len(parts))],
        # Linear, without mipmaps: with mipmaps, Mesa's software renderer hangs on a face that is
        # seen exactly edge-on.
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": wrap, "wrapT": wrap}],
        "images": [{"uri": _data_uri("image/png", png)} for _, png in parts],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [
            {"uri": _data_uri("application/octet-stream", buffer), "byteLength": len(buffer)}
        ],
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n"
