"""Validation errors are one short line: the file, the field, the value and what is allowed."""

import importlib
import math
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

import drake_clutter
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.config import load_config
from drake_clutter.files import InputError
from drake_clutter.resources import resource_path
from drake_clutter.validation import (
    Finite,
    Flag,
    Fraction,
    InRange,
    Integer,
    NonEmptyText,
    NonNegative,
    Positive,
    StrictModel,
    Vector3,
    config_class,
    config_yaml,
    load_config_as,
    override_config,
    renamed_fields,
    to_plain,
    validate,
)
from drake_clutter.yaml_io import parse_yaml, read_yaml, to_yaml


class Cup(StrictModel):
    """First member of a union."""

    kind: Literal["cup"] = "cup"
    radius: Positive = 0.01
    rims: tuple[Vector3, ...] = ()


class Jaws(StrictModel):
    """Second member of the union."""

    kind: Literal["jaws"] = "jaws"
    width: Annotated[float, InRange(0.01, 0.2)]


class Lamp(StrictModel):
    """Entry of a collection by names."""

    pose: PoseSpec = PoseSpec()
    power: NonNegative = 1.0


@config_class
class Room:
    """Config with every kind of field."""

    tool: Annotated[Cup | Jaws, Field(discriminator="kind")] = Cup()
    lamps: dict[str, Lamp] = field(default_factory=lambda: {"main": Lamp()})
    shelf: tuple[Lamp, ...] = ()
    name: NonEmptyText = "room"
    lit: Flag = True
    seats: Annotated[int, InRange(1, 8)] = 2
    level: Integer = 0
    share: Fraction = 0.5
    height: Finite | None = None
    door: Literal["left", "right"] = "left"
    steps: tuple[Positive, ...] = (1.0, 2.0)


FIELDS = "tool, lamps, shelf, name, lit, seats, level, share, height, door, steps"
REFUSED = [
    ("lit: 1", "lit: 1; expected true or false"),
    ("lit: 'yes'", "lit: 'yes'; expected true or false"),
    ("name: 3", "name: 3; expected a text"),
    ("name: ''", "name: ''; expected a text"),
    ("seats: 2.0", "seats: 2.0; expected a whole number from 1 to 8"),
    ("seats: true", "seats: True; expected a whole number from 1 to 8"),
    ("seats: 0", "seats: 0; expected a whole number from 1 to 8"),
    ("level: 0.5", "level: 0.5; expected a whole number"),
    ("share: 2", "share: 2; expected a finite number from 0 to 1"),
    ("share: true", "share: True; expected a finite number from 0 to 1"),
    ("share: '0.5'", "share: '0.5'; expected a finite number from 0 to 1"),
    ("share: null", "share: None; expected a finite number from 0 to 1"),
    ("share: .nan", "share: nan; expected a finite number from 0 to 1"),
    ("height: .inf", "height: inf; expected a finite number"),
    ("height: 1" + "0" * 400, "expected a finite number"),
    ("height: 0x" + "f" * 5000, "height: a number; expected a finite number"),
    (
        "lamps: {main: {power: -1}}",
        "lamps.main.power: -1; expected a finite number from 0 to inf",
    ),
    ("door: up", "door: 'up'; expected one of left, right"),
    ("door: [left]", "door: ['left']; expected one of left, right"),
    ("steps: 1", "steps: 1; expected a list"),
    ("steps: [1, -2]", "steps[1]: -2; expected a finite number from 1e-12 to inf"),
    ("door_: up", f"door_: is unknown; expected {FIELDS}"),
    ("3: up", f"[3]: is unknown; expected {FIELDS}"),
    ('"a\\nb": up', f"'a\\nb': is unknown; expected {FIELDS}"),
    ("tool: cup", "tool: 'cup'; expected a mapping"),
    ("tool: {kind: hook}", "tool.kind: 'hook'; expected one of cup, jaws"),
    ("tool: {kind: [hook]}", "tool.kind: ['hook']; expected one of cup, jaws"),
    ("tool: {kind: jaws}", "tool.width: is missing; needed are width"),
    ("tool: {kind: jaws, span: 0.1}", "tool.span: is unknown; expected kind, width"),
    ("tool: {kind: jaws, width: 1}", "tool.width: 1; expected a finite number from 0.01 to 0.2"),
    ("tool: {radius: 1, color: 2}", "tool.color: is unknown; expected kind, radius, rims"),
    ("tool: {rims: [[1, 2, 3], [1, 2]]}", "tool.rims[1]: [1, 2]; expected a list of 3 numbers"),
    ("tool: {rims: [[1, 2, 3, 4]]}", "tool.rims[0]: [1, 2, 3, 4]; expected a list of 3 numbers"),
    ("tool: {rims: [up]}", "tool.rims[0]: 'up'; expected a list of 3 numbers"),
    ("tool: {rims: [[1, 2, .nan]]}", "tool.rims[0][2]: nan; expected a finite number"),
    ("lamps: [1]", "lamps: [1]; expected a mapping"),
    ("lamps: {main: 3}", "lamps.main: 3; expected a mapping with pose, power"),
    ("lamps: {1: {}}", "lamps[1]: 1; expected a text"),
    (
        "lamps: {main: {pose: {x: 1}}}",
        "lamps.main.pose.x: is unknown; expected translation, rpy_deg",
    ),
    ("shelf: [{}, {power: on}]", "shelf[1].power: True; expected a finite number from 0 to inf"),
    ("shelf: [{}, {size: 1}]", "shelf[1].size: is unknown; expected pose, power"),
    ("- 1", f"[1]; expected a mapping with {FIELDS}"),
    ("room", f"'room'; expected a mapping with {FIELDS}"),
    ("lit: [true", "is not YAML (line 2: did not find expected ',' or ']')"),
    (
        "lit: true\nname: a\nlit: false",
        "is not YAML (line 3: 'lit' is a duplicate key in a mapping)",
    ),
    (
        "lamps:\n  a: {}\n  b: {power: 1, power: 2}",
        "(line 3: 'power' is a duplicate key in a mapping)",
    ),
    ("1e3: a\n1000.0: b", "(line 2: 1000.0 is a duplicate key in a mapping)"),
    ("lamps: &a [*a]", "is not YAML (line 1: found unconstructable recursive node)"),
    ("lamps: &a {b: *a}", "is not YAML (line 1: found unconstructable recursive node)"),
    ("? [a]\n: b", "is not YAML (line 1: found unhashable key)"),
    ("seats: " + "[" * 3000 + "]" * 3000, "is not YAML"),
    (
        "name: !!python/object:os.system {}",
        "is not YAML (line 1: could not determine a constructor",
    ),
]


@pytest.mark.parametrize(("text", "message"), REFUSED, ids=[text[:30] for text, _ in REFUSED])
def test_an_error_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    path.write_text(text + "\n")
    with pytest.raises(InputError) as refused:
        load_config_as(Room(), path)
    line = str(refused.value)
    assert line.startswith(f"{path}: ")
    assert message in line
    assert "expected" in line or "needed" in line
    assert "\n" not in line
    assert len(line) <= len(f"{path}: ") + 300


LONG = "x" * 5000


@pytest.mark.parametrize(
    "given",
    [
        {LONG: 1},
        {"name\n" * 9: 1},
        {"name": [LONG] * 100},
        {"lamps": {LONG: {"power": [[LONG] * 9] * 9}}},
        {"lamps": {LONG: {LONG: 1}}},
        {"tool": {"kind": LONG}},
        {"door": {LONG: {LONG: LONG}}},
        {"lit": 10**5000},
        [[LONG] * 100] * 100,
    ],
)
def test_a_long_value_is_truncated(given: Any) -> None:
    with pytest.raises(InputError, match="room: ") as refused:
        override_config(Room(), given, "room")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) <= 310


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"none\.yaml: cannot be read \(No such file.*expected a room"
    ):
        read_yaml(tmp_path / "none.yaml", "a room")
    (tmp_path / "binary.yaml").write_bytes(b"\x89PNG\xff")
    with pytest.raises(InputError, match=r"binary\.yaml: cannot be read \(invalid start byte\)"):
        read_yaml(tmp_path / "binary.yaml", "a room")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("lit", "--set lit: expected FIELD=VALUE"),
        ("=3", "--set =3: expected FIELD=VALUE"),
        ("steps=[1", "--set steps=[1: is not YAML (line 2: did not find"),
        ("steps={a: 1, a: 2}", "is not YAML (line 1: 'a' is a duplicate key in a mapping)"),
        ("steps.1=-1", "--set steps.1=-1: steps[1]: -1; expected"),
        ("steps.2=1", "steps: {'2': 1}; expected a list"),
        (
            "lamps.main.pose.yaw=north",
            "lamps.main.pose.rpy_deg[2]: 'north'; expected a finite number",
        ),
        ("lamps.main.yaw=3", "lamps.main.yaw: is unknown; expected pose, power"),
        ("door.left=1", "door: {'left': 1}; expected one of left, right"),
    ],
)
def test_an_invalid_setting(setting: str, message: str) -> None:
    with pytest.raises(InputError) as refused:
        load_config_as(Room(), settings=[setting])
    assert message in str(refused.value)


def test_settings_change_one_field_each() -> None:
    two = Room(lamps={"main": Lamp(power=2.0), "side": Lamp(power=3.0)})
    settings = [
        "lamps.side.power=1e-3",
        "lamps.side.pose.yaw=90",
        "steps.1=5",
        "tool.radius=2E-2",
        "name=1e",
    ]
    config = load_config_as(two, settings=settings)
    pose = PoseSpec(rpy_deg=(0.0, 0.0, 90.0))
    assert config.lamps == {"main": Lamp(power=2.0), "side": Lamp(power=0.001, pose=pose)}
    assert (config.steps, config.tool, config.name) == ((1.0, 5.0), Cup(radius=0.02), "1e")


def test_entries_of_a_replaced_collection_keep_fields_that_are_not_given() -> None:
    two = Room(lamps={"main": Lamp(power=2.0), "side": Lamp(power=3.0)})
    given = {"lamps": {"new": {"power": 4.0}, "side": {"pose": {"translation": [1, 2, 3]}}}}
    config = override_config(two, given, "room")
    pose = PoseSpec(translation=(1.0, 2.0, 3.0))
    assert list(config.lamps.items()) == [
        ("new", Lamp(power=4.0)),
        ("side", Lamp(power=3.0, pose=pose)),
    ]


def test_another_kind_is_not_merged_with_the_previous_one() -> None:
    assert override_config(Room(), {"tool": {"kind": "jaws", "width": 0.1}}, "room").tool == Jaws(
        width=0.1
    )
    assert override_config(
        Room(tool=Cup(radius=0.5)), {"tool": {"kind": "cup"}}, "room"
    ).tool == Cup(radius=0.5)


@pytest.mark.parametrize("name", ["ur5e", "iiwa14"])
def test_another_robot_keeps_no_field_of_the_previous_one(name: str, tmp_path: Path) -> None:
    path = resource_path(f"models/cells/{name}_epick_tray.yaml")
    file = tmp_path / "config.yaml"
    file.write_text(to_yaml({"cell": read_yaml(path, "a cell")}))
    config = load_config(file)
    assert config.cell.robot == load_cell(path).robot
    other = "package://drake_clutter_models/robots/ur3e.sdf"
    changed = load_config_as(config, settings=[f"cell.robot.model={other}"]).cell.robot
    assert changed == config.cell.robot.model_copy(update={"model": other})


def test_a_written_config_is_read_back(tmp_path: Path) -> None:
    room = Room(
        lamps={"side": Lamp(power=1e-5)}, name="1e-5", tool=Jaws(width=0.1), steps=(1e22, 1e-5)
    )
    assert validate(Room, to_plain(room), "room") == room
    (tmp_path / "room.yaml").write_text(config_yaml(room))
    assert load_config_as(Room(), tmp_path / "room.yaml") == room


def test_numbers_with_an_exponent_are_numbers() -> None:
    text = "[1e-3, 1E5, -2.e+1, .5e2, 1e-05, +1e3, 1.5e3]"
    assert parse_yaml(text, "") == [0.001, 1e5, -20.0, 50.0, 1e-5, 1e3, 1500.0]
    texts = ["1e-3", "e3", "1e", "1e3x", "1e-05", "-1E5", "yes", "12", "1:30", "", "a: b", "ö"]
    assert parse_yaml(to_yaml(texts), "") == texts
    assert parse_yaml("[e3, 1e, 1e3x, '1e3']", "") == ["e3", "1e", "1e3x", "1e3"]


def test_numbers_are_those_of_yaml_1_2() -> None:
    """YAML 1.1 reads 010 as 8, 1:30 as 90 and 1_000 as 1000."""
    text = "[010, -7, +012, 0x1F, 0o17, 0.5, 5., .5, -.inf]"
    assert parse_yaml(text, "") == [10, -7, 12, 31, 15, 0.5, 5.0, 0.5, -math.inf]
    texts = ["1:30", "1:30.5", "1_000", "0b11", "1.5_0", "0x", "-", "+.e3"]
    assert parse_yaml(f"[{', '.join(texts)}]", "") == texts
    assert parse_yaml(to_yaml([*texts, "010", 10, -0.0, 1e22]), "") == [
        *texts,
        "010",
        10,
        0.0,
        1e22,
    ]


def test_merge_keys_may_override() -> None:
    text = "a: &a {x: 1, y: 2}\nb: &b {<<: *a, x: 3}\nc: {<<: [*b, *a], y: 4}\n"
    assert parse_yaml(text, "")["b"] == {"x": 3, "y": 2}
    assert parse_yaml(text, "")["c"] == {"x": 3, "y": 4}
    with pytest.raises(InputError, match="line 2: 'x' is a duplicate key"):
        parse_yaml("a: &a {x: 1}\nb: {x: 1, <<: *a, x: 2}", "")


def schemas() -> list[Any]:
    """Return every model and config class of the package."""
    root = Path(drake_clutter.__file__).parent
    files = [path.relative_to(root.parent).with_suffix("") for path in root.rglob("*.py")]
    names = [
        ".".join(file.parts)
        for file in files
        if not file.stem.startswith("__") and "_shipped" not in file.parts
    ]
    modules = [importlib.import_module(name) for name in names]
    classes = {
        value for module in modules for value in vars(module).values() if isinstance(value, type)
    }
    return sorted((c for c in classes if "__pydantic_core_schema__" in vars(c)), key=str)


def find_converting_nodes(node: Any) -> Iterator[Any]:
    """Yield the parts of a core schema that convert values, or whose errors name no field."""
    if isinstance(node, dict):
        if node.get("type") in ("bool", "int", "float", "union") and not node.get("strict"):
            yield node
        for value in node.values():
            yield from find_converting_nodes(value)
    elif isinstance(node, list | tuple):
        for value in node:
            yield from find_converting_nodes(value)


def test_no_schema_converts() -> None:
    """A plain `int`, `float` or `bool` would accept "3", true or 1.

    `InRange`, `Integer` and `Flag` do not.
    """
    found = [
        (c.__name__, node)
        for c in schemas()
        for node in find_converting_nodes(vars(c)["__pydantic_core_schema__"])
    ]
    assert not found


def test_yaml_is_read_in_one_place() -> None:
    root = Path(drake_clutter.__file__).parent
    files = [*root.rglob("*.py"), *(root.parent / "training").glob("*.py")]
    users = {
        path.name
        for path in files
        if "yaml.safe_load" in path.read_text() or "yaml.load(" in path.read_text()
    }
    assert users == {"yaml_io.py"}


@config_class
@renamed_fields(rest_drift="max_rest_displacement")
class _Renamed:
    max_rest_displacement: NonNegative = 0.0025


@config_class
class _Holder:
    settle: _Renamed = field(default_factory=_Renamed)


def test_earlier_names_of_fields_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("settle: {rest_drift: 0.5}\n")
    assert load_config_as(_Holder(), path).settle.max_rest_displacement == 0.5
    assert load_config_as(_Holder(), None, ["settle.rest_drift=0.7"]) == _Holder(_Renamed(0.7))
    assert validate(_Holder, {"settle": {"rest_drift": 0.5}}, "a") == _Holder(_Renamed(0.5))
    assert to_plain(_Holder()) == {"settle": {"max_rest_displacement": 0.0025}}
    both = {"settle": {"rest_drift": 0.5, "max_rest_displacement": 0.4}}
    with pytest.raises(InputError, match=r"settle\.rest_drift: is unknown"):
        validate(_Holder, both, "a")
