"""What the fast judge knows of an object in an orientation: the faces that it stands on and carries with, and its surface.

Everything lies in flat arrays, so that compiled loops need nothing but a row and a position per object.
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.scenes.scene import SceneObject

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_LEVEL_ANGLE = np.radians(1.5)
"""rad; a face or an axis that is further from level is taken to lean."""
RIM_CORNERS = 16
"""Corners of a can's rim, as in Drake's contact mesh of it; and the most that any face that carries is given."""
STRIP_HALF_WIDTH = 0.006
"""m, half the width of the strip on which a cylinder lies. Its centre of mass and its load are above the strip's middle, so the
width holds no moment; but a cylinder that lies over the gap of a pair touches both its edges."""
_FOOTPRINT_CORNERS = 32
_SURFACE_SIDES = 48
"""Sides of a cylinder's surface, as in the mesh that Drake's camera sees."""
_COPLANARITY_TOLERANCE = 1e-4
"""By which normals (and offsets, in sizes of the object) of one face's triangles may differ: files round corners to 0.1 um."""
_MAX_ROWS = 8192


class Fault(IntEnum):
    """Why an orientation cannot be judged by equilibrium; NONE if it can."""

    NONE = 0
    LEANING = 1
    NOT_CONVEX = 2


class _Surface(NamedTuple):
    """A class's surface in O.

    Attributes:
        corner: (V, 3) m, of one convex face after the other, counter-clockwise seen from outside.
        counts: (F,) corners of each face.
        normal: (F, 3).
        p_Ocm: (3,) m, its centre of mass.
    """

    corner: Floats
    counts: Ints
    normal: Floats
    p_Ocm: Floats


def _hull_surface(corners: Floats) -> _Surface:
    """Of a convex hull of uniform density; triangles of one plane are one face."""
    hull = ConvexHull(corners)
    planes = hull.equations * [1.0, 1.0, 1.0, 1.0 / np.ptp(corners, axis=0).max()]
    member = np.full(len(planes), -1)
    for triangle in range(len(planes)):
        if member[triangle] < 0:
            member[
                (np.abs(planes - planes[triangle]).max(axis=1) < _COPLANARITY_TOLERANCE)
                & (member < 0)
            ] = triangle
    faces, normals = [], []
    for index in np.unique(member):
        triangles = np.flatnonzero(member == index)
        normal = hull.equations[triangles[0], :3]
        points = corners[np.unique(hull.simplices[triangles])]
        arms = points - points.mean(axis=0)
        angle = np.arctan2(arms @ np.cross(normal, arms[0]), arms @ arms[0])
        faces.append(points[np.argsort(angle)])
        normals.append(normal)
    # Tetrahedra from an inner point to every triangle.
    inner = corners[hull.vertices].mean(axis=0)
    triangles = corners[hull.simplices] - inner
    volumes = np.abs(np.linalg.det(triangles))
    p_Ocm = inner + (volumes[:, None] * triangles.sum(axis=1)).sum(axis=0) / (4 * volumes.sum())
    return _Surface(
        np.vstack(faces), np.array([len(face) for face in faces]), np.array(normals), p_Ocm
    )


def _ring(radius: float, z: float, sides: int) -> Floats:
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)])


@cache
def _surface(object_class: ObjectClass) -> _Surface:
    if object_class.shape is not Shape.CYLINDER:
        return _hull_surface(object_class.corners)
    radius, half = object_class.size[0] / 2, object_class.size[2] / 2
    surface = _hull_surface(np.vstack([_ring(radius, z, _SURFACE_SIDES) for z in (-half, half)]))
    return surface._replace(p_Ocm=np.zeros(3))


def _convex_outline(points: Floats, max_corners: int) -> Floats:
    """(C, 2) corners of the points' hull seen from above, counter-clockwise; of too many, evenly chosen ones."""
    corners = points[ConvexHull(points[:, :2]).vertices, :2]
    return (
        corners[np.arange(max_corners) * len(corners) // max_corners]
        if len(corners) > max_corners
        else corners
    )


class OrientedShape(NamedTuple):
    """One object class in one orientation; lengths in m, axes those of T, origin the object's.

    Attributes:
        fault: see `Fault`.
        rolls: whether it is a cylinder that lies.
        com: (3,) its centre of mass.
        bottom, top: (C, 2) corners of the face that it stands on, and of the one that carries; none if there is no such face. A
            cylinder that lies has a strip, see `STRIP`, and a line of two points.
        bottom_z, top_z: heights of these faces' middles; where there is none, of the lowest and the highest point.
        footprint: (C, 2) corners of its outline seen from above, counter-clockwise.
        surface: its surface, with axes turned to those of T.
    """

    fault: Fault
    rolls: bool
    com: Floats
    bottom: Floats
    top: Floats
    bottom_z: float
    top_z: float
    footprint: Floats
    surface: _Surface


def orient_shape(object_class: ObjectClass, quaternion: Sequence[float]) -> OrientedShape:
    """The class in an orientation, (4,) w, x, y, z."""
    R_TO = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    surface = _surface(object_class)
    corner, normal = surface.corner @ R_TO.T, surface.normal @ R_TO.T
    empty = np.empty((0, 3))
    bottom, top, rolls = empty, empty, False
    if object_class.shape is Shape.CYLINDER and abs(R_TO[2, 2]) < np.sin(MAX_LEVEL_ANGLE):
        rolls = True
        up = np.array([0.0, 0.0, object_class.size[0] / 2])
        axis, half_width = (
            object_class.size[2] / 2 * R_TO[:, 2],
            STRIP_HALF_WIDTH * np.cross([0.0, 0.0, 1.0], R_TO[:, 2]),
        )
        top = np.array([axis, -axis]) + up
        bottom = (
            np.array([axis + half_width, half_width - axis, -axis - half_width, axis - half_width])
            - up
        )
    else:
        level = np.flatnonzero(np.abs(normal[:, 2]) > np.cos(MAX_LEVEL_ANGLE))
        faces = {
            face: corner[surface.counts[:face].sum() :][: surface.counts[face]] for face in level
        }
        below = [face for face in faces if normal[face, 2] < 0]
        above = [face for face in faces if normal[face, 2] > 0]
        bottom = faces[max(below, key=lambda face: _area(faces[face]))] if below else empty
        top = faces[max(above, key=lambda face: _area(faces[face]))] if above else empty
    fault = Fault.NONE if len(bottom) else Fault.LEANING
    if len(object_class.convex_pieces) > 1:
        fault = Fault.NOT_CONVEX
    return OrientedShape(
        fault,
        rolls,
        com=R_TO @ surface.p_Ocm,
        bottom=_convex_outline(bottom, RIM_CORNERS) if len(bottom) else empty[:, :2],
        top=top[:, :2] if len(top) < 3 else _convex_outline(top, RIM_CORNERS),
        bottom_z=float(bottom[:, 2].mean() if len(bottom) else corner[:, 2].min()),
        top_z=float(top[:, 2].mean() if len(top) else corner[:, 2].max()),
        footprint=_convex_outline(corner, _FOOTPRINT_CORNERS),
        surface=surface._replace(corner=corner, normal=normal),
    )


def _area(face: Floats) -> float:
    return float(np.linalg.norm(np.cross(face[1:-1] - face[0], face[2:] - face[0]).sum(axis=0)) / 2)


SHAPE_DTYPE = np.dtype(
    [
        ("fault", np.int64),
        ("rolls", np.bool_),
        ("flat", np.bool_),
        ("com", np.float64, 3),
        ("lower", np.float64, 3),
        ("upper", np.float64, 3),
        ("bottom_z", np.float64),
        ("top_z", np.float64),
        ("mass", np.float64),
        ("footprint_radius", np.float64),
        ("bottom", np.float64, (RIM_CORNERS, 2)),
        ("top", np.float64, (RIM_CORNERS, 2)),
        ("footprint", np.float64, (_FOOTPRINT_CORNERS, 2)),
        ("sides", np.float64, (_FOOTPRINT_CORNERS, 3)),
        ("bottom_count", np.int64),
        ("top_count", np.int64),
        ("footprint_count", np.int64),
        ("first_face", np.int64),
        ("last_face", np.int64),
    ]
)
"""A records shape in a record: see `Posed`, and

    flat: whether bottom and top are as large as the footprint.
    lower, upper: (3,) m, of the box along the axes that holds it.
    mass: kg.
    reach: m, radius of the circle about the object's origin that holds its footprint.
    sides: outward normal of each side of the footprint, and m along it from the origin.
    bottom_count, top_count, footprint_count: corners in use.
    first_face, last_face: its faces in the table, the end excluded.
"""


class ShapeArrays(NamedTuple):
    """Posed shapes in few arrays (each costs a compiled function a moment), with room for more.

    Attributes:
        records: (N,) of `POSED`.
        first_corner: (F + 1,) a face's corners are first_corner[f] up to first_corner[f + 1].
        normal: (F, 3).
        corner: (V, 3) m.
    """

    records: NDArray[np.void]
    first_corner: Ints
    normal: Floats
    corner: Floats


def _allocate(rows: int, faces: int, corners: int) -> ShapeArrays:
    return ShapeArrays(
        np.zeros(rows, SHAPE_DTYPE),
        np.zeros(faces + 1, np.int64),
        np.zeros((faces, 3)),
        np.zeros((corners, 3)),
    )


class ShapeTable:
    """A table of the records shapes that were asked for, each made once.

    Attributes:
        arrays: of all rows given out so far.
        generation: grows whenever the table starts anew, after which earlier rows mean nothing.
    """

    def __init__(self) -> None:
        self.generation = 0
        self._start()

    def _start(self) -> None:
        self._row: dict[tuple[ObjectClass, tuple[float, float, float, float]], int] = {}
        self.arrays = _allocate(64, 512, 4096)

    def find_rows(self, objects: Sequence[SceneObject]) -> Ints:
        """(n,) the table's row of each object."""
        if len(self._row) > _MAX_ROWS:
            self._start()
            self.generation += 1
        known = self._row
        try:
            return np.array(
                [known[o.object_class, o.X_TO.quaternion] for o in objects], dtype=np.int64
            )
        except KeyError:
            for o in objects:
                if (o.object_class, o.X_TO.quaternion) not in known:
                    self._add(o)
            return np.array(
                [known[o.object_class, o.X_TO.quaternion] for o in objects], dtype=np.int64
            )

    def rows_and_positions(self, objects: Sequence[SceneObject]) -> tuple[Ints, Floats]:
        """The table's row of each object (n,), and p_TO (n, 3) m."""
        return self.find_rows(objects), np.array([o.X_TO.translation for o in objects]).reshape(
            -1, 3
        )

    def _add(self, scene_object: SceneObject) -> None:
        shape = orient_shape(scene_object.object_class, scene_object.X_TO.quaternion)
        row = len(self._row)
        face = int(self.arrays.records["last_face"].max())
        corner = self.arrays.first_corner[face]
        last_face, last_corner = (
            face + len(shape.surface.counts),
            corner + len(shape.surface.corner),
        )
        if (
            row >= len(self.arrays.records)
            or last_face >= len(self.arrays.normal)
            or last_corner > len(self.arrays.corner)
        ):
            old = self.arrays
            self.arrays = _allocate(
                2 * len(old.records),
                2 * max(last_face + 1, len(old.normal)),
                2 * max(last_corner, len(old.corner)),
            )
            for array, earlier in zip(self.arrays, old, strict=True):
                array[: len(earlier)] = earlier
        table, records = self.arrays, self.arrays.records[row]
        records["fault"], records["rolls"], records["com"] = shape.fault, shape.rolls, shape.com
        records["flat"] = scene_object.object_class.shape is not Shape.MESH and not shape.rolls
        records["lower"], records["upper"] = (
            shape.surface.corner.min(axis=0),
            shape.surface.corner.max(axis=0),
        )
        records["bottom_z"], records["top_z"], records["mass"] = (
            shape.bottom_z,
            shape.top_z,
            scene_object.object_class.mass,
        )
        records["footprint_radius"] = np.linalg.norm(shape.footprint, axis=1).max()
        for name, corners in (
            ("bottom", shape.bottom),
            ("top", shape.top),
            ("footprint", shape.footprint),
        ):
            records[name][: len(corners)], records[f"{name}_count"] = corners, len(corners)
        along = np.roll(shape.footprint, -1, axis=0) - shape.footprint
        normal = (
            np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
        )
        records["sides"][: len(normal)] = np.column_stack(
            [normal, (normal * shape.footprint).sum(axis=1)]
        )
        records["first_face"], records["last_face"] = face, last_face
        table.first_corner[face + 1 : last_face + 1] = corner + np.cumsum(shape.surface.counts)
        table.normal[face:last_face] = shape.surface.normal
        table.corner[corner:last_corner] = shape.surface.corner
        self._row[scene_object.object_class, scene_object.X_TO.quaternion] = row
