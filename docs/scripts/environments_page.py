"""The page docs/reference/environments.md: spaces and arguments are put into its text."""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium

from docstrings import docstring_section
from drake_clutter import ClutterExploration, ClutterGeneration
from drake_clutter.tasks.exploration_graph import EDGE_KINDS, GLOBAL_FEATURES, NODE_FEATURES
from markdown_text import table

TEXT = Path(__file__).parents[1] / "reference/environments.md"
GENERATION = {
    "node_kind": "kind of each node; 0 is padding",
    "node_mask": "1 for a node of the graph",
    "node_flags": "belongs to a finished stack (`is_simulated` in the paper); next structure, "
    "insertion, orientation rule rewrites it",
    "position": "position of an object of a finished stack at the center of the tray [m]",
    "edge_links": "parent and child of each edge",
    "edge_kind": "orientation of each edge; 0 is padding",
    "edge_mask": "1 for an edge of the graph",
    "remaining_nodes": "nodes still to be added, divided by 25",
}
"""Meaning of the parts of an observation of `ClutterGeneration-v0`."""
EXPLORATION = {
    "node_kind": "class of each node; 0 is padding",
    "node_features": "node features, see below",
    "edge_links": "lower and upper node of each pair",
    "edge_kind": "relation of each pair; 0 is padding: "
    + ", ".join(f"`{kind}`" for kind in EDGE_KINDS),
    "global_features": "global features: "
    + ", ".join(f"`{name}`" for name in GLOBAL_FEATURES)
    + ", divided by 20",
    "action_mask": "row x may be placed on column y",
}
"""Meaning of the parts of an observation of `ClutterExploration-v0`."""
FEATURE_MEANINGS = {
    "x": "position of the object's origin, divided by 0.35 m",
    "qw": "orientation as a unit quaternion",
    "extent_x": "extents of the axis-aligned bounding box, divided by 0.35 m",
    "in_view": "1 if the object is visible now",
    "visible_fraction": "visible pixels relative to the top view of the bounding box",
    "is_covered": "1 if another known object is above",
    "support_gap": "gap to the next known object or the tray below, divided by 0.35 m",
    "pick_count": "number of picks, divided by 3",
}
"""Meaning of node features; a feature without an entry continues the one before."""


def page() -> str:
    """Return the page."""
    generation = gymnasium.make("drake_clutter.tasks:ClutterGeneration-v0").unwrapped
    exploration = gymnasium.make("drake_clutter.tasks:ClutterExploration-v0").unwrapped
    parts = {
        "space: generation action": f"`{generation.action_space}`",
        "space: exploration action": f"`{exploration.action_space}`",
        "table: generation arguments": _arguments(ClutterGeneration),
        "table: exploration arguments": _arguments(ClutterExploration),
        "table: generation observation": _observation(generation, GENERATION),
        "table: exploration observation": _observation(exploration, EXPLORATION),
        "table: node features": _node_features(),
    }
    text = TEXT.read_text(encoding="utf-8")
    for marker, part in parts.items():
        comment = f"<!-- {marker} -->"
        if text.count(comment) != 1:
            raise ValueError(f"{TEXT}: the marker {comment} stands {text.count(comment)} times")
        text = text.replace(comment, part)
    return text


def _observation(environment: Any, meanings: Mapping[str, str]) -> str:
    """Return the table of an observation space; every part has a meaning, and the reverse."""
    spaces = environment.observation_space.spaces
    if {*spaces} != {*meanings}:
        raise ValueError(f"parts of the observation differ: {sorted({*spaces} ^ {*meanings})}")
    rows = [
        [
            f"`{name}`",
            str(space.shape),
            str(space.dtype),
            f"{space.low.min():g} to {space.high.max():g}",
            meanings[name],
        ]
        for name, space in spaces.items()
    ]
    return table(["key", "shape", "type", "range", "meaning"], rows).rstrip()


def _node_features() -> str:
    """Return the table of node features; features without a meaning belong to the one before."""
    groups: list[list[str]] = []
    for name in NODE_FEATURES:
        if name in FEATURE_MEANINGS:
            groups.append([])
        groups[-1].append(f"`{name}`")
    rows = [
        [", ".join(group), meaning]
        for group, meaning in zip(groups, FEATURE_MEANINGS.values(), strict=True)
    ]
    return table(["features", "meaning"], rows).rstrip()


def _arguments(environment: type) -> str:
    meanings = docstring_section(vars(environment)["__init__"], "Args")
    parameters = inspect.signature(environment).parameters
    rows = [
        [f"`{name}`", f"`{parameter.default}`", meanings[name]]
        for name, parameter in parameters.items()
    ]
    return table(["argument", "default", "meaning"], rows).rstrip()
