"""Which object each of the camera's rays meets first, by compiled loops over the faces of convex objects.

The rays go through the pixels' middles, with the intrinsics of `CameraConfig`. The rays that meet a face fill a convex polygon
of the image, row by row, and along a face the inverse distance is linear in the pixel: so a ray costs one addition and one
comparison. Nothing but the floor of the tray is seen beside the objects; its rim stands behind them.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from drake_clutter.config import CameraConfig
from drake_clutter.fast.shapes import Floats, Shapes
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.scenes.seams import Detection, Observation


@njit(cache=True)
def _cast(table, shapes, p_T, altitude, focal_length, nearest, hit, alone, seen):  # type: ignore[no-untyped-def]
    """Finds what every ray that may meet an object meets first, and counts.

    Args:
        table: of the shapes.
        shapes: (n,) rows of the table.
        p_T: (n, 3) m.
        altitude: m, of the camera above the origin of T.
        focal_length: pixels.
        nearest: (height, width) float32, becomes the inverse distance along the optical axis, 1/m.
        hit: (height, width) int16, becomes the index of the object, -1 where no object is.
        alone: (n,) zeros; becomes the number of rays that meet the object if nothing is before it.
        seen: (n,) zeros; becomes the number of rays that meet the object first.

    Returns:
        First row, last row, first column and last column of the rectangle (ends excluded) that was written to.
    """
    height, width = hit.shape
    middle_u, middle_v = width / 2 - 1, height / 2 - 1
    u, v = np.empty(64), np.empty(64)

    bounds = np.array([np.inf, -np.inf, np.inf, -np.inf])
    for i in range(len(shapes)):
        first_face, last_face = table.first_face[shapes[i]], table.first_face[shapes[i] + 1]
        for c in range(table.first_corner[first_face], table.first_corner[last_face]):
            scale = focal_length / (altitude - table.corner[c, 2] - p_T[i, 2])
            row, column = -scale * (table.corner[c, 1] + p_T[i, 1]), scale * (table.corner[c, 0] + p_T[i, 0])
            bounds[0], bounds[1] = min(bounds[0], row), max(bounds[1], row)
            bounds[2], bounds[3] = min(bounds[2], column), max(bounds[3], column)
    row_begin, row_end = max(0, math.floor(middle_v + bounds[0])), min(height, math.ceil(middle_v + bounds[1]) + 1)
    column_begin, column_end = max(0, math.floor(middle_u + bounds[2])), min(width, math.ceil(middle_u + bounds[3]) + 1)
    if row_end <= row_begin or column_end <= column_begin:
        return 0, 0, 0, 0
    nearest[row_begin:row_end, column_begin:column_end] = 1 / altitude
    hit[row_begin:row_end, column_begin:column_end] = -1

    for i in range(len(shapes)):
        shape, label = shapes[i], np.int16(i)
        for face in range(table.first_face[shape], table.first_face[shape + 1]):
            first, last = table.first_corner[face], table.first_corner[face + 1]
            nx, ny, nz = table.normal[face, 0], table.normal[face, 1], table.normal[face, 2]
            x0, y0, z0 = (
                table.corner[first, 0] + p_T[i, 0],
                table.corner[first, 1] + p_T[i, 1],
                table.corner[first, 2] + p_T[i, 2],
            )
            k = nx * x0 + ny * y0 + nz * (z0 - altitude)
            if k > -1e-9:
                continue  # turned away from the camera
            count = last - first
            top, bottom = np.inf, -np.inf
            for c in range(count):
                scale = focal_length / (altitude - table.corner[first + c, 2] - p_T[i, 2])
                u[c] = middle_u + scale * (table.corner[first + c, 0] + p_T[i, 0])
                v[c] = middle_v - scale * (table.corner[first + c, 1] + p_T[i, 1])
                top, bottom = min(top, v[c]), max(bottom, v[c])
            # Inverse distance: its slope along a row and down a column, and its value at pixel (0, 0).
            along, down = nx / focal_length / k, -ny / focal_length / k
            start = -nz / k - along * middle_u - down * middle_v
            for row in range(max(0, math.ceil(top)), min(height - 1, math.floor(bottom)) + 1):
                left, right = np.inf, -np.inf
                for c in range(count):
                    d = c + 1 if c + 1 < count else 0
                    # The same way round for both faces at an edge, so that no ray is counted twice or lost.
                    a, b = (c, d) if v[c] < v[d] else (d, c)
                    if v[a] <= row < v[b]:
                        crossing = u[a] + (row - v[a]) * ((u[b] - u[a]) / (v[b] - v[a]))
                        left, right = min(left, crossing), max(right, crossing)
                if left >= right:
                    continue
                begin, end = max(0, math.ceil(left)), min(width, math.ceil(right))
                if end <= begin:
                    continue
                alone[i] += end - begin
                # Both are always written, so that the compiler can do several pixels at a time.
                inverse, step = np.float32(start + down * row + along * begin), np.float32(along)
                depths, hits = nearest[row, begin:end], hit[row, begin:end]
                for column in range(end - begin):
                    value = inverse + step * np.float32(column)
                    nearer = value > depths[column]
                    depths[column] = value if nearer else depths[column]
                    hits[column] = label if nearer else hits[column]

    for row in range(row_begin, row_end):
        run, label = 0, np.int16(-1)
        for column in range(column_begin, column_end):
            if hit[row, column] != label:
                if label >= 0:
                    seen[label] += run
                run, label = 0, hit[row, column]
            run += 1
        if label >= 0:
            seen[label] += run
    return row_begin, row_end, column_begin, column_end


class RayCaster:
    """Casts the overhead camera's rays at scenes of convex objects."""

    def __init__(self, config: CameraConfig, shapes: Shapes | None = None) -> None:
        """Makes a caster; `shapes` may be shared with a judge."""
        self.config = config
        self._shapes = shapes or Shapes()
        self._nearest = np.empty((config.height, config.width), np.float32)
        self._hit = np.empty((config.height, config.width), np.int16)

    def _cast(self, objects: Sequence[SceneObject], p_T: Floats | None) -> tuple[list[float], tuple[slice, slice]]:
        """Fills the buffers in a rectangle, which it returns after the visible share of each object."""
        if p_T is None:
            p_T = np.array([o.X_TO.translation for o in objects])
        alone, seen = np.zeros(len(objects), np.int64), np.zeros(len(objects), np.int64)
        shapes = self._shapes.indices(objects)
        arguments = (self._shapes.table, shapes, p_T, self.config.altitude, self.config.focal_length)
        row, row_end, column, column_end = _cast(*arguments, self._nearest, self._hit, alone, seen)
        shares = [s / a if a else 1.0 for s, a in zip(seen.tolist(), alone.tolist(), strict=True)]
        return shares, (slice(row, row_end), slice(column, column_end))

    def visible_shares(self, objects: Sequence[SceneObject], p_T: Floats | None = None) -> dict[str, float]:
        """Of the rays that would meet each object alone on the tray, the share that does, by name; out of the frame, 1.

        Args:
            objects: convex ones.
            p_T: (n, 3) m, where they are; None: where their poses say.
        """
        shares, _ = self._cast(objects, p_T)
        return {o.name: share for o, share in zip(objects, shares, strict=True)}

    def observe(self, scene: Scene) -> tuple[Observation, dict[str, float]]:
        """What the camera shows of a scene, and the visible shares; as `LabelDetector` has it, but with the floor all around."""
        shares, rectangle = self._cast(scene.objects, None)
        depth = np.full(self._nearest.shape, self.config.altitude, np.float32)
        depth[rectangle] = 1 / self._nearest[rectangle]
        label = np.full(self._hit.shape, -1, np.int16)
        label[rectangle] = self._hit[rectangle]
        detections = tuple(
            Detection(o.name, o.object_class, o.X_TO, label == index)
            for index, (o, share) in enumerate(zip(scene.objects, shares, strict=True))
            if share >= self.config.hidden_below
        )
        return Observation(depth, detections, self.config, scene.tray_side), dict(zip(scene.names, shares, strict=True))
