"""The page docs/reference/configuration.md, from fields and docstrings of config classes."""

import math
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from docstrings import docstring_section, docstring_summary
from drake_clutter.config import ClutterConfig
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.recording.randomization import RandomizationConfig
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import InRange
from markdown_text import table
from training.train_detector import DetectorTrainingConfig
from training.train_explorer_dagger import DAggerTrainingConfig
from training.train_explorer_ppo import PPOTrainingConfig
from training.train_generator import GeneratorTrainingConfig

ROOTS: tuple[tuple[str, str, type], ...] = (
    (
        "World and work cell",
        "Fields of `--config` files, and of `--set`: `layout.stack_gap=0.02`, `robot.base.z=0.4`. "
        "A config file contains the fields that differ from the defaults; fields of the cell are "
        "nested in `cell`. `--set` omits `cell` and addresses components of a pose by `x`, `y`, "
        "`z`, `roll`, `pitch` and `yaw`. A [cell file](cell_file.md) contains a whole `WorkCell`.",
        ClutterConfig,
    ),
    (
        "Closed-loop scenario",
        "Fields of `drake-clutter run --scenario` files and of its `--set`.",
        Scenario,
    ),
    (
        "Randomization of recorded episodes",
        "Fields of files for `drake-clutter record --randomize`.",
        RandomizationConfig,
    ),
    ("Motion planner", "Argument of `PickPlacePlanner`; not a field of a file.", PlannerConfig),
    (
        "Training of a generator",
        "`training/configs/sg_star.yaml` is an example.",
        GeneratorTrainingConfig,
    ),
    (
        "Training of an explorer by PPO",
        "For teachers, and for the fine-tuning of students.",
        PPOTrainingConfig,
    ),
    ("Training of a student by cloning", "", DAggerTrainingConfig),
    ("Training of a detector", "", DetectorTrainingConfig),
)
"""Title, introduction and class of each group of configs."""


@dataclass(frozen=True)
class Field:
    """One field of a config class, as text.

    Attributes:
        name: Name in files.
        kind: Type.
        default: Default value; "required" if there is none.
        allowed: Allowed values.
        meaning: Description of the docstring.
    """

    name: str
    kind: str
    default: str
    allowed: str
    meaning: str


def page() -> str:
    """Return the page."""
    text = (
        "# Configuration\n\nAll config classes with their fields, types, defaults and allowed "
        "values. Lengths are in meters, angles of poses in degrees, joint angles in radians. "
        "Unknown fields are errors.\n"
    )
    documented: set[type] = set()
    for title, introduction, root in ROOTS:
        text += f"\n## {title}\n\n"
        text += f"{introduction}\n\n" if introduction else ""
        for cls in config_classes(root):
            if cls not in documented:
                documented.add(cls)
                text += _section(cls)
    return text


def config_classes(root: type) -> Iterator[type]:
    """Yield a config class and those of its fields, each once, outer ones first."""
    found = [root]
    for cls in found:
        found += [
            part
            for field in _field_infos(cls).values()
            for part in _classes_in_type(field.annotation)
            if part not in found
        ]
    yield from found


def _classes_in_type(annotation: Any) -> list[type]:
    """Return the config classes in a type."""
    if isinstance(annotation, type) and (
        is_dataclass(annotation) or issubclass(annotation, BaseModel)
    ):
        return [annotation]
    return [cls for part in get_args(annotation) for cls in _classes_in_type(part)]


def _field_infos(cls: type) -> Mapping[str, FieldInfo]:
    fields: Mapping[str, FieldInfo] = getattr(cls, "__pydantic_fields__", {})
    return fields


def _section(cls: type) -> str:
    summary = docstring_summary(cls)
    fields = list(config_fields(cls))
    rows = [[f"`{f.name}`", f.kind, f.default, f.allowed, f.meaning] for f in fields]
    head = ["field", "type", "default", "allowed", "meaning"]
    return f"### {cls.__name__}\n\n{summary}\n\n" + table(head, rows) + "\n"


def config_fields(cls: type) -> Iterator[Field]:
    """Yield the fields of a config class."""
    meanings = attribute_docs(cls)
    for name, info in _field_infos(cls).items():
        ranges = [part for part in info.metadata if isinstance(part, InRange)]
        yield Field(
            name,
            _type_text(info.annotation),
            _default_text(info),
            ", ".join(_range_text(part) for part in ranges) or _allowed_text(info.annotation),
            meanings.get(name, "").replace("|", "\\|"),
        )


def attribute_docs(cls: type) -> dict[str, str]:
    """Return the section "Attributes" of the docstrings of a class and its bases."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        docs |= docstring_section(base, "Attributes")
    return docs


def _type_text(annotation: Any) -> str:
    """Return a type in the words of YAML."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type_text(parts[0])
    if origin is Literal:
        return "string"
    if origin in (Union, types.UnionType):
        return " or ".join(_type_text(part) for part in parts)
    if origin is tuple:
        if len(parts) == 2 and parts[1] is ...:
            return f"list of {_plural(_type_text(parts[0]))}"
        kinds = {_type_text(part) for part in parts}
        return f"list of {len(parts)} {_plural(kinds.pop())}" if len(kinds) == 1 else "list"
    if origin is dict:
        return f"mapping of names to {_type_text(parts[1])}"
    if _classes_in_type(annotation):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    names = {float: "number", int: "integer", bool: "boolean", str: "string", type(None): "null"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _plural(noun: str) -> str:
    return noun if noun.startswith(("[", "list of")) else f"{noun}s"


def _allowed_text(annotation: Any) -> str:
    """Return what a type allows beyond its name: literal values, ranges of entries."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in parts)
    texts = [_range_text(part) for part in parts if isinstance(part, InRange)]
    texts += [_allowed_text(part) for part in parts if not isinstance(part, InRange)]
    return ", ".join(dict.fromkeys(text for text in texts if text))


def _range_text(allowed: InRange) -> str:
    low, high = allowed.low, allowed.high
    if high == math.inf:
        return "" if low == -math.inf else "> 0" if 0 < low < 1e-9 else f"≥ {low:g}"
    return f"≤ {high:g}" if low < -1e200 else f"{low:g} to {high:g}"


def _default_text(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    default = info.get_default(call_default_factory=True, validated_data={})
    if is_dataclass(default) or isinstance(default, BaseModel):
        return ""
    if default is None:
        return "null"
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, tuple):
        return f"`[{', '.join(str(value) for value in default)}]`"
    if isinstance(default, str):
        return f"`{default}`" if default else '`""`'
    return f"{default:g}"
