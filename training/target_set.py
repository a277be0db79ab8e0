"""Frozen sets of targets in the scenes of a shipped scene dataset, for searches for one object."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from drake_clutter.files import InputError, read_json, reading_file, write_text
from drake_clutter.scenes.scene_dataset import SceneDataset
from drake_clutter.tasks.oracle_search import Solvability
from drake_clutter.validation import (
    Count,
    CountOrZero,
    Flag,
    NonEmptyText,
    StrictModel,
    allowed_error,
    validate,
)
from training.script import ROOT

TARGETS = ROOT / "training/targets"
"""Shipped target sets."""


class TargetPair(StrictModel):
    """A scene and the target of a search in it.

    Attributes:
        scene: Index of the scene in the dataset.
        target: Name of the object, which is hidden at the start.
        solvable: Value of the `Solvability` that the oracle search found.
        moves: Number of moves of the oracle's plan; None if it found none.
        is_optimal: Whether no shorter plan exists.
    """

    scene: CountOrZero
    target: NonEmptyText
    solvable: NonEmptyText
    moves: Count | None
    is_optimal: Flag

    @model_validator(mode="after")
    def _check_plan(self) -> Self:
        if (self.moves is None) == (self.solvable == Solvability.SOLVABLE.value):
            raise allowed_error("moves of a solvable pair, and of no other")
        return self


@dataclass(frozen=True)
class TargetSet:
    """A frozen set of pairs.

    Attributes:
        name: Name of the file.
        scenes: Name of the scene dataset.
        pairs: The pairs.
        sha256: Hash of the content.
    """

    name: str
    scenes: str
    pairs: tuple[TargetPair, ...]
    sha256: str


def _digest(head: Mapping[str, Any], pairs: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(json.dumps([head, pairs], sort_keys=True).encode()).hexdigest()


def save_target_set(
    path: Path, metadata: Mapping[str, Any], scenes: SceneDataset, pairs: Sequence[TargetPair]
) -> None:
    """Write a target set, one pair per line.

    Args:
        path: The file.
        metadata: How the pairs were drawn: seed, budget of the search, commit.
        scenes: The scene dataset.
        pairs: The pairs.
    """
    entries = [pair.model_dump() for pair in pairs]
    head = {"scenes": scenes.name, "scenes_sha256": scenes.sha256, **metadata}
    document = {**head, "sha256": _digest(head, entries)}
    lines = ",\n".join(json.dumps(entry) for entry in entries)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, f'{json.dumps(document)[:-1]}, "pairs": [\n{lines}\n]}}\n')


def load_target_set(path: Path, scenes: SceneDataset) -> TargetSet:
    """Read a target set.

    Args:
        path: The file.
        scenes: The scene dataset of the pairs.

    Raises:
        InputError: The file cannot be read, was changed, or belongs to other scenes.
    """
    content = "a target set, which training/generate_target_set.py wrote"
    with reading_file(path, content):
        document = validate(dict[str, Any], read_json(path, content), str(path))
        entries = document.pop("pairs")
        digest = document.pop("sha256")
        scenes_digest = document["scenes_sha256"]
        name = str(document["scenes"])
        was_changed = _digest(document, entries) != digest
    if was_changed:
        raise InputError(f"{path}: sha256: does not match the pairs; expected an unmodified file")
    if scenes_digest != scenes.sha256:
        raise InputError(
            f"{path}: scenes_sha256: is that of other scenes than {scenes.name}; expected the"
            f" dataset {name} for which the pairs were drawn"
        )
    pairs = validate(tuple[TargetPair, ...], entries, f"{path}: pairs")
    for number, pair in enumerate(pairs):
        if pair.scene >= len(scenes.scenes):
            allowed = f"0 to {len(scenes.scenes) - 1}"
            raise InputError(f"{path}: pairs.{number}.scene: {pair.scene}; expected {allowed}")
    return TargetSet(path.name, name, pairs, digest)
