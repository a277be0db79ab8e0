"""Datasets of stable scenes in one JSON file, for training and evaluation.

A file holds the grammar rules that derive each graph, optionally the settled poses of the objects,
and a hash of its content. Evaluations record the hash, so that results on different scenes are not
compared by mistake.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, AliasChoices, Field, Strict

from drake_clutter.catalog import Catalog, ObjectClass
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import (
    InputError,
    format_value,
    input_error,
    read_json,
    reading_file,
    write_text,
)
from drake_clutter.grammar import Derivation, SceneGrammar
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.validation import (
    CountOrZero,
    Finite,
    NonEmptyText,
    StrictModel,
    allowed_error,
    to_plain,
    validate,
)

VERSION = 1
"""Version of the file format."""
_PoseRow = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]
"""Translation [m] and quaternion (w, x, y, z) in a file."""
_LAYOUT_TRIES = 100
"""Layouts sampled for a graph before `relayout` gives up."""


@dataclass(frozen=True)
class SceneRecord:
    """One stable scene of a dataset.

    Attributes:
        rules: Names of the rules that derive its graph.
        canonical_form: Hash of its graph, see `drake_clutter.grammar.canonical_form`.
        num_hidden: Number of objects that are hidden at the start.
        solvable: Result of the oracle search; empty if it was not run.
        settled_poses: X_TO of every object at rest, in the order of the laid-out scene, or None.
    """

    rules: tuple[str, ...]
    canonical_form: str
    num_hidden: int
    solvable: str = ""
    settled_poses: tuple[Pose, ...] | None = None


@dataclass(frozen=True)
class SceneDataset:
    """A dataset of stable scenes.

    Attributes:
        name: Name of the file.
        classes: Classes of the objects, in the order of the grammar.
        metadata: How the scenes were generated: agent, nodes, seed, object set, commit.
        scenes: The scenes.
        sha256: Hash of the content.
        cell: Work cell for which the scenes were generated.
    """

    name: str
    classes: tuple[ObjectClass, ...]
    metadata: Mapping[str, Any]
    scenes: tuple[SceneRecord, ...]
    sha256: str
    cell: WorkCell

    @property
    def grammar(self) -> SceneGrammar:
        """Grammar of the classes."""
        return SceneGrammar(self.classes)

    def derivation(self, index: int, grammar: SceneGrammar) -> Derivation:
        """Return the graph of a scene, with the rules that derive it.

        Raises:
            InputError: The rules do not derive a graph.
        """
        rules = self.scenes[index].rules
        with reading_file(f"{self.name}: scenes[{index}].rules", "a derivation of the grammar"):
            return Derivation(grammar.replay(rules), rules)

    def laid_out_scene(
        self, index: int, grammar: SceneGrammar, config: ClutterConfig, rng: np.random.Generator
    ) -> Scene:
        """Return a scene with its stacks in new positions, on the dataset's support.

        Raises:
            InputError: No layout fits on the support.
        """
        world = replace(config, cell=config.cell.with_support(self.cell.support))
        return relayout(self.derivation(index, grammar), grammar, world, rng)

    def settled_scene(self, index: int, grammar: SceneGrammar, config: ClutterConfig) -> Scene:
        """Return a scene with its settled poses, on the dataset's support.

        Raises:
            InputError: The dataset has no poses.
        """
        poses = self.scenes[index].settled_poses
        if poses is None:
            raise InputError(
                f"{self.name}: holds graphs without poses; expected a dataset with settled poses"
            )
        scene = self.laid_out_scene(index, grammar, config, np.random.default_rng(index))
        if len(poses) != len(scene.names):
            raise InputError(
                f"{self.name}: scenes[{index}].settled: {len(poses)} poses; "
                f"expected {len(scene.names)}, one for each object"
            )
        return scene.with_poses(dict(zip(scene.names, poses, strict=True)))


def _check_quaternion(row: _PoseRow) -> _PoseRow:
    """Check that the quaternion can be normalized."""
    if not 1e-6 < np.linalg.norm(row[3:]) < 1e6:
        raise allowed_error("a pose with a unit quaternion")
    return row


class _SceneEntry(StrictModel):
    """A scene in the file of a dataset."""

    rules: tuple[CountOrZero, ...]
    # Version 0.1 calls it a form.
    canonical_form: Annotated[
        NonEmptyText, Field(validation_alias=AliasChoices("canonical_form", "form"))
    ]
    hidden: CountOrZero
    solvable: Annotated[str, Strict()] | None
    settled: tuple[Annotated[_PoseRow, AfterValidator(_check_quaternion)], ...] | None = None


def relayout(
    derivation: Derivation, grammar: SceneGrammar, config: ClutterConfig, rng: np.random.Generator
) -> Scene:
    """Return a scene for a graph, with its stacks in new positions.

    Raises:
        InputError: No layout fits on the support.
    """
    for _ in range(_LAYOUT_TRIES):
        scene = lay_out(derivation, grammar.classes, config, rng)
        if not isinstance(scene, LayoutFailure):
            return scene
    raise InputError(
        f"a graph did not fit on the tray in {_LAYOUT_TRIES} attempts; "
        "expected a layout that has room for it"
    )


def _digest(head: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> str:
    """Return the hash of a dataset's header and scenes."""
    return hashlib.sha256(json.dumps([head, entries], sort_keys=True).encode()).hexdigest()


def save_scene_dataset(
    path: Path, metadata: Mapping[str, Any], scenes: Sequence[SceneRecord], cell: WorkCell
) -> None:
    """Write a dataset, one scene per line.

    Args:
        path: The file.
        metadata: How the scenes were generated; `objects` names the object set.
        scenes: The scenes.
        cell: Work cell for which the scenes were generated.
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
    """Read a dataset.

    Raises:
        InputError: The file cannot be read, has another version, was changed after it was written,
            or needs other object classes.
    """
    content = "a scene dataset, which training/generate_scene_dataset.py wrote"
    with reading_file(path, content):
        document = validate(dict[str, Any], read_json(path, content), str(path))
        entries = document.pop("scenes")
        digest = document.pop("sha256")
        was_changed = _digest(document, entries) != digest
        version = document.pop("version")
        names = document.pop("rules")
        objects = document["objects"]
    if version != VERSION:
        raise input_error(str(path), f"version: {format_value(version)}; expected {VERSION}")
    if was_changed:
        raise InputError(
            f"{path}: sha256: does not match the scenes, which were changed; "
            "expected an unmodified file"
        )
    # A dataset of version 0.1 has no cell.
    given = document.pop("cell", None)
    cell = default_cell() if given is None else validate(WorkCell, given, f"{path}: cell")
    names = validate(tuple[NonEmptyText, ...], names, f"{path}: rules")
    objects = validate(NonEmptyText, objects, f"{path}: objects")
    scenes = []
    for number, entry in enumerate(validate(tuple[_SceneEntry, ...], entries, f"{path}: scenes")):
        unknown = [k for k in entry.rules if k >= len(names)]
        if unknown:
            raise InputError(
                f"{path}: scenes[{number}].rules: {unknown[0]}; expected the number of a rule, "
                f"below {len(names)}"
            )
        poses = None if entry.settled is None else tuple(map(_pose, entry.settled))
        rules = tuple(names[k] for k in entry.rules)
        scenes.append(
            SceneRecord(rules, entry.canonical_form, entry.hidden, entry.solvable or "", poses)
        )
    return SceneDataset(
        path.name, catalog.object_set(objects), document, tuple(scenes), digest, cell
    )


def _pose(numbers: Sequence[float]) -> Pose:
    """Return a pose from translation and quaternion, which is normalized."""
    x, y, z, *quaternion = numbers
    w, i, j, k = (float(v) for v in np.array(quaternion) / np.linalg.norm(quaternion))
    return Pose((x, y, z), (w, i, j, k))
