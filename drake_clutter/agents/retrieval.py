"""Policy that searches for a target, and hands it over when it is in view."""

from collections.abc import Sequence

import numpy as np

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.interfaces import Detection, Move, Observation
from drake_clutter.scenes.placement import find_free_placements, has_clear_top
from drake_clutter.scenes.scene import TRAY, SceneObject
from drake_clutter.tasks.belief import Belief, Decision, Policy
from drake_clutter.tasks.search_target import SearchTarget


def handover_move(detection: Detection, cell: WorkCell, release_height: float) -> Move:
    """Return the move of an object to the hand-over place of a cell, in its orientation.

    Args:
        detection: The object.
        cell: A cell with a hand-over place.
        release_height: Height above the place at which the object is released [m].

    Raises:
        InputError: The cell has no hand-over place.
    """
    if cell.handover is None:
        raise InputError("cell: handover: is missing; expected the pose of a place beside the tray")
    lower, upper = SceneObject(detection.name, detection.object_class, detection.X_TO).bounds_T
    offset = detection.X_TO.p - [*(lower + upper)[:2] / 2, lower[2]]
    x, y, z = np.array(cell.handover.translation) + offset + [0.0, 0.0, release_height]
    return Move(detection.name, f"{x:.4f},{y:.4f},{z:.4f},0")


class RetrievingExplorer:
    """Search policy that moves the target to the hand-over place as soon as it is in view.

    Objects that rest on the target are moved to the tray first.
    """

    def __init__(
        self, search: Policy, target: SearchTarget, cell: WorkCell, config: ExplorationConfig
    ) -> None:
        """Create the policy.

        Args:
            search: Policy while the target is not in view.
            target: Target of the search.
            cell: Work cell with a hand-over place.
            config: Release height and clearances.
        """
        self._search = search
        self._target = target
        self._cell = cell
        self._config = config

    def __call__(
        self, belief: Belief, observation: Observation, rng: np.random.Generator
    ) -> Decision:
        """Choose the next move; see `Policy`."""
        found = [d for d in observation.detections if d.name in self._target.names]
        moves = [
            handover_move(d, self._cell, self._config.release_height)
            for d in found
            if has_clear_top(observation, d)
        ]
        for d in found:
            moves += self._clearing_moves(d, belief.objects, observation)
        for move in moves:
            if move not in belief.invalid_moves:
                return Decision(move)
        return Decision(None) if found else self._search(belief, observation, rng)

    def _clearing_moves(
        self, covered: Detection, known_objects: Sequence[SceneObject], observation: Observation
    ) -> list[Move]:
        """Return moves to the tray of clear objects that rest on an object, however high."""
        above = list[str]()
        carriers = [SceneObject(covered.name, covered.object_class, covered.X_TO)]
        while carriers:
            carrier = carriers.pop()
            others = [o for o in known_objects if o.name != carrier.name and o.name not in above]
            names = objects_resting_on(carrier, others)
            above += names
            carriers += [o for o in others if o.name in names]
        return [
            move
            for d in observation.detections
            if d.name in above
            and has_clear_top(observation, d)
            and find_free_placements(observation, move := Move(d.name, TRAY), self._config)
            is not None
        ]
