"""Pick-and-place moves by teleport, judged by static equilibrium."""

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
    """Executes moves by teleport and judges them statically (a `MoveExecutor`).

    The picked object appears at its placement, at rest on what is below. The scene collapses when
    an object loses its support as the picked one is removed, or when the contact group of the
    placed object is not in equilibrium. Falls are not simulated: after a collapse, the scene shows
    the picked object at its placement and the others unmoved. If the static model does not cover
    the scene, the result is `MoveResult.INCONCLUSIVE`.
    """

    def __init__(self, config: ClutterConfig, judge: StaticStabilityJudge | None = None) -> None:
        """Create an executor.

        Args:
            config: The simulated world.
            judge: A judge to share, with its cache of stacks.
        """
        self._config = config
        self._judge = judge or StaticStabilityJudge(config)

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Return the outcome of a command; see `MoveExecutor.execute`."""
        (x, y, _) = sample_offsets(1, self._config.settle.jitter, rng)[0]
        resting = command.X_TO_place.translated((x, y, -self._config.exploration.release_height))
        moved = scene.with_poses({command.move.pick: resting})
        verdict = self._judge_move(scene, moved, command.move)
        if isinstance(verdict, InconclusiveVerdict):
            return Outcome(MoveResult.INCONCLUSIVE, scene, inconclusive=verdict)
        return Outcome(
            MoveResult.PLACED if verdict is None else MoveResult.COLLAPSED, moved, verdict
        )

    def _judge_move(
        self, before: Scene, after: Scene, move: Move
    ) -> Instability | InconclusiveVerdict | None:
        """Return the object that falls during a move, or None if none does.

        As in Drake, objects that the move does not touch stay at rest. If a touched object rests
        before the move although the static model lets it fall, the verdict is inconclusive.
        """
        below: tuple[str, ...] = () if move.place == TRAY else (move.place,)
        if move.place_values is not None:
            touched = self._judge.contact_group(after, move.pick).names
            below = tuple(name for name in touched if name != move.pick)
        for name in (move.pick, *below):
            verdict = self._judge.find_instability(self._judge.contact_group(before, name))
            if isinstance(verdict, Instability):
                return InconclusiveVerdict(InconclusiveReason.RESTS_NEVERTHELESS, verdict.object)
            if verdict is not None:
                return verdict
        losing = self._judge.objects_losing_support(before, move.pick)
        if isinstance(losing, InconclusiveVerdict):
            return losing
        if losing:
            return Instability(InstabilityReason.UNSUPPORTED, losing[0])
        return self._judge.find_instability(self._judge.contact_group(after, move.pick))
