"""YAML as every file of the package is read and written.

Beyond YAML 1.1, 1e-3 is a number, and a key that stands twice in a mapping is refused.
"""

import re
from pathlib import Path
from typing import Any

import yaml

from drake_clutter.files import format_value, input_error

_EXPONENT_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$")
"""Numbers such as 1e-3, which YAML 1.1 takes as a text."""


class _Loader(yaml.CSafeLoader):
    """Reads 1e-3 as a number, and refuses a key that stands twice in a mapping."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        own_items = node.value  # without what a merge key adds
        mapping: dict[Any, Any] = super().construct_mapping(node, deep=deep)
        if len(mapping) < len(node.value):
            seen = set[Any]()
            for key_node, _ in own_items:
                key = self.construct_object(key_node, deep=True)
                if key in seen:
                    problem = f"{format_value(key)} is there twice in a mapping"
                    raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
                seen.add(key)
        return mapping

    def construct_whole_mapping(self, node: yaml.MappingNode) -> dict[Any, Any]:
        return self.construct_mapping(node, deep=True)

    def construct_whole_sequence(self, node: yaml.SequenceNode) -> list[Any]:
        return list(self.construct_sequence(node, deep=True))


class _Dumper(yaml.CSafeDumper):
    """Quotes what `_Loader` would read as a number."""


# Whole containers, so that one that holds itself is an error.
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_whole_mapping)
_Loader.add_constructor("tag:yaml.org,2002:seq", _Loader.construct_whole_sequence)
for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT_NUMBER, list("-+.0123456789"))


def to_yaml(document: Any, width: int = 160) -> str:
    """Return a plain document as YAML that `parse_yaml` reads back.

    Args:
        document: Mappings, lists, numbers and texts.
        width: Of a line [characters].
    """
    style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "width": width}
    return str(yaml.dump(document, Dumper=_Dumper, **style))


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
        what = f"cannot be read ({error.strerror}); allowed is {allowed_content}"
        raise input_error(str(path), what) from error
    except UnicodeDecodeError as error:
        what = f"is not YAML ({error.reason}); allowed is {allowed_content}"
        raise input_error(str(path), what) from error
    return parse_yaml(text, str(path), allowed_content)


def parse_yaml(text: str, source: str, allowed_content: str = "YAML") -> Any:
    """Return what a YAML text holds.

    Args:
        text: The text.
        source: Where it was read, for the message.
        allowed_content: What it may hold, for the message.

    Raises:
        InputError: It is not YAML, or a mapping has a key twice.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        why = f"{line}{error.problem}"
        raise input_error(source, f"is not YAML ({why}); allowed is {allowed_content}") from error
    except Exception as error:  # constructors raise many kinds for a bad date, number or nesting
        raise input_error(source, f"is not YAML ({error}); allowed is {allowed_content}") from error
