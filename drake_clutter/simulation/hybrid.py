"""Judge and executor with the static model, and Drake where it does not apply."""

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
    """Judges scenes statically, or in Drake where that is inconclusive."""

    def __init__(self, config: ClutterConfig) -> None:
        self._static = StaticStabilityJudge(config)
        self._drake = DrakeJudge(config)

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict:
        """Return the verdict; see `SceneJudge.judge`."""
        verdict = self._static.judge(scene, rng)
        if isinstance(verdict, InconclusiveVerdict):
            return self._drake.judge(scene, rng)
        return verdict


class HybridExecutor:
    """Executes moves statically, or in Drake where that is inconclusive."""

    def __init__(self, config: ClutterConfig, *, simulate_collapse: bool = True) -> None:
        """Create both executors.

        Args:
            config: The simulated world.
            simulate_collapse: See `SettleExecutor`.
        """
        self._static = StaticExecutor(config)
        self._settle = SettleExecutor(config, simulate_collapse=simulate_collapse)

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Return the outcome of a command; see `MoveExecutor.execute`."""
        state = rng.bit_generator.state
        outcome = self._static.execute(scene, command, rng)
        if outcome.result is MoveResult.INCONCLUSIVE:
            # The offsets are the same as if Drake executed the command directly.
            rng.bit_generator.state = state
            return self._settle.execute(scene, command, rng)
        return outcome
