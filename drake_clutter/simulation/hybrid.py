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
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge


class HybridJudge:
    """Judges fast, and asks Drake about what the fast judge cannot judge (a `SceneJudge`)."""

    def __init__(self, config: ClutterConfig) -> None:
        self._static, self._drake = StaticStabilityJudge(config), DrakeJudge(config)

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict:
        """See `SceneJudge.judge`."""
        verdict = self._static.judge(scene, rng)
        return (
            self._drake.judge(scene, rng) if isinstance(verdict, InconclusiveVerdict) else verdict
        )


class HybridExecutor:
    """Carries moves out fast, and asks Drake about what the fast judge cannot judge (a `MoveExecutor`)."""

    def __init__(self, config: ClutterConfig, *, simulate_collapse: bool = True) -> None:
        """Makes both; `simulate_collapse` is Drake's, see `SettleExecutor`."""
        self._static, self._settle = (
            StaticExecutor(config),
            SettleExecutor(config, simulate_collapse=simulate_collapse),
        )

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`."""
        state = rng.bit_generator.state
        outcome = self._static.execute(scene, command, rng)
        if outcome.result is MoveResult.INCONCLUSIVE:
            rng.bit_generator.state = state  # the same offsets as if Drake had been asked first
            return self._settle.execute(scene, command, rng)
        return outcome
