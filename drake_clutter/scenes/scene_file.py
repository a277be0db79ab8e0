"""Scene files: versioned YAML for one scene, its work cell and its verdict."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AliasChoices, Field, field_validator, model_validator

from drake_clutter.catalog import Catalog
from drake_clutter.cell.support import Side
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.files import InputError, format_value, input_error, write_text
from drake_clutter.grammar import ClutterGraph, Orientation
from drake_clutter.grammar.clutter_graph import PRIMITIVE, STRUCTURE_KINDS, EdgeKind
from drake_clutter.scenes.geometry import MAX_PENETRATION, max_penetration
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject
from drake_clutter.validation import (
    Finite,
    Flag,
    Fraction,
    InRange,
    Integer,
    NonEmptyText,
    StrictModel,
    Vector3,
    allowed_error,
    to_plain,
    validate,
)
from drake_clutter.yaml_io import parse_yaml, read_yaml, to_yaml

VERSION = 2
"""Version of the files that are written."""
_QUATERNION_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1; 0.7071 is precise enough."""
_EDGE_KINDS: dict[str, EdgeKind] = {PRIMITIVE: PRIMITIVE} | {
    orientation.name.lower(): orientation for orientation in Orientation
}


@dataclass(frozen=True)
class SceneFile:
    """Content of a scene file.

    Attributes:
        scene: The objects as laid out.
        cell: Work cell for which the scene was made.
        verdict: A judge's verdict, or None.
    """

    scene: Scene
    cell: WorkCell
    verdict: Verdict | None = None

    @property
    def settled_scene(self) -> Scene:
        """The scene at rest, or as laid out if it was never judged."""
        return self.scene.with_poses(self.verdict.settled) if self.verdict else self.scene


class _PoseEntry(StrictModel):
    """A pose in a scene file."""

    translation: Vector3
    quaternion: tuple[Finite, Finite, Finite, Finite]

    @field_validator("quaternion")
    @classmethod
    def _normalize(cls, quaternion: tuple[float, ...]) -> tuple[float, ...]:
        norm = math.sqrt(sum(value * value for value in quaternion))
        if abs(norm - 1) > _QUATERNION_TOLERANCE:
            raise allowed_error(f"w, x, y, z of length 1 (this one's is {norm:.6g})")
        if abs(norm - 1) > 1e-12:
            return tuple(value / norm for value in quaternion)
        return quaternion

    @property
    def pose(self) -> Pose:
        """The pose."""
        return Pose(self.translation, self.quaternion)


class _ObjectEntry(StrictModel):
    """An object in a scene file."""

    name: NonEmptyText
    object_class: Annotated[NonEmptyText, Field(alias="class")]
    X_TO: _PoseEntry
    node: Integer | None = None

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        if name == TRAY:
            raise allowed_error(f"any name but {TRAY}")
        return name


class _NodeEntry(StrictModel):
    """A node of the graph in a scene file."""

    id: Integer
    kind: NonEmptyText


class _EdgeEntry(StrictModel):
    """An edge of the graph in a scene file."""

    parent: Integer
    child: Integer
    kind: NonEmptyText


class _GraphEntry(StrictModel):
    """The graph in a scene file."""

    nodes: tuple[_NodeEntry, ...]
    edges: tuple[_EdgeEntry, ...]


class _InstabilityEntry(StrictModel):
    """The instability of a verdict in a scene file."""

    reason: InstabilityReason
    object: NonEmptyText
    displacement: Finite
    tilt: Finite


class _VerdictEntry(StrictModel):
    """A verdict in a scene file."""

    stable: Flag
    settled: dict[str, _PoseEntry]
    visible_fractions: Annotated[
        dict[str, Fraction],
        Field(validation_alias=AliasChoices("visible_fractions", "visible_share")),
    ]
    hidden: tuple[NonEmptyText, ...]
    instability: _InstabilityEntry | None = None


class _TrayEntry(StrictModel):
    """The square tray in a scene file of version 1."""

    side: Side


class _Document(StrictModel):
    """Schema of a scene file. A file of version 1 has a tray and no cell."""

    version: Annotated[int, InRange(1, VERSION)]
    objects: Annotated[tuple[_ObjectEntry, ...], Field(min_length=1)]
    tray: _TrayEntry | None = None
    cell: WorkCell | None = None
    graph: _GraphEntry | None = None
    derivation: tuple[NonEmptyText, ...] = ()
    seed: Integer | None = None
    verdict: _VerdictEntry | None = None

    @model_validator(mode="after")
    def _check_tray_or_cell(self) -> Self:
        if self.tray is not None and self.cell is not None:
            raise allowed_error("a tray or a cell, which has one")
        return self

    @property
    def work_cell(self) -> WorkCell:
        """The cell of the file, or the default cell with the tray of version 1."""
        if self.cell is not None:
            return self.cell
        cell = default_cell()
        if self.tray is None:
            return cell
        side = self.tray.side
        return cell.with_support(cell.support.model_copy(update={"size": (side, side)}))


def load_scene(path: Path, catalog: Catalog) -> SceneFile:
    """Read a scene file.

    Args:
        path: The file.
        catalog: Catalog of the object classes.

    Raises:
        InputError: The file is not a valid scene. The message names the field and what is allowed.
    """
    return _build_scene_file(read_yaml(path, "a scene file"), str(path), catalog)


def scene_from_yaml(text: str, source: str, catalog: Catalog) -> SceneFile:
    """Parse the content of a scene file.

    Args:
        text: The content.
        source: Name of the source for error messages.
        catalog: Catalog of the object classes.

    Raises:
        InputError: See `load_scene`.
    """
    return _build_scene_file(parse_yaml(text, source, "a scene file"), source, catalog)


def _build_scene_file(given: Any, path: str, catalog: Catalog) -> SceneFile:
    """Return the content of a validated document."""
    document = validate(_Document, given, path)
    objects = tuple(_build_objects(document.objects, path, catalog))
    depth, first, second = max_penetration(objects)
    if depth > MAX_PENETRATION:
        problem = f"objects: {first} and {second} overlap by {1000 * depth:.1f} mm"
        raise input_error(path, f"{problem}; expected at most {1000 * MAX_PENETRATION:g} mm")
    graph = None if document.graph is None else _build_graph(document.graph, objects, path)
    cell = document.work_cell
    scene = Scene(objects, cell.support, graph, document.derivation, document.seed)
    entry = document.verdict
    return SceneFile(scene, cell, None if entry is None else _build_verdict(entry, scene, path))


def _value_error(path: str, field: str, value: Any, what: str) -> InputError:
    """Return the error for a field with a value that is not allowed."""
    return input_error(path, f"{field}: {format_value(value)}; expected {what}")


def _build_objects(
    entries: Sequence[_ObjectEntry], path: str, catalog: Catalog
) -> list[SceneObject]:
    """Return the objects of a scene file."""
    objects: dict[str, SceneObject] = {}
    for k, entry in enumerate(entries):
        object_class = catalog.classes.get(entry.object_class)
        if object_class is None:
            allowed_classes = f"one of {', '.join(catalog.classes)}"
            raise _value_error(path, f"objects[{k}].class", entry.object_class, allowed_classes)
        if entry.name in objects:
            problem = f"objects[{k}].name: {format_value(entry.name)} is used twice"
            raise input_error(path, f"{problem}; expected names without repeats")
        objects[entry.name] = SceneObject(entry.name, object_class, entry.X_TO.pose, entry.node)
    return list(objects.values())


def _build_graph(entry: _GraphEntry, objects: Sequence[SceneObject], path: str) -> ClutterGraph:
    """Return the graph of a scene file, if it fits the objects."""
    classes = {o.node: o.object_class.name for o in objects if o.node is not None}
    nodes: dict[int, str] = {}
    for k, node in enumerate(entry.nodes):
        if node.id in nodes:
            raise _value_error(
                path, f"graph.nodes[{k}].id", node.id, "an id that no other node has"
            )
        if node.kind not in STRUCTURE_KINDS and classes.get(node.id) != node.kind:
            what = "a structure node, or the class of the object that names this node"
            raise _value_error(path, f"graph.nodes[{k}].kind", node.kind, what)
        nodes[node.id] = node.kind
    edges: dict[tuple[int, int], EdgeKind] = {}
    for k, edge in enumerate(entry.edges):
        if edge.kind not in _EDGE_KINDS:
            what = f"one of {', '.join(_EDGE_KINDS)}"
            raise _value_error(path, f"graph.edges[{k}].kind", edge.kind, what)
        edges[edge.parent, edge.child] = _EDGE_KINDS[edge.kind]
    try:
        graph = ClutterGraph.from_parts(nodes, edges)
    except ValueError as error:
        raise input_error(path, f"graph.{error}") from error
    for o in objects:
        if o.node is not None and nodes.get(o.node) != o.object_class.name:
            problem = f"graph.nodes: the node of {o.name}, {o.node}, is missing or of another kind"
            raise input_error(path, f"{problem}; expected {o.object_class.name}")
    if not graph.is_terminal:
        problem = "graph: holds slots or edges without orientation"
        raise input_error(path, f"{problem}; expected a terminal graph")
    return graph


def _build_verdict(entry: _VerdictEntry, scene: Scene, path: str) -> Verdict:
    """Return the verdict of a scene file, if it fits the scene."""
    failure = entry.instability
    if entry.stable == (failure is not None):
        what = "expected one for an unstable scene, and none for a stable one"
        raise input_error(path, f"verdict.instability: {what}")
    names_by_field = {
        "settled": set(entry.settled),
        "visible_fractions": set(entry.visible_fractions),
    }
    names_by_field |= {
        "hidden": set(entry.hidden),
        "instability.object": {failure.object} if failure else set(),
    }
    for field, names in names_by_field.items():
        if unknown_names := sorted(names - set(scene.names)):
            problem = f"verdict.{field}: {format_value(unknown_names[0])} is no object"
            raise input_error(path, f"{problem}; expected {', '.join(scene.names)}")
    for field in ("settled", "visible_fractions") if entry.stable else ("settled",):
        if missing := sorted(set(scene.names) - names_by_field[field]):
            problem = f"verdict.{field}: {missing[0]} is missing"
            raise input_error(path, f"{problem}; expected an entry for every object")
    instability = None
    if failure is not None:
        instability = Instability(
            failure.reason, failure.object, failure.displacement, failure.tilt
        )
    settled = {name: pose.pose for name, pose in entry.settled.items()}
    return Verdict(instability, settled, entry.visible_fractions, entry.hidden)


def _pose_to_dict(pose: Pose) -> dict[str, list[float]]:
    """Return a pose as it stands in a scene file."""
    return {"translation": list(pose.translation), "quaternion": list(pose.quaternion)}


def scene_to_dict(scene: Scene, cell: WorkCell, verdict: Verdict | None = None) -> dict[str, Any]:
    """Return a scene file's document as plain lists and mappings."""
    plain = to_plain(cell.with_support(scene.support))
    document: dict[str, Any] = {
        "version": VERSION,
        "seed": scene.seed,
        "cell": plain,
        "objects": [],
    }
    for o in scene.objects:
        entry: dict[str, Any] = {
            "name": o.name,
            "class": o.object_class.name,
            "X_TO": _pose_to_dict(o.X_TO),
        }
        if o.node is not None:
            entry["node"] = o.node
        document["objects"].append(entry)
    if scene.graph is not None:
        edges = scene.graph.digraph.edges(data="kind")
        document["graph"] = {
            "nodes": [
                {"id": node, "kind": kind} for node, kind in scene.graph.digraph.nodes(data="kind")
            ],
            "edges": [
                {
                    "parent": a,
                    "child": b,
                    "kind": k.name.lower() if isinstance(k, Orientation) else k,
                }
                for a, b, k in edges
            ],
        }
    if scene.derivation:
        document["derivation"] = list(scene.derivation)
    if verdict is not None:
        document["verdict"] = _verdict_to_dict(verdict)
    return document


def _verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as it stands in a scene file."""
    fields: dict[str, Any] = {"stable": verdict.stable}
    if verdict.instability is not None:
        failure = verdict.instability
        fields["instability"] = {
            "reason": failure.reason.value,
            "object": failure.object,
            "displacement": failure.displacement,
            "tilt": failure.tilt,
        }
    settled: Mapping[str, Any] = {
        name: _pose_to_dict(pose) for name, pose in verdict.settled.items()
    }
    return fields | {
        "hidden": list(verdict.hidden),
        "visible_fractions": dict(verdict.visible_fractions),
        "settled": settled,
    }


def save_scene(path: Path, scene: Scene, cell: WorkCell, verdict: Verdict | None = None) -> None:
    """Write a scene file atomically.

    Args:
        path: The file.
        scene: The objects as laid out, and the support, which replaces the cell's.
        cell: Work cell for which the scene was made.
        verdict: A judge's verdict, or None.
    """
    write_text(path, scene_to_yaml(scene, cell, verdict))


def scene_to_yaml(scene: Scene, cell: WorkCell, verdict: Verdict | None = None) -> str:
    """Return the content of a scene file; see `save_scene`."""
    return to_yaml(scene_to_dict(scene, cell, verdict))
