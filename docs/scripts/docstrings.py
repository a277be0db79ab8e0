"""Sections of Google-style docstrings."""

import inspect
import re
from typing import Any

_ENTRY = re.compile(r"^    (\w+): (.*)$")
"""An entry of a section."""


def docstring_summary(owner: Any) -> str:
    """Return the first paragraph of a docstring as one line."""
    return (inspect.getdoc(owner) or "").split("\n\n")[0].replace("\n", " ")


def docstring_section(owner: Any, title: str) -> dict[str, str]:
    """Return the entries of a section of a docstring, by name.

    Args:
        owner: Class or function.
        title: Title of the section, such as "Attributes".
    """
    _, _, section = inspect.cleandoc(owner.__doc__ or "").partition(f"{title}:\n")
    entries: dict[str, str] = {}
    name = ""
    for line in section.splitlines():
        entry = _ENTRY.match(line)
        if entry:
            name = entry[1]
            entries[name] = entry[2]
        elif line.startswith("     ") and name:
            entries[name] += " " + line.strip()
        elif line.strip():
            break
    return entries
