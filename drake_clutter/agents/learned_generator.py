"""The Scene Generation agent at work: a trained Q over rules, sampled."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from drake_clutter.agents.graph_network import RuleValues
from drake_clutter.agents.soft_q import softmax_choice, stacked
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Derivation, NodeBudget, SceneGrammar
from drake_clutter.learning.checkpoint import Checkpoint, load_checkpoint
from drake_clutter.stability.judge import FastJudge
from drake_clutter.tasks.generation import GenerationTask, GraphVocabulary, PartialScene


def about_values(grammar: SceneGrammar, width: int) -> dict[str, Any]:
    """What the inputs and outputs of a `RuleValues` stand for, for its checkpoint."""
    vocabulary = GraphVocabulary.of(grammar)
    return {
        "node_kinds": list(vocabulary.node_kinds),
        "edge_kinds": [
            kind if isinstance(kind, str) else kind.name.lower() for kind in vocabulary.edge_kinds
        ],
        "rules": [rule.name for rule in grammar.rules],
        "width": width,
    }


def load_values(checkpoint: Checkpoint, grammar: SceneGrammar) -> RuleValues:
    """The network of a checkpoint, for a grammar.

    What the checkpoint knows by name is taken over: node kinds, edge kinds and rules of another set of objects keep the
    values of a new network. So a training on one set can begin with what was learned on another.
    """
    about = checkpoint.about["network"]
    mine = about_values(grammar, about["width"])
    network = RuleValues(
        len(mine["node_kinds"]), len(mine["edge_kinds"]), len(mine["rules"]), about["width"]
    )
    state, theirs, ours = network.state_dict(), _named_axes(about), _named_axes(mine)
    for name, weights in checkpoint.weights.items():
        if name not in ours:
            state[name] = weights
            continue
        axis, names = ours[name]
        shared = [kind for kind in names if kind in theirs[name][1]]
        taken = weights.index_select(
            axis, torch.tensor([theirs[name][1].index(kind) for kind in shared])
        )
        state[name].index_copy_(axis, torch.tensor([names.index(kind) for kind in shared]), taken)
    network.load_state_dict(state)
    return network


def _named_axes(about: dict[str, Any]) -> dict[str, tuple[int, list[str]]]:
    """Of each parameter with inputs or outputs that have names: the axis and the names along it."""
    both_ways = about["edge_kinds"] + [f"{kind} backwards" for kind in about["edge_kinds"]]
    return {
        "network.kind.weight": (0, about["node_kinds"]),
        "network.edge.weight": (0, both_ways),
        "value.weight": (0, about["rules"]),
        "value.bias": (0, about["rules"]),
    }


class LearnedGenerator:
    """SG: draws rules from the softmax of Q / temperature over the feasible ones (a `GenerationAgent`)."""

    def __init__(self, path: Path, config: ClutterConfig, temperature: float | None = None) -> None:
        """Loads an agent.

        Args:
            path: a checkpoint of `training/train_generator.py`.
            config: the world.
            temperature: None: the one that its checkpoint names.

        Raises:
            InputError: the checkpoint cannot be read, or is none of a generator.
        """
        self._path, self._config, self._checkpoint = path, config, load_checkpoint(path)
        if self._checkpoint.about.get("kind") != "generator":
            raise InputError(
                f"{path}: is a checkpoint of another kind; allowed is one of training/train_generator.py"
            )
        about = self._checkpoint.about
        self._temperature = about["temperature"] if temperature is None else temperature
        self._judge = FastJudge(config, margin=about["config"]["task"]["margin"])
        self._network: RuleValues | None = None

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """See `GenerationAgent.derive`. Stacks that do not stand stay in the graph: nothing is drawn again.

        Raises:
            InputError: the grammar has object classes that the agent has not learned.
        """
        if self._network is None:
            unknown = sorted(
                set(grammar.classes) - set(self._checkpoint.about["network"]["node_kinds"])
            )
            if unknown:
                raise InputError(
                    f"--agent {self._path}: was not trained with {', '.join(unknown)}; train one with your objects"
                )
            self._network = load_values(self._checkpoint, grammar).eval()
        task = GenerationTask(nodes=budget.nodes, must_come_apart=False)
        partial = PartialScene(grammar, task, self._config, self._judge)
        while not partial.finished:
            with torch.no_grad():
                values = self._network(stacked([partial.observe()])).numpy()
            partial.apply(
                int(softmax_choice(values, partial.mask[None], self._temperature, rng)[0])
            )
        return Derivation(partial.graph, tuple(partial.rules))
