"""Scene generator that samples grammar rules from a trained Q-network."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BaseModel, Field

from drake_clutter.agents.graph_network import RuleQNetwork
from drake_clutter.agents.replay_buffer import collate
from drake_clutter.agents.soft_q import sample_softmax_actions
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, input_error
from drake_clutter.grammar import Derivation, NodeBudget, SceneGrammar
from drake_clutter.learning.checkpoint import Checkpoint, load_checkpoint, load_weights
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.generation_task import GenerationTaskConfig, GraphVocabulary, PartialScene
from drake_clutter.validation import NetworkWidth, NonEmptyText, Positive, StrictModel, validate

CHECKPOINT_KIND = "generator"
"""Value of `kind` in the metadata of checkpoints."""


class _NetworkEntry(StrictModel):
    """The network in a checkpoint's metadata, see `rule_network_metadata`."""

    node_kinds: Annotated[tuple[NonEmptyText, ...], Field(min_length=1)]
    edge_kinds: Annotated[tuple[NonEmptyText, ...], Field(min_length=1)]
    rules: Annotated[tuple[NonEmptyText, ...], Field(min_length=1)]
    width: NetworkWidth


class _ConfigEntry(BaseModel):
    """What a generator needs of the configuration of its training."""

    task: GenerationTaskConfig


class _GeneratorMetadata(BaseModel):
    """Metadata of a checkpoint of a scene generator."""

    network: _NetworkEntry
    temperature: Positive
    config: _ConfigEntry


def load_generator_checkpoint(path: Path) -> Checkpoint:
    """Return a checkpoint of `train_generator.py`.

    Raises:
        InputError: The file cannot be read, or is not a checkpoint of a scene generator.
    """
    checkpoint = load_checkpoint(path)
    if checkpoint.kind != CHECKPOINT_KIND:
        raise input_error(
            str(path),
            f"is a checkpoint of another kind ({checkpoint.kind}); "
            f"expected a {CHECKPOINT_KIND} of training/train_generator.py",
        )
    validate(_GeneratorMetadata, checkpoint.metadata, str(path.with_suffix(".json")))
    return checkpoint


def rule_network_metadata(grammar: SceneGrammar, width: int) -> dict[str, Any]:
    """Return the metadata that a checkpoint needs to recreate a `RuleQNetwork`.

    Args:
        grammar: The grammar, whose kinds and rules the inputs and outputs stand for.
        width: Width of the embeddings.
    """
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
    """Return the network of a checkpoint, adapted to a grammar.

    Weights that belong to a node kind, an edge kind or a rule are matched by its name; those of
    kinds and rules that the checkpoint does not have are initialized as in a new network. Training
    on one object set can thus start from a network that was trained on another.

    Args:
        checkpoint: A checkpoint of a scene generator.
        grammar: The grammar.
    """
    trained_metadata = checkpoint.metadata["network"]
    metadata = rule_network_metadata(grammar, trained_metadata["width"])
    network = _make_network(metadata)
    trained = _make_network(trained_metadata)
    load_weights(trained, checkpoint.weights, checkpoint.path)
    state = network.state_dict()
    rows = _row_names(metadata)
    trained_rows = _row_names(trained_metadata)
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
    """Return a new network with the inputs and outputs of `rule_network_metadata`."""
    return RuleQNetwork(
        num_node_kinds=len(metadata["node_kinds"]),
        num_edge_kinds=len(metadata["edge_kinds"]),
        num_rules=len(metadata["rules"]),
        width=metadata["width"],
    )


def _row_names(metadata: dict[str, Any]) -> dict[str, list[str]]:
    """Return, for each parameter with one row per kind or rule, the names of its rows."""
    edge_kinds = metadata["edge_kinds"]
    reversed_edge_kinds = [f"{kind} backwards" for kind in edge_kinds]
    return {
        "encoder.node_kind_embedding.weight": metadata["node_kinds"],
        "encoder.edge_kind_embedding.weight": [*edge_kinds, *reversed_edge_kinds],
        "q_head.weight": metadata["rules"],
        "q_head.bias": metadata["rules"],
    }


class LearnedGenerator:
    """Samples rules from softmax(Q / temperature) (SG of Kumar et al. 2022; a `GenerationAgent`).

    The softmax is taken over the feasible rules.
    """

    def __init__(self, path: Path, config: ClutterConfig, temperature: float | None = None) -> None:
        """Load a checkpoint of `train_generator.py`.

        Args:
            path: File of the checkpoint.
            config: Configuration of the simulated world.
            temperature: Temperature of the softmax; None selects that of the checkpoint.

        Raises:
            InputError: The file cannot be read, or is not a checkpoint of a scene generator.
        """
        self._path = path
        self._config = config
        self._checkpoint = load_generator_checkpoint(path)
        metadata = self._checkpoint.metadata
        self._temperature = metadata["temperature"] if temperature is None else temperature
        task = validate(GenerationTaskConfig, metadata["config"]["task"], str(path))
        self._judge = StaticStabilityJudge(config, margin=task.contact_margin)
        self._network: RuleQNetwork | None = None

    def require_classes(self, classes: Collection[str]) -> None:
        """Raise an error for a class that the agent was not trained with.

        Args:
            classes: Names of object classes.

        Raises:
            InputError: The agent was not trained with one of the classes.
        """
        trained_kinds = self._checkpoint.metadata["network"]["node_kinds"]
        unknown = sorted(set(classes) - set(trained_kinds))
        if unknown:
            raise InputError(
                f"--agent {self._path}: was not trained with {', '.join(unknown)}; "
                "train one with your objects"
            )

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """Derive a terminal graph; see `GenerationAgent`.

        Unstable stacks stay in the graph: the derivation is not repeated.

        Raises:
            InputError: The agent was not trained with an object class of the grammar.
        """
        if self._network is None:
            self.require_classes(grammar.classes)
            self._network = load_rule_network(self._checkpoint, grammar).eval()
        task = GenerationTaskConfig(nodes=budget.nodes, require_disassembly=False)
        partial = PartialScene(grammar, task, self._config, self._judge)
        while not partial.finished:
            with torch.no_grad():
                values = self._network(collate([partial.observe()])).numpy()
            actions = sample_softmax_actions(
                values, partial.action_mask[None], self._temperature, rng
            )
            partial.apply(int(actions[0]))
        return Derivation(partial.graph, tuple(partial.rules))
