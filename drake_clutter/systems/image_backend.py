"""Exploration backend without an arm, with observations from rendered images."""

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
from drake_clutter.systems.perception_system import PerceptionFn, with_image_tolerances
from drake_clutter.systems.tracking import associate_detections, to_ground_truth_names
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.episode import SteppedBackend


class ImageBackend(SteppedBackend):
    """Detect objects in rendered images, teleport the picked one, and let Drake settle the scene.

    Names of detections differ from those of the true objects. A command picks the true object
    nearest to the detection, and the pose error of the detection carries over to the placement.
    """

    def __init__(
        self,
        scene: Scene,
        perceive: PerceptionFn,
        *,
        seed: int,
        config: ClutterConfig,
    ) -> None:
        """Start an episode on a scene at rest, and observe the scene.

        Args:
            scene: Objects at rest.
            perceive: Returns the detections in an image.
            seed: Seed of all random numbers.
            config: Config of the cell, the simulation and the task.
        """
        config = with_image_tolerances(config)
        self._perceive = perceive
        self._seed = seed
        self._camera = CameraRenderer(config.cell.camera)
        empty_depth = self._camera.render(replace(scene, objects=())).depth
        super().__init__(
            SettleExecutor(config, simulate_collapse=False),
            LabelDetector(config.cell.camera),
            config.exploration,
            scene,
            item_rng(seed),
            tracker=associate_detections,
            action_filter=InfeasibleMoveFilter(_unloaded_objects, empty_depth, config.exploration),
        )

    @property
    def policy_rng(self) -> np.random.Generator:
        """Random generator of the next move; see `SteppedBackend.policy_rng`."""
        return item_rng(self._seed, len(self.belief.history) + 1)

    @property
    def outcome_rng(self) -> np.random.Generator:
        """Random generator of the next outcome; see `SteppedBackend.outcome_rng`."""
        return item_rng(self._seed, len(self.belief.history) + 1, 1)

    def observe(self) -> Observation:
        """Return the detections in a rendered image of the scene."""
        images = self._camera.render(self.scene)
        return self._perceive(images.depth, images.color, ())

    def execute(self, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Execute a command with the true object nearest to its pick pose."""
        picked = nearest_object(self.scene.objects, command.X_TO_pick)
        X_TO_place = transport_pose(command.X_TO_pick, command.X_TO_place, picked.X_TO)
        move = replace(command.move, pick=picked.name)
        outcome = super().execute(PickPlaceCommand(move, picked.X_TO, X_TO_place), rng)
        return replace(outcome, X_TO_released=command.X_TO_place)

    def observable_result(self, outcome: Outcome) -> MoveResult:
        """Return `PLACED`: the policy learns of the outcome from the next observation only."""
        return MoveResult.PLACED

    def to_ground_truth(self, decision: Decision) -> Decision:
        """Return a decision with the names of the true objects."""
        return to_ground_truth_names(
            decision, self.belief.objects, self.observation, self.scene.objects
        )


def _unloaded_objects(known: Sequence[SceneObject]) -> set[str]:
    """Return the names of the objects that carry no other object."""
    return {o.name for o in known if not objects_resting_on(o, known)}
