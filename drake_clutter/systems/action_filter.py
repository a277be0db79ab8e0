"""Filter of moves that are infeasible for a policy that knows objects from images only."""

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
"""Returns the names of objects that can be grasped and support no other known object.

Args: the objects of a belief.
"""


@dataclass(frozen=True, eq=False)
class InfeasibleMoveFilter:
    """Find the moves whose object cannot be picked or has no free placement (an `ActionFilter`).

    Moves of objects that may support something undetected are infeasible, too, unless there are no
    other feasible moves.

    Attributes:
        pickable: Returns the names of pickable objects.
        empty_depth: Depth image of the cell without objects [m]. Shape (H, W).
        config: Config of the exploration task.
    """

    pickable: PickableFn
    empty_depth: NDArray[np.float32]
    config: ExplorationConfig

    def __call__(self, belief: Belief, observation: Observation) -> Sequence[Move]:
        """Return the infeasible moves; see `ActionFilter`."""
        moves = legal_moves(observation)
        pickable = self.pickable(belief.objects)
        possible = [
            move
            for move in moves
            if move.pick in pickable
            and find_free_placements(observation, move, self.config) is not None
        ]
        risky = objects_below_unidentified_points(belief.objects, observation, self.empty_depth)
        feasible = {move for move in possible if move.pick not in risky} or set(possible)
        return [move for move in moves if move not in feasible]
