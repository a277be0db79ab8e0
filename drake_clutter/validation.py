"""Reads typed data from files and options: one line names the file, the field, the value and what is allowed.

Schemas are pydantic models or pydantic dataclasses. `Between` and `NonEmpty` are the annotations for what a value may be.
"""

import dataclasses
import json
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, dataclass_transform

import pydantic.dataclasses
import yaml
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from drake_clutter.files import InputError

Schema = TypeVar("Schema")

_POSE_FIELDS = {
    "x": ("translation", 0),
    "y": ("translation", 1),
    "z": ("translation", 2),
    "roll": ("rpy_deg", 0),
    "pitch": ("rpy_deg", 1),
    "yaw": ("rpy_deg", 2),
}
"""Components of a pose that a setting may name."""
_KINDS = {
    "bool_type": "true or false",
    "string_type": "a text",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "model_type": "a mapping",
    "dataclass_type": "a mapping",
    "model_attributes_type": "a mapping",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
}
"""What is allowed, by pydantic's type of the error."""
_ADAPTERS: dict[Any, TypeAdapter[Any]] = {}


@dataclass(frozen=True)
class Between:
    """Annotation of an int or float: finite, and between two values.

    Attributes:
        low: Least value.
        high: Greatest value.
    """

    low: float = 0.0
    high: float = math.inf

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Validate without converting: a bool is not a number, and a float is not an int."""
        whole = source is int

        def check(value: Any) -> Any:
            kind: Any = int if whole else (int, float)
            if isinstance(value, bool) or not isinstance(value, kind):
                raise self._error(whole)
            if not self.low <= value <= self.high or not abs(value) < 1e300:
                raise self._error(whole)
            return int(value) if whole else float(value)

        return core_schema.no_info_plain_validator_function(
            check,
            json_schema_input_schema=core_schema.int_schema() if whole else core_schema.float_schema(),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda value: value),
        )

    def _error(self, whole: bool) -> PydanticCustomError:
        number = "a whole number" if whole else "a finite number"
        return allowed(f"{number} from {self.low:g} to {self.high:g}")


def allowed(what: str) -> PydanticCustomError:
    """Return the error that a validator raises; `what` says what is allowed."""
    return PydanticCustomError("allowed", "{what}", {"what": what})


Finite = Annotated[float, Between(-math.inf, math.inf)]
"""Any finite number."""
NonNegative = Annotated[float, Between(0.0, math.inf)]
"""A finite number that is not negative."""
Positive = Annotated[float, Between(1e-12, math.inf)]
"""A finite number above zero."""
Vector3 = tuple[Finite, Finite, Finite]
"""Three finite numbers."""


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def config_class(cls: type[Schema]) -> type[Schema]:
    """Return a class as a frozen, validated dataclass that takes no field but those that are declared."""
    made: Any = pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(extra="forbid"))(cls)
    return cast(type[Schema], made)


class Model(BaseModel):
    """Base of what is read from files: frozen, and no field but those that are declared."""

    model_config = ConfigDict(frozen=True, extra="forbid", ignored_types=(property,), arbitrary_types_allowed=True)


def _adapter(schema: Any) -> TypeAdapter[Any]:
    if schema not in _ADAPTERS:
        _ADAPTERS[schema] = TypeAdapter(schema)
    return _ADAPTERS[schema]


def validate(schema: type[Schema], given: Any, source: str) -> Schema:
    """Return `given` as an instance of a schema.

    Args:
        schema: A pydantic model or dataclass.
        given: What was read.
        source: The file or option that it was read from, for the message.

    Raises:
        InputError: The first field that cannot be used, in one line.
    """
    try:
        validated: Schema = _adapter(schema).validate_python(given)
    except ValidationError as error:
        raise InputError(f"{source}: {_message(schema, error.errors()[0])}") from None
    return validated


def _message(schema: Any, error: ErrorDetails) -> str:
    path = [part for part in error["loc"] if not _is_variant(part)]
    field = ".".join(str(part) for part in path) or "the file"
    kind = error["type"]
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{field}: is unknown; allowed are {', '.join(_fields_at(schema, path[:-1]))}"
    if kind in ("missing", "missing_argument"):
        return f"{field}: is missing"
    if kind == "union_tag_not_found":
        return f"{field}.kind: is missing; allowed is {error['ctx']['discriminator']}"
    if kind == "union_tag_invalid":
        shown = reprlib.repr(error["ctx"]["tag"])
        return f"{field}.kind: {shown}; allowed are {error['ctx']['expected_tags']}"
    what = _KINDS.get(kind, error["msg"])
    if kind in ("allowed",):
        what = error["msg"]
    elif kind == "literal_error" or kind == "enum":
        what = str(error["ctx"]["expected"])
    elif kind in ("too_short", "too_long", "missing_positional_only_argument"):
        what = f"a list of {error['ctx'].get('min_length', error['ctx'].get('max_length'))} values"
    return f"{field}: {_shown(error['input'])}; allowed is {what}"


def _is_variant(part: Any) -> bool:
    """Whether a part of a location names a member of a union, which no file does."""
    return isinstance(part, str) and ("[" in part or part.startswith("function-"))


def _shown(value: Any) -> str:
    try:
        return reprlib.repr(value)
    except ValueError:  # an integer of too many digits
        return "a number"


def _fields_at(schema: Any, path: Sequence[int | str]) -> list[str]:
    """Return the names of the fields that a mapping at a place of a schema may have."""
    document = _adapter(schema).json_schema(mode="validation")
    node: Any = document
    for part in path:
        node = _resolved(document, node)
        if "properties" in node and part in node["properties"]:
            node = node["properties"][part]
        elif "oneOf" in node or "anyOf" in node:
            variants = [_resolved(document, v) for v in node.get("oneOf", node.get("anyOf"))]
            node = next((v for v in variants if str(part) in str(v.get("properties", {}).get("kind"))), variants[0])
        else:
            node = node.get("additionalProperties") or node.get("items") or {}
    return list(_resolved(document, node).get("properties", {}))


def _resolved(document: Mapping[str, Any], node: Any) -> Any:
    while isinstance(node, dict) and "$ref" in node:
        node = document["$defs"][node["$ref"].rsplit("/", 1)[-1]]
    return node if isinstance(node, dict) else {}


def to_plain(value: Any) -> Any:
    """Return a config as mappings, lists, numbers and texts."""
    return _adapter(type(value)).dump_python(value, mode="json")


def config_yaml(config: Any) -> str:
    """Return a config as YAML, every field written out."""
    return str(yaml.safe_dump(to_plain(config), sort_keys=False, default_flow_style=None, width=100))


def read_yaml(path: Path, allowed_content: str) -> Any:
    """Return what a YAML file holds.

    Args:
        path: The file.
        allowed_content: What it may hold, for the message.

    Raises:
        InputError: It cannot be read, or is not YAML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); allowed is {allowed_content}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not YAML ({error}); allowed is {allowed_content}") from error
    return parse_yaml(text, str(path), allowed_content)


def parse_yaml(text: str, source: str, allowed_content: str = "YAML") -> Any:
    """Return what a YAML text holds.

    Args:
        text: The text.
        source: Where it was read, for the message.
        allowed_content: What it may hold, for the message.

    Raises:
        InputError: It is not YAML.
    """
    try:
        return yaml.load(text, Loader=yaml.CSafeLoader)
    except Exception as error:  # PyYAML's constructors raise many kinds for a bad date, number or nesting
        words = " ".join(str(error).split())
        raise InputError(f"{source}: is not YAML ({words}); allowed is {allowed_content}") from error


def load_typed(
    defaults: Schema,
    path: Path | None = None,
    settings: Sequence[str] = (),
    convert: Callable[[Any], Any] = lambda given: given,
) -> Schema:
    """Return a config: the defaults, over them the fields that a file names, over those single fields.

    Args:
        defaults: A complete config.
        path: A YAML file.
        settings: Fields as text, such as "camera.altitude=2"; x, y, z, roll, pitch and yaw name a pose's components.
        convert: Turns what older versions wrote into today's fields.

    Raises:
        InputError: The file cannot be read, an unknown field, or a value that is not allowed.
    """
    config = defaults
    if path is not None:
        given = read_yaml(path, "a mapping of config fields")
        config = override(config, convert({} if given is None else given), str(path))
    for setting in settings:
        config = override(config, convert(parse_setting(setting, to_plain(config))), f"--set {setting}")
    return config


def parse_setting(setting: str, plain: Any = None) -> dict[str, Any]:
    """Return FIELD=VALUE as nested mappings.

    Args:
        setting: The text.
        plain: The config that it is for, see `to_plain`: poses and lists in it may be set by component.

    Raises:
        InputError: The text is no setting.
    """
    name, equals, text = setting.partition("=")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        equals = ""
    if not equals or not name:
        raise InputError(f"--set {setting}: allowed is FIELD=VALUE, such as exploration.max_moves=20")
    parts = name.split(".")
    for depth in range(len(parts) - 1, -1, -1):
        owner, part = _at(plain, parts[:depth]), parts[depth]
        if isinstance(owner, dict) and {"translation", "rpy_deg"} <= owner.keys() and part in _POSE_FIELDS:
            field, index = _POSE_FIELDS[part]
            value = {field: [value if k == index else old for k, old in enumerate(owner[field])]}
        elif isinstance(owner, list) and part.isdecimal() and int(part) < len(owner):
            value = [value if k == int(part) else old for k, old in enumerate(owner)]
        else:
            value = {part: value}
    nested: dict[str, Any] = value
    return nested


def _at(plain: Any, parts: Sequence[str]) -> Any:
    for part in parts:
        if isinstance(plain, dict):
            plain = plain.get(part)
        elif isinstance(plain, list) and part.isdecimal() and int(part) < len(plain):
            plain = plain[int(part)]
        else:
            return None
    return plain


def override(defaults: Schema, given: Any, source: str) -> Schema:
    """Return a config with the fields of a document over its own.

    Raises:
        InputError: The first field that cannot be used.
    """
    if not isinstance(given, dict):
        names = ", ".join(_fields_at(type(defaults), ()))
        raise InputError(f"{source}: the file: {_shown(given)}; allowed is a mapping with some of {names}")
    return validate(type(defaults), _merged(to_plain(defaults), given), source)


def _merged(plain: Any, given: Any) -> Any:
    """Return a config with mappings merged; a part of another kind replaces the whole."""
    if not isinstance(plain, dict) or not isinstance(given, dict):
        return given
    if "kind" in given and given["kind"] != plain.get("kind"):
        return given
    return {**plain, **{key: _merged(plain.get(key), value) for key, value in given.items()}}


def same_json(a: Any, b: Any) -> bool:
    """Return whether two plain documents are equal as JSON."""
    return json.dumps(a, sort_keys=True) == json.dumps(b, sort_keys=True)
