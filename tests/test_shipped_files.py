"""Files in the repository that this or an earlier version wrote still load."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import CATALOG, DEFAULT_CELL, ONE_CUP, cell_with, training_script

from drake_clutter.cell.work_cell import load_cell
from drake_clutter.config import ClutterConfig, upgrade_cell, upgrade_config, upgrade_header_configs
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.records import read_jsonl
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import load_config_as, override_config
from drake_clutter.yaml_io import parse_yaml, to_yaml

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "training/configs").glob("*.yaml"))
CHECKPOINTS = sorted((ROOT / "training/checkpoints").glob("*.safetensors"))
SETS = sorted((ROOT / "training/scenes").glob("*.json"))
CELLS = sorted((ROOT / "models/cells").glob("*.yaml"))
CELLS_OF_RESULTS = (
    DEFAULT_CELL,
    cell_with(ONE_CUP),
    # The stiffness of each cup in full, rounded; it follows from the size of the cup.
    cell_with("gripper.cups.0.bending_stiffness=4.9", "gripper.cups.1.bending_stiffness=0.028"),
)
"""Default cells of the shipped results: those of earlier versions have a single cup."""
RESULTS = sorted(
    path
    for folder in ("training/results", "benchmarks/results")
    for path in (ROOT / folder).rglob("*.json*")
)


def script_config(name: str) -> Any:
    """Return the config class instance of the training that a file is named after."""
    if name.startswith("detector"):
        return training_script("train_detector").CONFIG
    if name.startswith("sg"):
        return training_script("train_generator").CONFIG
    if name == "student_rg" or name.endswith(("_bc", "_dagger")) or "dagger_seed" in name:
        return training_script("train_explorer_dagger").CONFIG
    return training_script("train_explorer_ppo").CONFIG


def name_of(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("path", CELLS, ids=name_of)
def test_cells(path: Path, tmp_path: Path) -> None:
    cell = load_cell(path)
    (tmp_path / "cell.yaml").write_text(to_yaml(cell.model_dump(mode="json")))
    assert load_cell(tmp_path / "cell.yaml") == cell


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_training_configs(path: Path) -> None:
    default = script_config(path.stem)
    assert type(load_config_as(default, path, upgrade=upgrade_config)) is type(default)


@pytest.mark.parametrize("path", CHECKPOINTS, ids=name_of)
def test_checkpoints_and_their_configs(path: Path) -> None:
    given = upgrade_config(load_checkpoint(path).metadata["config"])
    if "detector" in path.stem:
        del given["layout"]  # of version 0.1; a detector has no use for it
    config = override_config(script_config(path.stem), given, str(path))
    assert (config.cell if "detector" in path.stem else config.world.cell) == DEFAULT_CELL


@pytest.mark.parametrize("path", SETS, ids=name_of)
def test_scene_datasets(path: Path) -> None:
    assert load_scene_dataset(path, CATALOG).cell == DEFAULT_CELL


def configs_in(document: Any) -> Iterator[tuple[str, Any]]:
    """Yield the configs in a result, by their keys."""
    if isinstance(document, list):
        for item in document:
            yield from configs_in(item)
    if isinstance(document, dict):
        for key, value in document.items():
            if key in ("config", "scenario", "arm", "cell"):
                yield key, value
            else:
                yield from configs_in(value)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_results(path: Path) -> None:
    is_record_file = path.name.endswith(".jsonl.gz")
    document = read_jsonl(path)[0] if is_record_file else json.loads(path.read_text())
    upgrade_header_configs(document)
    for key, value in configs_in(document):
        if isinstance(value, str):  # YAML, or the name of a config
            value = parse_yaml(value, str(path))
        if not isinstance(value, dict):
            continue
        if key == "scenario":
            assert (
                override_config(Scenario(), upgrade_config(value), str(path)).world.cell
                in CELLS_OF_RESULTS
            )
        elif key in ("arm", "cell"):
            cell = override_config(DEFAULT_CELL, upgrade_cell(value), str(path))
            assert cell in CELLS_OF_RESULTS
        else:
            of_training = "learning" in value
            default: Any = script_config("sg") if of_training else ClutterConfig()
            config = override_config(default, upgrade_config(value), str(path))
            assert (config.world if of_training else config).cell in CELLS_OF_RESULTS
