"""Scene files: versioned YAML that a person can read and edit."""

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from drake_clutter.catalogue import Catalogue
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.files import InputError, write_text
from drake_clutter.grammar import ClutterGraph, Orientation
from drake_clutter.grammar.graph import PRIMITIVE, STRUCTURE_KINDS, EdgeKind
from drake_clutter.scenes.geometry import PENETRATION_ALLOWED, deepest_penetration
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject

VERSION = 1
_QUATERNION_TOLERANCE = 1e-3  # a hand-written 0.7071 is close enough, and is normalised
_EDGE_KINDS: dict[str, EdgeKind] = {PRIMITIVE: PRIMITIVE} | {orientation.name.lower(): orientation for orientation in Orientation}


@dataclass(frozen=True)
class SceneFile:
    """What a scene file holds.

    Attributes:
        scene: the objects as laid out.
        verdict: what a judge said of it, or None.
    """

    scene: Scene
    verdict: Verdict | None = None

    @property
    def settled_scene(self) -> Scene:
        """The scene as it settled, or as laid out if it was never judged."""
        return self.scene.at(self.verdict.settled) if self.verdict else self.scene


class _Reader:
    """One value of a YAML document, with the place it stands in, for errors that name it."""

    def __init__(self, value: Any, where: str) -> None:
        self.value, self.where = value, where

    def refuse(self, allowed: str) -> InputError:
        try:
            shown = reprlib.repr(self.value)
        except ValueError:  # an integer of too many digits
            shown = "a number"
        return InputError(f"{self.where}: {shown}; allowed is {allowed}")

    def mapping(self, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, "_Reader"]:
        if not isinstance(self.value, dict):
            raise self.refuse(f"a mapping with {', '.join(required) or ', '.join(optional)}")
        for key in required:
            if key not in self.value:
                raise InputError(f"{self.where}: {key} is missing; needed are {', '.join(required)}")
        for key in self.value:
            if key not in required and key not in optional:
                raise InputError(f"{self.where}: {key!r} is unknown; allowed are {', '.join([*required, *optional])}")
        return {key: _Reader(value, f"{self.where}.{key}") for key, value in self.value.items()}

    def entries(self) -> dict[str, "_Reader"]:
        if not isinstance(self.value, dict):
            raise self.refuse("a mapping")
        return {str(key): _Reader(value, f"{self.where}.{key}") for key, value in self.value.items()}

    def items(self) -> list["_Reader"]:
        if not isinstance(self.value, list):
            raise self.refuse("a list")
        return [_Reader(value, f"{self.where}[{index}]") for index, value in enumerate(self.value)]

    def truth(self) -> bool:
        if not isinstance(self.value, bool):
            raise self.refuse("true or false")
        return self.value

    def share(self) -> float:
        if not 0 <= self.number() <= 1:
            raise self.refuse("0 to 1")
        return self.number()

    def text(self) -> str:
        if not isinstance(self.value, str) or not self.value:
            raise self.refuse("a text")
        return self.value

    def integer(self) -> int:
        if not isinstance(self.value, int) or isinstance(self.value, bool):
            raise self.refuse("an integer")
        return self.value

    def number(self) -> float:
        if isinstance(self.value, int | float) and not isinstance(self.value, bool):
            try:
                number = float(self.value)
            except OverflowError:  # an integer beyond every float
                number = math.inf
            if math.isfinite(number):
                return number
        raise self.refuse("a finite number")

    def numbers(self, count: int) -> list[float]:
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.refuse(f"a list of {count} finite numbers")
        return [item.number() for item in self.items()]

    def pose(self) -> Pose:
        fields = self.mapping(("translation", "quaternion"))
        x, y, z = fields["translation"].numbers(3)
        quaternion = fields["quaternion"].numbers(4)
        norm = math.sqrt(sum(value * value for value in quaternion))
        if abs(norm - 1) > _QUATERNION_TOLERANCE:
            raise fields["quaternion"].refuse(f"w, x, y, z of length 1 (this one's is {norm:.6g})")
        if abs(norm - 1) > 1e-12:
            quaternion = [value / norm for value in quaternion]
        qw, qx, qy, qz = quaternion
        return Pose((x, y, z), (qw, qx, qy, qz))


def load_scene(path: Path, catalogue: Catalogue) -> SceneFile:
    """Reads a scene file.

    Raises:
        InputError: the file, the field and what is allowed, for whatever cannot be a scene.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not YAML, or cut off ({error})") from error
    return scene_from_text(text, str(path), catalogue)


def scene_from_text(text: str, path: str, catalogue: Catalogue) -> SceneFile:
    """Reads what a scene file holds; see `load_scene`. `path` is how errors name it."""
    try:
        document = _Reader(yaml.load(text, Loader=yaml.CSafeLoader), path)
    except Exception as error:  # its constructors raise whatever a bad date, number or nesting leads to
        raise InputError(f"{path}: is not YAML, or cut off ({error})") from error
    fields = document.mapping(("version", "objects"), ("tray", "graph", "derivation", "seed", "verdict"))
    if fields["version"].integer() != VERSION:
        raise fields["version"].refuse(str(VERSION))
    support = default_cell().support
    if "tray" in fields:
        side = fields["tray"].mapping(("side",))["side"]
        length = side.number()
        if not 0.1 <= length <= 2.0:
            raise side.refuse("0.1 to 2 (m)")
        support = support.model_copy(update={"size": (length, length)})
    objects = tuple(_object(item, catalogue) for item in fields["objects"].items())
    if not objects:
        raise fields["objects"].refuse("a list of at least one object")
    names = [o.name for o in objects]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise InputError(f"{path}.objects[{index}].name: {name!r} is there twice; allowed are names without repeats")
    depth, first, second = deepest_penetration(objects)
    if depth > PENETRATION_ALLOWED:
        raise InputError(
            f"{path}.objects: {first} and {second} overlap by {1000 * depth:.1f} mm; allowed is {1000 * PENETRATION_ALLOWED:g} mm"
        )
    graph = _graph(fields["graph"], objects) if fields.get("graph") and fields["graph"].value is not None else None
    derivation = tuple(item.text() for item in fields["derivation"].items()) if "derivation" in fields else ()
    seed = fields["seed"].integer() if "seed" in fields and fields["seed"].value is not None else None
    scene = Scene(objects, support, graph, derivation, seed)
    judged = "verdict" in fields and fields["verdict"].value is not None
    return SceneFile(scene, _verdict(fields["verdict"], scene) if judged else None)


def _object(item: _Reader, catalogue: Catalogue) -> SceneObject:
    fields = item.mapping(("name", "class", "X_TO"), ("node",))
    class_name = fields["class"].text()
    if class_name not in catalogue.classes:
        raise fields["class"].refuse(f"one of {', '.join(catalogue.classes)}")
    if (name := fields["name"].text()) == TRAY:
        raise fields["name"].refuse(f"any name but {TRAY}")
    node = fields["node"].integer() if "node" in fields else None
    return SceneObject(name, catalogue.classes[class_name], fields["X_TO"].pose(), node)


def _graph(item: _Reader, objects: Sequence[SceneObject]) -> ClutterGraph:
    fields = item.mapping(("nodes", "edges"))
    classes = {o.node: o.object_class.name for o in objects if o.node is not None}
    nodes: dict[int, str] = {}
    for node in fields["nodes"].items():
        entry = node.mapping(("id", "kind"))
        identity, kind = entry["id"].integer(), entry["kind"].text()
        if identity in nodes:
            raise entry["id"].refuse("an id that no other node has")
        if kind not in STRUCTURE_KINDS and classes.get(identity) != kind:
            raise entry["kind"].refuse("a structure node, or the class of the object that names this node")
        nodes[identity] = kind
    edges: dict[tuple[int, int], EdgeKind] = {}
    for edge in fields["edges"].items():
        entry = edge.mapping(("parent", "child", "kind"))
        kind = entry["kind"].text()
        if kind not in _EDGE_KINDS:
            raise entry["kind"].refuse(f"one of {', '.join(_EDGE_KINDS)}")
        edges[entry["parent"].integer(), entry["child"].integer()] = _EDGE_KINDS[kind]
    try:
        graph = ClutterGraph.from_parts(nodes, edges)
    except ValueError as error:
        raise InputError(f"{item.where}.{error}") from error
    for o in objects:
        if o.node is not None and nodes.get(o.node) != o.object_class.name:
            raise InputError(
                f"{item.where}.nodes: the node of {o.name}, {o.node}, is missing or not of kind {o.object_class.name}"
            )
    if not graph.is_terminal:
        raise InputError(f"{item.where}: holds slots or edges without orientation; allowed is a terminal graph")
    return graph


def _verdict(item: _Reader, scene: Scene) -> Verdict:
    fields = item.mapping(("stable", "settled", "visible_share", "hidden"), ("instability",))
    stable = fields["stable"].truth()
    if stable == ("instability" in fields):
        raise InputError(f"{item.where}.instability: allowed is one for an unstable scene, and none for a stable one")
    settled = {name: reader.pose() for name, reader in fields["settled"].entries().items()}
    shares = {name: reader.share() for name, reader in fields["visible_share"].entries().items()}
    hidden = tuple(reader.text() for reader in fields["hidden"].items())
    instability = _instability(fields["instability"]) if not stable else None
    named = {"settled": set(settled), "visible_share": set(shares), "hidden": set(hidden)}
    named["instability.object"] = {instability.object} if instability else set()
    for field, names in named.items():
        if strangers := sorted(names - set(scene.names)):
            raise InputError(f"{item.where}.{field}: {strangers[0]!r} is no object; allowed are {', '.join(scene.names)}")
    for field in ("settled", "visible_share") if stable else ("settled",):
        if missing := sorted(set(scene.names) - named[field]):
            raise InputError(f"{item.where}.{field}: {missing[0]} is missing; allowed is an entry for every object")
    return Verdict(instability, settled, shares, hidden)


def _instability(item: _Reader) -> Instability:
    fields = item.mapping(("reason", "object", "displacement", "tilt"))
    reasons = {reason.value: reason for reason in InstabilityReason}
    if fields["reason"].text() not in reasons:
        raise fields["reason"].refuse(f"one of {', '.join(reasons)}")
    return Instability(
        reasons[fields["reason"].text()], fields["object"].text(), fields["displacement"].number(), fields["tilt"].number()
    )


def _pose_fields(pose: Pose) -> dict[str, list[float]]:
    return {"translation": list(pose.translation), "quaternion": list(pose.quaternion)}


def scene_fields(scene: Scene, verdict: Verdict | None = None) -> dict[str, Any]:
    """The document of a scene file, as plain lists and mappings."""
    document: dict[str, Any] = {"version": VERSION, "seed": scene.seed, "tray": {"side": scene.support.size[0]}, "objects": []}
    for o in scene.objects:
        entry: dict[str, Any] = {"name": o.name, "class": o.object_class.name, "X_TO": _pose_fields(o.X_TO)}
        if o.node is not None:
            entry["node"] = o.node
        document["objects"].append(entry)
    if scene.graph is not None:
        edges = scene.graph.nx.edges(data="kind")
        document["graph"] = {
            "nodes": [{"id": node, "kind": kind} for node, kind in scene.graph.nx.nodes(data="kind")],
            "edges": [
                {"parent": a, "child": b, "kind": k.name.lower() if isinstance(k, Orientation) else k} for a, b, k in edges
            ],
        }
    if scene.derivation:
        document["derivation"] = list(scene.derivation)
    if verdict is not None:
        document["verdict"] = _verdict_fields(verdict)
    return document


def _verdict_fields(verdict: Verdict) -> dict[str, Any]:
    fields: dict[str, Any] = {"stable": verdict.stable}
    if verdict.instability is not None:
        why = verdict.instability
        fields["instability"] = {
            "reason": why.reason.value,
            "object": why.object,
            "displacement": why.displacement,
            "tilt": why.tilt,
        }
    settled: Mapping[str, Any] = {name: _pose_fields(pose) for name, pose in verdict.settled.items()}
    return fields | {"hidden": list(verdict.hidden), "visible_share": dict(verdict.visible_share), "settled": settled}


def save_scene(path: Path, scene: Scene, verdict: Verdict | None = None) -> None:
    """Writes a scene file in one step."""
    write_text(path, scene_text(scene, verdict))


def scene_text(scene: Scene, verdict: Verdict | None = None) -> str:
    """What a scene file holds."""
    fields = scene_fields(scene, verdict)
    return str(yaml.dump(fields, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=160))
