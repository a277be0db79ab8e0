"""Ray casting at objects: depth images, masks and visible fractions.

The rays go through the centers of the pixels. The rays that meet a face fill a convex polygon of
the image, row by row, and on a face the inverse depth is linear in the pixel, so a ray costs one
addition and one comparison. Besides the objects, only the plane of the support's floor is cast,
not its walls. Objects that reach behind the camera are ignored. Objects that are not convex are
cast as the union of their convex pieces.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import MIN_DEPTH, point_to_camera, project, vector_to_camera
from drake_clutter.compilation import njit
from drake_clutter.rendering.polygon_fill import fill_polygon
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.stability.shape_table import Floats, Ints, ShapeTable

_MAX_OCCLUDERS = 64
"""Most objects of a scene for `occluder_sets`: one bit each."""


@njit(cache=True, inline="always")
def _inverse_depth(camera, nx, ny, nz, k):  # type: ignore[no-untyped-def]
    """Return a plane's inverse depth as a linear function of the pixel.

    Args:
        camera: `Pinhole` of the camera.
        nx: Normal of the plane in T.
        ny: Normal of the plane in T.
        nz: Normal of the plane in T.
        k: Distance of the plane from the camera along the normal [m].

    Returns:
        Slope along a row, slope along a column, and value at pixel (0, 0) [1/m].
    """
    nx, ny, nz = vector_to_camera(camera, nx, ny, nz)
    along, down = nx / camera.focal_length / k, ny / camera.focal_length / k
    return along, down, nz / k - along * camera.u0 - down * camera.v0


@njit(cache=True)
def _cast_object(arrays, shape, p_TO, camera, label, nearest, hit):  # type: ignore[no-untyped-def]
    """Cast all rays that may meet an object, and record those that meet it first.

    Args:
        arrays: `ShapeArrays` of the shapes.
        shape: Row of the object's shape.
        p_TO: Origin of the object in T [m]. Shape (3,).
        camera: `Pinhole` of the camera.
        label: Value to write into `hit`.
        nearest: Largest inverse depth so far [1/m]. Shape (height, width).
        hit: Object of the largest inverse depth. Shape (height, width).

    Returns:
        Number of rays that meet the object, whatever is in front of it. A ray through several
        pieces of an object counts several times.
    """
    p_TC = camera.p_TC
    p_x, p_y, p_z = vector_to_camera(camera, p_TO[0], p_TO[1], p_TO[2])
    u, v = np.empty(64), np.empty(64)
    # First column, and column after the last, of a face in each row.
    begin = np.zeros(hit.shape[0], np.int64)
    end = np.zeros(hit.shape[0], np.int64)
    rays = 0
    for face in range(arrays.table[shape].first_face, arrays.table[shape].last_face):
        first, last = arrays.first_corner[face], arrays.first_corner[face + 1]
        nx, ny, nz = arrays.normal[face, 0], arrays.normal[face, 1], arrays.normal[face, 2]
        corner = arrays.corner[first]
        k = (
            nx * (corner[0] + p_TO[0] - p_TC[0])
            + ny * (corner[1] + p_TO[1] - p_TC[1])
            + nz * (corner[2] + p_TO[2] - p_TC[2])
        )
        if k > -1e-9:
            continue  # the face is turned away from the camera
        count = last - first
        if count > len(u):
            u, v = np.empty(count), np.empty(count)
        for c in range(count):
            x, y, z = point_to_camera(
                camera,
                arrays.corner[first + c, 0],
                arrays.corner[first + c, 1],
                arrays.corner[first + c, 2],
            )
            u[c], v[c] = project(camera, x + p_x, y + p_y, z + p_z)
        plane = _inverse_depth(camera, nx, ny, nz, k)
        rays += fill_polygon(u, v, count, plane, label, nearest, hit, begin, end)
    return rays


@njit(cache=True)
def _window(shape, p_TO, camera, image_shape):  # type: ignore[no-untyped-def]
    """Return the window of the image that contains an object's bounding box.

    Returns:
        First row, row end, first column, column end; all 0 if the object is not in the image.
    """
    height, width = image_shape
    p_x, p_y, p_z = vector_to_camera(camera, p_TO[0], p_TO[1], p_TO[2])
    top, bottom, left, right = np.inf, -np.inf, np.inf, -np.inf
    for corner in range(8):
        x, y, z = point_to_camera(
            camera,
            shape.upper[0] if corner & 1 else shape.lower[0],
            shape.upper[1] if corner & 2 else shape.lower[1],
            shape.upper[2] if corner & 4 else shape.lower[2],
        )
        if z + p_z < MIN_DEPTH:
            return 0, 0, 0, 0
        u, v = project(camera, x + p_x, y + p_y, z + p_z)
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    row_begin, row_end = max(0, math.floor(top)), min(height, math.ceil(bottom) + 1)
    column_begin, column_end = max(0, math.floor(left)), min(width, math.ceil(right) + 1)
    if row_end <= row_begin or column_end <= column_begin:
        return 0, 0, 0, 0
    return row_begin, row_end, column_begin, column_end


@njit(cache=True)
def _cast_floor(nearest, along, down, start):  # type: ignore[no-untyped-def]
    """Write the inverse depth of the floor of a tilted camera, see `_inverse_depth`."""
    for row in range(nearest.shape[0]):
        inverse, step, here = np.float32(start + down * row), np.float32(along), nearest[row]
        for k in range(len(here)):
            value = inverse + step * np.float32(k)
            here[k] = value if value > 0 else np.float32(0)


@njit(cache=True)
def _count_rays(arrays, shape, p_TO, camera, window, nearest, hit):  # type: ignore[no-untyped-def]
    """Return the number of rays that meet an object of several convex pieces.

    It overwrites the window of the image.
    """
    nearest[window[0] : window[1], window[2] : window[3]] = 0
    hit[window[0] : window[1], window[2] : window[3]] = -1
    _cast_object(arrays, shape, p_TO, camera, np.int16(0), nearest, hit)
    return (hit[window[0] : window[1], window[2] : window[3]] == 0).sum()


@njit(cache=True)
def _cast_scene(arrays, shapes, p_T, camera, nearest, hit, unoccluded, visible):  # type: ignore[no-untyped-def]
    """Find the first object that each ray meets, and count rays.

    Args:
        arrays: `ShapeArrays` of the shapes.
        shapes: Row of each object's shape. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        camera: `Pinhole` of the camera.
        nearest: Output: inverse depth, 0 where nothing is seen [1/m]. Shape (height, width).
        hit: Output: index of the object, -1 where there is none. Shape (height, width).
        unoccluded: Output, zeros before: rays that meet the object if nothing is in front of it.
            Shape (n,).
        visible: Output, zeros before: rays that meet the object first. Shape (n,).

    Returns:
        The window of the image that was written, see `_window`.
    """
    windows = np.zeros((len(shapes), 4), np.int64)
    row_begin, row_end, column_begin, column_end = hit.shape[0], 0, hit.shape[1], 0
    for i in range(len(shapes)):
        window = _window(arrays.table[shapes[i]], p_T[i], camera, hit.shape)
        windows[i, 0], windows[i, 1], windows[i, 2], windows[i, 3] = window
        if window[1] > 0:
            row_begin, row_end = min(row_begin, window[0]), max(row_end, window[1])
            column_begin, column_end = min(column_begin, window[2]), max(column_end, window[3])
    for i in range(len(shapes)):
        if windows[i, 1] > 0 and arrays.table[shapes[i]].first_part != shapes[i]:
            unoccluded[i] = _count_rays(arrays, shapes[i], p_T[i], camera, windows[i], nearest, hit)
    along, down, start = _inverse_depth(camera, 0.0, 0.0, 1.0, -camera.p_TC[2])
    for row in range(row_begin, row_end):
        nearest[row, column_begin:column_end] = start
        hit[row, column_begin:column_end] = -1
    if along != 0 or down != 0:
        first = start + down * row_begin + along * column_begin
        _cast_floor(nearest[row_begin:row_end, column_begin:column_end], along, down, first)
    for i in range(len(shapes)):
        if windows[i, 1] > 0:
            rays = _cast_object(arrays, shapes[i], p_T[i], camera, np.int16(i), nearest, hit)
            if arrays.table[shapes[i]].first_part == shapes[i]:
                unoccluded[i] = rays
    for i in range(len(shapes)):
        label = np.int16(i)
        total = 0
        for row in range(windows[i, 0], windows[i, 1]):
            in_row = np.int16(0)  # 16 bits like the labels, so that the loop vectorizes well
            here = hit[row, windows[i, 2] : windows[i, 3]]
            for k in range(len(here)):
                in_row = np.int16(in_row + (here[k] == label))
            total += int(in_row)
        visible[i] = total
    return min(row_begin, row_end), row_end, min(column_begin, column_end), column_end


@njit(cache=True)
def _occluders_by_ray(arrays, shapes, p_T, camera, target, nearest, hit):  # type: ignore[no-untyped-def]
    """Return the objects in front of a target as bits, for each ray of the target."""
    window = _window(arrays.table[shapes[target]], p_T[target], camera, hit.shape)
    nearest[window[0] : window[1], window[2] : window[3]] = 0
    hit[window[0] : window[1], window[2] : window[3]] = -1
    if window[1] > 0:
        _cast_object(arrays, shapes[target], p_T[target], camera, np.int16(0), nearest, hit)
    rows, columns = np.nonzero(hit[window[0] : window[1], window[2] : window[3]] == 0)
    rows = rows + window[0]
    columns = columns + window[2]
    own = np.empty(len(rows), np.float32)
    occluders = np.zeros(len(rows), np.uint64)
    for k in range(len(rows)):
        own[k] = nearest[rows[k], columns[k]]
    for i in range(len(shapes)):
        other = _window(arrays.table[shapes[i]], p_T[i], camera, hit.shape)
        is_apart = (
            other[0] >= window[1]
            or window[0] >= other[1]
            or other[2] >= window[3]
            or window[2] >= other[3]
        )
        if i == target or is_apart:
            continue
        _cast_object(arrays, shapes[i], p_T[i], camera, np.int16(1), nearest, hit)
        for k in range(len(rows)):
            if hit[rows[k], columns[k]] == 1:
                occluders[k] |= np.uint64(1) << np.uint64(i)
                hit[rows[k], columns[k]], nearest[rows[k], columns[k]] = 0, own[k]
    return occluders


class RayCaster:
    """Casts a camera's rays at scenes of objects.

    Attributes:
        camera: The camera.
    """

    def __init__(self, camera: Camera, shapes: ShapeTable | None = None) -> None:
        """Create a caster.

        Args:
            camera: The camera.
            shapes: Table of shapes to share with a judge.
        """
        self.camera = camera
        self._pinhole = camera.pinhole
        self._shapes = shapes or ShapeTable()
        self._nearest = np.empty((camera.height, camera.width), np.float32)
        self._hit = np.empty((camera.height, camera.width), np.int16)

    def _cast(self, shapes: Ints, p_T: Floats) -> tuple[list[float], tuple[slice, slice]]:
        """Fill the buffers in a window of the image.

        Returns:
            Visible fraction of each object, and the window.
        """
        if not len(shapes):
            return [], (slice(0, 0), slice(0, 0))
        unoccluded = np.zeros(len(shapes), np.int64)
        visible = np.zeros(len(shapes), np.int64)
        arguments = (self._shapes.arrays, shapes, p_T, self._pinhole)
        row, row_end, column, column_end = _cast_scene(
            *arguments, self._nearest, self._hit, unoccluded, visible
        )
        fractions = [
            v / u if u else 1.0 for v, u in zip(visible.tolist(), unoccluded.tolist(), strict=True)
        ]
        return fractions, (slice(row, row_end), slice(column, column_end))

    def _mask(self, index: int, rectangle: tuple[slice, slice]) -> NDArray[np.bool_]:
        """Return the mask of an object in the last cast image."""
        mask = np.zeros(self._hit.shape, np.bool_)
        np.equal(self._hit[rectangle], index, out=mask[rectangle])
        return mask

    def visible_fractions_of_rows(self, shapes: Ints, p_T: Floats) -> list[float]:
        """Return the visible fractions of shapes, see `visible_fractions`.

        Args:
            shapes: Rows of the shapes in the arrays. Shape (n,).
            p_T: Origins of the objects in T [m]. Shape (n, 3).
        """
        return self._cast(shapes, p_T)[0]

    def visible_fractions(self, objects: Sequence[SceneObject]) -> dict[str, float]:
        """Return the visible fraction of each object, by name.

        It is the fraction of the rays that would meet the object alone which also meet it in the
        scene. Objects outside of the image have fraction 1.

        Args:
            objects: The objects.
        """
        fractions = self.visible_fractions_of_rows(*self._shapes.rows_and_positions(objects))
        return {o.name: fraction for o, fraction in zip(objects, fractions, strict=True)}

    def occluder_sets(self, scene: Scene, name: str) -> dict[frozenset[str], int]:
        """Return which sets of objects occlude an object, with their numbers of rays.

        Args:
            scene: A scene of at most 64 objects.
            name: Name of the occluded object.

        Returns:
            Number of the object's rays that meet exactly these objects first, by set of names.

        Raises:
            KeyError: No object has this name.
            ValueError: The scene has more than 64 objects.
        """
        scene[name]
        if len(scene.objects) > _MAX_OCCLUDERS:
            raise ValueError(
                f"the scene has {len(scene.objects)} objects; expected at most {_MAX_OCCLUDERS}"
            )
        shapes, p_T = self._shapes.rows_and_positions(scene.objects)
        arguments = (self._shapes.arrays, shapes, p_T, self._pinhole, scene.names.index(name))
        sets, counts = np.unique(
            _occluders_by_ray(*arguments, self._nearest, self._hit), return_counts=True
        )
        names = scene.names
        members = [
            frozenset(names[i] for i in range(len(names)) if bits >> i & 1)
            for bits in sets.tolist()
        ]
        return dict(zip(members, counts.tolist(), strict=True))

    def observe(self, scene: Scene) -> tuple[Observation, dict[str, float]]:
        """Return an observation of a scene, and the visible fractions by name.

        It equals that of `LabelDetector`, except that the floor extends beyond the support.
        """
        fractions, rectangle = self._cast(*self._shapes.rows_and_positions(scene.objects))
        depth = self.camera.floor_depth.copy()
        with np.errstate(divide="ignore"):
            depth[rectangle] = 1 / self._nearest[rectangle]
        detections = tuple(
            Detection(o.name, o.object_class, o.X_TO, mask)
            for index, (o, fraction) in enumerate(zip(scene.objects, fractions, strict=True))
            if fraction >= self.camera.visibility_threshold
            and (mask := self._mask(index, rectangle)).any()
        )
        return Observation(depth, detections, self.camera, scene.support), dict(
            zip(scene.names, fractions, strict=True)
        )
