"""Reading and writing YAML.

Numbers are those of YAML 1.2: 1e-3 is one, 010 is ten, and 1:30 is text. A duplicate key of a
mapping is an error. Everything else is YAML 1.1.
"""

import re
from pathlib import Path
from typing import Any, ClassVar

import yaml

from drake_clutter.files import format_value, input_error, read_text

MAX_DEPTH = 100
"""Largest depth of nested mappings and lists; libyaml overflows the stack at some ten thousand."""
MAX_VALUES = 10**7
"""Largest number of values of a document, with those of its aliases."""
_INTEGER_TAG = "tag:yaml.org,2002:int"
_FLOAT_TAG = "tag:yaml.org,2002:float"
_INTEGER = re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$")
"""Integers; YAML 1.1 reads 010 as octal, and 1:30 as 90."""
_FLOAT = re.compile(
    r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*)([eE][-+]?[0-9]+)?$|[-+]?[0-9]+[eE][-+]?[0-9]+$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
)
"""Floating-point numbers; YAML 1.1 reads 1e-3 as a string."""


class _Loader(yaml.CSafeLoader):
    """Loader that reads the numbers of YAML 1.2 and rejects duplicate keys."""

    # Without those of YAML 1.1.
    yaml_implicit_resolvers: ClassVar[dict[str, list[tuple[str, Any]]]] = {
        first: [(tag, text) for tag, text in known if tag not in (_INTEGER_TAG, _FLOAT_TAG)]
        for first, known in yaml.CSafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        own_items = node.value  # without the items of a merge key
        mapping: dict[Any, Any] = super().construct_mapping(node, deep=deep)
        if len(mapping) < len(node.value):
            seen = set[Any]()
            for key_node, _ in own_items:
                key = self.construct_object(key_node, deep=True)
                if key in seen:
                    problem = f"{format_value(key)} is a duplicate key in a mapping"
                    raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
                seen.add(key)
        return mapping

    def construct_whole_mapping(self, node: yaml.MappingNode) -> dict[Any, Any]:
        return self.construct_mapping(node, deep=True)

    def construct_integer(self, node: yaml.ScalarNode) -> int:
        text = str(node.value)
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))

    def construct_whole_sequence(self, node: yaml.SequenceNode) -> list[Any]:
        return list(self.construct_sequence(node, deep=True))


class _Dumper(yaml.CSafeDumper):
    """Dumper that quotes strings which `_Loader` would read as numbers."""


# Containers are constructed at once, so that one that contains itself is an error.
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_whole_mapping)
_Loader.add_constructor("tag:yaml.org,2002:seq", _Loader.construct_whole_sequence)
_Loader.add_constructor(_INTEGER_TAG, _Loader.construct_integer)
for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(_INTEGER_TAG, _INTEGER, list("-+0123456789"))
    _kind.add_implicit_resolver(_FLOAT_TAG, _FLOAT, list("-+.0123456789"))


def to_yaml(document: Any, width: int = 160) -> str:
    """Return a document as YAML that `parse_yaml` reads back.

    Args:
        document: Mappings, lists, numbers and strings.
        width: Maximum width of a line [characters].
    """
    style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "width": width}
    return str(yaml.dump(document, Dumper=_Dumper, **style))


def read_yaml(path: Path, allowed_content: str) -> Any:
    """Return the document of a YAML file.

    Args:
        path: The file.
        allowed_content: What the file may contain, for the message.

    Raises:
        InputError: The file cannot be read or is not YAML.
    """
    return parse_yaml(read_text(path, allowed_content), str(path), allowed_content)


def parse_yaml(text: str, source: str, allowed_content: str = "YAML") -> Any:
    """Return the document of a YAML text.

    Args:
        text: The text.
        source: File or option of the text, for the message.
        allowed_content: What the text may contain, for the message.

    Raises:
        InputError: The text is not YAML, or a mapping has a duplicate key.
    """
    try:
        _check_size(text)
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        reason = f"{line}{error.problem}"
        raise input_error(source, f"is not YAML ({reason}); expected {allowed_content}") from error
    except Exception as error:  # many types, for a bad date, number or nesting
        raise input_error(source, f"is not YAML ({error}); expected {allowed_content}") from error


def _check_size(text: str) -> None:
    """Check depth and number of values of a YAML text, before its document is built.

    Raises:
        ValueError: There are more than `MAX_DEPTH` or `MAX_VALUES`.
    """
    sizes = [0]  # of the containers that are open, and their anchors
    anchors: list[str | None] = []
    known: dict[str, int] = {}
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            anchors.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            size = sizes.pop()
            sizes[-1] += size
            if anchor := anchors.pop():
                known[anchor] = size
        elif isinstance(event, yaml.AliasEvent):
            sizes[-1] += known.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            sizes[-1] += 1
        if len(sizes) > MAX_DEPTH:
            raise ValueError(f"more than {MAX_DEPTH} mappings and lists are nested")
        if sizes[-1] > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES:.0e} values")
