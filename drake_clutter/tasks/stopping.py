"""Policy that stops when its belief says that nothing is left to be found."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_clutter.belief.hidden_belief import estimate_hidden
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import BeliefConfig
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.tasks.belief import Belief, Decision, Policy


@dataclass(frozen=True, eq=False)
class StoppingPolicy:
    """A policy that stops when every object is probably known (a `Policy`).

    It uses no ground truth; the number of objects is unknown to it. Its decisions hold what unseen
    space may hide.

    Attributes:
        policy: Chooses the moves.
        classes: Classes of the objects that there may be.
        empty_depth: Depth image of the cell without objects [m]. Shape (H, W).
        config: When the policy stops.
    """

    policy: Policy
    classes: Sequence[ObjectClass]
    empty_depth: NDArray[np.float32]
    config: BeliefConfig

    def __call__(
        self, belief: Belief, observation: Observation, rng: np.random.Generator
    ) -> Decision:
        """Return the next move, or the decision to stop; see `Policy`."""
        hidden = estimate_hidden(
            belief.objects, observation, self.empty_depth, self.classes, self.config
        )
        if hidden.nothing_left >= self.config.stop_probability:
            return Decision(None, hidden=hidden, is_stop=True)
        return replace(self.policy(belief, observation, rng), hidden=hidden)
