"""The fast judge and executor where they can tell, Drake where they cannot."""

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.interfaces import (
    InconclusiveVerdict,
    MoveResult,
    Outcome,
    PickPlaceCommand,
    Verdict,
)
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.executor import SettleExecutor
from drake_clutter.simulation.judge import DrakeJudge
from drake_clutter.stability.executor import FastExecutor
from drake_clutter.stability.judge import FastJudge


class FastOrDrakeJudge:
    """Judges fast, and asks Drake about what the fast judge cannot judge (a `SceneJudge`)."""

    def __init__(self, config: ClutterConfig) -> None:
        self._fast, self._drake = FastJudge(config), DrakeJudge(config)

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict:
        """See `SceneJudge.judge`."""
        verdict = self._fast.judge(scene, rng)
        return (
            self._drake.judge(scene, rng) if isinstance(verdict, InconclusiveVerdict) else verdict
        )


class FastOrDrakeExecutor:
    """Carries moves out fast, and asks Drake about what the fast judge cannot judge (a `MoveExecutor`)."""

    def __init__(self, config: ClutterConfig, *, follow_falls: bool = True) -> None:
        """Makes both; `follow_falls` is Drake's, see `SettleExecutor`."""
        self._fast, self._settle = (
            FastExecutor(config),
            SettleExecutor(config, follow_falls=follow_falls),
        )

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`."""
        state = rng.bit_generator.state
        outcome = self._fast.execute(scene, command, rng)
        if outcome.result is MoveResult.INCONCLUSIVE:
            rng.bit_generator.state = state  # the same offsets as if Drake had been asked first
            return self._settle.execute(scene, command, rng)
        return outcome
