"""Flat tables of oriented object shapes for compiled functions.

An oriented shape has the faces on which an object stands and carries, and its surface. Compiled
functions need only a row of the table and a position for each object. An object that is not convex
has further rows, one for each convex piece.
"""

import itertools
from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.compilation import zero_records
from drake_clutter.scenes.scene import SceneObject

Floats = NDArray[np.float64]
"""An array of floats."""
Ints = NDArray[np.int64]
"""An array of integers."""

MAX_LEVEL_ANGLE = np.radians(1.5)
"""A face or axis farther from level than this leans [rad]."""
RIM_CORNERS = 16
"""Corners of a can's rim, as in Drake's contact mesh; the most of any face."""
MAX_LEVEL_DIFFERENCE = 0.002
"""Faces of an object whose heights differ by less than this form one bottom or top [m]."""
STRIP_HALF_WIDTH = 0.006
"""Half the width of the strip on which a lying cylinder rests [m].

Its center of mass and its load are above the strip's center line, so the width supports no moment.
It makes a cylinder over the gap of a pair touch both edges.
"""
_FOOTPRINT_CORNERS = 32
"""Largest number of corners of a footprint."""
_SURFACE_SIDES = 48
"""Sides of a cylinder's surface, as in the mesh that Drake's camera renders."""
_COPLANARITY_TOLERANCE = 1e-4
"""Largest difference of the normals of triangles that form one face.

Offsets of the planes are compared as a fraction of the object's size. Mesh files round corners to
0.1 um.
"""
_MAX_ROWS = 8192
"""Number of rows after which the table is emptied."""


class Fault(IntEnum):
    """Why equilibrium cannot judge an orientation; NONE if it can."""

    NONE = 0
    LEANING = 1


class _Surface(NamedTuple):
    """Surface of a class in O.

    Attributes:
        corner: Corners of the convex faces, face by face, counter-clockwise seen from outside [m].
            Shape (V, 3).
        counts: Number of corners of each face. Shape (F,).
        normal: Outward normals of the faces. Shape (F, 3).
    """

    corner: Floats
    counts: Ints
    normal: Floats


def _hull_surface(corners: Floats) -> _Surface:
    """Return the surface of a convex hull.

    Coplanar triangles form one face.
    """
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
    return _Surface(np.vstack(faces), np.array([len(face) for face in faces]), np.array(normals))


def _ring(radius: float, z: float, sides: int) -> Floats:
    """Return points on a horizontal circle [m]. Shape (sides, 3)."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)])


@cache
def _piece_surfaces(object_class: ObjectClass) -> tuple[_Surface, ...]:
    """Return the surfaces of the convex pieces of a class in O."""
    if object_class.shape is Shape.CYLINDER:
        radius, half = object_class.size[0] / 2, object_class.size[2] / 2
        rings = [_ring(radius, z, _SURFACE_SIDES) for z in (-half, half)]
        return (_hull_surface(np.vstack(rings)),)
    return tuple(_hull_surface(piece) for piece in object_class.convex_pieces)


def _convex_outline(points: Floats, max_corners: int) -> Floats:
    """Return the corners of the hull of points seen from above [m].

    They are counter-clockwise. If there are more than `max_corners`, evenly spaced ones are chosen.
    Shape (C, 2).
    """
    corners = points[ConvexHull(points[:, :2]).vertices, :2]
    return (
        corners[np.arange(max_corners) * len(corners) // max_corners]
        if len(corners) > max_corners
        else corners
    )


class OrientedShape(NamedTuple):
    """One object class in one orientation, in the axes of T about the object's origin.

    Attributes:
        fault: Why the orientation cannot be judged.
        rolls: Whether it is a lying cylinder.
        com: Center of mass [m]. Shape (3,).
        bottom: Corners of the face on which it stands [m]; none if there is no such face. A lying
            cylinder has a strip, see `STRIP_HALF_WIDTH`. Shape (C, 2).
        top: Corners of the face that can carry [m]; none if there is no such face. A lying cylinder
            has a line of two points. Shape (C, 2).
        bottom_z: Height of the bottom face's center, or of the lowest point [m].
        top_z: Height of the top face's center, or of the highest point [m].
        footprint: Corners of the outline seen from above, counter-clockwise [m]. Shape (C, 2).
        surface: The surface, with axes rotated to those of T.
        parts: Its convex pieces; none for a convex object. A piece has a bottom only if the object
            stands on it.
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
    parts: "tuple[OrientedShape, ...]" = ()


def orient_shape(object_class: ObjectClass, quaternion: Sequence[float]) -> OrientedShape:
    """Return a class in an orientation, given as a quaternion (w, x, y, z) of R_TO."""
    R_TO = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    com = R_TO @ object_class.center_of_mass
    surfaces = [
        surface._replace(corner=surface.corner @ R_TO.T, normal=surface.normal @ R_TO.T)
        for surface in _piece_surfaces(object_class)
    ]
    if len(surfaces) > 1:
        return _join_parts([_orient_piece(surface, com) for surface in surfaces])
    if object_class.shape is Shape.CYLINDER and abs(R_TO[2, 2]) < np.sin(MAX_LEVEL_ANGLE):
        up = np.array([0.0, 0.0, object_class.size[0] / 2])
        axis = object_class.size[2] / 2 * R_TO[:, 2]
        half_width = STRIP_HALF_WIDTH * np.cross([0.0, 0.0, 1.0], R_TO[:, 2])
        top = np.array([axis, -axis]) + up
        bottom = (
            np.array([axis + half_width, half_width - axis, -axis - half_width, axis - half_width])
            - up
        )
        return _oriented_shape(surfaces[0], com, bottom, top, rolls=True)
    return _orient_piece(surfaces[0], com)


def _orient_piece(surface: _Surface, com: Floats) -> OrientedShape:
    """Return a convex piece, given its surface and the object's center of mass (3,) in T's axes."""
    level = np.flatnonzero(np.abs(surface.normal[:, 2]) > np.cos(MAX_LEVEL_ANGLE))
    ends = np.cumsum(surface.counts)
    faces = [surface.corner[ends[face] - surface.counts[face] : ends[face]] for face in level]
    below = [face for face, index in zip(faces, level, strict=True) if surface.normal[index, 2] < 0]
    above = [face for face, index in zip(faces, level, strict=True) if surface.normal[index, 2] > 0]
    bottom, top = _lowest_faces(below, 1), _lowest_faces(above, -1)
    return _oriented_shape(surface, com, bottom, top, rolls=False)


def _lowest_faces(faces: Sequence[Floats], sign: int) -> Floats:
    """Return the corners of the faces that are level with the lowest one [m]. Shape (C, 3).

    The base of a scanned object consists of several faces.

    Args:
        faces: Level faces. Shapes (C, 3).
        sign: 1 for the lowest faces, -1 for the highest ones.
    """
    if not faces:
        return np.empty((0, 3))
    heights = np.array([sign * face[:, 2].mean() for face in faces])
    return np.vstack(
        [
            face
            for face, height in zip(faces, heights, strict=True)
            if height < heights.min() + MAX_LEVEL_DIFFERENCE
        ]
    )


def _oriented_shape(
    surface: _Surface, com: Floats, bottom: Floats, top: Floats, *, rolls: bool
) -> OrientedShape:
    """Return a shape with the given corners of bottom (C, 3) and top (C, 3) in the axes of T."""
    empty = np.empty((0, 2))
    corner = surface.corner
    return OrientedShape(
        Fault.NONE if len(bottom) else Fault.LEANING,
        rolls,
        com=com,
        bottom=_convex_outline(bottom, RIM_CORNERS) if len(bottom) else empty,
        top=top[:, :2] if len(top) < 3 else _convex_outline(top, RIM_CORNERS),
        bottom_z=float(bottom[:, 2].mean() if len(bottom) else corner[:, 2].min()),
        top_z=float(top[:, 2].mean() if len(top) else corner[:, 2].max()),
        footprint=_convex_outline(corner, _FOOTPRINT_CORNERS),
        surface=surface,
    )


def _join_parts(parts: Sequence[OrientedShape]) -> OrientedShape:
    """Return an object of several convex pieces.

    It stands on the pieces whose bottoms are level with its lowest point. Its bottom and top are
    the outlines of those that are lowest and highest.
    """
    counts = np.concatenate([part.surface.counts for part in parts])
    surface = _Surface(
        np.vstack([part.surface.corner for part in parts]),
        counts,
        np.vstack([part.surface.normal for part in parts]),
    )
    lowest = surface.corner[:, 2].min()
    highest = surface.corner[:, 2].max()
    feet = [len(p.bottom) > 0 and p.bottom_z < lowest + MAX_LEVEL_DIFFERENCE for p in parts]
    bottom = [
        np.column_stack([part.bottom, np.full(len(part.bottom), part.bottom_z)])
        for part in itertools.compress(parts, feet)
    ]
    top = [
        np.column_stack([part.top, np.full(len(part.top), part.top_z)])
        for part in parts
        if len(part.top) and part.top_z > highest - MAX_LEVEL_DIFFERENCE
    ]
    no_face = np.empty((0, 3))
    joined = _oriented_shape(
        surface,
        parts[0].com,
        np.vstack([*bottom, no_face]),
        np.vstack([*top, no_face]),
        rolls=False,
    )
    no_corner = np.empty((0, 2))
    pieces = [
        part if is_foot else part._replace(bottom=no_corner)
        for part, is_foot in zip(parts, feet, strict=True)
    ]
    return joined._replace(parts=tuple(pieces))


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
        ("first_part", np.int64),
        ("last_part", np.int64),
    ]
)
"""Record of an `OrientedShape`, with these further fields.

flat: Whether bottom and top are as large as the footprint.
lower, upper: Corners of the axis-aligned bounding box [m].
mass: Mass [kg].
footprint_radius: Radius of the circle about the origin that contains the footprint [m].
sides: Outward normal of each side of the footprint, and its distance from the origin [m].
bottom_count, top_count, footprint_count: Numbers of corners in use.
first_face, last_face: Range of its faces in the table; the end is excluded.
first_part, last_part: Range of the rows of its convex pieces; its own row for a convex object.
"""


class ShapeArrays(NamedTuple):
    """Oriented shapes in a few arrays with spare capacity.

    Few arrays keep the overhead of calls to compiled functions small.

    Attributes:
        table: The shapes, of type `SHAPE_DTYPE`. Shape (N,).
        first_corner: Index of each face's first corner, and the end. Shape (F + 1,).
        normal: Outward normals of the faces. Shape (F, 3).
        corner: Corners of the faces [m]. Shape (V, 3).
    """

    table: NDArray[np.void]
    first_corner: Ints
    normal: Floats
    corner: Floats


def _allocate(rows: int, faces: int, corners: int) -> ShapeArrays:
    """Return empty arrays of the given capacities."""
    return ShapeArrays(
        zero_records(rows, SHAPE_DTYPE),
        np.zeros(faces + 1, np.int64),
        np.zeros((faces, 3)),
        np.zeros((corners, 3)),
    )


class ShapeTable:
    """A table of oriented shapes, each computed once.

    Attributes:
        arrays: The shapes of all rows so far.
        generation: Number of times the table was emptied, which invalidates earlier rows.
    """

    def __init__(self) -> None:
        self.generation = 0
        self._start()

    def _start(self) -> None:
        """Empty the table."""
        self._row_by_shape: dict[tuple[ObjectClass, tuple[float, float, float, float]], int] = {}
        self._num_rows = 0
        self._num_faces = 0
        self.arrays = _allocate(64, 512, 4096)

    def find_rows(self, objects: Sequence[SceneObject]) -> Ints:
        """Return the table's row of each object. Shape (n,)."""
        if self._num_rows > _MAX_ROWS:
            self._start()
            self.generation += 1
        row_by_shape = self._row_by_shape
        try:
            return np.array(
                [row_by_shape[o.object_class, o.X_TO.quaternion] for o in objects], dtype=np.int64
            )
        except KeyError:
            for o in objects:
                if (o.object_class, o.X_TO.quaternion) not in row_by_shape:
                    self._add(o)
            return np.array(
                [row_by_shape[o.object_class, o.X_TO.quaternion] for o in objects], dtype=np.int64
            )

    def rows_and_positions(self, objects: Sequence[SceneObject]) -> tuple[Ints, Floats]:
        """Return the table's row of each object (n,), and p_TO (n, 3) [m]."""
        return self.find_rows(objects), np.array([o.X_TO.translation for o in objects]).reshape(
            -1, 3
        )

    def _add(self, scene_object: SceneObject) -> None:
        """Add the shape of an object as a new row, and its convex pieces as further rows."""
        object_class = scene_object.object_class
        shape = orient_shape(object_class, scene_object.X_TO.quaternion)
        row = self._add_row(shape, object_class)
        for part in shape.parts:
            # Rays meet the faces of the object, so its pieces need none.
            no_faces = part.surface._replace(
                counts=np.empty(0, np.int64), corner=np.empty((0, 3)), normal=np.empty((0, 3))
            )
            self._add_row(part._replace(surface=no_faces), object_class)
        record = self.arrays.table[row]
        record["first_part"] = row + 1 if shape.parts else row
        record["last_part"] = self._num_rows
        record["lower"] = shape.surface.corner.min(axis=0)
        record["upper"] = shape.surface.corner.max(axis=0)
        self._row_by_shape[object_class, scene_object.X_TO.quaternion] = row

    def _add_row(self, shape: OrientedShape, object_class: ObjectClass) -> int:
        """Add a shape as a new row, and return its number."""
        row = self._num_rows
        face = self._num_faces
        corner = self.arrays.first_corner[face]
        last_face = face + len(shape.surface.counts)
        last_corner = corner + len(shape.surface.corner)
        while (
            row >= len(self.arrays.table)
            or last_face >= len(self.arrays.normal)
            or last_corner > len(self.arrays.corner)
        ):
            old = self.arrays
            self.arrays = _allocate(
                2 * len(old.table),
                2 * max(last_face + 1, len(old.normal)),
                2 * max(last_corner, len(old.corner)),
            )
            for array, earlier in zip(self.arrays, old, strict=True):
                array[: len(earlier)] = earlier
        table = self.arrays
        record = table.table[row]
        record["fault"] = shape.fault
        record["rolls"] = shape.rolls
        record["com"] = shape.com
        record["flat"] = object_class.shape is not Shape.MESH and not shape.rolls
        record["bottom_z"] = shape.bottom_z
        record["top_z"] = shape.top_z
        record["mass"] = object_class.mass
        record["footprint_radius"] = np.linalg.norm(shape.footprint, axis=1).max()
        for name, corners in (
            ("bottom", shape.bottom),
            ("top", shape.top),
            ("footprint", shape.footprint),
        ):
            record[name][: len(corners)] = corners
            record[f"{name}_count"] = len(corners)
        along = np.roll(shape.footprint, -1, axis=0) - shape.footprint
        normal = (
            np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
        )
        record["sides"][: len(normal)] = np.column_stack(
            [normal, (normal * shape.footprint).sum(axis=1)]
        )
        record["first_face"] = face
        record["last_face"] = last_face
        table.first_corner[face + 1 : last_face + 1] = corner + np.cumsum(shape.surface.counts)
        table.normal[face:last_face] = shape.surface.normal
        table.corner[corner:last_corner] = shape.surface.corner
        self._num_rows = row + 1
        self._num_faces = last_face
        return row
