"""The scene grammar: graphs, production rules, derivations. It knows nothing of poses on the tray or of physics."""

from drake_clutter.grammar.grammar import Derivation, NodeBudget, SceneGrammar, uniform_choice
from drake_clutter.grammar.graph import ClutterGraph, canonical_form
from drake_clutter.grammar.orientation import Orientation, resting_rotation

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
