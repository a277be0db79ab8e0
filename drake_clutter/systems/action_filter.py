"""Moves in view that are not worth trying, of an explorer that knows objects from images."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.config import ExplorationConfig
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.occlusion import objects_below_unidentified_points
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.tasks.belief import Belief, legal_moves

PickableFn = Callable[[Sequence[SceneObject]], Collection[str]]
"""From K_t, the names of objects that carry nothing known, and that can be held."""


@dataclass(frozen=True, eq=False)
class InfeasibleMoveFilter:
    """Finds the moves of what cannot be picked, and those without a free place (an `ActionFilter`).

    Also those of what may carry something that was not recognized, as long as others are left.

    Attributes:
        pickable: Says what can be picked.
        empty_depth: Depth of the cell without objects [m]. Shape (height, width).
        config: Of the task.
    """

    pickable: PickableFn
    empty_depth: NDArray[np.float32]
    config: ExplorationConfig

    def __call__(self, belief: Belief, observation: Observation) -> Sequence[Move]:
        """See `ActionFilter`."""
        moves, pickable = legal_moves(observation), self.pickable(belief.objects)
        free = [
            move
            for move in moves
            if move.pick in pickable
            and find_free_placements(observation, move, self.config) is not None
        ]
        risky = objects_below_unidentified_points(belief.objects, observation, self.empty_depth)
        worth_trying = {move for move in free if move.pick not in risky} or set(free)
        return [move for move in moves if move not in worth_trying]
