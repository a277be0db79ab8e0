"""A backend without an arm whose observations come from rendered images."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.geometry import objects_resting_on, transport_pose
from drake_clutter.scenes.interfaces import (
    MoveResult,
    Observation,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.station.body_sleep import nearest_object
from drake_clutter.systems.action_filter import InfeasibleMoveFilter
from drake_clutter.systems.perception_system import PerceptionFn, with_min_release_height
from drake_clutter.systems.tracking import associate_detections, to_ground_truth_names
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.episode import SteppedBackend


class ImageBackend(SteppedBackend):
    """What a detector sees in rendered images is picked, appears at its place, and Drake settles.

    The policy knows objects by names of its own. What is picked is the true object nearest to
    where one was seen, and it lands as far off as it was seen.
    """

    def __init__(
        self,
        scene: Scene,
        perceive: PerceptionFn,
        *,
        seed: int,
        world: ClutterConfig,
    ) -> None:
        """Start on a scene at rest, and observe it.

        Args:
            scene: The objects, at rest.
            perceive: The detector.
            seed: Of all chances.
            world: The config.
        """
        world = with_min_release_height(world)
        self._perceive, self._seed = perceive, seed
        self._camera = CameraRenderer(world.cell.camera)
        empty_depth = self._camera.render(replace(scene, objects=())).depth
        super().__init__(
            SettleExecutor(world, simulate_collapse=False),
            LabelDetector(world.cell.camera),
            world.exploration,
            scene,
            item_rng(seed),
            tracker=associate_detections,
            action_filter=InfeasibleMoveFilter(_unloaded_objects, empty_depth, world.exploration),
        )

    @property
    def policy_rng(self) -> np.random.Generator:
        """See `SteppedBackend.policy_rng`."""
        return item_rng(self._seed, len(self.belief.history) + 1)

    @property
    def world_rng(self) -> np.random.Generator:
        """See `SteppedBackend.world_rng`."""
        return item_rng(self._seed, len(self.belief.history) + 1, 1)

    def observe(self) -> Observation:
        """See `SteppedBackend.observe`."""
        images = self._camera.render(self.scene)
        return self._perceive(images.depth, images.color, ())

    def execute(self, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `SteppedBackend.execute`."""
        picked = nearest_object(self.scene.objects, command.X_TO_pick)
        X_TO_place = transport_pose(command.X_TO_pick, command.X_TO_place, picked.X_TO)
        move = replace(command.move, pick=picked.name)
        outcome = super().execute(PickPlaceCommand(move, picked.X_TO, X_TO_place), rng)
        return replace(outcome, X_TO_released=command.X_TO_place)

    def observable_result(self, outcome: Outcome) -> MoveResult:
        """Return that the object was placed: what became of it shows when it is seen again."""
        return MoveResult.PLACED

    def to_ground_truth(self, decision: Decision) -> Decision:
        """See `SteppedBackend.to_ground_truth`."""
        return to_ground_truth_names(
            decision, self.belief.objects, self.observation, self.scene.objects
        )


def _unloaded_objects(known: Sequence[SceneObject]) -> set[str]:
    """Return the names of objects on which nothing rests."""
    return {o.name for o in known if not objects_resting_on(o, known)}
