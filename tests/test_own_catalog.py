"""Training scripts take the user's own object classes with `--catalog`."""

from pathlib import Path

import pytest
import typer
from conftest import training_script
from typer.testing import CliRunner

from drake_clutter.assets import build_assets
from drake_clutter.catalog import load_catalog
from drake_clutter.perception.image_dataset import ImageDataset
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.validation import load_config_as
from training.script import settings_with_catalog

TRAININGS = ("train_generator", "train_detector", "train_explorer_ppo", "train_explorer_dagger")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Assets of a flat and a tall carton, in a folder whose name YAML could mistake."""
    folder = tmp_path_factory.mktemp("own") / "my #1: objects"
    folder.mkdir()
    (folder / "catalog.yaml").write_text(
        "classes:\n"
        "  flat: {shape: box, size_mm: [30, 70, 80], mass_g: 90}\n"
        "  tall: {shape: box, size_mm: [70, 110, 160], mass_g: 400}\n"
        "object_sets:\n  mine: [flat, tall]\n"
    )
    build_assets(folder)
    return folder


@pytest.mark.parametrize("name", TRAININGS)
def test_trainings_read_the_catalog(name: str, folder: Path) -> None:
    script = training_script(name)
    settings = settings_with_catalog(["seed=5"], folder)
    training = load_config_as(script.CONFIG, settings=settings)
    assert (training.catalog, training.seed) == (str(folder), 5)
    app = typer.Typer()
    app.command()(script.main)
    result = CliRunner().invoke(app, ["--catalog", str(folder / "none"), "--out", "unused"])
    assert "none" in str(result.exception)


@pytest.mark.parametrize("with_poses", [False, True])
def test_a_scene_dataset_of_own_objects(with_poses: bool, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.json"
    training_script("generate_scene_dataset").main(
        out,
        tmp_path / "work",
        agent="random",
        nodes=8,
        objects="mine",
        catalog=folder,
        count=1,
        with_poses=with_poses,
    )
    dataset = load_scene_dataset(out, load_catalog(folder))
    assert {c.name for c in dataset.classes} == {"flat", "tall"}
    assert dataset.scenes[0].num_hidden > 0


def test_images_of_own_objects(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = training_script("render_image_dataset")
    monkeypatch.setattr(script, "DISMANTLINGS", 1)
    script.main(tmp_path / "images", count=1, heap_fraction=0.0, objects="mine", catalog=folder)
    images = ImageDataset(tmp_path / "images")
    assert {name for image in map(images.__getitem__, range(4)) for name in image.classes} <= {
        "flat",
        "tall",
    }
    assert images[0].label.max() == len(images[0].classes) - 1
    models = tmp_path / "images/models"
    number = list(load_catalog(folder).classes).index("tall") + 1
    assert (models / f"obj_{number:06d}.ply").is_file()
