"""Convex pieces of a mesh with a bounded number of corners, and how far they are from it."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import io
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryInstance,
    InMemoryMesh,
    Mesh,
    ProximityProperties,
    QueryObject,
    SceneGraph,
)
from pydrake.math import RigidTransform
from scipy.spatial import ConvexHull, cKDTree

from drake_clutter.files import InputError
from drake_clutter.mesh_file import contains, is_flat

Floats = NDArray[np.float64]
"""An array of floats."""

MAX_PIECE_CORNERS = 128
"""Largest number of corners of a convex piece.

128 points on a sphere leave 2 % of its radius at most. The time of contact queries grows with the
number of corners.
"""
SURFACE_TOLERANCE = 0.0002
"""A piece gets no more corners once its surface is moved by less than this [m]."""
_FLAT_ANGLE = np.radians(2.0)
"""Triangles of a convex hull whose normals differ by less may be of one flat face [rad]."""
_MIN_FLAT_FRACTION = 0.02
"""Area of a flat face, on which an object may stand, as a fraction of that of the hull.

Triangles of a ball within `_FLAT_ANGLE` make up 0.0003 of it.
"""
_NUM_FLAT_CANDIDATES = 200
"""Number of triangles, the largest first, around which flat faces are searched."""
_NUM_FLAT_CORNERS = 32
"""Largest number of corners of a flat face: a disk with a radius of 30 mm loses 0.14 mm."""
MAX_DENT = 0.001
"""A mesh that lies nowhere deeper than this below its convex hull counts as convex [m].

It exceeds the noise of scanners, which is a few tenths of a millimeter.
"""
_MAX_DENT_FRACTION = 0.02
"""Largest such depth as a fraction of the smallest extent, so that a thin plate keeps its rim."""
_CONVEX_VOLUME_RATIO = 0.999
"""A mesh whose volume is at least this fraction of its hull's counts as convex."""
MAX_BULGE = 0.0035
"""Largest distance of the pieces of a body beyond its surface at which no finer ones are made [m].

A suction cup touches the pieces and seals on the surface below, up to
`drake_clutter.cell.suction.MAX_SEAL_GAP`, less the gap that the planner leaves above the pieces.
"""
_THRESHOLDS = (0.06, 0.04, 0.03)
"""Concavities up to which CoACD leaves a piece; the first one that obeys `MAX_BULGE` is taken."""
_COACD_OPTIONS = {
    "mcts_iterations": 20,
    "mcts_nodes": 10,
    "mcts_max_depth": 2,
    "resolution": 1000,
    "seed": 1,
}
"""Options of CoACD for few pieces, as every piece costs simulation time.

With its default options, CoACD makes 48 pieces of the example's mug.
"""
MAX_DECOMPOSITION_TIME = 300.0
"""Largest time that CoACD may take for a body [s]; the example's mug takes 2 s."""
_COACD_SCRIPT = Path(__file__).with_name("coacd_process.py")
_NUM_EXACT_DISTANCES = 200
"""Number of vertices farthest outside of all pieces whose distance is computed exactly."""


def obj_text(mesh: trimesh.Trimesh) -> str:
    """Return a mesh as the content of an OBJ file."""
    lines = ["v {:.7f} {:.7f} {:.7f}".format(*vertex) for vertex in mesh.vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    return "\n".join(lines) + "\n"


def _excess(hull: ConvexHull, points: Floats) -> Floats:
    """Return how far points (N, 3) are beyond the planes of a hull [m]; negative inside."""
    excess = np.full(len(points), -np.inf)
    for start in range(0, len(points), 4096):  # a group of rows keeps the memory small
        part = points[start : start + 4096] @ hull.equations[:, :3].T + hull.equations[:, 3]
        excess[start : start + 4096] = part.max(axis=1)
    return excess


def _first_corners(points: Floats) -> list[int]:
    """Return the indices of a tetrahedron's corners and of the extreme points along the axes."""
    first = int(points[:, 0].argmin())
    second = int(np.linalg.norm(points - points[first], axis=1).argmax())
    arms = points - points[first]
    area = np.linalg.norm(np.cross(arms, arms[second]), axis=1)
    third = int(area.argmax())
    fourth = int(np.abs(arms @ np.cross(arms[second], arms[third])).argmax())
    extremes = [*points.argmin(axis=0).tolist(), *points.argmax(axis=0).tolist()]
    return list(dict.fromkeys([first, second, third, fourth, *extremes]))


def _flat_faces(hull: trimesh.Trimesh) -> list[list[int]]:
    """Return the corners of the flat faces of a convex hull, the largest face first.

    Of a round face, the corners that are farthest in `_NUM_FLAT_CORNERS` directions are taken.

    Returns:
        Indices of the hull's vertices.
    """
    normals = np.asarray(hull.face_normals)
    areas = np.asarray(hull.area_faces)
    remaining = areas.copy()
    faces = list[tuple[float, list[int]]]()
    for _ in range(_NUM_FLAT_CANDIDATES):
        normal = normals[remaining.argmax()]
        members = (normals @ normal > np.cos(_FLAT_ANGLE)) & (remaining > 0)
        area = float(areas[members].sum())
        remaining[members] = 0.0
        if area >= _MIN_FLAT_FRACTION * hull.area:
            corners = np.unique(hull.faces[members])
            axes = np.linalg.svd(normal[None])[2][1:]
            angle = np.arange(_NUM_FLAT_CORNERS) * (2 * np.pi / _NUM_FLAT_CORNERS)
            directions = np.array([np.cos(angle), np.sin(angle)])
            farthest = (hull.vertices[corners] @ axes.T @ directions).argmax(axis=0)
            faces.append((area, corners[np.unique(farthest)].tolist()))
        if remaining.sum() < _MIN_FLAT_FRACTION * hull.area:
            break
    return [corners for _, corners in sorted(faces, key=lambda face: -face[0])]


def bounded_hull(points: Floats) -> trimesh.Trimesh:
    """Return a convex hull with at most `MAX_PIECE_CORNERS` corners.

    Of a hull with more corners, those of flat faces are taken first, so that an object stands as
    the mesh does. Then the corner farthest outside is added until the number or `SURFACE_TOLERANCE`
    is reached. The result lies within the hull and has its bounding box.

    Args:
        points: Points that do not lie in a plane [m]. Shape (N, 3).
    """
    full: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    corners = np.asarray(full.vertices, float)
    if len(corners) <= MAX_PIECE_CORNERS:
        return full
    chosen = _first_corners(corners)
    for face in _flat_faces(full):
        added = [corner for corner in face if corner not in chosen]
        if len(chosen) + len(added) <= MAX_PIECE_CORNERS:
            chosen += added
    hull = ConvexHull(corners[chosen], incremental=True)
    while len(chosen) < MAX_PIECE_CORNERS:
        excess = _excess(hull, corners)
        farthest = int(excess.argmax())
        if excess[farthest] < SURFACE_TOLERANCE:
            break
        chosen.append(farthest)
        hull.add_points(corners[[farthest]])
    hull.close()
    bounded: trimesh.Trimesh = trimesh.convex.convex_hull(corners[chosen])
    return bounded


def _is_convex(mesh: trimesh.Trimesh) -> bool:
    """Return whether a mesh is convex but for noise."""
    if mesh.volume > _CONVEX_VOLUME_RATIO * mesh.convex_hull.volume:
        return True
    hull = ConvexHull(bounded_hull(mesh.vertices).vertices)
    # Dents of triangles that span a groove are at their centers.
    points = np.vstack([mesh.vertices, mesh.triangles_center])
    max_dent = min(MAX_DENT, _MAX_DENT_FRACTION * mesh.extents.min())
    return bool(_excess(hull, points).min() > -max_dent)


def _outer_bodies(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the bodies of a mesh without its closed cavities, which nothing can touch."""
    return [body for body in mesh.split(only_watertight=False) if body.volume > 0]


def decompose_convex(mesh: trimesh.Trimesh, where: str) -> list[trimesh.Trimesh]:
    """Return convex hulls that cover a mesh; one for each convex body.

    The decomposition is CoACD (Wei et al. 2022). Bodies are decomposed one by one, because CoACD
    does not return for some meshes of separate bodies. Closed cavities are filled. Every hull has
    at most `MAX_PIECE_CORNERS` corners.

    Args:
        mesh: A closed mesh.
        where: Field of the catalog, for error messages.

    Raises:
        InputError: CoACD fails, or does not return within `MAX_DECOMPOSITION_TIME`.
    """
    bodies = _outer_bodies(mesh)
    pieces = list[trimesh.Trimesh]()
    for number, body in enumerate(bodies, start=1):
        if _is_convex(body):
            pieces.append(bounded_hull(body.vertices))
            continue
        label = f"body {number} of {len(bodies)}: " if len(bodies) > 1 else ""
        low, high = body.bounds
        for threshold in _THRESHOLDS:
            corners = _run_coacd(body, threshold, f"{where}: {label}")
            # Clipped, because objects are stacked on the bounding box. A piece that is flat
            # afterwards has no volume, and is left out.
            clipped = [np.clip(points, low, high) for points in corners]
            hulls = [bounded_hull(points) for points in clipped if not is_flat(points)]
            if measure_deviation(body, hulls)[0] <= MAX_BULGE:
                break
        pieces += hulls
    return pieces


def _run_coacd(body: trimesh.Trimesh, threshold: float, prefix: str) -> list[Floats]:
    """Return the corners of the convex pieces that CoACD makes of a body [m]. Shapes (V, 3).

    CoACD runs in a process of its own, because it cannot be interrupted, and because Drake's SDF
    reader fails in a process that has loaded CoACD before Drake.

    Args:
        body: A closed mesh.
        threshold: Concavity up to which a piece is left.
        prefix: Start of error messages.
    """
    remedy = (
        f"reduce its {len(body.faces)} triangles, and close gaps and deep recesses that no object "
        "enters"
    )
    arrays = io.BytesIO()
    np.savez(arrays, vertices=body.vertices, faces=body.faces)
    options = {**_COACD_OPTIONS, "threshold": threshold}
    command = [sys.executable, "-P", str(_COACD_SCRIPT), json.dumps(options)]
    try:
        run = subprocess.run(
            command,
            input=arrays.getvalue(),
            capture_output=True,
            timeout=MAX_DECOMPOSITION_TIME,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"{prefix}CoACD found no convex pieces within {MAX_DECOMPOSITION_TIME:g} s; {remedy}"
        ) from error
    except subprocess.CalledProcessError as error:
        last_line = error.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise InputError(
            f"{prefix}CoACD failed with exit code {error.returncode} ({last_line}); {remedy}"
        ) from error
    with np.load(io.BytesIO(run.stdout)) as pieces:
        return [np.asarray(corners, float) for corners in pieces.values()]


def _distance_query(mesh: trimesh.Trimesh) -> tuple[SceneGraph, QueryObject]:
    """Return Drake's query of distances to a closed mesh, with the geometry that it needs."""
    scene_graph = SceneGraph()
    file = MemoryFile(obj_text(mesh), ".obj", "mesh")
    shape = Mesh(InMemoryMesh(mesh_file=file), 1.0)
    instance = GeometryInstance(RigidTransform(), shape, "mesh")
    instance.set_proximity_properties(ProximityProperties())
    scene_graph.RegisterAnchoredGeometry(scene_graph.RegisterSource("mesh"), instance)
    context = scene_graph.CreateDefaultContext()
    return scene_graph, scene_graph.get_query_output_port().Eval(context)


def _largest_distance_outside(mesh: trimesh.Trimesh, points: Floats) -> float:
    """Return the largest distance of points outside of a mesh from it [m]; 0 if all are inside.

    Args:
        mesh: A closed mesh.
        points: Points [m]. Shape (N, 3).
    """
    centers = cKDTree(mesh.triangles_center)
    radius = np.linalg.norm(mesh.triangles - mesh.triangles_center[:, None], axis=2).max()
    distances = np.empty(len(points))
    for k, (point, bound) in enumerate(zip(points, centers.query(points)[0], strict=True)):
        near = mesh.triangles[centers.query_ball_point(point, bound + radius)]
        closest = trimesh.triangles.closest_point(near, np.tile(point, (len(near), 1)))
        distances[k] = np.linalg.norm(closest - point, axis=1).min()
    for k in np.argsort(-distances):
        if not contains(mesh, points[k]):
            return float(distances[k])
    return 0.0


def measure_deviation(
    mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]
) -> tuple[float, float]:
    """Return how far convex pieces bulge beyond a mesh, and recede behind it [m].

    The bulge is measured at the corners, the edges' midpoints and the centers of the faces of the
    pieces, the recess at the vertices of the mesh.

    Args:
        mesh: A closed mesh, whose cavities do not count.
        pieces: Convex pieces that cover it.
    """
    outer: trimesh.Trimesh = trimesh.util.concatenate(_outer_bodies(mesh))  # type: ignore[assignment]
    points = np.vstack(
        [
            np.vstack([p.vertices, p.vertices[p.edges_unique].mean(axis=1), p.triangles_center])
            for p in pieces
        ]
    )
    try:
        _scene_graph, query = _distance_query(outer)
        distances = [query.ComputeSignedDistanceToPoint(point)[0].distance for point in points]
        bulge = max(0.0, *distances)
    except RuntimeError:  # Drake refuses meshes with a fold of almost 180 deg, as scans have.
        bulge = _largest_distance_outside(outer, points)
    recess = np.full(len(outer.vertices), np.inf)
    for piece in pieces:
        recess = np.minimum(recess, _excess(ConvexHull(piece.vertices), outer.vertices))
    # The excess over planes is at most the distance, so the largest ones are computed exactly.
    farthest = np.argsort(recess)[-_NUM_EXACT_DISTANCES:]
    outside = outer.vertices[farthest[recess[farthest] > 0]]
    triangles = np.vstack([piece.triangles for piece in pieces])
    distances = [
        np.linalg.norm(
            trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1))) - point,
            axis=1,
        ).min()
        for point in outside
    ]
    return bulge, float(max(distances, default=0.0))
