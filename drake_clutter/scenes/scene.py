"""Scenes: objects with class and pose on the tray, the graph they came from, and nothing of Drake.

Frames: T the tray (origin on the tray's floor at its centre, z up), O an object (origin at its geometric centre).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.support import Support
from drake_clutter.grammar import ClutterGraph

TRAY = "tray"
"""The name by which a move says "on the tray"; no object may have it."""


@dataclass(frozen=True)
class Pose:
    """A rigid pose X_AB.

    Attributes:
        translation: (3,) m, p_AB.
        quaternion: (4,) w, x, y, z; of unit length.
    """

    translation: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def from_rotation(rotation: NDArray[np.float64], translation: Iterable[float]) -> "Pose":
        """The pose with R_AB (3, 3) and p_AB (3,) m; w is not negative."""
        w, x, y, z = (
            float(v)
            for v in Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
        )
        px, py, pz = (float(v) for v in translation)
        return Pose((px, py, pz), (w, x, y, z))

    @cached_property
    def rotation(self) -> NDArray[np.float64]:
        """R_AB, (3, 3)."""
        return np.asarray(Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix())

    @property
    def p(self) -> NDArray[np.float64]:
        """p_AB, (3,) m, as an array."""
        return np.asarray(self.translation)

    def apply(self, p_B: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) m given in B, in A."""
        return np.asarray(p_B @ self.rotation.T + self.p)

    def translated(self, offset: Iterable[float]) -> "Pose":
        """The pose with p_AB + offset, offset (3,) m."""
        x, y, z = (float(v) for v in self.p + np.asarray(list(offset)))
        return replace(self, translation=(x, y, z))


@dataclass(frozen=True)
class SceneObject:
    """One object of a scene.

    Attributes:
        name: unique in the scene.
        object_class: what it is.
        X_TO: its pose in the tray frame.
        node: its node in the scene's graph, or None.
    """

    name: str
    object_class: ObjectClass
    X_TO: Pose
    node: int | None = None

    @cached_property
    def corners_T(self) -> NDArray[np.float64]:
        """Corners of its convex pieces in the tray frame, (V, 3) m."""
        return self.X_TO.apply(self.object_class.corners)

    @cached_property
    def bounds_T(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of its axis-aligned box in the tray frame, (3,) m each."""
        return self.corners_T.min(axis=0), self.corners_T.max(axis=0)

    @property
    def top_height(self) -> float:
        """Height of its highest point above the tray's floor, m."""
        return float(self.bounds_T[1][2])


@dataclass(frozen=True)
class Scene:
    """Objects on a tray.

    Attributes:
        objects: in order; names are unique.
        support: what they stand on.
        graph: the terminal graph it was laid out from, or None.
        derivation: the names of the rules that derived the graph.
        seed: of the batch it was drawn in, or None.
    """

    objects: tuple[SceneObject, ...]
    support: Support
    graph: ClutterGraph | None = None
    derivation: tuple[str, ...] = ()
    seed: int | None = None

    def __getitem__(self, name: str) -> SceneObject:
        """The object of a name.

        Raises:
            KeyError: no such object.
        """
        for scene_object in self.objects:
            if scene_object.name == name:
                return scene_object
        raise KeyError(f"object {name!r} is not in the scene; it holds {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The objects' names, in order."""
        return tuple(scene_object.name for scene_object in self.objects)

    @property
    def poses(self) -> dict[str, Pose]:
        """X_TO by name."""
        return {scene_object.name: scene_object.X_TO for scene_object in self.objects}

    def with_poses(self, poses: Mapping[str, Pose]) -> "Scene":
        """The scene with the poses of the objects that are named replaced."""
        return replace(
            self,
            objects=tuple(
                replace(o, X_TO=poses[o.name]) if o.name in poses else o for o in self.objects
            ),
        )


def sample_offsets(count: int, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(count, 3) m: for each object an offset in the tray's plane, drawn uniformly from a disc of the radius (m)."""
    samples = rng.random((count, 2))
    distance, angle = radius * np.sqrt(samples[:, 0]), 2 * math.pi * samples[:, 1]
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(count)])


def perturb_poses(
    objects: Sequence[SceneObject], radius: float, rng: np.random.Generator
) -> list[SceneObject]:
    """The objects, each moved by a random offset of its own."""
    offsets = sample_offsets(len(objects), radius, rng)
    return [
        replace(o, X_TO=o.X_TO.translated(offset))
        for o, offset in zip(objects, offsets, strict=True)
    ]


def tilt_between(object_class: ObjectClass, X_TA: Pose, X_TB: Pose) -> float:
    """How far an object has turned from pose A to pose B, rad; a body of revolution: how far its axis has."""
    if object_class.shape is Shape.CYLINDER:
        axis_A, axis_B = X_TA.rotation[:, 2], X_TB.rotation[:, 2]
        return math.atan2(float(np.linalg.norm(np.cross(axis_A, axis_B))), float(axis_A @ axis_B))
    return float(np.linalg.norm(Rotation.from_matrix(X_TA.rotation.T @ X_TB.rotation).as_rotvec()))
