"""Configuration of one closed-loop episode, and the detector and policy that it names."""

from collections.abc import Collection
from dataclasses import field
from pathlib import Path
from typing import Literal

from drake_clutter.agents.explorers import BASELINE_POLICIES, ORACLE, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.perception.depth_noise import DepthNoise
from drake_clutter.scenes.scene import Scene
from drake_clutter.systems.perception_system import LearnedPerception, PerceptionFn
from drake_clutter.tasks.belief import Policy
from drake_clutter.validation import Count, NodeCount, Seed, config_class, renamed_fields


@config_class
@renamed_fields(catalogue="catalog")
class Scenario:
    """Configuration of one closed-loop episode.

    Attributes:
        scene: Scene file; empty: the generator makes a scene.
        catalog: Folder with the user's own object classes, or empty.
        generator: Name of a generator, or file of a checkpoint.
        objects: Object set of the generator and of the learned detector.
        nodes: Number of nodes of the generated scene graph.
        agent: Explorer that chooses the moves: student, student-14, largest-clear, ..., or file of
            a checkpoint.
        perception: Detector: labels (ground truth), depth or depth-color (learned), or file of a
            checkpoint.
        until: When the episode ends: `all-found` (every object has been in view, which the ground
            truth decides) or `belief` (the agent stops by itself).
        max_moves: Number of moves after which the episode ends.
        seed: Seed of all random numbers.
        world: Config of the cell, the simulation and the task.
    """

    scene: str = ""
    catalog: str = ""
    generator: str = "sg-star"
    objects: str = "ycb7"
    nodes: NodeCount = 25
    agent: str = "student"
    perception: str = "labels"
    until: Literal["all-found", "belief"] = "all-found"
    max_moves: Count = 20
    seed: Seed = 0
    world: ClutterConfig = field(default_factory=ClutterConfig)


PRETRAINED_DETECTORS = {
    "depth": "training/checkpoints/detector_depth.safetensors",
    "depth-color": "training/checkpoints/detector_color.safetensors",
}
"""Checkpoints of the shipped detectors, by name."""


def make_perception(scenario: Scenario, scene: Scene) -> PerceptionFn | None:
    """Return the learned detector that a scenario names.

    Args:
        scenario: The scenario.
        scene: The scene.

    Returns:
        The detector; None for ground-truth labels.

    Raises:
        InputError: There is no such detector, the object set lacks a class of the scene, or the
            detector was not trained with a class of the set.
    """
    if scenario.perception == "labels":
        return None
    is_checkpoint = scenario.perception.endswith(".safetensors")
    if scenario.perception not in PRETRAINED_DETECTORS and not is_checkpoint:
        allowed = f"labels, {', '.join(PRETRAINED_DETECTORS)}, or a .safetensors file"
        raise InputError(f"perception: {scenario.perception}; expected {allowed}")
    path = checkpoint_path(scenario.perception, PRETRAINED_DETECTORS)
    # These imports need PyTorch.
    from drake_clutter.perception.learned_detector import LearnedDetector
    from drake_clutter.perception.segmentation import SegmentationNetwork

    catalog = load_catalog(Path(scenario.catalog) if scenario.catalog else None)
    classes = catalog.object_set(scenario.objects)
    missing = sorted(class_names(scene) - {c.name for c in classes})
    if missing:
        raise InputError(
            f"objects: {scenario.objects}; expected a set with all classes of the scene, which"
            f" contains {', '.join(missing)}"
        )
    camera = scenario.world.cell.camera
    network = SegmentationNetwork.load(path)
    try:
        detector = LearnedDetector(network, classes, camera, scene.support)
    except InputError as error:
        raise InputError(f"perception: {scenario.perception}: {error}") from error
    noise = DepthNoise(focal_length=camera.focal_length) if camera.depth_noise else None
    return LearnedPerception(detector.detect, noise=noise, seed=scenario.seed)


def class_names(scene: Scene) -> set[str]:
    """Return the names of the object classes of a scene."""
    return {o.object_class.name for o in scene.objects}


def make_policy(name: str, config: ClutterConfig, classes: Collection[str] = ()) -> Policy:
    """Return the policy of an explorer that uses only observations.

    Args:
        name: Name of an explorer, or file of a checkpoint.
        config: Config of the world.
        classes: Names of the object classes that will occur, as far as they are known.

    Raises:
        InputError: There is no such explorer, it uses the true state of the scene, or it was not
            trained with one of the classes.
    """
    if name in BASELINE_POLICIES:
        return BASELINE_POLICIES[name]
    factory = None if name == ORACLE else make_policy_factory(name, config, classes)
    if factory is not None:
        # This import needs PyTorch.
        from drake_clutter.agents.learned_explorer import LearnedExplorerFactory

        if isinstance(factory, LearnedExplorerFactory) and not factory.privileged:
            return factory()
    allowed = f"a student, or one of {', '.join(BASELINE_POLICIES)}"
    raise InputError(f"agent: {name} uses the true state of the scene; expected {allowed}")
