"""Objects and scenes that the tests share.

Expensive fixtures are created once for the whole run.
"""

import gc
import importlib.util
import re
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pytest
from hypothesis import settings

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import ClutterConfig, load_config
from drake_clutter.grammar import (
    NodeBudget,
    Orientation,
    SceneGrammar,
    resting_rotation,
    uniform_choice,
)
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import (
    Move,
    MoveExecutor,
    MoveResult,
    Observation,
    Outcome,
)
from drake_clutter.scenes.layout import lay_out
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.validation import load_config_as

if TYPE_CHECKING:
    import trimesh

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")

AnyReport = TypeVar("AnyReport", pytest.CollectReport, pytest.TestReport)

CATALOG = load_catalog()
CLASSES = CATALOG.classes
GRAMMARS = {name: SceneGrammar(CATALOG.object_set(name)) for name in ("ycb7", "pantry14")}

DEFAULT_CELL = default_cell()
TRAY = DEFAULT_CELL.support
WORLD = ClutterConfig()


def own_mesh_class(folder: Path, mesh: "trimesh.Trimesh") -> ObjectClass:
    """Return a built class of a mesh of 200 g."""
    mesh.export(folder / "own.stl")
    (folder / "catalog.yaml").write_text(
        "classes:\n  own: {shape: mesh, mesh: own.stl, mass_g: 200}\n"
    )
    build_assets(folder)
    return load_catalog(folder).classes["own"]


def resting(
    class_name: str,
    orientation: Orientation = Orientation.FLAT_0,
    xy: Sequence[float] = (0.0, 0.0),
    floor: float = 0.0,
    name: str = "",
) -> SceneObject:
    """Return an object of a shipped class in a resting pose.

    Its bounding box is centered over xy [m], and its lowest point is at height `floor` [m].
    """
    object_class = CLASSES[class_name]
    R_TO = resting_rotation(object_class, orientation)
    lowest = float((object_class.corners @ R_TO.T)[:, 2].min())
    return SceneObject(
        name or class_name, object_class, Pose.from_rotation(R_TO, (xy[0], xy[1], floor - lowest))
    )


def tray(side: float) -> Support:
    """Return the default tray with another inner side [m]."""
    return DEFAULT_CELL.support.model_copy(update={"size": (side, side)})


ONE_CUP = "gripper.cup_diameter=0.025"
"""Setting that leaves the default cell its large cup, on which no marker seals."""


def cell_with(*settings: str) -> WorkCell:
    """Return the default cell with changed fields, such as "robot.base.x=-0.8"."""
    return load_config_as(DEFAULT_CELL, settings=settings)


def world_with(*settings: str) -> ClutterConfig:
    """Return the default config with changed fields, such as "settle.jitter=0.003"."""
    return load_config(settings=settings)


def scene_of(*objects: SceneObject, side: float = 0.70) -> Scene:
    """Return a scene without a graph, on a tray of an inner side [m]."""
    return Scene(objects, tray(side))


def random_scene(seed: int, fewest: int = 16, most: int = 16, objects: str = "ycb7") -> Scene:
    """Return a laid-out scene of a graph derived by RG.

    The graph has `fewest` to `most` nodes; graphs that do not fit on the support are skipped.
    """
    generator = rng(seed)
    while True:
        budget = NodeBudget(int(generator.integers(fewest, most + 1)))
        derivation = GRAMMARS[objects].derive(budget, uniform_choice(generator))
        scene = lay_out(derivation, CLASSES, ClutterConfig(), generator, seed)
        if isinstance(scene, Scene):
            return scene


def training_script(name: str) -> ModuleType:
    """Return a script of `training/` as a module."""
    return importlib.import_module(f"training.{name}")


def executed(
    executor: MoveExecutor,
    scene: Scene,
    observation: Observation,
    move: Move,
    generator: np.random.Generator,
) -> Outcome:
    """Return the outcome of a move to a placement that the observation shows to be free."""
    command = resolve_placement(move, observation, WORLD.exploration, generator)
    if command is None:
        return Outcome(MoveResult.NO_FREE_PLACEMENT, scene)
    return executor.execute(scene, command, generator)


def rng(seed: int = 0) -> np.random.Generator:
    """Return a random generator."""
    return np.random.default_rng(seed)


OPTIONAL = (
    *("torch", "safetensors", "tensorboard", "threadpoolctl", "ray", "pybullet"),
    *(
        "av",
        "foxglove_schemas_protobuf",
        "lerobot",
        "mcap",
        "mcap_protobuf",
        "pxr",
        "pyarrow",
        "rerun",
    ),
)
"""Optional packages; tests that need a missing one are skipped."""
_MISSING = "|".join(name for name in OPTIONAL if importlib.util.find_spec(name) is None)


def _skipped_if_missing(report: AnyReport, path: Path) -> AnyReport:
    """Return a report; a test that failed for lack of an optional package is skipped."""
    words = rf"No module named '({_MISSING})[.\w]*'|install drake_clutter with \[\w+\]"
    if _MISSING and report.failed and (found := re.search(words, report.longreprtext)):
        report.outcome = "skipped"
        report.longrepr = (str(path), 0, f"Skipped: {found[0]}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Skip modules that need a package that is not installed."""
    return _skipped_if_missing((yield), collector.path)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip tests that need a package that is not installed."""
    return _skipped_if_missing((yield), item.path)


@pytest.fixture(scope="module", autouse=True)
def _collected_here() -> Iterator[None]:
    """Collect a module's renderers in this thread.

    Collected in another thread, they abort the process.
    """
    yield
    gc.collect()


@pytest.fixture(scope="session")
def config() -> ClutterConfig:
    """The default world."""
    return ClutterConfig()


@pytest.fixture(scope="session")
def judge(config: ClutterConfig) -> DrakeJudge:
    """One judge for all tests; its verdicts must not depend on earlier ones."""
    return DrakeJudge(config)


@pytest.fixture(scope="session")
def static_judge(config: ClutterConfig) -> StaticStabilityJudge:
    """One static judge for all tests, to share its caches."""
    return StaticStabilityJudge(config)


@pytest.fixture(scope="session")
def detector(config: ClutterConfig) -> LabelDetector:
    """One detector for all tests, to share its engine."""
    return LabelDetector(config.cell.camera)


@pytest.fixture(scope="session")
def camera(detector: LabelDetector) -> CameraRenderer:
    """The detector's camera."""
    return detector.renderer
