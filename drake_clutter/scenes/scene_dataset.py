"""Sets of stable scenes in one small file: training ground for explorers, and the frozen scenes that they are compared on.

A file is JSON. It holds the rules that derive each graph, and of a frozen set also where the objects came to rest; and a hash of
all that, so that nobody compares agents on different work without noticing.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.catalog import Catalog, ObjectClass
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, write_text
from drake_clutter.grammar import Derivation, SceneGrammar
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.validation import to_plain, validate

VERSION = 1
_LAYOUT_TRIES = 100


@dataclass(frozen=True)
class SceneRecord:
    """One stable scene of a set.

    Attributes:
        rules: by name, that derive its graph.
        canonical_form: its canonical form, see `canonical_form`.
        num_hidden: objects that were hidden.
        solvable: what the full-knowledge search said of it; "" if it was not asked.
        settled_poses: X_TO of every object at rest, in the order of the laid-out scene, or None.
    """

    rules: tuple[str, ...]
    canonical_form: str
    num_hidden: int
    solvable: str = ""
    settled_poses: tuple[Pose, ...] | None = None


@dataclass(frozen=True)
class SceneDataset:
    """A set of scenes.

    Attributes:
        name: the file's.
        classes: of the objects, in the grammar's order.
        metadata: agent, nodes, seed, object set, commit and whatever else says how it was made.
        scenes: the scenes.
        sha256: of all that.
        cell: the work cell that it was made with.
    """

    name: str
    classes: tuple[ObjectClass, ...]
    metadata: Mapping[str, Any]
    scenes: tuple[SceneRecord, ...]
    sha256: str
    cell: WorkCell

    @property
    def grammar(self) -> SceneGrammar:
        """Of its classes."""
        return SceneGrammar(self.classes)

    def derivation(self, index: int, grammar: SceneGrammar) -> Derivation:
        """The graph of a scene, with the rules that derive it."""
        rules = self.scenes[index].rules
        return Derivation(grammar.replay(rules), rules)

    def settled_scene(self, index: int, grammar: SceneGrammar, config: ClutterConfig) -> Scene:
        """A scene of a frozen set, as it came to rest, on the set's support.

        Raises:
            InputError: the set has no poses.
        """
        poses = self.scenes[index].settled_poses
        if poses is None:
            raise InputError(
                f"{self.name}: holds graphs without poses; allowed is a frozen set, as make_scenes.py --frozen writes"
            )
        world = replace(config, cell=config.cell.with_support(self.cell.support))
        scene = relayout(
            self.derivation(index, grammar), grammar, world, np.random.default_rng(index)
        )
        return scene.with_poses(dict(zip(scene.names, poses, strict=True)))


def relayout(
    derivation: Derivation, grammar: SceneGrammar, config: ClutterConfig, rng: np.random.Generator
) -> Scene:
    """A graph that has been laid out before, with its stacks in new places."""
    for _ in range(_LAYOUT_TRIES):
        scene = lay_out(derivation, grammar.classes, config, rng)
        if not isinstance(scene, LayoutFailure):
            return scene
    raise InputError(
        f"a graph found no room on the tray, {_LAYOUT_TRIES} times in a row; allowed is a layout that has room for it"
    )


def _digest(head: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(json.dumps([head, entries], sort_keys=True).encode()).hexdigest()


def save_scene_dataset(
    path: Path, metadata: Mapping[str, Any], scenes: Sequence[SceneRecord], cell: WorkCell
) -> None:
    """Write a set, one scene a line.

    Args:
        path: The file.
        metadata: Names the object set (`objects`) and what else is to be known.
        scenes: The scenes.
        cell: The work cell that it was made with.
    """
    names = sorted({rule for scene in scenes for rule in scene.rules})
    number = {name: k for k, name in enumerate(names)}
    entries: list[dict[str, Any]] = []
    for scene in scenes:
        entry: dict[str, Any] = {
            "canonical_form": scene.canonical_form,
            "hidden": scene.num_hidden,
            "solvable": scene.solvable,
        }
        entry["rules"] = [number[rule] for rule in scene.rules]
        if scene.settled_poses is not None:
            entry["settled"] = [
                [round(v, 6) for v in (*pose.translation, *pose.quaternion)]
                for pose in scene.settled_poses
            ]
        entries.append(entry)
    head = {"version": VERSION, **metadata, "cell": to_plain(cell), "rules": names}
    head["sha256"] = _digest(head, entries)
    lines = ",\n".join(json.dumps(entry, separators=(",", ":")) for entry in entries)
    write_text(path, f'{json.dumps(head)[:-1]}, "scenes": [\n{lines}\n]}}\n')


def load_scene_dataset(path: Path, catalog: Catalog) -> SceneDataset:
    """Reads a set.

    Raises:
        InputError: it cannot be read, is of another version, was changed since it was made, or needs other objects.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        entries, digest = document.pop("scenes"), document.pop("sha256")
        was_changed = _digest(document, entries) != digest
        version, names, objects = (
            document.pop("version"),
            document.pop("rules"),
            document["objects"],
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: is no set of scenes ({error}); allowed is a file that training/make_scenes.py wrote"
        ) from error
    if version != VERSION:
        raise InputError(f"{path}: version: {version}; allowed is {VERSION}")
    if was_changed:
        raise InputError(
            f"{path}: sha256: does not belong to its scenes, they were changed; allowed is the file as it was made"
        )
    # A set of version 0.1 has no cell.
    given = document.pop("cell", None)
    cell = default_cell() if given is None else validate(WorkCell, given, f"{path}: cell")
    scenes = []
    for entry in entries:
        poses = (
            tuple(_pose(numbers) for numbers in entry["settled"]) if "settled" in entry else None
        )
        rules = tuple(names[k] for k in entry["rules"])
        # Version 0.1 calls it a form.
        form = entry["canonical_form"] if "canonical_form" in entry else entry["form"]
        scenes.append(SceneRecord(rules, form, entry["hidden"], entry["solvable"], poses))
    return SceneDataset(
        path.name, catalog.object_set(objects), document, tuple(scenes), digest, cell
    )


def _pose(numbers: Sequence[float]) -> Pose:
    x, y, z, *quaternion = numbers
    w, i, j, k = (float(v) for v in np.array(quaternion) / np.linalg.norm(quaternion))
    return Pose((x, y, z), (w, i, j, k))
