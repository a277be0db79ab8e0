"""Moves by teleport, judged without simulating."""

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    InstabilityReason,
    Move,
    MoveResult,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.scene import TRAY, Scene, sample_offsets
from drake_clutter.stability.static_judge import StaticStabilityJudge


class StaticExecutor:
    """Carries out a move at fidelity `fast` (a `MoveExecutor`).

    The picked object appears at its place, at rest on what is below. The scene collapses when an object loses its support as
    the picked one is taken away, or when what it touches afterwards does not balance; where things fall is not followed, so the
    scene after a collapse shows the picked object at its place and the others where they were. What the judge cannot judge
    is a result of its own.
    """

    def __init__(self, config: ClutterConfig, judge: StaticStabilityJudge | None = None) -> None:
        """Makes an executor; a judge that is shared remembers more stacks."""
        self._config = config
        self._judge = judge or StaticStabilityJudge(config)

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`."""
        (x, y, _) = sample_offsets(1, self._config.settle.jitter, rng)[0]
        resting = command.X_TO_place.translated((x, y, -self._config.exploration.release_height))
        moved = scene.with_poses({command.move.pick: resting})
        found = self._judge_move(scene, moved, command.move)
        if isinstance(found, InconclusiveVerdict):
            return Outcome(MoveResult.INCONCLUSIVE, scene, inconclusive=found)
        return Outcome(MoveResult.PLACED if found is None else MoveResult.COLLAPSED, moved, found)

    def _judge_move(
        self, before: Scene, after: Scene, move: Move
    ) -> Instability | InconclusiveVerdict | None:
        """What does not stand when the picked object goes from one place to the other; None if everything does.

        As under Drake, what the move does not touch stays at rest. What rests before the move although the judge would let it
        fall is beyond the judge.
        """
        for name in (move.pick,) if move.place == TRAY else (move.pick, move.place):
            found = self._judge.find_instability(self._judge.contact_group(before, name))
            if isinstance(found, Instability):
                return InconclusiveVerdict(InconclusiveReason.RESTS_NEVERTHELESS, found.object)
            if found is not None:
                return found
        losing = self._judge.objects_losing_support(before, move.pick)
        if isinstance(losing, InconclusiveVerdict):
            return losing
        if losing:
            return Instability(InstabilityReason.UNSUPPORTED, losing[0])
        return self._judge.find_instability(self._judge.contact_group(after, move.pick))
