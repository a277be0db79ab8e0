"""From a terminal graph to poses: objects in their resting poses, pairs with their gap, stacks side by side on the tray."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalogue import ObjectClass, Rest
from drake_clutter.config import LayoutConfig
from drake_clutter.grammar import ClutterGraph, Derivation, Orientation, resting_rotation
from drake_clutter.grammar.graph import DUMMY, END
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
        amount: m^2, area of the stacks' footprints, or m, height of the highest stack.
        limit: m^2, area of the tray, or m, the height allowed.
    """

    reason: LayoutFailureReason
    amount: float
    limit: float

    def __str__(self) -> str:
        unit = "m" if self.reason is LayoutFailureReason.TOO_HIGH else "m^2"
        return f"{self.reason.value}: {self.amount:.3g} of {self.limit:.3g} {unit}"


def _resting_at(node: int, object_class: ObjectClass, orientation: Orientation, floor: float) -> SceneObject:
    """The object in its resting pose, centred over the tray's centre, its lowest point at height `floor` (m)."""
    R_TO = resting_rotation(object_class, orientation)
    lowest = float((object_class.corners @ R_TO.T)[:, 2].min())
    return SceneObject(f"{object_class.name}_{node}", object_class, Pose.of(R_TO, (0.0, 0.0, floor - lowest)), node)


def _stack(graph: ClutterGraph, classes: Mapping[str, ObjectClass], bottom: list[int], config: LayoutConfig) -> list[SceneObject]:
    """The objects of one stack, centred over the tray's centre; `bottom` is the single or the pair that stands on the tray."""
    placed: list[SceneObject] = []
    floor, level = 0.0, bottom
    parent = ClutterGraph.TRAY_NODE
    while level:
        orientation = graph.edge_kind(parent, level[0])  # a pair's two are alike
        assert isinstance(orientation, Orientation), "layout needs a terminal graph"
        resting = [_resting_at(node, classes[graph.kind(node)], orientation, floor) for node in level]
        if len(resting) == 2:
            gap = config.lying_gap if orientation.rest is Rest.FLAT else config.standing_gap
            aside = np.array([0.0, (resting[0].bounds_T[1][1] - resting[0].bounds_T[0][1] + gap) / 2, 0.0])
            resting = [replace(o, X_TO=o.X_TO.moved(sign * aside)) for o, sign in zip(resting, (-1, 1), strict=True)]
        placed += resting
        floor = max(o.top for o in resting)
        parent = level[0]
        above = graph.children(parent)
        if above and graph.kind(above[0]) == DUMMY:
            parent = above[0]
            above = graph.children(parent)
        level = [node for node in above if graph.kind(node) != END]
    return placed


def _place(half_sizes: NDArray[np.float64], config: LayoutConfig, rng: np.random.Generator) -> NDArray[np.float64] | None:
    """(S, 2) m, centres of S rectangles in the tray's square, gap kept; None if no draw fits. Large ones are drawn first."""
    reach = config.tray_side / 2 - config.stack_gap - half_sizes
    if (reach < 0).any():
        return None
    order = np.argsort(-half_sizes.prod(axis=1), kind="stable")
    for _ in range(config.placement_tries):
        centres = np.full_like(half_sizes, np.nan)
        for drawn, stack in enumerate(order):
            draws = rng.uniform(-1, 1, (config.placement_tries, 2)) * reach[stack]
            others = order[:drawn]
            apart = np.abs(draws[:, None] - centres[others]) - half_sizes[others] - half_sizes[stack]
            free = (apart.max(axis=2) >= config.stack_gap).all(axis=1)
            if not free.any():
                break
            centres[stack] = draws[np.argmax(free)]
        else:
            return centres
    return None


def lay_out(
    derivation: Derivation,
    classes: Mapping[str, ObjectClass],
    config: LayoutConfig,
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
        config: sizes and gaps.
        rng: draws the stacks' places.
        seed: noted in the scene.
    """
    graph = derivation.graph
    stacks = [_stack(graph, classes, bottom, config) for bottom in graph.stacks()]
    height = max(o.top for stack in stacks for o in stack)
    if height > config.max_stack_height:
        return LayoutFailure(LayoutFailureReason.TOO_HIGH, height, config.max_stack_height)
    lower = np.array([np.min([o.bounds_T[0][:2] for o in stack], axis=0) for stack in stacks])
    upper = np.array([np.max([o.bounds_T[1][:2] for o in stack], axis=0) for stack in stacks])
    centres = _place((upper - lower) / 2, config, rng)
    if centres is None:
        return LayoutFailure(LayoutFailureReason.NO_ROOM, float((upper - lower).prod(axis=1).sum()), config.tray_side**2)
    objects = []
    for stack, centre, middle in zip(stacks, centres, (lower + upper) / 2, strict=True):
        x, y = centre - middle
        objects += [replace(o, X_TO=o.X_TO.moved((x, y, 0.0))) for o in stack]
    return Scene(tuple(objects), config.tray_side, graph, derivation.rules, seed)
