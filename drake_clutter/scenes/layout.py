"""From a terminal graph to poses: objects in their resting poses, pairs with their gap, stacks side by side on the tray."""

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
        reason: why.
        required: m^2, area of the stacks' footprints, or m, height of the highest stack.
        available: m^2, area of the tray, or m, the height allowed.
    """

    reason: LayoutFailureReason
    required: float
    available: float

    def __str__(self) -> str:
        unit = "m" if self.reason is LayoutFailureReason.TOO_HIGH else "m^2"
        return f"{self.reason.value}: {self.required:.3g} of {self.available:.3g} {unit}"


class _RestingPose(NamedTuple):
    """An object class at rest; lengths in m, axes those of T, origin the object's.

    Attributes:
        quaternion: (4,) of R_TO.
        lower, upper: (3,) of its box along the axes.
    """

    quaternion: tuple[float, float, float, float]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


@lru_cache(maxsize=4096)
def _resting_pose(object_class: ObjectClass, orientation: Orientation) -> _RestingPose:
    X_TO = Pose.from_rotation(resting_rotation(object_class, orientation), (0.0, 0.0, 0.0))
    corners = X_TO.apply(object_class.corners)
    return _RestingPose(X_TO.quaternion, corners.min(axis=0), corners.max(axis=0))


class Stack:
    """What stands on one single or one pair, laid out over the tray's centre.

    Attributes:
        nodes: of its objects in the graph, each below what it carries.
        p_T: (n, 3) m, their origins.
        lower, upper: (3,) m, its box along the axes.
    """

    def __init__(
        self,
        graph: ClutterGraph,
        classes: Mapping[str, ObjectClass],
        bottom: Sequence[int],
        config: LayoutConfig,
    ) -> None:
        """Lays out a stack whose attributes are all terminal; `bottom`: the single or the pair that stands on the tray."""
        self.nodes: list[int] = []
        self._graph, self._classes, self._resting = graph, classes, list[_RestingPose]()
        origins: list[list[float]] = []
        floor, level, parent = 0.0, list(bottom), ClutterGraph.TRAY_NODE
        while level:
            orientation = graph.edge_kind(parent, level[0])  # a pair's two are alike
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
            height = floor - resting.lower[2]
            origins += (
                [[0.0, 0.0, height]]
                if len(level) == 1
                else [[0.0, -offset, height], [0.0, offset, height]]
            )
            floor = height + resting.upper[2]
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
        """The stack's objects, the stack moved by x and y (m)."""
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
    """(S, 2) m, centres of S rectangles on the support's floor, gap kept; None if no draw fits. Large ones are drawn first."""
    reach = support.half_size - config.stack_gap - half_sizes
    if (reach < 0).any():
        return None
    order = np.argsort(-half_sizes.prod(axis=1), kind="stable")
    for _ in range(config.placement_attempts):
        centers = np.full_like(half_sizes, np.nan)
        for num_placed, stack in enumerate(order):
            samples = rng.uniform(-1, 1, (config.placement_attempts, 2)) * reach[stack]
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
    """A scene from a terminal graph.

    A child stands centred on its parent's top; a pair's two objects stand beside each other along the tray's y, their gap
    over the parent's centre; a dummy is the pair's centre and top. Stacks keep their orientation and are put uniformly at
    random where their axis-aligned footprints keep the config's gap.

    Args:
        derivation: a terminal graph and its rules.
        classes: by name.
        config: gaps, and the support.
        rng: draws the stacks' places.
        seed: noted in the scene.
    """
    graph = derivation.graph
    stacks = [Stack(graph, classes, bottom, config.layout) for bottom in graph.stack_bases()]
    height = max(float(stack.upper[2]) for stack in stacks)
    if height > config.layout.max_stack_height:
        return LayoutFailure(LayoutFailureReason.TOO_HIGH, height, config.layout.max_stack_height)
    lower, upper = (
        np.array([stack.lower[:2] for stack in stacks]),
        np.array([stack.upper[:2] for stack in stacks]),
    )
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
