"""The Scene Generation agent at work: a trained Q over rules, sampled."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from drake_clutter.agents.graph_network import RuleQNetwork
from drake_clutter.agents.soft_q import collate, sample_softmax_actions
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Derivation, NodeBudget, SceneGrammar
from drake_clutter.learning.checkpoint import Checkpoint, load_checkpoint
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.generation_task import GenerationTaskConfig, GraphVocabulary, PartialScene
from drake_clutter.validation import validate


def rule_network_metadata(grammar: SceneGrammar, width: int) -> dict[str, Any]:
    """What the inputs and outputs of a `RuleValues` stand for, for its checkpoint."""
    vocabulary = GraphVocabulary.from_grammar(grammar)
    return {
        "node_kinds": list(vocabulary.node_kinds),
        "edge_kinds": [
            kind if isinstance(kind, str) else kind.name.lower() for kind in vocabulary.edge_kinds
        ],
        "rules": [rule.name for rule in grammar.rules],
        "width": width,
    }


def load_rule_network(checkpoint: Checkpoint, grammar: SceneGrammar) -> RuleQNetwork:
    """The network of a checkpoint, for a grammar.

    What the checkpoint knows by name is taken over: node kinds, edge kinds and rules of another set of objects keep the
    values of a new network. So a training on one set can begin with what was learned on another.
    """
    trained_metadata = checkpoint.metadata["network"]
    metadata = rule_network_metadata(grammar, trained_metadata["width"])
    network, trained = _make_network(metadata), _make_network(trained_metadata)
    trained.load_state_dict(checkpoint.weights)
    state = network.state_dict()
    rows, trained_rows = _named_rows(metadata), _named_rows(trained_metadata)
    for name, weights in trained.state_dict().items():
        if name not in rows:
            state[name] = weights
            continue
        shared = [row for row in rows[name] if row in trained_rows[name]]
        target = torch.tensor([rows[name].index(row) for row in shared])
        source = torch.tensor([trained_rows[name].index(row) for row in shared])
        state[name].index_copy_(0, target, weights.index_select(0, source))
    network.load_state_dict(state)
    return network


def _make_network(metadata: dict[str, Any]) -> RuleQNetwork:
    node_kinds, edge_kinds, rules = (
        len(metadata[name]) for name in ("node_kinds", "edge_kinds", "rules")
    )
    return RuleQNetwork(node_kinds, edge_kinds, rules, metadata["width"])


def _named_rows(metadata: dict[str, Any]) -> dict[str, list[str]]:
    """Return what each row stands for, of the parameters whose rows stand for kinds or rules."""
    edge_kinds = metadata["edge_kinds"]
    return {
        "encoder.node_kind_embedding.weight": metadata["node_kinds"],
        "encoder.edge_kind_embedding.weight": [
            *edge_kinds,
            *(f"{kind} backwards" for kind in edge_kinds),
        ],
        "q_head.weight": metadata["rules"],
        "q_head.bias": metadata["rules"],
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
        if self._checkpoint.metadata.get("kind") != "generator":
            raise InputError(
                f"{path}: is a checkpoint of another kind; allowed is one of training/train_generator.py"
            )
        about = self._checkpoint.metadata
        self._temperature = about["temperature"] if temperature is None else temperature
        task = validate(GenerationTaskConfig, about["config"]["task"], str(path))
        self._judge = StaticStabilityJudge(config, margin=task.contact_margin)
        self._network: RuleQNetwork | None = None

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """See `GenerationAgent.derive`. Stacks that do not stand stay in the graph: nothing is drawn again.

        Raises:
            InputError: the grammar has object classes that the agent has not learned.
        """
        if self._network is None:
            unknown = sorted(
                set(grammar.classes) - set(self._checkpoint.metadata["network"]["node_kinds"])
            )
            if unknown:
                raise InputError(
                    f"--agent {self._path}: was not trained with {', '.join(unknown)}; train one with your objects"
                )
            self._network = load_rule_network(self._checkpoint, grammar).eval()
        task = GenerationTaskConfig(nodes=budget.nodes, require_disassembly=False)
        partial = PartialScene(grammar, task, self._config, self._judge)
        while not partial.finished:
            with torch.no_grad():
                values = self._network(collate([partial.observe()])).numpy()
            partial.apply(
                int(
                    sample_softmax_actions(
                        values, partial.action_mask[None], self._temperature, rng
                    )[0]
                )
            )
        return Derivation(partial.graph, tuple(partial.rules))
