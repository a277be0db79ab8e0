"""Layout of terminal clutter graphs: object poses in stacks on the support."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, RestOrientation
from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig, LayoutConfig
from drake_clutter.grammar import ClutterGraph, Derivation, Orientation, resting_rotation
from drake_clutter.grammar.clutter_graph import DUMMY, END
from drake_clutter.scenes.scene import Pose, Scene, SceneObject


class LayoutFailureReason(Enum):
    """Why a graph cannot be laid out."""

    NO_ROOM = "no room on the tray"
    TOO_HIGH = "stack too high"


@dataclass(frozen=True)
class LayoutFailure:
    """A graph that cannot be laid out.

    Attributes:
        reason: Why it cannot be laid out.
        required: Area of the stacks' footprints [m^2], or height of the highest stack [m].
        available: Area of the support [m^2], or largest allowed height [m].
    """

    reason: LayoutFailureReason
    required: float
    available: float

    def __str__(self) -> str:
        unit = "m" if self.reason is LayoutFailureReason.TOO_HIGH else "m^2"
        return f"{self.reason.value}: {self.required:.3g} of {self.available:.3g} {unit}"


class _RestingPose(NamedTuple):
    """An object class at rest, in the axes of T about the object's origin.

    Attributes:
        quaternion: Quaternion (w, x, y, z) of R_TO.
        lower: Lower corner of the axis-aligned bounding box [m]. Shape (3,).
        upper: Upper corner of the axis-aligned bounding box [m]. Shape (3,).
    """

    quaternion: tuple[float, float, float, float]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


@lru_cache(maxsize=4096)
def _resting_pose(object_class: ObjectClass, orientation: Orientation) -> _RestingPose:
    """Return a class in a resting orientation."""
    X_TO = Pose.from_rotation(resting_rotation(object_class, orientation), (0.0, 0.0, 0.0))
    corners = X_TO.apply(object_class.corners)
    return _RestingPose(X_TO.quaternion, corners.min(axis=0), corners.max(axis=0))


class Stack:
    """An object or pair on the support and everything above it, centered.

    Attributes:
        nodes: Graph nodes of its objects, each before the objects that it carries.
        p_T: Origins of the objects [m]. Shape (n, 3).
        lower: Lower corner of the axis-aligned bounding box [m]. Shape (3,).
        upper: Upper corner of the axis-aligned bounding box [m]. Shape (3,).
    """

    def __init__(
        self,
        graph: ClutterGraph,
        classes: Mapping[str, ObjectClass],
        bottom: Sequence[int],
        config: LayoutConfig,
    ) -> None:
        """Lay out a stack.

        Args:
            graph: A terminal graph.
            classes: Object classes by name.
            bottom: Node of the object, or nodes of the pair, on the support.
            config: Gaps between the objects of a pair.
        """
        self.nodes: list[int] = []
        self._graph = graph
        self._classes = classes
        self._resting = list[_RestingPose]()
        origins: list[list[float]] = []
        base_height = 0.0
        level = list(bottom)
        parent = ClutterGraph.TRAY_NODE
        while level:
            # Both objects of a pair have the same orientation.
            orientation = graph.edge_kind(parent, level[0])
            assert isinstance(orientation, Orientation), "layout needs a terminal graph"
            resting = _resting_pose(classes[graph.kind(level[0])], orientation)
            offset = 0.0
            if len(level) == 2:
                gap = (
                    config.lying_gap
                    if orientation.rest is RestOrientation.FLAT
                    else config.standing_gap
                )
                offset = (resting.upper[1] - resting.lower[1] + gap) / 2
            self.nodes += level
            self._resting += [resting] * len(level)
            height = base_height - resting.lower[2]
            origins += (
                [[0.0, 0.0, height]]
                if len(level) == 1
                else [[0.0, -offset, height], [0.0, offset, height]]
            )
            base_height = height + resting.upper[2]
            parent = level[0]
            above = graph.children(parent)
            if above and graph.kind(above[0]) == DUMMY:
                parent = above[0]
                above = graph.children(parent)
            level = [node for node in above if graph.kind(node) != END]
        self.p_T = np.array(origins)
        self.lower = np.min(
            self.p_T + np.array([resting.lower for resting in self._resting]), axis=0
        )
        self.upper = np.max(
            self.p_T + np.array([resting.upper for resting in self._resting]), axis=0
        )

    def objects(self, x: float = 0.0, y: float = 0.0) -> list[SceneObject]:
        """Return the objects of the stack, moved by x and y [m]."""
        objects = []
        for node, resting, (px, py, pz) in zip(
            self.nodes, self._resting, (self.p_T + np.array([x, y, 0.0])).tolist(), strict=True
        ):
            object_class = self._classes[self._graph.kind(node)]
            objects.append(
                SceneObject(
                    f"{object_class.name}_{node}",
                    object_class,
                    Pose((px, py, pz), resting.quaternion),
                    node,
                )
            )
        return objects


def _sample_positions(
    half_sizes: NDArray[np.float64],
    support: Support,
    config: LayoutConfig,
    rng: np.random.Generator,
) -> NDArray[np.float64] | None:
    """Sample positions of rectangles that keep the gap, large rectangles first.

    Args:
        half_sizes: Half sizes of S rectangles [m]. Shape (S, 2).
        support: The support.
        config: Gap between stacks and number of attempts.
        rng: Random generator.

    Returns:
        Centers of the rectangles [m], shape (S, 2), or None if no attempt succeeded.
    """
    half_range = support.half_size - config.stack_gap - half_sizes
    if (half_range < 0).any():
        return None
    order = np.argsort(-half_sizes.prod(axis=1), kind="stable")
    for _ in range(config.placement_attempts):
        centers = np.full_like(half_sizes, np.nan)
        for num_placed, stack in enumerate(order):
            samples = rng.uniform(-1, 1, (config.placement_attempts, 2)) * half_range[stack]
            placed = order[:num_placed]
            gap = (
                np.abs(samples[:, None] - centers[placed]) - half_sizes[placed] - half_sizes[stack]
            )
            free = (gap.max(axis=2) >= config.stack_gap).all(axis=1)
            if not free.any():
                break
            centers[stack] = samples[np.argmax(free)]
        else:
            return centers
    return None


def lay_out(
    derivation: Derivation,
    classes: Mapping[str, ObjectClass],
    config: ClutterConfig,
    rng: np.random.Generator,
    seed: int | None = None,
) -> Scene | LayoutFailure:
    """Return a scene for a terminal graph, or the reason why there is none.

    A child stands centered on its parent's top. The two objects of a pair stand side by side along
    the tray's y axis, with their gap over the parent's center; a dummy node represents the pair's
    center and top. Stacks keep their orientation and get uniformly random positions at which their
    axis-aligned footprints are at least `stack_gap` apart.

    Args:
        derivation: A terminal graph and its rules.
        classes: Object classes by name.
        config: Gaps and support.
        rng: Draws the positions of the stacks.
        seed: Seed to record in the scene.
    """
    graph = derivation.graph
    stacks = [Stack(graph, classes, bottom, config.layout) for bottom in graph.stack_bases()]
    height = max(float(stack.upper[2]) for stack in stacks)
    if height > config.layout.max_stack_height:
        return LayoutFailure(LayoutFailureReason.TOO_HIGH, height, config.layout.max_stack_height)
    lower = np.array([stack.lower[:2] for stack in stacks])
    upper = np.array([stack.upper[:2] for stack in stacks])
    centers = _sample_positions((upper - lower) / 2, config.cell.support, config.layout, rng)
    if centers is None:
        return LayoutFailure(
            LayoutFailureReason.NO_ROOM,
            float((upper - lower).prod(axis=1).sum()),
            config.cell.support.area,
        )
    objects = [
        o
        for stack, (x, y) in zip(stacks, centers - (lower + upper) / 2, strict=True)
        for o in stack.objects(float(x), float(y))
    ]
    return Scene(tuple(objects), config.cell.support, graph, derivation.rules, seed)
