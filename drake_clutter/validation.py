"""Validation of data from files and options.

Schemas are pydantic models or pydantic dataclasses. An error is one line with the file, the field,
the value and what is allowed.
"""

import dataclasses
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, dataclass_transform

import pydantic.dataclasses
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    Strict,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from drake_clutter.files import format_value, input_error
from drake_clutter.limits import MAX_COUNT, MAX_NETWORK_WIDTH, MAX_NODES, MAX_SEED
from drake_clutter.yaml_io import parse_yaml, read_yaml, to_yaml

Schema = TypeVar("Schema")

_POSE_FIELDS = {
    "x": ("translation", 0),
    "y": ("translation", 1),
    "z": ("translation", 2),
    "roll": ("rpy_deg", 0),
    "pitch": ("rpy_deg", 1),
    "yaw": ("rpy_deg", 2),
}
"""Components of a pose that a setting may name: field and index of each."""
_TYPE_DESCRIPTIONS = {
    "bool": "true or false",
    "string": "a text",
    "float": "a number",
    "int": "a whole number",
    "finite": "a finite number",
}
"""What is allowed, by the first word of the type of a pydantic error."""


@dataclass(frozen=True)
class InRange:
    """Annotation of a strict int or float: finite and between two values.

    Attributes:
        low: Smallest allowed value.
        high: Largest allowed value.
    """

    low: float = 0.0
    high: float = math.inf

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of a number in the range."""
        low = None if self.low == -math.inf else self.low
        high = None if self.high == math.inf else self.high
        if source is int:
            least, greatest = (None if bound is None else int(bound) for bound in (low, high))
            number: CoreSchema = core_schema.int_schema(strict=True, ge=least, le=greatest)
        else:
            number = core_schema.float_schema(strict=True, ge=low, le=high, allow_inf_nan=False)
        description = "a whole number" if source is int else "a finite number"
        if low is not None or high is not None:
            description += f" from {self.low:g} to {self.high:g}"
        return core_schema.custom_error_schema(
            number,
            "allowed",
            custom_error_message="{what}",
            custom_error_context={"what": description},
        )


def allowed_error(allowed: str) -> PydanticCustomError:
    """Return the error of a validator for a value that is not allowed.

    Args:
        allowed: What is allowed instead, such as "a number above zero".
    """
    return PydanticCustomError("allowed", "{what}", {"what": allowed})


def rejected_error(message: str) -> PydanticCustomError:
    """Return the error of a validator for a part of a field.

    Args:
        message: Name of the part, what is wrong with it, and what is allowed.
    """
    return PydanticCustomError("refused", "{what}", {"what": message})


Finite = Annotated[float, InRange(-math.inf, math.inf)]
"""Any finite number."""
NonNegative = Annotated[float, InRange(0.0, math.inf)]
"""A finite number that is not negative."""
Positive = Annotated[float, InRange(1e-12, math.inf)]
"""A finite number above zero."""
Fraction = Annotated[float, InRange(0.0, 1.0)]
"""A number from 0 to 1."""
Integer = Annotated[int, InRange(-math.inf, math.inf)]
"""Any whole number."""
Count = Annotated[int, InRange(1, MAX_COUNT)]
"""A number of things of which there is at least one."""
CountOrZero = Annotated[int, InRange(0, MAX_COUNT)]
"""A number of things of which there may be none."""
NetworkWidth = Annotated[int, InRange(1, MAX_NETWORK_WIDTH)]
"""A width of the embeddings of a network."""
NodeCount = Annotated[int, InRange(3, MAX_NODES)]
"""A number of nodes of a scene graph: at least tray, one object and end."""
Seed = Annotated[int, InRange(0, MAX_SEED)]
"""A random seed."""
Flag = Annotated[bool, Strict()]
"""True or false."""
NonEmptyText = Annotated[str, Field(strict=True, min_length=1)]
"""A text that is not empty."""
Vector3 = tuple[Finite, Finite, Finite]
"""Three finite numbers."""


_RENAMED: dict[type, Mapping[str, str]] = {}
"""Current names of fields by earlier ones, of each class that has renamed fields."""


def renamed_fields(**current_names: str) -> Callable[[type[Schema]], type[Schema]]:
    """Return a class decorator that accepts earlier names of fields in files.

    It stands below `config_class`.

    Args:
        current_names: Current name of a field by its earlier name.
    """

    def decorate(cls: type[Schema]) -> type[Schema]:
        def take_earlier_names(cls: type, given: Any) -> Any:
            return with_current_names(cls, given)

        _RENAMED[cls] = current_names
        validator: Any = model_validator(mode="before")(cast(Any, classmethod(take_earlier_names)))
        setattr(cls, take_earlier_names.__name__, validator)
        return cls

    return decorate


def with_current_names(schema: type, document: Any) -> Any:
    """Return a document with the fields of a schema under their current names.

    If a field is given under both names, the earlier one is kept, too, and then refused as unknown.

    Args:
        schema: Class of the document; classes of its fields are not considered.
        document: The document.
    """
    current_names = _current_names(schema)
    if not current_names or not isinstance(document, dict):
        return document
    return {
        current_names[key]
        if key in current_names and current_names[key] not in document
        else key: value
        for key, value in document.items()
    }


def _current_names(schema: type) -> dict[str, str]:
    """Return the current names of the renamed fields of a schema by the earlier ones."""
    return {
        earlier: name
        for base in reversed(schema.__mro__)
        for earlier, name in _RENAMED.get(base, {}).items()
    }


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def config_class(cls: type[Schema]) -> type[Schema]:
    """Return a class as a frozen, validated dataclass without additional fields."""
    config = ConfigDict(extra="forbid")
    decorated: Any = pydantic.dataclasses.dataclass(frozen=True, config=config)(cls)
    return cast(type[Schema], decorated)


class StrictModel(BaseModel):
    """Base class of data read from files: frozen, without additional fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", ignored_types=(property,))


@cache
def _adapter(schema: Any) -> TypeAdapter[Any]:
    return TypeAdapter(schema)


@cache
def _json_schema(schema: Any) -> dict[str, Any]:
    return _adapter(schema).json_schema()


_UNKNOWN_FIELD = ("extra_forbidden", "unexpected_keyword_argument", "invalid_key")
"""Types of pydantic's errors about a field that a schema does not have."""


def validate(schema: type[Schema], document: Any, source: str) -> Schema:
    """Return a document as an instance of a schema.

    Args:
        schema: Pydantic model or dataclass, or a container of them.
        document: The document.
        source: File or option of the document, for the message.

    Raises:
        InputError: A field is unknown or has a value that is not allowed.
    """
    try:
        validated: Schema = _adapter(cast(Hashable, schema)).validate_python(document)
    except ValidationError as error:
        # Unknown fields come first: a misspelled field is reported, rather than as a missing one.
        errors = sorted(
            error.errors(include_url=False), key=lambda found: found["type"] not in _UNKNOWN_FIELD
        )
        raise input_error(source, _error_message(schema, errors[0])) from None
    return validated


def _error_message(schema: Any, error: ErrorDetails) -> str:
    """Return field, value and what is allowed, from a pydantic error."""
    error_type = error["type"]
    location = error["loc"]
    if error_type in _UNKNOWN_FIELD:
        owner, node = _locate(schema, location[:-1])
        names = ", ".join(node.get("properties", {}))
        return f"{_field_path(owner, location[-1])}: is unknown; expected {names}"
    if error_type in ("missing", "missing_argument"):
        owner, node = _locate(schema, location[:-1])
        if "prefixItems" in node:
            return _value_message(owner, error["input"], _describe_list(node))
        needed = ", ".join(node.get("required", {}))
        return f"{_field_path(owner, location[-1])}: is missing; needed are {needed}"
    field, node = _locate(schema, location)
    if error_type == "refused":
        return f"{field}{'.' if field else ''}{error['msg']}"
    if error_type in ("union_tag_not_found", "union_tag_invalid"):
        tag = error["input"].get(node["discriminator"]["propertyName"])
        field = _field_path(field, node["discriminator"]["propertyName"])
        return _value_message(field, tag, f"one of {', '.join(node['discriminator']['mapping'])}")
    return _value_message(field, error["input"], _describe_allowed(error, node))


def _value_message(field: str, value: Any, allowed: str) -> str:
    """Return the message about a value that is not allowed."""
    return f"{field}{': ' if field else ''}{format_value(value)}; expected {allowed}"


def _describe_allowed(error: ErrorDetails, node: Mapping[str, Any]) -> str:
    """Return what is allowed, as words.

    Args:
        error: The pydantic error.
        node: Part of the JSON schema about the field.
    """
    error_type = error["type"]
    if error_type in ("literal_error", "enum"):
        values = [str(value) for value in node.get("enum", [node.get("const")])]
        return values[0] if len(values) == 1 else f"one of {', '.join(values)}"
    if error_type in ("dict_type", "model_type", "dataclass_type", "model_attributes_type"):
        names = ", ".join(node.get("required") or node.get("properties", ()))
        return f"a mapping with {names}" if names else "a mapping"
    if error_type == "too_short" and node.get("type") == "object":
        return "a mapping of at least one entry"
    if error_type in ("list_type", "tuple_type", "too_long", "too_short"):
        return _describe_list(node)
    return _TYPE_DESCRIPTIONS.get(error_type.split("_")[0], error["msg"])


def _describe_list(node: Mapping[str, Any]) -> str:
    """Return what is allowed for a list, from its part of the JSON schema."""
    if "prefixItems" not in node:
        return "a list of at least one entry" if node.get("minItems") else "a list"
    items = node["prefixItems"]
    item_description = (
        "numbers" if all(item.get("type") == "number" for item in items) else "values"
    )
    return f"a list of {len(items)} {item_description}"


def _locate(schema: Any, location: Sequence[int | str]) -> tuple[str, Mapping[str, Any]]:
    """Return the path of a field as text, and its part of the schema's JSON schema."""
    document = _json_schema(schema)
    field = ""
    node = _resolve_reference(document, document)
    for part in location:
        if part == "[key]":  # of a mapping with a key that is not allowed
            break
        if "discriminator" in node:  # the part is a member of the union, which no file names
            node = _resolve_reference(document, {"$ref": node["discriminator"]["mapping"][part]})
            continue
        field = _field_path(field, part)
        if isinstance(part, int):
            items = node.get("prefixItems", ())
            below = items[part] if part < len(items) else node.get("items")
        else:
            below = node.get("properties", {}).get(part) or node.get("additionalProperties")
        node = _resolve_reference(document, below)
    return field, node


def _field_path(field: str, part: int | str) -> str:
    """Return the path of a field or list element, such as `cameras.overhead` or `steps[1]`."""
    if isinstance(part, int):
        return f"{field}[{part}]"
    name = str(part) if str(part).isprintable() and len(str(part)) <= 40 else format_value(part)
    return f"{field}.{name}" if field else name


def _resolve_reference(document: Mapping[str, Any], node: Any) -> Mapping[str, Any]:
    """Return a part of a JSON schema after its references are followed."""
    while isinstance(node, dict) and ("$ref" in node or "anyOf" in node):
        reference = node.get("$ref", "").rsplit("/", 1)[-1]
        node = document["$defs"][reference] if reference else node["anyOf"][0]
    return node if isinstance(node, dict) else {}


def to_plain(value: Any) -> Any:
    """Return a config as mappings, lists, numbers and strings."""
    return _adapter(cast(Hashable, type(value))).dump_python(value, mode="json", by_alias=True)


def config_yaml(config: Any) -> str:
    """Return a config as YAML with all fields."""
    return to_yaml(to_plain(config), width=100)


def load_config_as(
    defaults: Schema,
    path: Path | None = None,
    settings: Sequence[str] = (),
    upgrade: Callable[[Any], Any] = lambda given: given,
) -> Schema:
    """Return a config from defaults, a file and single settings, the later over the earlier.

    Args:
        defaults: Complete config, whose class is the schema.
        path: YAML file, or None.
        settings: Single fields as text, such as "layout.stack_gap=0.02". The names x, y, z, roll,
            pitch and yaw select components of a pose, numbers elements of a list.
        upgrade: Converts a document of an earlier version.

    Raises:
        InputError: The file cannot be read, or a field is unknown, has a value that is not
            allowed, or is set under an earlier name and the current one.
    """
    config = defaults
    if path is not None:
        document = read_yaml(path, "a mapping of config fields")
        config = override_config(config, upgrade({} if document is None else document), str(path))
    names: dict[str, Any] = {}
    for setting in settings:
        part = names
        for name in setting.partition("=")[0].split("."):
            part = part.setdefault(name, {})
    _check_names(config, names)
    for setting in settings:
        document = _parse_setting(setting, config)
        config = override_config(config, upgrade(document), f"--set {setting}")
    return config


def _check_names(config: Any, names: Mapping[str, Any]) -> None:
    """Check that no field is set under two names.

    Args:
        config: The config, or a part of it.
        names: Names of the fields that are set, as nested mappings.

    Raises:
        InputError: A field is set under an earlier name and the current one.
    """
    current_names = _current_names(type(config))
    for earlier in names.keys() & current_names.keys():
        if current_names[earlier] in names:
            raise input_error(
                "--set",
                f"{earlier} is the earlier name of {current_names[earlier]}; expected one of them",
            )
    fields = config if isinstance(config, dict) else _field_values(config)
    for name, below in names.items():
        _check_names(fields.get(current_names.get(name, name)), below)


def _parse_setting(setting: str, config: Any) -> Any:
    """Return FIELD=VALUE as nested mappings, completed by the rest of a list."""
    name, equals, text = setting.partition("=")
    if not equals or not name:
        raise input_error(f"--set {setting}", "expected FIELD=VALUE, such as layout.stack_gap=0.02")
    value = parse_yaml(text, f"--set {setting}", "FIELD=VALUE with a YAML value")
    parts = name.split(".")
    for depth in range(len(parts) - 1, -1, -1):
        owner = _get_nested(config, parts[:depth])
        part = parts[depth]
        if part in _POSE_FIELDS and {"translation", "rpy_deg"} <= _field_values(owner).keys():
            part, index = _POSE_FIELDS[part]
            value = _with_item(getattr(owner, part), index, value)
        if isinstance(owner, tuple) and part.isdecimal() and int(part) < len(owner):
            value = _with_item(owner, int(part), _merge(owner[int(part)], value))
        else:
            value = {**(owner if isinstance(owner, dict) else {}), part: value}
    return value


def _with_item(values: tuple[Any, ...], index: int, value: Any) -> list[Any]:
    """Return values as a list with one item replaced."""
    return [value if k == index else old for k, old in enumerate(values)]


def _get_nested(config: Any, parts: Sequence[str]) -> Any:
    """Return the value at a path of names and indices; None if there is none."""
    for part in parts:
        if isinstance(config, tuple):
            config = dict(enumerate(config)).get(int(part) if part.isdecimal() else -1)
        else:
            config = (config if isinstance(config, dict) else _field_values(config)).get(part)
    return config


def _field_values(config: Any) -> dict[str, Any]:
    """Return the fields of a model or dataclass by name; empty for other values."""
    if isinstance(config, BaseModel):
        return dict(config)
    if dataclasses.is_dataclass(config):
        return {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return {}


def override_config(defaults: Schema, document: Any, source: str) -> Schema:
    """Return a config with the fields of a document replaced.

    Lists are replaced as a whole. So is a part with another `kind`, and one with another `model`
    unless only the model is given. A collection by names, such as cameras, is replaced, but an
    entry of the same name keeps the fields that are not given.

    Args:
        defaults: The config.
        document: The document.
        source: File or option of the document, for the message.

    Raises:
        InputError: A field is unknown or has a value that is not allowed.
    """
    return validate(type(defaults), _merge(defaults, document), source)


def _merge(config: Any, document: Any) -> Any:
    """Return a document completed by the fields of a config; see `override_config`."""
    if not isinstance(document, dict):
        return document
    if isinstance(config, dict):
        return {key: _merge(config.get(key), value) for key, value in document.items()}
    fields = _field_values(config)
    document = with_current_names(type(config), document)
    if document.get("kind", fields.get("kind")) != fields.get("kind"):
        return document
    if len(document) > 1 and document.get("model", fields.get("model")) != fields.get("model"):
        return document
    return {**fields, **{key: _merge(fields.get(key), value) for key, value in document.items()}}
