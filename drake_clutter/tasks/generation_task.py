"""Scene generation: derive, rule by rule, a graph whose scene is stable and hides objects.

This is the Markov decision process of scene generation in Kumar et al. 2022, with rewards that are
paid as soon as a stack is finished.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, format_value
from drake_clutter.grammar import ClutterGraph, Derivation, NodeBudget, Orientation, SceneGrammar
from drake_clutter.grammar.clutter_graph import (
    DUMMY,
    END,
    NON_TERMINAL_KINDS,
    OBJECT_SLOT,
    OPEN_SLOT,
    PRIMITIVE,
    TRAY,
)
from drake_clutter.scenes.interfaces import InconclusiveVerdict, Verdict
from drake_clutter.scenes.layout import LayoutFailure, Stack, lay_out
from drake_clutter.scenes.scene import Scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.environment_interface import (
    RENDER_METADATA,
    check_index,
    check_instance,
    check_is_reset,
    check_render_mode,
    check_reset_options,
    index_type,
    render_picture,
)
from drake_clutter.validation import (
    Flag,
    InRange,
    NodeCount,
    NonNegative,
    config_class,
    renamed_fields,
)

MAX_BALANCED_STACK_FRACTION = 0.6
"""Largest fraction of a balanced scene's objects that may be in one stack."""
MAX_INFEASIBLE_ACTIONS_PER_NODE = 100
"""Number of infeasible actions per node of a graph after which an episode is truncated.

An agent that samples rules uniformly needs about 10 attempts for each rule that it applies.
"""
_REMAINING_NODES_SCALE = 25
"""Number of remaining nodes that is represented by 1: the size of the largest trained graphs."""

GenerationObservation = dict[str, NDArray[Any]]
"""Arrays of the observation of `ClutterGeneration` by name."""


@config_class
@renamed_fields(must_come_apart="require_disassembly", margin="contact_margin")
class GenerationTaskConfig:
    """Requirements on generated scenes, and their rewards.

    Attributes:
        nodes: Number of nodes of each graph.
        hidden_reward: Reward w_u per hidden object of a stable scene.
        balance_reward: Reward of a stable scene without a stack of more than
            `MAX_BALANCED_STACK_FRACTION` of the objects. It is not part of Kumar et al. 2022.
        instability_reward: Reward w_s of a scene that is unstable, cannot be laid out, or whose
            verdict is inconclusive.
        require_disassembly: Whether a stack counts as unstable if it cannot be disassembled from
            the top, object by object.
        contact_margin: Distance by which the static stability judge shrinks contacts [m]. Above the
            random offsets of poses, so that simulations in Drake agree with the judge.
    """

    nodes: NodeCount = 25
    hidden_reward: NonNegative = 0.5
    balance_reward: NonNegative = 0.5
    instability_reward: Annotated[float, InRange(-1e300, 0.0)] = -1.0
    require_disassembly: Flag = True
    contact_margin: NonNegative = 0.003


class StackFailure(Enum):
    """Reason why a finished stack ends the derivation."""

    TOO_HIGH = "stack too high"
    UNSTABLE = "unstable"
    INCONCLUSIVE = "cannot be judged"
    NOT_DISASSEMBLABLE = "does not come apart"


@dataclass(frozen=True)
class GraphVocabulary:
    """Numbers of the kinds of nodes and edges of a grammar; 0 is padding.

    Attributes:
        node_kinds: Kinds of nodes in the order of their numbers, from 1 on.
        edge_kinds: Kinds of edges in the order of their numbers, from 1 on.
    """

    node_kinds: tuple[str, ...]
    edge_kinds: tuple[Orientation | str, ...]

    @staticmethod
    def from_grammar(grammar: SceneGrammar) -> "GraphVocabulary":
        """Return the vocabulary of a grammar."""
        return GraphVocabulary(
            (TRAY, OBJECT_SLOT, OPEN_SLOT, END, DUMMY, *grammar.classes), (PRIMITIVE, *Orientation)
        )


def max_edges(nodes: int) -> int:
    """Return the maximum number of edges of a graph.

    The graph is a tree, except that each pair of objects below a dummy node has one more edge.

    Args:
        nodes: Number of nodes.
    """
    return nodes - 1 + max(0, nodes - 2) // 3


class PartialScene:
    """A derivation in progress, with the verdicts of its finished stacks.

    Attributes:
        graph: The graph.
        rules: Names of the rules that were applied.
        object_positions: Position of each object of a finished stack by its node, if the stack
            stands at the center of the tray [m]. Shape (3,) each.
        num_hidden: Number of objects that are hidden by their own stack.
        failure: Why the latest finished stack ends the derivation; None if it does not.
        latest_stack: The latest finished stack at the center of the tray, or None.
        action_mask: Which rules are feasible. Shape (number of rules,).
    """

    def __init__(
        self,
        grammar: SceneGrammar,
        task: GenerationTaskConfig,
        config: ClutterConfig,
        judge: StaticStabilityJudge,
    ) -> None:
        """Start a derivation from the tray.

        Args:
            grammar: The scene grammar.
            task: Requirements and rewards.
            config: Configuration of the simulated world.
            judge: Judges finished stacks and the finished scene.
        """
        vocabulary = GraphVocabulary.from_grammar(grammar)
        self._grammar = grammar
        self._task = task
        self._config = config
        self._judge = judge
        self._budget = NodeBudget(task.nodes)
        self._node_kind_ids = {kind: k for k, kind in enumerate(vocabulary.node_kinds, start=1)}
        self._edge_kind_ids = {kind: k for k, kind in enumerate(vocabulary.edge_kinds, start=1)}
        self.graph = ClutterGraph()
        self.rules: list[str] = []
        self.object_positions: dict[int, NDArray[np.float64]] = {}
        self.num_hidden = 0
        self.failure: StackFailure | None = None
        self.latest_stack: Scene | None = None
        self._match_rules()

    def _match_rules(self) -> None:
        """Find the matches of all rules, and which rules are feasible."""
        self._matches = self._grammar.find_matches(self.graph)
        self.action_mask = self._grammar.feasible_rules(self.graph, self._budget, self._matches)

    @property
    def finished(self) -> bool:
        """Whether no rule is feasible."""
        return not self.action_mask.any()

    def apply(self, rule_index: int) -> None:
        """Apply a feasible rule to its first match, and judge the stack that it finishes, if any.

        Args:
            rule_index: Index of the rule in the grammar.
        """
        rule = self._grammar.rules[rule_index]
        match = self._matches[self._grammar.pattern_indices[rule_index]]
        assert match is not None, f"rule {rule.name} is not feasible"
        self._grammar.rewrite_in_place(self.graph, rule, match)
        self.rules.append(rule.name)
        changed_node = match[rule.left.target]
        if changed_node != ClutterGraph.TRAY_NODE:
            bottom = self._finished_stack_bottom(changed_node)
            if bottom:
                self._judge_stack(
                    Stack(self.graph, self._grammar.classes, bottom, self._config.layout)
                )
        self._match_rules()

    def _finished_stack_bottom(self, node: int) -> list[int]:
        """Return the bottom nodes of the stack of a node, if all its attributes are terminal.

        Returns:
            The nodes that rest on the tray; empty if the stack is not finished.
        """
        # The adjacency dictionaries of networkx; its views are too slow for the inner loop.
        successors = self.graph.digraph._adj
        predecessors = self.graph.digraph._pred
        while True:
            parent = next(iter(predecessors[node]))
            if parent == ClutterGraph.TRAY_NODE:
                break
            node = parent
        dummies = [child for child in successors[node] if self.graph.kind(child) == DUMMY]
        bottom = list(predecessors[dummies[0]]) if dummies else [node]
        level = bottom
        edge_kinds = [self.graph.edge_kind(ClutterGraph.TRAY_NODE, bottom[0])]
        while level:
            for parent in level:
                if self.graph.kind(parent) in NON_TERMINAL_KINDS:
                    return []
                edge_kinds += [
                    edge["kind"]
                    for child, edge in successors[parent].items()
                    if self.graph.kind(child) != END
                ]
            level = list(dict.fromkeys(child for parent in level for child in successors[parent]))
        return [] if PRIMITIVE in edge_kinds else bottom

    def _judge_stack(self, stack: Stack) -> None:
        """Record the positions, and the failure or the hidden objects of a finished stack."""
        self.object_positions |= dict(zip(stack.nodes, stack.p_T, strict=True))
        scene = Scene(tuple(stack.objects()), self._config.cell.support)
        self.latest_stack = scene
        if stack.upper[2] > self._config.layout.max_stack_height:
            self.failure = StackFailure.TOO_HIGH
            return
        instability = self._judge.find_instability(scene)
        if isinstance(instability, InconclusiveVerdict):
            self.failure = StackFailure.INCONCLUSIVE
        elif instability is not None:
            self.failure = StackFailure.UNSTABLE
        elif self._task.require_disassembly and not self._judge.is_disassemblable(scene):
            self.failure = StackFailure.NOT_DISASSEMBLABLE
        else:
            visible_fractions = self._judge.ray_caster.visible_fractions(scene.objects)
            threshold = self._config.cell.camera.visibility_threshold
            self.num_hidden += sum(v < threshold for v in visible_fractions.values())

    def terminal_reward(self, num_hidden: int) -> float:
        """Return the sum of rewards of a derivation with a stable scene.

        Args:
            num_hidden: Number of objects that the scene hides.
        """
        is_balanced = self.graph.largest_stack_fraction() <= MAX_BALANCED_STACK_FRACTION
        return self._task.hidden_reward * num_hidden + self._task.balance_reward * is_balanced

    def lay_out_and_judge(self, rng: np.random.Generator) -> tuple[Scene, Verdict] | None:
        """Return the finished scene with its stacks at random places, and its verdict.

        Returns:
            The scene and its verdict; None if it cannot be laid out or is not stable.
        """
        derivation = Derivation(self.graph, tuple(self.rules))
        scene = lay_out(derivation, self._grammar.classes, self._config, rng)
        if isinstance(scene, LayoutFailure):
            return None
        verdict = self._judge.judge(scene, rng)
        if isinstance(verdict, InconclusiveVerdict) or not verdict.stable:
            return None
        return scene, verdict

    def observe(self) -> GenerationObservation:
        """Return the observation of `ClutterGeneration`."""
        num_nodes = self._task.nodes
        num_edges = max_edges(num_nodes)
        count = len(self.graph)
        node_kind = np.zeros(num_nodes, index_type(len(self._node_kind_ids)))
        node_flags = np.zeros((num_nodes, 4), np.int8)
        position = np.zeros((num_nodes, 3), np.float32)
        node_kind[:count] = [self._node_kind_ids[kind] for kind in self.graph.kinds()]
        for node, p_TO in self.object_positions.items():
            node_flags[node, 0] = 1
            position[node] = p_TO
        for column, (pattern, match) in enumerate(
            zip(self._grammar.patterns, self._matches, strict=True)
        ):
            # The first pattern always rewrites the tray, which needs no flag.
            if match is not None and column > 0:
                node_flags[match[pattern.target], column] = 1
        edge_links = np.zeros((num_edges, 2), np.int16)
        edge_kind = np.zeros(num_edges, index_type(len(self._edge_kind_ids)))
        e = 0
        for parent, children in self.graph.digraph._adj.items():
            for child, edge in children.items():
                edge_links[e] = parent, child
                edge_kind[e] = self._edge_kind_ids[edge["kind"]]
                e += 1
        remaining_nodes = (num_nodes - count) / _REMAINING_NODES_SCALE
        return {
            "node_kind": node_kind,
            "node_mask": (node_kind > 0).astype(np.int8),
            "node_flags": node_flags,
            "position": position,
            "edge_links": edge_links,
            "edge_kind": edge_kind,
            "edge_mask": (edge_kind > 0).astype(np.int8),
            "remaining_nodes": np.array([remaining_nodes], np.float32),
        }


class ClutterGeneration(gymnasium.Env[GenerationObservation, int]):
    """Environment `ClutterGeneration-v0`: derive a graph whose scene is stable and hides objects.

    Observation space, a `Dict` with N = `nodes` and E = `max_edges(N)`; rows beyond the graph are
    zeros:

    - `node_kind` (N,): Number of the node's kind in the `GraphVocabulary`; 0 is padding.
    - `node_mask` (N,): Whether there is a node.
    - `node_flags` (N, 4): Whether the node belongs to a finished stack, which has been judged; then
      whether it is rewritten by the next rule of structure, of insertion and of orientation. A rule
      rewrites the first match of its left-hand side, breadth first from the tray.
    - `position` (N, 3): Position of an object of a finished stack that stands at the center of the
      tray [m].
    - `edge_links` (E, 2): Parent and child.
    - `edge_kind` (E,): Number of the edge's kind in the `GraphVocabulary`; 0 is padding.
    - `edge_mask` (E,): Whether there is an edge.
    - `remaining_nodes` (1,): Number of nodes that are still to be added, divided by 25.

    Action space: `Discrete`, the rules of the grammar. `info["action_mask"]` (number of rules,)
    marks the feasible ones, as does `action_masks`; any other changes nothing.

    Reward: `hidden_reward` for each object that a stack hides, when the stack is finished and
    stable. An unstable stack ends the episode: the earlier rewards are taken back, and
    `instability_reward` is paid. At the end, the finished scene is laid out and judged; the
    difference between the objects that it hides and those that its stacks hide is made up for, and
    `balance_reward` is paid for a balanced scene. The rewards of an episode, summed without
    discount, are thus `PartialScene.terminal_reward` of a stable scene, otherwise
    `instability_reward`.

    Termination: no rule is feasible, or a stack has failed. The last `info` has the `scene` and its
    `verdict`, or the `failure`: a `StackFailure`, or None if the finished scene could not be laid
    out or was not stable.

    Truncation: after `MAX_INFEASIBLE_ACTIONS_PER_NODE` infeasible actions per node, so that
    episodes of agents that ignore the mask end.

    Rendering: the picture of the work cell's first camera, of the latest finished stack, and at the
    end of the finished scene.
    """

    metadata: dict[str, Any] = RENDER_METADATA

    def __init__(
        self,
        classes: Sequence[ObjectClass] | None = None,
        task: GenerationTaskConfig | None = None,
        config: ClutterConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Create an environment.

        Args:
            classes: Object classes of the grammar; None selects the seven YCB objects.
            task: Requirements and rewards; None selects the defaults.
            config: Configuration of the simulated world; None selects the default.
            render_mode: "rgb_array" for pictures, or None.

        Raises:
            InputError: There is no such render mode, or another argument is of the wrong kind.
        """
        self.render_mode = check_render_mode(render_mode)
        self.task = check_instance(task, GenerationTaskConfig, "task") or GenerationTaskConfig()
        self._config = check_instance(config, ClutterConfig, "config") or ClutterConfig()
        if classes is None:
            classes = load_catalog().object_set("ycb7")
        if not classes or not all(isinstance(c, ObjectClass) for c in classes):
            raise InputError(f"classes: {format_value(classes)}; expected some ObjectClass")
        self.grammar = SceneGrammar(classes)
        self.vocabulary = GraphVocabulary.from_grammar(self.grammar)
        self._judge = StaticStabilityJudge(self._config, margin=self.task.contact_margin)
        n = self.task.nodes
        e = max_edges(n)
        num_node_kinds = len(self.vocabulary.node_kinds)
        num_edge_kinds = len(self.vocabulary.edge_kinds)
        max_coordinate = max(*self._config.cell.support.size, self._config.layout.max_stack_height)
        box = gymnasium.spaces.Box
        spaces: dict[str, gymnasium.Space[Any]] = {
            "node_kind": box(0, num_node_kinds, (n,), index_type(num_node_kinds)),
            "node_mask": box(0, 1, (n,), np.int8),
            "node_flags": box(0, 1, (n, 4), np.int8),
            "position": box(-max_coordinate, max_coordinate, (n, 3), np.float32),
            "edge_links": box(0, n - 1, (e, 2), np.int16),
            "edge_kind": box(0, num_edge_kinds, (e,), index_type(num_edge_kinds)),
            "edge_mask": box(0, 1, (e,), np.int8),
            "remaining_nodes": box(0, n / _REMAINING_NODES_SCALE, (1,), np.float32),
        }
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(len(self.grammar.rules))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GenerationObservation, dict[str, Any]]:
        """Start an episode from the tray.

        Raises:
            InputError: There are options, of which this environment has none.
        """
        super().reset(seed=seed)
        check_reset_options(options, ())
        self._num_infeasible = 0
        self._scene = Scene((), self._config.cell.support)
        self.partial = PartialScene(self.grammar, self.task, self._config, self._judge)
        return self.partial.observe(), self._info()

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which rules are feasible, as sb3-contrib requires. Shape (number of rules,).

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
        """
        check_is_reset(self, "partial")
        return self.partial.action_mask.astype(bool)

    def render(self) -> Any:
        """Return the camera's picture as (height, width, 3) uint8; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
        """
        if self.render_mode is None:
            return None
        check_is_reset(self, "partial")
        return render_picture(self._scene, self._config)

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self.partial.action_mask.astype(np.int8)}

    def step(
        self, action: int
    ) -> tuple[GenerationObservation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Apply a rule, given by its index.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
            InputError: There is no such action.
        """
        check_is_reset(self, "partial")
        action = check_index(action, len(self.grammar.rules), "action")
        partial = self.partial
        if not partial.action_mask[action]:
            self._num_infeasible += 1
            limit = MAX_INFEASIBLE_ACTIONS_PER_NODE * self.task.nodes
            truncated = self._num_infeasible >= limit
            return partial.observe(), 0.0, partial.finished, truncated, self._info()
        return_before = self.task.hidden_reward * partial.num_hidden
        partial.apply(action)
        info = self._info()
        return_after = self.task.hidden_reward * partial.num_hidden
        if partial.latest_stack is not None:
            self._scene = partial.latest_stack
        terminated = partial.finished or partial.failure is not None
        if terminated:
            finished_scene = None
            if partial.failure is None:
                finished_scene = partial.lay_out_and_judge(self.np_random)
            if finished_scene is None:
                info["failure"] = partial.failure
                return_after = self.task.instability_reward
            else:
                info["scene"], info["verdict"] = finished_scene
                self._scene = info["scene"]
                return_after = partial.terminal_reward(len(info["verdict"].hidden))
        return partial.observe(), return_after - return_before, terminated, False, info
