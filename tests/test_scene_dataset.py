"""Scene datasets in one file."""

from pathlib import Path

import pytest
from conftest import CATALOG, DEFAULT_CELL, GRAMMARS, random_scene, rng, tray

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Derivation, canonical_form
from drake_clutter.scenes.scene_dataset import (
    SceneRecord,
    load_scene_dataset,
    relayout,
    save_scene_dataset,
)

WORLD = ClutterConfig()
SCENES = [random_scene(seed) for seed in (1, 2, 3)]


def entry(number: int, *, frozen: bool) -> SceneRecord:
    scene = SCENES[number]
    assert scene.graph is not None
    poses = (
        tuple(pose.translated((0.001, 0.0, 0.0)) for pose in scene.poses.values())
        if frozen
        else None
    )
    return SceneRecord(
        scene.derivation, canonical_form(scene.graph, CATALOG.classes), number, "solvable", poses
    )


@pytest.mark.parametrize("frozen", [False, True])
def test_what_is_written_is_read(frozen: bool, tmp_path: Path) -> None:
    written = [entry(number, frozen=frozen) for number in range(3)]
    save_scene_dataset(tmp_path / "set.json", {"objects": "ycb7", "seed": 5}, written, DEFAULT_CELL)
    held = load_scene_dataset(tmp_path / "set.json", CATALOG)
    assert held.name == "set.json"
    assert held.metadata == {"objects": "ycb7", "seed": 5}
    assert [(s.rules, s.canonical_form, s.num_hidden, s.solvable) for s in held.scenes] == [
        (s.rules, s.canonical_form, s.num_hidden, s.solvable) for s in written
    ]
    for number, scene in enumerate(SCENES):
        assert scene.graph is not None
        derivation = held.derivation(number, held.grammar)
        assert dict(derivation.graph.digraph.edges) == dict(scene.graph.digraph.edges)
        if frozen:
            settled = held.settled_scene(number, held.grammar, WORLD)
            assert settled.names == scene.names
            for pose, laid_out in zip(settled.poses.values(), scene.poses.values(), strict=True):
                assert pose.p - laid_out.p == pytest.approx([0.001, 0, 0], abs=1e-6)
                assert pose.rotation == pytest.approx(laid_out.rotation, abs=1e-5)
        else:
            with pytest.raises(InputError, match=r"set\.json: holds graphs without poses"):
                held.settled_scene(number, held.grammar, WORLD)


def test_relayout_moves_the_stacks_only() -> None:
    grammar, first = GRAMMARS["ycb7"], SCENES[0]
    derivation = Derivation(grammar.replay(first.derivation), first.derivation)
    scenes = [relayout(derivation, grammar, WORLD, rng(seed)) for seed in (1, 1, 2)]
    for scene in scenes:
        assert scene.names == first.names
        assert [o.X_TO.p[2] for o in scene.objects] == pytest.approx(
            [o.X_TO.p[2] for o in first.objects]
        )
    assert scenes[0].poses == scenes[1].poses != scenes[2].poses


def test_a_changed_set_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "set.json"
    save_scene_dataset(path, {"objects": "ycb7"}, [entry(0, frozen=False)], DEFAULT_CELL)
    whole = path.read_text()
    path.write_text(whole.replace('"hidden":0', '"hidden":9'))
    with pytest.raises(InputError, match=r"set\.json: sha256"):
        load_scene_dataset(path, CATALOG)
    path.write_text(whole.replace('"version": 1', '"version": 7'))
    with pytest.raises(InputError, match=r"set\.json: version: 7; expected 1"):
        load_scene_dataset(path, CATALOG)
    path.write_text(whole[:-20])
    with pytest.raises(InputError, match=r"set\.json: is not JSON .*; expected a scene dataset"):
        load_scene_dataset(path, CATALOG)
    with pytest.raises(InputError, match=r"none\.json: cannot be read"):
        load_scene_dataset(tmp_path / "none.json", CATALOG)


def test_no_graph_that_explorers_are_compared_on_was_learned_from() -> None:
    """The shipped test datasets share no graph with the training ones, up to symmetry."""
    sets = {
        path: load_scene_dataset(path, CATALOG)
        for path in (Path(__file__).parents[1] / "training/scenes").glob("*.json")
    }
    learned_from = {
        scene.canonical_form
        for path, held in sets.items()
        if path.stem.startswith("train_")
        for scene in held.scenes
    }
    assert len(learned_from) >= 9000
    for path, held in sets.items():
        forms = {scene.canonical_form for scene in held.scenes}
        assert len(forms) == len(held.scenes), path.name
        if not path.stem.startswith("train_"):
            assert all(scene.settled_poses is not None for scene in held.scenes)
            assert not forms & learned_from, path.name


def test_a_frozen_scene_stands_on_the_support_of_its_set(tmp_path: Path) -> None:
    small = DEFAULT_CELL.with_support(tray(0.65))
    save_scene_dataset(tmp_path / "set.json", {"objects": "ycb7"}, [entry(0, frozen=True)], small)
    held = load_scene_dataset(tmp_path / "set.json", CATALOG)
    assert held.settled_scene(0, held.grammar, WORLD).support == small.support
