"""Train a scene generator for about two minutes and sample scenes from it."""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from drake_clutter import ClutterConfig, ClutterGeneration, GenerationTaskConfig, load_catalog
from drake_clutter.agents.learned_generator import rule_network_metadata
from drake_clutter.agents.soft_q import SoftQConfig, SoftQLearner, sample_episodes
from drake_clutter.learning.checkpoint import save_checkpoint
from drake_clutter.validation import to_plain


def evaluate(learner: SoftQLearner, make: Callable[[], ClutterGeneration], count: int) -> str:
    """Return the mean score of sampled scenes and the fraction of stable ones."""
    episodes = sample_episodes(learner.network, make, count, temperature=0.25, seed=1)
    stable = np.mean(["scene" in episode.info for episode in episodes])
    score = np.mean([episode.episodic_return for episode in episodes])
    return f"step {learner.step}: score {score:.2f}, stable {stable:.2f}"


def main(steps: int, scenes: int, out: Path) -> None:
    classes = load_catalog().object_set("ycb7")

    task = GenerationTaskConfig(nodes=15)

    def make_environment() -> ClutterGeneration:
        return ClutterGeneration(classes, task, ClutterConfig())

    config = SoftQConfig(total_timesteps=steps, learning_starts=min(2000, steps // 4))
    learner = SoftQLearner(make_environment, config, 0, torch.device("cpu"), 2)
    print(evaluate(learner, make_environment, scenes))
    for round_end in np.linspace(0, steps, 5)[1:]:
        while learner.step < round_end:
            learner.train_iteration()
        print(evaluate(learner, make_environment, scenes))

    out.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "kind": "generator",
        "network": rule_network_metadata(make_environment().grammar, config.width),
        "temperature": config.temperature,
        "config": {"task": to_plain(task)},
    }
    save_checkpoint(out, learner.network, metadata)
    print(f"saved {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--scenes", type=int, default=64, help="scenes per evaluation")
    parser.add_argument("--out", type=Path, default=Path("out/tutorial/generator.safetensors"))
    arguments = parser.parse_args()
    main(arguments.steps, arguments.scenes, arguments.out)
