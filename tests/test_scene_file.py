"""Scene files: exact round trips; every broken file is refused with its name and the field."""

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import (
    CATALOG,
    CLASSES,
    DEFAULT_CELL,
    TRAY,
    cell_with,
    random_scene,
    resting,
    rng,
    scene_of,
    tray,
)

from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.scenes.scene_file import SceneFile, load_scene, save_scene, scene_to_dict

Path_ = tuple[str | int, ...]
GONE = object()


def stable_verdict(scene: Scene) -> Verdict:
    """Return an arbitrary verdict, with numbers that need all their digits."""
    generator = rng(1)
    settled = {o.name: o.X_TO.translated(generator.normal(size=3) * 1e-5) for o in scene.objects}
    shares = {name: float(generator.uniform()) for name in scene.names}
    return Verdict(
        None, settled, shares, tuple(name for name, share in shares.items() if share < 0.3)
    )


def unstable_verdict(scene: Scene) -> Verdict:
    instability = Instability(InstabilityReason.LEFT_TRAY, scene.names[-1], 1 / 3, math.pi / 7)
    return Verdict(instability, scene.poses, {}, ())


def reloaded(folder: Path, scene: Scene, verdict: Verdict | None = None) -> SceneFile:
    path = folder / "scene.yaml"
    save_scene(path, scene, DEFAULT_CELL, verdict)
    return load_scene(path, CATALOG)


def loads_or_is_refused(path: Path) -> bool:
    """Return whether the file loads; otherwise the error must name it."""
    try:
        load_scene(path, CATALOG)
    except InputError as refusal:
        message = str(refusal)
    else:
        return True
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return False


def assert_same(one: Scene, other: Scene) -> None:
    assert one.objects == other.objects
    assert (one.support, one.derivation, one.seed) == (other.support, other.derivation, other.seed)
    assert (one.graph is None) == (other.graph is None)
    if one.graph is not None and other.graph is not None:
        assert list(one.graph.digraph.nodes(data="kind")) == list(
            other.graph.digraph.nodes(data="kind")
        )
        assert list(one.graph.digraph.edges(data="kind")) == list(
            other.graph.digraph.edges(data="kind")
        )


@pytest.mark.parametrize("seed", range(8))
def test_round_trip_is_exact(seed: int, tmp_path: Path) -> None:
    scene = random_scene(seed, 12, 12, "pantry14")
    for verdict in (None, stable_verdict(scene), unstable_verdict(scene)):
        read = reloaded(tmp_path, scene, verdict)
        assert_same(read.scene, scene)
        assert read.verdict == verdict
        assert read.settled_scene == (
            read.scene.with_poses(verdict.settled) if verdict else read.scene
        )


def test_poses_of_every_size_survive(tmp_path: Path) -> None:
    """Small numbers are written with a point: YAML 1.1 reads 1e-05 as text."""
    objects = [
        resting("sugar_box", xy=(x, y), floor=z, name=f"box {index}")
        for index, (x, y, z) in enumerate(
            [(1e-5, -1e-17, 0), (1e22, 1 / 3, 5e-324), (-1e-300, 0.0, 1e16)]
        )
    ]
    assert reloaded(tmp_path, scene_of(*objects, side=0.1 + 0.2)).scene == scene_of(
        *objects, side=0.1 + 0.2
    )


def test_a_file_holds_the_cell_that_it_was_made_with(tmp_path: Path) -> None:
    cell = cell_with(
        "robot.base.x=-0.8", "cameras.overhead.pose.roll=165", "gripper.extension=0.15"
    )
    save_scene(tmp_path / "scene.yaml", SCENE, cell)
    read = load_scene(tmp_path / "scene.yaml", CATALOG)
    assert read.cell == cell
    assert_same(read.scene, SCENE)
    smaller = scene_of(resting("sugar_box"), side=0.5)
    save_scene(tmp_path / "scene.yaml", smaller, cell)
    assert load_scene(tmp_path / "scene.yaml", CATALOG).cell == cell.with_support(tray(0.5))


def test_a_file_of_version_1_names_the_tray_alone(tmp_path: Path) -> None:
    (path := tmp_path / "scene.yaml").write_text(ONE_BOX + "tray: {side: 0.5}\n")
    read = load_scene(path, CATALOG)
    assert read.scene.support == read.cell.support == tray(0.5)
    assert read.cell == DEFAULT_CELL.with_support(tray(0.5))
    path.write_text(ONE_BOX)
    assert load_scene(path, CATALOG).cell == DEFAULT_CELL


def test_names_are_any_text(tmp_path: Path) -> None:
    names = [
        "yes",
        "1",
        "a: b",
        "Dose \N{LATIN SMALL LETTER O WITH DIAERESIS}",
        "null",
        "1e-5",
        "# no",
        "  spaced  ",
    ]
    scene = scene_of(
        *(resting("large_marker", xy=(0, 0.03 * k), name=name) for k, name in enumerate(names))
    )
    read = reloaded(tmp_path, scene, stable_verdict(scene))
    assert read.scene.names == tuple(names)
    assert read.verdict == stable_verdict(scene)


def test_a_file_by_hand(tmp_path: Path) -> None:
    """A minimal file has no graph, no nodes, integers, and a rounded quaternion."""
    path = tmp_path / "mine.yaml"
    path.write_text("""
version: 1
objects:
  - name: box
    class: sugar_box
    X_TO: {translation: [0, 0, 0.0875], quaternion: [0.7071, 0, 0, 0.7071]}
  - name: can
    class: tomato_soup_can
    X_TO: {translation: [0.2, 0, 0.0505], quaternion: [1, 0, 0, 0]}
""")
    read = load_scene(path, CATALOG)
    box, can = read.scene.objects
    assert box.X_TO.quaternion == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
    assert math.hypot(*box.X_TO.quaternion) == pytest.approx(1, abs=1e-15)
    assert Pose((0.2, 0.0, 0.0505)) == can.X_TO
    assert (read.verdict, read.scene.graph, read.scene.seed, read.scene.derivation) == (
        None,
        None,
        None,
        (),
    )
    assert read.scene.support == TRAY
    assert read.settled_scene is read.scene or read.settled_scene == read.scene


def test_a_file_from_elsewhere_is_written_alike(tmp_path: Path) -> None:
    scene = random_scene(2, 12, 12, "pantry14")
    save_scene(tmp_path / "one.yaml", scene, DEFAULT_CELL, stable_verdict(scene))
    read = load_scene(tmp_path / "one.yaml", CATALOG)
    save_scene(tmp_path / "two.yaml", read.scene, read.cell, read.verdict)
    assert (tmp_path / "one.yaml").read_bytes() == (tmp_path / "two.yaml").read_bytes()


# --- What is refused ---

SCENE = random_scene(1, 12, 12, "pantry14")
DOCUMENT = scene_to_dict(SCENE, DEFAULT_CELL, stable_verdict(SCENE))
UNSTABLE = scene_to_dict(SCENE, DEFAULT_CELL, unstable_verdict(SCENE))


def changed(document: dict[str, Any], path: Path_, value: Any) -> dict[str, Any]:
    """Return a copy of the document with one value replaced or removed."""
    result = copy.deepcopy(document)
    at: Any = result
    for key in path[:-1]:
        at = at[key]
    if value is GONE:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return result


def written(folder: Path, document: Any) -> Path:
    path = folder / "scene.yaml"
    path.write_text(yaml.dump(document, sort_keys=False))
    return path


def object_node() -> int:
    """Return the index of the first object in the graph's list of nodes."""
    return next(
        index for index, node in enumerate(DOCUMENT["graph"]["nodes"]) if node["kind"] in CLASSES
    )


X_TO: Path_ = ("objects", 0, "X_TO")
NODE: Path_ = ("graph", "nodes", object_node())
EDGE: Path_ = ("graph", "edges", 0)
REFUSED: list[tuple[Path_, Any, str]] = [
    (("version",), 3, "version: 3; expected a whole number from 1 to 2"),
    (("version",), "1", "version: '1'; expected a whole number from 1 to 2"),
    (("version",), True, "version: True"),
    (("version",), GONE, "version: is missing; needed are version, objects"),
    (("camera",), 1, "camera: is unknown; expected version, objects, tray, cell"),
    (("tray",), 0.7, "tray: 0.7; expected a mapping with side"),
    (("tray",), {"side": 0.7}, "expected a tray or a cell"),
    (("cell",), "ur10", "cell: 'ur10'; expected a mapping with robot, gripper, support, cameras"),
    (
        ("cell", "support", "size", 0),
        5,
        "cell.support.size[0]: 5; expected a finite number from 0.1 to 2",
    ),
    (("cell", "cameras"), {}, "cell.cameras: {}; expected a mapping of at least one entry"),
    (("tray",), {"side": 0}, "tray.side: 0; expected a finite number from 0.1 to 2"),
    (("tray",), {"side": math.nan}, "tray.side: nan"),
    (("seed",), 1.5, "seed: 1.5; expected a whole number"),
    (("objects",), GONE, "objects: is missing"),
    (("objects",), [], "objects: []; expected a list of at least one entry"),
    (("objects",), None, "objects: None; expected a list"),
    (("objects",), {"a": 1}, "objects: {'a': 1}; expected a list"),
    (("objects", 0), "box", "objects[0]: 'box'; expected a mapping"),
    (
        ("objects", 1, "class"),
        "teapot",
        "objects[1].class: 'teapot'; expected one of cracker_box",
    ),
    (("objects", 1, "class"), GONE, "objects[1].class: is missing; needed are name, class, X_TO"),
    (("objects", 1, "class"), 3, "objects[1].class: 3; expected a text"),
    (("objects", 1, "name"), GONE, "objects[1].name: is missing"),
    (("objects", 1, "name"), "", "objects[1].name: ''; expected a text"),
    (("objects", 1, "name"), None, "objects[1].name: None"),
    (("objects", 1, "name"), "tray", "objects[1].name: 'tray'; expected any name but tray"),
    (("objects", 1, "name"), SCENE.names[0], f"objects[1].name: '{SCENE.names[0]}' is used twice"),
    (
        ("objects", 1, "color"),
        "red",
        "objects[1].color: is unknown; expected name, class, X_TO, node",
    ),
    (("objects", 1, "node"), "1", "objects[1].node: '1'; expected a whole number"),
    (("objects", 1, "node"), True, "objects[1].node: True; expected a whole number"),
    (
        ("objects", 1, "node"),
        99,
        "expected a structure node, or the class of the object that names this node",
    ),
    (X_TO, GONE, "objects[0].X_TO: is missing"),
    (
        X_TO,
        [0, 0, 0],
        "objects[0].X_TO: [0, 0, 0]; expected a mapping with translation, quaternion",
    ),
    ((*X_TO, "translation"), GONE, "objects[0].X_TO.translation: is missing"),
    ((*X_TO, "translation"), [0, 0], "X_TO.translation: [0, 0]; expected a list of 3 numbers"),
    ((*X_TO, "translation"), [0, 0, 0, 0], "X_TO.translation: [0, 0, 0, 0]"),
    ((*X_TO, "translation"), "0 0 0", "X_TO.translation: '0 0 0'"),
    ((*X_TO, "translation", 1), math.nan, "X_TO.translation[1]: nan; expected a finite number"),
    ((*X_TO, "translation", 2), math.inf, "X_TO.translation[2]: inf"),
    ((*X_TO, "translation", 0), "0.1", "X_TO.translation[0]: '0.1'; expected a finite number"),
    ((*X_TO, "translation", 0), True, "X_TO.translation[0]: True"),
    ((*X_TO, "quaternion"), [1, 0, 0], "X_TO.quaternion: [1, 0, 0]; expected a list of 4"),
    ((*X_TO, "quaternion"), [0, 0, 0, 0], "expected w, x, y, z of length 1 (this one's is 0)"),
    ((*X_TO, "quaternion"), [0.71, 0.71, 0, 0], "(this one's is 1.00409)"),
    ((*X_TO, "quaternion", 3), -math.inf, "X_TO.quaternion[3]: -inf"),
    (("graph",), [], "graph: []; expected a mapping with nodes, edges"),
    (("graph", "nodes"), GONE, "graph.nodes: is missing"),
    (("graph", "nodes", 0), GONE, "graph.nodes: expected exactly one tray"),
    (("graph", "nodes", 0, "id"), "0", "graph.nodes[0].id: '0'; expected a whole number"),
    (NODE, GONE, "graph.edges: 0 -> 1 refers to a node that does not exist"),
    ((*NODE, "kind"), "teapot", "kind: 'teapot'; expected a structure node, or the class"),
    ((*NODE, "kind"), "tray", "expected exactly one tray"),
    ((*NODE, "id"), 0, "expected an id that no other node has"),
    ((*NODE, "color"), 1, "color: is unknown; expected id, kind"),
    (
        ("graph", "edges"),
        [],
        "expected an acyclic graph in which every node is reachable from the tray",
    ),
    (
        (*EDGE, "kind"),
        "flat_45",
        "graph.edges[0].kind: 'flat_45'; expected one of primitive, flat_0",
    ),
    ((*EDGE, "kind"), 0, "graph.edges[0].kind: 0; expected a text"),
    ((*EDGE, "child"), GONE, "graph.edges[0].child: is missing"),
    ((*EDGE, "child"), 99, "refers to a node that does not exist"),
    ((*EDGE, "child"), 0, "acyclic"),
    (("derivation",), "drop_object", "derivation: 'drop_object'; expected a list"),
    (("derivation", 1), 3, "derivation[1]: 3; expected a text"),
    (("verdict",), "stable", "verdict: 'stable'; expected a mapping"),
    (("verdict", "stable"), GONE, "verdict.stable: is missing"),
    (("verdict", "stable"), False, "verdict.instability: expected"),
    (("verdict", "hidden"), ["ghost"], "ghost' is no object"),
    (("verdict", "hidden"), "none", "verdict.hidden: 'none'; expected a list"),
    (("verdict", "visible_fractions", "ghost"), 0.5, "ghost' is no object"),
    (
        ("verdict", "visible_fractions", SCENE.names[0]),
        "all",
        f"verdict.visible_fractions.{SCENE.names[0]}: 'all'",
    ),
    (
        ("verdict", "settled", "ghost"),
        {"translation": [0, 0, 0], "quaternion": [1, 0, 0, 0]},
        "'ghost' is no object",
    ),
    (
        ("verdict", "settled", SCENE.names[0]),
        None,
        f"verdict.settled.{SCENE.names[0]}: None; expected a mapping",
    ),
]


@pytest.mark.parametrize(
    ("path", "value", "message"), REFUSED, ids=[message[:40] for _, _, message in REFUSED]
)
def test_a_broken_field_is_named(path: Path_, value: Any, message: str, tmp_path: Path) -> None:
    file = written(tmp_path, changed(DOCUMENT, path, value))
    with pytest.raises(InputError) as refusal:
        load_scene(file, CATALOG)
    assert str(refusal.value).startswith(str(file))
    assert message in str(refusal.value)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            ("verdict", "instability", "reason"),
            "bored",
            "verdict.instability.reason: 'bored'; expected one of toppled, slid",
        ),
        (
            ("verdict", "instability", "tilt"),
            "much",
            "verdict.instability.tilt: 'much'; expected a finite number",
        ),
        (
            ("verdict", "instability", "displacement"),
            math.inf,
            "verdict.instability.displacement: inf",
        ),
        (("verdict", "instability", "object"), GONE, "verdict.instability.object: is missing"),
        (
            ("verdict", "instability"),
            None,
            "verdict.instability: expected one for an unstable scene",
        ),
    ],
)
def test_a_broken_instability_is_named(
    path: Path_, value: Any, message: str, tmp_path: Path
) -> None:
    file = written(tmp_path, changed(UNSTABLE, path, value))
    with pytest.raises(InputError) as refusal:
        load_scene(file, CATALOG)
    assert str(refusal.value).startswith(f"{file}: {message}")


def test_objects_that_overlap_are_refused_and_a_touch_is_not(tmp_path: Path) -> None:
    """A penetration of 1 mm is allowed, for settled objects and rounded poses."""
    for gap, allowed in ((0.0, True), (-0.0009, True), (-0.0011, False), (-0.020, False)):
        scene = scene_of(
            resting("sugar_box", name="below"),
            resting("pudding_box", floor=0.038 + gap, name="above"),
        )
        save_scene(tmp_path / "scene.yaml", scene, DEFAULT_CELL)
        if allowed:
            assert load_scene(tmp_path / "scene.yaml", CATALOG).scene == scene
        else:
            with pytest.raises(
                InputError,
                match=rf"below and above overlap by {-1000 * gap:.1f} mm; expected at most 1 mm",
            ):
                load_scene(tmp_path / "scene.yaml", CATALOG)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        b"null\n",
        b"[1, 2]\n",
        b"just words",
        b"\x89PNG\r\n\x1a\n\x00\xff",
        b"\xff\xfe\x00",
        b"a: b: c",
        b"a: [1, 2",
        b"\t",
    ],
    ids=lambda content: repr(content)[:20],
)
def test_what_is_no_document_is_refused(content: bytes, tmp_path: Path) -> None:
    (path := tmp_path / "scene.yaml").write_bytes(content)
    with pytest.raises(InputError) as refusal:
        load_scene(path, CATALOG)
    assert str(refusal.value).startswith(str(path))


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.yaml: cannot be read \(No such file"):
        load_scene(tmp_path / "missing.yaml", CATALOG)
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)"):
        load_scene(tmp_path, CATALOG)


def test_a_file_that_was_cut_off_is_refused(tmp_path: Path) -> None:
    """A truncated file is refused, or holds the first objects completely."""
    path = tmp_path / "scene.yaml"
    save_scene(path, SCENE, DEFAULT_CELL, stable_verdict(SCENE))
    whole = path.read_text()
    refused = 0
    for length in np.linspace(0, len(whole) - 2, 150).astype(int):
        path.write_text(whole[:length])
        if not loads_or_is_refused(path):
            refused += 1
            continue
        read = load_scene(path, CATALOG).scene
        for cut, o in zip(read.objects, SCENE.objects[: len(read.objects)], strict=True):
            assert (cut.name, cut.object_class, cut.X_TO) == (o.name, o.object_class, o.X_TO)
    assert refused > 120


ONE_BOX = """version: 1
objects:
- {name: a, class: sugar_box, X_TO: {translation: [0, 0, 0.0875], quaternion: [1, 0, 0, 0]}}
"""


@pytest.mark.parametrize(
    "line",
    [
        "seed: 2023-13-45",
        "seed: !!timestamp foo",
        "seed: !!int foo",
        "seed: !!bool foo",
        "seed: 0b_",
        "seed: " + "9" * 5000,
        "tray: {side: 0x" + "f" * 5000 + "}",
        "tray: {side: 1" + "0" * 400 + "}",
        "seed: " + "[" * 3000 + "]" * 3000,
    ],
)
def test_yaml_that_its_reader_stumbles_over_is_refused(line: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(ONE_BOX + line + "\n")
    with pytest.raises(InputError, match=r"scene\.yaml"):
        load_scene(path, CATALOG)


@pytest.mark.parametrize(
    "verdict",
    [
        "{stable: banana, settled: {}, visible_fractions: {}, hidden: []}",
        "{stable: 1, settled: {}, visible_fractions: {}, hidden: []}",
        "{stable: false, settled: {}, visible_fractions: {}, hidden: [], "
        "instability: {reason: slid, object: ghost, displacement: 0.1, tilt: 0.1}}",
        "{stable: true, settled: {}, visible_fractions: {}, hidden: [], "
        "instability: {reason: slid, object: a, displacement: 0.1, tilt: 0.1}}",
        "{stable: true, settled: {}, visible_fractions: {a: 7.0}, hidden: []}",
        "{stable: true, settled: {}, visible_fractions: {a: 1.0}, hidden: []}",
    ],
)
def test_a_verdict_that_contradicts_itself_is_refused(verdict: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(ONE_BOX + f"verdict: {verdict}\n")
    with pytest.raises(InputError, match=r"scene\.yaml: verdict"):
        load_scene(path, CATALOG)


@pytest.mark.parametrize(
    "graph",
    [
        "{nodes: [{id: 0, kind: tray}, {id: 1, kind: open_slot}], "
        "edges: [{parent: 0, child: 1, kind: primitive}]}",
        "{nodes: [{id: 0, kind: tray}, {id: 1, kind: end}, {id: 2, kind: end}], "
        "edges: [{parent: 0, child: 1, kind: primitive}, {parent: 1, child: 2, kind: primitive}]}",
    ],
)
def test_a_graph_that_no_derivation_ends_with_is_refused(graph: str, tmp_path: Path) -> None:
    (path := tmp_path / "scene.yaml").write_text(ONE_BOX + f"graph: {graph}\n")
    with pytest.raises(InputError, match=r"scene\.yaml: graph"):
        load_scene(path, CATALOG)


def test_an_object_may_not_name_a_structure_node(tmp_path: Path) -> None:
    graph = "graph: {nodes: [{id: 0, kind: tray}], edges: []}\n"
    (path := tmp_path / "scene.yaml").write_text(
        ONE_BOX.replace("name: a", "name: a, node: 0") + graph
    )
    with pytest.raises(InputError, match="node"):
        load_scene(path, CATALOG)


def test_visible_fractions_under_their_earlier_name(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    fractions = dict.fromkeys(SCENE.names, 0.5)
    save_scene(path, SCENE, DEFAULT_CELL, Verdict(None, SCENE.poses, fractions, ()))
    text = path.read_text()
    path.write_text(text.replace("visible_fractions:", "visible_share:"))
    assert path.read_text() != text
    verdict = load_scene(path, CATALOG).verdict
    assert verdict is not None
    assert verdict.visible_fractions == fractions
