"""Scenarios: everything that decides an episode of the closed loop, in one typed file."""

from dataclasses import field
from pathlib import Path
from typing import Annotated

from drake_clutter.agents.explorers import BASELINE_POLICIES, ORACLE, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.perception.depth_noise import DepthNoise
from drake_clutter.systems.perception_system import LearnedPerception, PerceptionFn
from drake_clutter.tasks.belief import Policy
from drake_clutter.validation import InRange, config_class, renamed_fields


@config_class
@renamed_fields(catalogue="catalog")
class Scenario:
    """An episode of the closed loop.

    Attributes:
        scene: a scene file; "": one that the generator makes.
        catalog: a folder with object classes of one's own, or "".
        generator, objects, nodes: as for `drake-clutter generate`.
        agent: who chooses the moves: student, student-14, largest-clear, ..., or the file of a checkpoint.
        perception: what sees: labels, the perfect detector; depth or depth-color, trained ones; or the file of a checkpoint.
            A trained one recognises classes of `objects`.
        max_moves: after which it ends.
        seed: of everything that is left to chance.
        world: config.
    """

    scene: str = ""
    catalog: str = ""
    generator: str = "sg-star"
    objects: str = "ycb7"
    nodes: Annotated[int, InRange(3, 1000)] = 25
    agent: str = "student"
    perception: str = "labels"
    max_moves: Annotated[int, InRange(1)] = 20
    seed: Annotated[int, InRange(0)] = 0
    world: ClutterConfig = field(default_factory=ClutterConfig)


PRETRAINED_DETECTORS = {
    "depth": "training/checkpoints/detector_depth.safetensors",
    "depth-color": "training/checkpoints/detector_color.safetensors",
}
"""The shipped detectors, by name."""


def make_perception(scenario: Scenario, support: Support) -> PerceptionFn | None:
    """What a scenario sees with; None: the perfect detector.

    Raises:
        InputError: no such detector.
    """
    if scenario.perception == "labels":
        return None
    if scenario.perception not in PRETRAINED_DETECTORS and not scenario.perception.endswith(
        ".safetensors"
    ):
        allowed = f"labels, {', '.join(PRETRAINED_DETECTORS)}, or a .safetensors file"
        raise InputError(f"perception: {scenario.perception}; allowed are {allowed}")
    path = checkpoint_path(scenario.perception, PRETRAINED_DETECTORS)
    from drake_clutter.perception.learned_detector import LearnedDetector  # takes PyTorch
    from drake_clutter.perception.segmentation import SegmentationNetwork

    classes = load_catalog(Path(scenario.catalog) if scenario.catalog else None).object_set(
        scenario.objects
    )
    camera = scenario.world.cell.camera
    detector = LearnedDetector(SegmentationNetwork.load(path), classes, camera, support)
    noise = DepthNoise(focal_length=camera.focal_length) if camera.depth_noise else None
    return LearnedPerception(detector.detect, noise=noise, seed=scenario.seed)


def make_policy(name: str, config: ClutterConfig) -> Policy:
    """Return an explorer that knows no more than the camera shows.

    Raises:
        InputError: no such explorer, or one that knows more than the camera shows.
    """
    if name in BASELINE_POLICIES:
        return BASELINE_POLICIES[name]
    explorers = None if name == ORACLE else make_policy_factory(name, config)
    if explorers is not None:
        from drake_clutter.agents.learned_explorer import LearnedExplorerFactory  # takes PyTorch

        if isinstance(explorers, LearnedExplorerFactory) and not explorers.privileged:
            return explorers()
    allowed = f"a student, or one of {', '.join(BASELINE_POLICIES)}"
    raise InputError(f"agent: {name} knows more than the camera shows; allowed is {allowed}")
