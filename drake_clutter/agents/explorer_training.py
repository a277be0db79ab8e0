"""What all trainings of explorers have in common: the scenes, the world, and how they are watched."""

from dataclasses import field
from pathlib import Path
from typing import Annotated

from drake_clutter.agents.backends import backends
from drake_clutter.agents.exploration_episodes import acting, figures, play_episodes
from drake_clutter.agents.explorer_network import ExplorerNetwork
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.validation import InRange, config_class, renamed_fields

CHECKPOINT = "explorer.safetensors"


@config_class
@renamed_fields(catalogue="catalog")
class ExplorerTraining:
    """A training.

    Attributes:
        scenes: file of a set of scenes; catalog: a folder with object classes of one's own, or "".
        seed: same seed, same weights (on the same kind of machine).
        fidelity: of the moves; max_moves: of an episode; most_objects: of a scene.
        evaluation_episodes: that are played with the likeliest moves, to see how it goes.
        world: see there.
    """

    scenes: str = "training/scenes/train_sg_star.json"
    catalog: str = ""
    seed: Annotated[int, InRange(0)] = 0
    fidelity: str = "equilibrium"
    max_moves: Annotated[int, InRange(1)] = 20
    most_objects: Annotated[int, InRange(1, 64)] = 24
    evaluation_episodes: Annotated[int, InRange(1)] = 200
    world: ClutterConfig = field(default_factory=ClutterConfig)

    def environment(self, *, privileged: bool = False) -> ClutterExploration:
        """Where it learns; `privileged`: it sees everything, or K_t."""
        return ClutterExploration(
            load_scene_dataset(
                Path(self.scenes), load_catalog(Path(self.catalog) if self.catalog else None)
            ),
            privileged=privileged,
            fidelity=backends(self.fidelity, self.world),
            config=self.world,
            max_moves=self.max_moves,
            most_objects=self.most_objects,
        )

    def evaluation(
        self, environment: ClutterExploration, network: ExplorerNetwork
    ) -> dict[str, float]:
        """How a network does, on the same episodes every time."""
        return figures(
            play_episodes(
                environment, self.evaluation_episodes, (self.seed, 3), acting(network, None)
            )
        )
