"""What the fast judge knows of an object in an orientation: the faces that it stands on and carries with, and its surface.

Everything lies in flat arrays, so that compiled loops need nothing but an index and a position per object.
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_clutter.catalogue import ObjectClass, Shape
from drake_clutter.scenes.scene import SceneObject

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVEL_WITHIN = np.radians(1.5)
"""rad; a face or an axis that is further from level is taken to lean."""
RIM_CORNERS = 16
"""Corners of a can's rim, as in Drake's contact mesh of it."""
STRIP = 0.006
"""m, half the width of the strip on which a cylinder lies. Its centre of mass and its load are above the strip's middle, so the
width holds no moment; but a cylinder that lies over the gap of a pair touches both its edges."""
_SURFACE_SIDES = 48
"""Sides of a cylinder's surface, as in the mesh that Drake's camera sees."""
_CAPACITY = 4096
"""Orientations that are kept before the table starts anew."""


class Fault(IntEnum):
    """Why an orientation cannot be judged by equilibrium; NONE if it can."""

    NONE = 0
    LEANING = 1
    NOT_CONVEX = 2


class _Surface(NamedTuple):
    """A class's surface in O: convex faces, counter-clockwise seen from outside, and its centre of mass."""

    faces: list[Floats]
    normals: Floats
    p_Ocm: Floats


def _hull_faces(corners: Floats) -> _Surface:
    """The faces of a convex hull; triangles of one plane are one face."""
    hull = ConvexHull(corners)
    planes, member = np.unique(np.round(hull.equations, 5), axis=0, return_inverse=True)
    faces, normals = [], []
    for index in range(len(planes)):
        normal = hull.equations[member == index][0, :3]
        points = corners[np.unique(hull.simplices[member == index])]
        middle = points.mean(axis=0)
        across = points[0] - middle
        across /= np.linalg.norm(across)
        angle = np.arctan2((points - middle) @ np.cross(normal, across), (points - middle) @ across)
        faces.append(points[np.argsort(angle)])
        normals.append(normal)
    # Of a solid of uniform density: tetrahedra from an inner point to every triangle.
    inner = corners.mean(axis=0)
    triangles = corners[hull.simplices] - inner
    volumes = np.abs(np.linalg.det(triangles))
    p_Ocm = inner + (volumes[:, None] * triangles.sum(axis=1)).sum(axis=0) / (4 * volumes.sum())
    return _Surface(faces, np.asarray(normals), p_Ocm)


def _ring(radius: float, z: float, sides: int) -> Floats:
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)])


@cache
def _surface(object_class: ObjectClass) -> _Surface:
    if object_class.shape is not Shape.CYLINDER:
        return _hull_faces(object_class.convex_pieces[0])
    radius, half = object_class.size[0] / 2, object_class.size[2] / 2
    low, high = _ring(radius, -half, _SURFACE_SIDES), _ring(radius, half, _SURFACE_SIDES)
    after = np.roll(np.arange(_SURFACE_SIDES), -1)
    sides = [np.array([low[k], low[after[k]], high[after[k]], high[k]]) for k in range(_SURFACE_SIDES)]
    outward = np.array([np.cross(side[1] - side[0], side[3] - side[0]) for side in sides])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return _Surface([high, low[::-1], *sides], np.vstack([[[0, 0, 1.0], [0, 0, -1.0]], outward]), np.zeros(3))


class Posed(NamedTuple):
    """One object class in one orientation, lengths in m, axes those of T, origin the object's.

    Attributes:
        fault: see `Fault`.
        rolls: whether it is a cylinder that lies.
        com: (3,) its centre of mass.
        bottom, top: (V, 2) corners of the face that it stands on, and of the one that carries. A cylinder that lies has a strip,
            see `STRIP`, and a line of two points.
        low, high: heights of these faces' middles; where there is none, of the lowest and the highest point.
        footprint: (V, 2) corners of its outline seen from above, counter-clockwise.
        faces: of its surface, see `_Surface`.
        normals: (F, 3) theirs.
    """

    fault: Fault
    rolls: bool
    com: Floats
    bottom: Floats
    top: Floats
    low: float
    high: float
    footprint: Floats
    faces: list[Floats]
    normals: Floats


def pose(object_class: ObjectClass, quaternion: Sequence[float]) -> Posed:
    """The class in an orientation, (4,) w, x, y, z."""
    R_TO = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    surface = _surface(object_class)
    faces = [face @ R_TO.T for face in surface.faces]
    normals = surface.normals @ R_TO.T
    corners = object_class.corners @ R_TO.T
    bottom, top, rolls = np.empty((0, 3)), np.empty((0, 3)), False
    if object_class.shape is not Shape.CYLINDER:
        area = np.array([_area(face) for face in faces])
        for sign in (-1, 1):
            level = np.where(sign * normals[:, 2] > np.cos(LEVEL_WITHIN), area, 0.0)
            if level.any():
                face = faces[int(np.argmax(level))]
                bottom, top = (face, top) if sign < 0 else (bottom, face)
    else:
        radius, half = object_class.size[0] / 2, object_class.size[2] / 2
        rises = R_TO[2, 2]
        if abs(rises) > np.cos(LEVEL_WITHIN):
            rim, end = _ring(radius, 0.0, RIM_CORNERS) @ R_TO.T, np.sign(rises) * half * R_TO[:, 2]
            bottom, top = rim - end, rim + end
        elif abs(rises) < np.sin(LEVEL_WITHIN):
            rolls = True
            axis, aside = half * R_TO[:, 2], STRIP * np.cross([0.0, 0.0, 1.0], R_TO[:, 2])
            up = np.array([0.0, 0.0, radius])
            top = np.array([axis, -axis]) + up
            bottom = np.array([axis + aside, aside - axis, -axis - aside, axis - aside]) - up
    fault = Fault.NONE if len(bottom) else Fault.LEANING
    if len(object_class.convex_pieces) > 1:
        fault = Fault.NOT_CONVEX
    return Posed(
        fault,
        rolls,
        com=R_TO @ surface.p_Ocm,
        bottom=_outline(bottom),
        top=_outline(top),
        low=float(bottom[:, 2].mean() if len(bottom) else corners[:, 2].min()),
        high=float(top[:, 2].mean() if len(top) else corners[:, 2].max()),
        footprint=_outline(corners),
        faces=faces,
        normals=normals,
    )


def _outline(points: Floats) -> Floats:
    """(V, 2) corners of the points' hull seen from above, counter-clockwise; fewer than three points stay as they are."""
    return points[ConvexHull(points[:, :2]).vertices, :2] if len(points) > 2 else points[:, :2]


def _area(face: Floats) -> float:
    crosses = np.cross(face[1:-1] - face[0], face[2:] - face[0])
    return float(np.linalg.norm(crosses.sum(axis=0)) / 2)


class Table(NamedTuple):
    """Posed shapes in arrays, for compiled loops; a row per shape, corners padded with zeros.

    Attributes:
        fault, rolls, mass, com, low, high: (N, ...) see `Posed`; mass in kg.
        reach: (N,) m, radius of the circle about the object's origin that holds its footprint.
        bottom, top, footprint: (N, C, 2) m.
        bottom_count, top_count, footprint_count: (N,) corners in use.
        first_face: (N + 1,) a shape's faces are first_face[i] up to first_face[i + 1].
        first_corner: (F + 1,) a face's corners likewise.
        normal: (F, 3).
        corner: (V, 3) m.
    """

    fault: Ints
    rolls: NDArray[np.bool_]
    mass: Floats
    com: Floats
    low: Floats
    high: Floats
    reach: Floats
    bottom: Floats
    bottom_count: Ints
    top: Floats
    top_count: Ints
    footprint: Floats
    footprint_count: Ints
    first_face: Ints
    first_corner: Ints
    normal: Floats
    corner: Floats


class Shapes:
    """A table of the posed shapes that were asked for, each made once.

    Attributes:
        generation: grows whenever the table starts anew, after which earlier indices mean nothing.
    """

    def __init__(self) -> None:
        self.generation = 0
        self._clear()

    def _clear(self) -> None:
        self._index: dict[tuple[ObjectClass, tuple[float, float, float, float]], int] = {}
        self._posed: list[tuple[Posed, float]] = []
        self._table: Table | None = None

    def indices(self, objects: Sequence[SceneObject]) -> Ints:
        """(n,) the table's row of each object."""
        if len(self._index) > _CAPACITY:
            self._clear()
            self.generation += 1
        known = self._index
        try:
            return np.array([known[o.object_class, o.X_TO.quaternion] for o in objects], dtype=np.int64)
        except KeyError:
            for o in objects:
                key = (o.object_class, o.X_TO.quaternion)
                if key not in known:
                    known[key] = len(self._posed)
                    self._posed.append((pose(*key), o.object_class.mass))
            self._table = None
            return self.indices(objects)

    @property
    def table(self) -> Table:
        """The table of all rows given out so far."""
        if self._table is None:
            self._table = _table(self._posed)
        return self._table


def _table(posed: list[tuple[Posed, float]]) -> Table:
    shapes = [shape for shape, _ in posed]
    faces = [face for shape in shapes for face in shape.faces]
    return Table(
        fault=np.array([shape.fault for shape in shapes], dtype=np.int64),
        rolls=np.array([shape.rolls for shape in shapes]),
        mass=np.array([mass for _, mass in posed]),
        com=np.array([shape.com for shape in shapes]),
        low=np.array([shape.low for shape in shapes]),
        high=np.array([shape.high for shape in shapes]),
        reach=np.array([np.linalg.norm(shape.footprint, axis=1).max() for shape in shapes]),
        bottom=_padded([shape.bottom for shape in shapes]),
        bottom_count=np.array([len(shape.bottom) for shape in shapes]),
        top=_padded([shape.top for shape in shapes]),
        top_count=np.array([len(shape.top) for shape in shapes]),
        footprint=_padded([shape.footprint for shape in shapes]),
        footprint_count=np.array([len(shape.footprint) for shape in shapes]),
        first_face=np.cumsum([0] + [len(shape.faces) for shape in shapes]),
        first_corner=np.cumsum([0] + [len(face) for face in faces]),
        normal=np.vstack([shape.normals for shape in shapes]),
        corner=np.vstack(faces),
    )


def _padded(polygons: list[Floats]) -> Floats:
    padded = np.zeros((len(polygons), max(len(polygon) for polygon in polygons), 2))
    for row, polygon in zip(padded, polygons, strict=True):
        row[: len(polygon)] = polygon
    return padded
