"""Scenes: objects with classes and poses on a support, independent of Drake.

Frames: T is the support's frame (origin at the center of its floor, z up); O is an object's frame
(origin at the object's geometric center).
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
        translation: p_AB [m]. Shape (3,).
        quaternion: Unit quaternion (w, x, y, z) of R_AB.
    """

    translation: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def from_rotation(rotation: NDArray[np.float64], translation: Iterable[float]) -> "Pose":
        """Return the pose with a rotation matrix and a translation; w is not negative.

        Args:
            rotation: R_AB. Shape (3, 3).
            translation: p_AB [m]. Shape (3,).
        """
        w, x, y, z = (
            float(v)
            for v in Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
        )
        px, py, pz = (float(v) for v in translation)
        return Pose((px, py, pz), (w, x, y, z))

    @cached_property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation matrix R_AB. Shape (3, 3)."""
        return np.asarray(Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix())

    @property
    def p(self) -> NDArray[np.float64]:
        """Translation p_AB as an array [m]. Shape (3,)."""
        return np.asarray(self.translation)

    @property
    def place_text(self) -> str:
        """Translation p_AB for readers, to the millimeter."""
        x, y, z = self.translation
        return f"({x:.3f}, {y:.3f}, {z:.3f}) m"

    def apply(self, p_B: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points given in B, expressed in A.

        Args:
            p_B: Points in B [m]. Shape (N, 3).
        """
        return np.asarray(p_B @ self.rotation.T + self.p)

    def translated(self, offset: Iterable[float]) -> "Pose":
        """Return the pose translated by an offset in A (3,) [m]."""
        x, y, z = (float(v) for v in self.p + np.asarray(list(offset)))
        return replace(self, translation=(x, y, z))


@dataclass(frozen=True)
class SceneObject:
    """One object of a scene.

    Attributes:
        name: Unique name in the scene.
        object_class: Class of the object.
        X_TO: Pose in the support's frame.
        node: Node of the object in the scene's graph, or None.
    """

    name: str
    object_class: ObjectClass
    X_TO: Pose
    node: int | None = None

    @cached_property
    def corners_T(self) -> NDArray[np.float64]:
        """Corners of the convex pieces in T [m]. Shape (V, 3)."""
        return self.X_TO.apply(self.object_class.corners)

    @cached_property
    def bounds_T(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the axis-aligned bounding box in T, (3,) each [m]."""
        return self.corners_T.min(axis=0), self.corners_T.max(axis=0)

    @property
    def top_height(self) -> float:
        """Height of the highest point above the support's floor [m]."""
        return float(self.bounds_T[1][2])


@dataclass(frozen=True)
class Scene:
    """Objects on a support.

    Attributes:
        objects: The objects, in order; their names are unique.
        support: The support that they stand on.
        graph: Terminal graph from which the scene was laid out, or None.
        derivation: Names of the rules that derived the graph.
        seed: Seed of the batch in which the scene was generated, or None.
    """

    objects: tuple[SceneObject, ...]
    support: Support
    graph: ClutterGraph | None = None
    derivation: tuple[str, ...] = ()
    seed: int | None = None

    def __getitem__(self, name: str) -> SceneObject:
        """Return the object of a name.

        Raises:
            KeyError: No object has this name.
        """
        for scene_object in self.objects:
            if scene_object.name == name:
                return scene_object
        raise KeyError(f"object {name!r} is not in the scene; it holds {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in order."""
        return tuple(scene_object.name for scene_object in self.objects)

    @property
    def poses(self) -> dict[str, Pose]:
        """X_TO of the objects, by name."""
        return {scene_object.name: scene_object.X_TO for scene_object in self.objects}

    def with_poses(self, poses: Mapping[str, Pose]) -> "Scene":
        """Return the scene with the poses of the named objects replaced."""
        return replace(
            self,
            objects=tuple(
                replace(o, X_TO=poses[o.name]) if o.name in poses else o for o in self.objects
            ),
        )


def sample_offsets(count: int, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample one horizontal offset for each object, uniformly from a disc.

    Args:
        count: Number of objects.
        radius: Radius of the disc [m].
        rng: Random generator.

    Returns:
        Offsets in T with z = 0 [m]. Shape (count, 3).
    """
    samples = rng.random((count, 2))
    distance, angle = radius * np.sqrt(samples[:, 0]), 2 * math.pi * samples[:, 1]
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(count)])


def perturb_poses(
    objects: Sequence[SceneObject], radius: float, rng: np.random.Generator
) -> list[SceneObject]:
    """Return the objects, each translated by a random offset; see `sample_offsets`."""
    offsets = sample_offsets(len(objects), radius, rng)
    return [
        replace(o, X_TO=o.X_TO.translated(offset))
        for o, offset in zip(objects, offsets, strict=True)
    ]


def tilt_between(object_class: ObjectClass, X_TA: Pose, X_TB: Pose) -> float:
    """Return the angle by which an object rotates from pose A to pose B [rad].

    A rotation of a body of revolution about its own axis does not count.
    """
    if object_class.shape is Shape.CYLINDER:
        axis_A, axis_B = X_TA.rotation[:, 2], X_TB.rotation[:, 2]
        return math.atan2(float(np.linalg.norm(np.cross(axis_A, axis_B))), float(axis_A @ axis_B))
    return float(np.linalg.norm(Rotation.from_matrix(X_TA.rotation.T @ X_TB.rotation).as_rotvec()))
