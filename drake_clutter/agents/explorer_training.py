"""Configuration shared by all trainings of exploration policies."""

from dataclasses import field
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorer_network import ExplorerNetwork
from drake_clutter.agents.rollouts import collect_rollouts, episode_metrics, make_policy_fn
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import current_fidelity
from drake_clutter.validation import Count, InRange, Seed, config_class, renamed_fields

CHECKPOINT_FILE = "explorer.safetensors"
"""Name of the checkpoint that a training writes to its run folder."""


@config_class
@renamed_fields(catalogue="catalog", most_objects="max_objects")
class ExplorerTrainingConfig:
    """Configuration shared by all trainings of exploration policies.

    Attributes:
        scenes: Scene dataset to train on.
        catalog: Folder with additional object classes; "" for none.
        seed: Random seed; equal seeds give equal weights on the same kind of machine.
        fidelity: Model of the outcomes of moves; see `make_backend_factory`.
        max_moves: Maximum number of moves of an episode.
        max_objects: Maximum number of objects of a scene.
        evaluation_episodes: Number of episodes of an evaluation.
        target: What an episode looks for, see `ClutterExploration`; "" for all objects.
        world: Configuration of the simulated world.
    """

    scenes: str = "training/scenes/train_sg_star.json"
    catalog: str = ""
    seed: Seed = 0
    fidelity: Annotated[str, AfterValidator(current_fidelity)] = "static"
    max_moves: Count = 20
    max_objects: Annotated[int, InRange(1, 64)] = 24
    evaluation_episodes: Count = 200
    target: str = ""
    world: ClutterConfig = field(default_factory=ClutterConfig)

    def make_environment(self, *, privileged: bool = False) -> ClutterExploration:
        """Create the environment.

        Args:
            privileged: Whether observations show all objects at their true poses, instead of the
                belief K_t.
        """
        catalog = load_catalog(Path(self.catalog) if self.catalog else None)
        return ClutterExploration(
            load_scene_dataset(Path(self.scenes), catalog),
            privileged=privileged,
            fidelity=make_backend_factory(self.fidelity, self.world),
            config=self.world,
            max_moves=self.max_moves,
            max_objects=self.max_objects,
            target=self.target or None,
        )

    def evaluate(
        self, environment: ClutterExploration, network: ExplorerNetwork
    ) -> dict[str, float]:
        """Return the metrics of a network's most probable moves on a fixed set of episodes."""
        return episode_metrics(
            collect_rollouts(
                environment,
                self.evaluation_episodes,
                (self.seed, 3),
                make_policy_fn(network, None),
            )
        )
