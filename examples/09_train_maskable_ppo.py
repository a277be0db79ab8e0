"""Train sb3-contrib's MaskablePPO to generate scenes. Untrained, it chooses rules at random."""

import argparse
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

from drake_clutter import GenerationTaskConfig

try:
    from sb3_contrib import MaskablePPO
except ModuleNotFoundError:
    print("skipped: MaskablePPO is not installed; run `pip install sb3-contrib`")
    sys.exit()

task = GenerationTaskConfig(nodes=15)
environment: Any = gymnasium.make("drake_clutter.tasks:ClutterGeneration-v0", task=task)
model = MaskablePPO("MultiInputPolicy", environment, gamma=1.0, ent_coef=0.01, seed=0)


def evaluate(episodes: int) -> Iterator[tuple[float, int]]:
    """Yield the return of each episode, and how many objects its stable scene hides."""
    for seed in range(episodes):
        (observation, info), episodic_return, over = environment.reset(seed=seed), 0.0, False
        while not over:
            action, _ = model.predict(observation, action_masks=info["action_mask"])
            observation, reward, terminated, truncated, info = environment.step(action)
            episodic_return, over = episodic_return + reward, terminated or truncated
        yield episodic_return, len(info["verdict"].hidden) if "verdict" in info else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000)
    for steps in (0, parser.parse_args().steps):
        model.learn(steps)
        print(f"{steps} steps: return, hidden objects: {np.mean([*evaluate(100)], axis=0)}")
