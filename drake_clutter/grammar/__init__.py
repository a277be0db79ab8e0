"""The scene grammar: graphs, production rules and derivations."""

from drake_clutter.grammar.clutter_graph import ClutterGraph, canonical_form
from drake_clutter.grammar.orientation import Orientation, resting_rotation
from drake_clutter.grammar.scene_grammar import Derivation, NodeBudget, SceneGrammar, uniform_choice

__all__ = [
    "ClutterGraph",
    "Derivation",
    "NodeBudget",
    "Orientation",
    "SceneGrammar",
    "canonical_form",
    "resting_rotation",
    "uniform_choice",
]
