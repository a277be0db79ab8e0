"""What all trainings of explorers have in common: the scenes, the world, and how they are watched."""

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
from drake_clutter.validation import InRange, config_class, renamed_fields

CHECKPOINT_FILE = "explorer.safetensors"


@config_class
@renamed_fields(catalogue="catalog", most_objects="max_objects")
class ExplorerTrainingConfig:
    """A training.

    Attributes:
        scenes: file of a set of scenes; catalog: a folder with object classes of one's own, or "".
        seed: same seed, same weights (on the same kind of machine).
        fidelity: of the moves; max_moves: of an episode; max_objects: of a scene.
        evaluation_episodes: that are played with the likeliest moves, to see how it goes.
        world: see there.
    """

    scenes: str = "training/scenes/train_sg_star.json"
    catalog: str = ""
    seed: Annotated[int, InRange(0)] = 0
    fidelity: Annotated[str, AfterValidator(current_fidelity)] = "static"
    max_moves: Annotated[int, InRange(1)] = 20
    max_objects: Annotated[int, InRange(1, 64)] = 24
    evaluation_episodes: Annotated[int, InRange(1)] = 200
    world: ClutterConfig = field(default_factory=ClutterConfig)

    def make_environment(self, *, privileged: bool = False) -> ClutterExploration:
        """Where it learns; `privileged`: it sees everything, or K_t."""
        return ClutterExploration(
            load_scene_dataset(
                Path(self.scenes), load_catalog(Path(self.catalog) if self.catalog else None)
            ),
            privileged=privileged,
            fidelity=make_backend_factory(self.fidelity, self.world),
            config=self.world,
            max_moves=self.max_moves,
            max_objects=self.max_objects,
        )

    def evaluate(
        self, environment: ClutterExploration, network: ExplorerNetwork
    ) -> dict[str, float]:
        """How a network does, on the same episodes every time."""
        return episode_metrics(
            collect_rollouts(
                environment, self.evaluation_episodes, (self.seed, 3), make_policy_fn(network, None)
            )
        )
