"""Reading, checking and repairing the meshes of a user's object classes.

A file may hold several bodies, and a body several parts with a material each. Vertices that are
split at texture seams, at normals per face or between materials are merged for the solid; the
parts keep them for the visual geometry. Coordinates in messages are those of the file, converted to
meters; of glTF files, they are those with z up.
"""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drake_clutter.files import InputError
from drake_clutter.visual_mesh import GLTF_SUFFIXES, check_textures

Floats = NDArray[np.float64]
"""An array of floats."""
Ints = NDArray[np.int64]
"""An array of integers."""

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Transform from a frame with y up (glTF) to one with z up. Shape (4, 4)."""
MAX_HOLE_SIZE = 0.02
"""Largest extent of a hole that a repair closes, as a fraction of the mesh's largest extent.

Larger holes may be openings of a model that has no walls, which a lid would turn into a solid.
"""
MAX_TRIANGLES = 1_000_000
"""Largest number of triangles, twice that of the finest published scans of household objects (YCB).
"""
MIN_EXTENT = 0.003
"""Smallest extent of an object [m]."""
MAX_EXTENT = 1.0
"""Largest extent of an object [m]."""
_MERGE_DISTANCE = 1e-6
"""Vertices closer than this are merged, as a fraction of the mesh's largest extent.

It is the resolution of single precision, in which most formats store coordinates.
"""
_MIN_THICKNESS = 1e-5
"""A body whose mean thickness is smaller is a surface without volume [m]."""
_WINDING_GRID = 64
"""Number of vertical lines a side along which winding numbers are measured."""
MAX_INVERTED_FRACTION = 1e-3
"""Largest fraction of a mesh's volume that may be inside out: the accuracy of the lines."""
MAX_OVERLAP_FRACTION = 0.05
"""Largest fraction of a mesh's volume that may be covered twice, as where a handle enters a wall.

The overlap counts twice in the inertia, whose error is of this order.
"""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """A part of a mesh file with one material, in O.

    Attributes:
        points: Vertices as in the file, split at seams [m]. Shape (V, 3).
        triangles: Vertex indices, counter-clockwise seen from outside. Shape (F, 3).
        triangle_ids: Indices of the triangles in their part of the file. Shape (F,).
        visual: Appearance, a visual of `trimesh`.
    """

    points: Floats
    triangles: Ints
    triangle_ids: Ints
    visual: Any


@dataclass(frozen=True, eq=False)
class ObjectMesh:
    """A user's mesh, with the center of its bounding box at the origin of O.

    Attributes:
        solid: Closed surface of all bodies with merged vertices and outward normals.
        parts: What is seen, a part for each material.
        center: Center of the bounding box in the coordinates of the messages [m]. Shape (3,).
        repairs: What was repaired, other than merged vertices.
        holes: Holes that were closed in `solid` and need the user's consent.
    """

    solid: trimesh.Trimesh
    parts: tuple[MeshPart, ...]
    center: Floats
    repairs: tuple[str, ...]
    holes: tuple[str, ...]


@dataclass(frozen=True)
class _Body:
    """A connected surface.

    Attributes:
        label: Name and number in messages; "" for the only body.
        faces: Indices of its triangles. Shape (F,).
    """

    label: str
    faces: Ints


def format_point(point: Floats) -> str:
    """Return a point for a message."""
    return f"({', '.join(f'{value:.4g}' for value in point)})"


@contextmanager
def _reading_mesh(path: Path, where: str) -> Iterator[None]:
    """Turn whatever the readers of meshes and images raise into an `InputError`.

    What they log or warn of is either repaired, or in the message of the error.
    """
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise whatever their formats suggest
        reason = " ".join(str(error).split())[:140] or type(error).__name__
        raise InputError(f"{where}: {path} cannot be read as a mesh ({reason})") from error
    finally:
        logger.setLevel(level)


def _read_parts(path: Path, where: str, scale: float) -> list[tuple[str, trimesh.Trimesh]]:
    """Return the names and meshes of the parts of a file, z up and in meters."""
    parts = []
    with _reading_mesh(path, where):
        check_textures(path)
        scene = trimesh.load_scene(path, process=False)
        for node in sorted(scene.graph.nodes_geometry):
            transform, geometry = scene.graph[node]
            part = scene.geometry[geometry]
            if isinstance(part, trimesh.Trimesh) and len(part.faces):
                faces, count = np.asarray(part.faces), len(part.vertices)
                if faces.min() < 0 or faces.max() >= count:
                    wrong = faces[(faces < 0) | (faces >= count)][0]
                    raise ValueError(f"a triangle has vertex {wrong} of {count}")
                if np.shape(part.vertices)[1] != 3:
                    raise ValueError("its vertices have not three coordinates")
                part = part.copy()
                part.apply_transform(transform)
                if path.suffix.lower() in GLTF_SUFFIXES:
                    part.apply_transform(Y_UP_TO_Z_UP)
                if scale != 1:
                    part.vertices = np.asarray(part.vertices, float) * scale
                parts.append((str(node), part))
        num_triangles = sum(len(part.faces) for _, part in parts)
        if not num_triangles:
            raise ValueError("it has no triangles")
    if num_triangles > MAX_TRIANGLES:
        raise InputError(
            f"{where}: {path} has {num_triangles} triangles; expected at most {MAX_TRIANGLES}, "
            "simplify the mesh"
        )
    return parts


def _check_extent(points: Floats, path: Path, where: str) -> None:
    """Raise an error if a mesh has coordinates that are not finite, or an unsuitable size."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(
            f"{where}: {path}: {len(bad)} vertices are not finite; "
            f"the first is {format_point(points[bad[0]])}"
        )
    extent = np.ptp(points, axis=0)
    if extent.min() >= MIN_EXTENT and extent.max() <= MAX_EXTENT:
        return
    hint = "(see `mesh_unit`)"
    if extent.max() > MAX_EXTENT:
        unit, factor = ("cm", 0.01) if extent.max() <= 30 else ("mm", 0.001)
        if extent.max() * factor <= MAX_EXTENT:
            hint = f"(is it in {unit}? Set `mesh_unit: {unit}` of the class)"
    elif extent.min() < _MIN_THICKNESS:
        hint = "; it is a flat surface without volume"
    x, y, z = extent
    raise InputError(
        f"{where}: {path} measures {x:.4g} x {y:.4g} x {z:.4g} m; "
        f"expected {MIN_EXTENT} to {MAX_EXTENT:g} m a side {hint}"
    )


def _merge_vertices(points: Floats, distance: float) -> Ints:
    """Return the index of the first vertex at the place of each vertex. Shape (V,)."""
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(points),) * 2)
    label = connected_components(links, directed=False)[1]
    return np.asarray(np.unique(label, return_index=True)[1][label], np.int64)


def _half_edges(triangles: Ints) -> Ints:
    """Return the directed edges of triangles, in the order of the triangles. Shape (3F, 2)."""
    return triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_counts(triangles: Ints) -> Ints:
    """Return the number of triangles at each half-edge of each triangle. Shape (F, 3)."""
    edges = np.sort(_half_edges(triangles), axis=1)
    _, index, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(counts[index.reshape(-1)].reshape(-1, 3), np.int64)


def _join_parts(points: Floats, triangles: Ints, part: Ints, distance: float) -> Ints:
    """Return triangles of merged vertices, where closed parts stay separate.

    Args:
        points: Vertices [m]. Shape (V, 3).
        triangles: Vertex indices. Shape (F, 3).
        part: Part of each triangle. Shape (F,).
        distance: Distance below which vertices are merged [m].
    """
    merged = triangles.copy()
    is_open = np.zeros(len(triangles), bool)
    for index in np.unique(part):
        members = np.flatnonzero(part == index)
        used, local = np.unique(triangles[members], return_inverse=True)
        merged[members] = used[_merge_vertices(points[used], distance)[local.reshape(-1, 3)]]
        valid = _without_degenerate(merged[members])
        is_open[members] = bool((_edge_counts(merged[members][valid]) != 2).any())
    if is_open.any():
        used, local = np.unique(triangles[is_open], return_inverse=True)
        merged[is_open] = used[_merge_vertices(points[used], distance)[local.reshape(-1, 3)]]
    return merged


def _without_degenerate(triangles: Ints) -> Ints:
    """Return the indices of triangles with three different vertices, each once."""
    a, b, c = triangles.T
    valid = np.flatnonzero((a != b) & (b != c) & (c != a))
    # Equal triangles begin with their smallest index after a rotation.
    start = triangles[valid].argmin(axis=1)
    rotated = np.take_along_axis(triangles[valid], (start[:, None] + np.arange(3)) % 3, axis=1)
    return np.sort(valid[np.unique(rotated, axis=0, return_index=True)[1]])


def _find_bodies(triangles: Ints, part: Ints, names: Sequence[str]) -> list[_Body]:
    """Return the bodies, which are connected by edges of two triangles."""
    edges = np.sort(_half_edges(triangles), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    links = coo_array(
        (np.ones(same.sum(), bool), (order[1:][same] // 3, order[:-1][same] // 3)),
        shape=(len(triangles),) * 2,
    )
    count, label = connected_components(links, directed=False)
    bodies = []
    for index in range(count):
        faces = np.flatnonzero(label == index)
        name = names[int(np.bincount(part[faces]).argmax())]
        text = f"body {index + 1} of {count} ({name}): " if count > 1 else ""
        bodies.append(_Body(text, faces))
    return bodies


def contains(mesh: trimesh.Trimesh, point: Floats) -> bool:
    """Return whether a closed surface contains a point, by its winding number."""
    a, b, c = (mesh.triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    determinant = (a * np.cross(b, c)).sum(axis=1)
    divisor = (
        la * lb * lc
        + (a * b).sum(axis=1) * lc
        + (b * c).sum(axis=1) * la
        + (c * a).sum(axis=1) * lb
    )
    return bool(abs(np.arctan2(determinant, divisor).sum()) > np.pi)


def _find_holes(triangles: Ints) -> list[Ints]:
    """Return the open half-edges of each hole. Shapes (E, 2)."""
    open_edges = _half_edges(triangles)[_edge_counts(triangles).reshape(-1) == 1]
    if not len(open_edges):
        return []
    links = coo_array(
        (np.ones(len(open_edges), bool), open_edges.T), shape=(triangles.max() + 1,) * 2
    )
    label = connected_components(links, directed=False)[1][open_edges[:, 0]]
    return [open_edges[label == index] for index in np.unique(label)]


def _is_consistent(triangles: Ints) -> bool:
    """Return whether no two triangles have the same half-edge."""
    edges = _half_edges(triangles)
    return len(np.unique(edges, axis=0)) == len(edges)


def is_flat(points: Floats) -> bool:
    """Return whether points lie in a plane."""
    arms = points - points.mean(axis=0)
    normal = np.linalg.eigh(arms.T @ arms)[1][:, 0]
    return float(np.ptp(arms @ normal)) < _MIN_THICKNESS


def _orient(triangles: Ints, points: Floats, prefix: str) -> Ints:
    """Return triangles that turn the same way around, in their order."""
    if _is_consistent(triangles):
        return triangles
    surface = trimesh.Trimesh(points, triangles, process=False)
    trimesh.repair.fix_winding(surface)
    oriented = np.asarray(surface.faces, np.int64)
    if not _is_consistent(oriented):
        raise InputError(f"{prefix}has no inside: its surface is one-sided, as a Moebius strip's")
    return oriented


def _check_edges(triangles: Ints, points: Floats, prefix: str, max_hole: float) -> None:
    """Raise an error unless triangles form a surface with small holes at most."""
    if is_flat(points[np.unique(triangles)]):
        place = format_point(points[triangles[0, 0]])
        raise InputError(f"{prefix}is a flat surface without thickness, at {place}")
    crowded = np.argwhere(_edge_counts(triangles) > 2)
    if len(crowded):
        place = format_point(points[triangles[tuple(crowded[0])]])
        raise InputError(
            f"{prefix}is not watertight: more than two triangles meet at an edge at {place}; "
            "give closed surfaces that do not share edges"
        )
    holes = _find_holes(triangles)
    extents = [_hole_extent(hole, points) for hole in holes]
    if max(extents, default=0.0) > max_hole:
        largest = holes[int(np.argmax(extents))]
        count = f"{len(holes)} holes, the largest" if len(holes) > 1 else "a hole"
        raise InputError(
            f"{prefix}is not watertight: {sum(len(hole) for hole in holes)} open edges around "
            f"{count} {max(extents) * 1000:.3g} mm wide at {format_point(points[largest[0, 0]])}; "
            "give a closed surface"
        )


def _hole_extent(hole: Ints, points: Floats) -> float:
    """Return the largest extent of a hole [m]."""
    return float(np.ptp(points[hole.reshape(-1)], axis=0).max())


def _flipped(before: Ints, after: Ints) -> NDArray[np.bool_]:
    """Return which triangles have the opposite cyclic order. Shape (F,)."""
    equal = [(np.roll(after, shift, axis=1) == before).all(axis=1) for shift in range(3)]
    return np.asarray(~np.any(equal, axis=0))


def load_object_mesh(path: Path, where: str, scale: float = 1.0) -> ObjectMesh:
    """Return a user's mesh as a closed solid and the parts that are seen.

    Vertices at one place are merged, and degenerate and repeated triangles removed. Bodies with
    mixed or inward normals are turned outward, except for cavities. Holes up to `MAX_HOLE_SIZE` are
    closed and listed.

    Args:
        path: The mesh file; glTF files are y up, all others z up.
        where: Field of the catalog, for error messages.
        scale: Unit of the file's coordinates [m].

    Raises:
        InputError: The mesh cannot be read or has a defect. The message says which and where.
    """
    if not path.is_file():
        raise InputError(f"{where}: no file {path}; give a mesh that lies beside the catalog")
    parts = _read_parts(path, where, scale)
    starts = np.cumsum([0] + [len(part.vertices) for _, part in parts[:-1]])
    points = np.vstack([np.asarray(part.vertices, float) for _, part in parts])
    triangles = np.vstack(
        [
            np.asarray(part.faces, np.int64) + start
            for (_, part), start in zip(parts, starts, strict=True)
        ]
    )
    part_ids = np.repeat(np.arange(len(parts)), [len(part.faces) for _, part in parts])
    triangle_ids = np.concatenate([np.arange(len(part.faces)) for _, part in parts])
    used = np.unique(triangles)
    _check_extent(points[used], path, where)
    size = float(np.ptp(points[used], axis=0).max())

    merged = _join_parts(points, triangles, part_ids, _MERGE_DISTANCE * size)
    kept = _without_degenerate(merged)
    merged = merged[kept]
    triangles = triangles[kept]
    part_ids = part_ids[kept]
    triangle_ids = triangle_ids[kept]

    if not len(merged):
        raise InputError(f"{where}: {path} has no triangle with an area; give a closed surface")
    names = [name for name, _ in parts]
    bodies = _find_bodies(merged, part_ids, names)
    surfaces = []
    repairs = list[str]()
    hole_texts = list[str]()
    for body in bodies:
        prefix = f"{where}: {path}: {body.label}"
        before = merged[body.faces]
        _check_edges(before, points, prefix, MAX_HOLE_SIZE * size)
        oriented = _orient(before, points, prefix)
        if oriented is not before:
            repairs.append(f"{body.label}turned triangles with the opposite winding")
        faces = [oriented]
        for hole in _find_holes(oriented):
            hole_texts.append(
                f"{body.label}hole of {len(hole)} edges, "
                f"{_hole_extent(hole, points) * 1000:.3g} mm wide, "
                f"at {format_point(points[hole[0, 0]])}"
            )
            points = np.vstack([points, points[np.unique(hole)].mean(axis=0)])
            tip = np.full(len(hole), len(points) - 1)
            faces.append(np.column_stack([hole[:, ::-1], tip]))
        surface = trimesh.Trimesh(points, np.vstack(faces), process=False)
        if 2 * abs(surface.volume) < _MIN_THICKNESS * surface.area:
            place = format_point(surface.triangles[0, 0])
            raise InputError(f"{prefix}is a surface without thickness, at {place}")
        surfaces.append(surface)

    flipped = np.zeros(len(merged), bool)
    for body, surface in zip(bodies, surfaces, strict=True):
        if surface.volume < 0:
            depth = sum(
                contains(other, surface.triangles[0].mean(axis=0))
                for other in surfaces
                if abs(other.volume) > abs(surface.volume)
            )
            if depth % 2 == 0:  # otherwise it is a cavity
                surface.invert()
                repairs.append(f"{body.label}turned its inward normals outward")
        final = np.asarray(surface.faces, np.int64)[: len(body.faces)]
        flipped[body.faces] = _flipped(merged[body.faces], final)
    triangles[flipped] = triangles[flipped, ::-1]

    used, local = np.unique(np.vstack([each.faces for each in surfaces]), return_inverse=True)
    center = (points[used].min(axis=0) + points[used].max(axis=0)) / 2
    seen = [
        MeshPart(
            np.asarray(part.vertices, float) - center,
            triangles[part_ids == index] - starts[index],
            triangle_ids[part_ids == index],
            part.visual,
        )
        for index, (_, part) in enumerate(parts)
        if np.any(part_ids == index)
    ]
    solid = trimesh.Trimesh(points[used] - center, local.reshape(-1, 3), process=False)
    return ObjectMesh(solid, tuple(seen), center, tuple(repairs), tuple(hole_texts))


@dataclass(frozen=True)
class WindingDefect:
    """Space whose winding number is neither 0 nor 1.

    Attributes:
        fraction: Its volume as a fraction of the mesh's volume.
        place: A point in it [m]; zeros if there is none. Shape (3,).
    """

    fraction: float
    place: Floats


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the z components of cross products of vectors in the plane."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _line_crossings(mesh: trimesh.Trimesh) -> tuple[Ints, Floats, Ints, Floats]:
    """Return where a grid of vertical lines crosses a mesh.

    Returns:
        Line, height [m] and direction of each crossing (1 into the mesh, -1 out of it), and the
        positions of the lines [m]. Shapes (n,), (n,), (n,), (L, 2).
    """
    low, high = mesh.bounds[:, :2]
    step = (high - low) / _WINDING_GRID
    # An irrational offset keeps the lines off the edges of regular meshes.
    origin = low + step * np.array([0.4142135, 0.7320508])
    corners = np.asarray(mesh.triangles, float)
    first = np.ceil((corners[:, :, :2].min(axis=1) - origin) / step).astype(np.int64)
    last = np.floor((corners[:, :, :2].max(axis=1) - origin) / step).astype(np.int64)
    first = np.maximum(first, 0)
    counts = np.maximum(np.minimum(last, _WINDING_GRID - 1) - first + 1, 0)
    candidates = counts.prod(axis=1)
    found = []
    # Triangles are taken in groups with about a million candidates each.
    groups = np.cumsum(candidates) // 1_000_000
    for group in np.unique(groups):
        members = np.flatnonzero((groups == group) & (candidates > 0))
        total = candidates[members]
        triangle = np.repeat(members, total)
        rank = np.arange(len(triangle)) - np.repeat(np.cumsum(total) - total, total)
        cells = first[triangle] + np.column_stack(
            [rank // counts[triangle, 1], rank % counts[triangle, 1]]
        )
        a, b, c = (corners[triangle, corner] for corner in range(3))
        arm = origin + cells * step - a[:, :2]
        side_b = (b - a)[:, :2]
        side_c = (c - a)[:, :2]
        area = _cross(side_b, side_c)
        with np.errstate(divide="ignore", invalid="ignore"):
            weight_b = _cross(arm, side_c) / area
            weight_c = _cross(side_b, arm) / area
            hit = (weight_b >= 0) & (weight_c >= 0) & (weight_b + weight_c <= 1)
            height = a[:, 2] + weight_b * (b - a)[:, 2] + weight_c * (c - a)[:, 2]
        line = cells[:, 0] * _WINDING_GRID + cells[:, 1]
        found.append((line[hit], height[hit], -np.sign(area[hit]).astype(np.int64)))
    index = np.arange(_WINDING_GRID**2)
    cells = np.column_stack([index // _WINDING_GRID, index % _WINDING_GRID])
    lines, heights, directions = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return lines, heights, directions, origin + cells * step


def measure_windings(mesh: trimesh.Trimesh) -> tuple[WindingDefect, WindingDefect]:
    """Return the space that is inside out, and the space that is covered more than once.

    Winding numbers are summed along a grid of vertical lines through the mesh.
    """
    lines, heights, directions, positions = _line_crossings(mesh)
    order = np.lexsort([heights, lines])
    lines = lines[order]
    heights = heights[order]
    # A line that crosses an edge twice or never does not return to 0, and is left out.
    winding = np.cumsum(directions[order])
    starts = np.flatnonzero(np.append(True, lines[1:] != lines[:-1]))
    ends = np.append(starts[1:], len(lines)) - 1
    base = np.append(0, winding[ends[:-1]])
    length = np.append(np.diff(heights), 0.0)
    length[ends] = 0.0
    counts = ends - starts + 1
    valid = np.repeat(winding[ends] == base, counts)
    winding = winding - np.repeat(base, counts)
    total = float(length[valid & (winding != 0)].sum())
    defects = []
    for wrong in (winding < 0, winding > 1):
        span = np.where(valid & wrong, length, 0.0)
        worst = int(span.argmax())
        place = np.array([*positions[lines[worst]], heights[worst] + span[worst] / 2])
        defects.append(WindingDefect(float(span.sum()) / max(total, 1e-12), place))
    return defects[0], defects[1]
