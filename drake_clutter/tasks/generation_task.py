"""Scene generation (SPEC section 3): derive a graph, rule by rule, whose scene is stable and hides objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.config import ClutterConfig
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
from drake_clutter.validation import Flag, InRange, NonNegative, config_class, renamed_fields

MAX_BALANCED_STACK_FRACTION = 0.6
"""Of a balanced scene's objects."""

GenerationObservation = dict[str, NDArray[Any]]


@config_class
@renamed_fields(must_come_apart="require_disassembly", margin="contact_margin")
class GenerationTaskConfig:
    """What is asked of a generated scene.

    Attributes:
        nodes: exact size of the graphs.
        hidden_reward: w_u, per hidden object of a stable scene.
        balance_reward: for a stable scene of which no stack holds more than `MOST_IN_A_STACK` of the objects. Not in the paper.
        instability_reward: w_s, for a scene that is unstable, or that cannot be laid out or judged.
        require_disassembly: whether a stack that cannot be taken away from the top, object by object, counts as unstable.
        contact_margin: m, by which the fast judge shrinks contacts; more than the offsets ask for, so that Drake agrees.
    """

    nodes: Annotated[int, InRange(3, 1000)] = 25
    hidden_reward: NonNegative = 0.5
    balance_reward: NonNegative = 0.5
    instability_reward: Annotated[float, InRange(-1e300, 0.0)] = -1.0
    require_disassembly: Flag = True
    contact_margin: NonNegative = 0.003


class StackFailure(Enum):
    """Why a stack ends the derivation."""

    TOO_HIGH = "stack too high"
    UNSTABLE = "unstable"
    INCONCLUSIVE = "cannot be judged"
    NOT_DISASSEMBLABLE = "does not come apart"


@dataclass(frozen=True)
class GraphVocabulary:
    """Numbers for the kinds of nodes and edges of a grammar; 0 is padding.

    Attributes:
        node_kinds, edge_kinds: the kinds, in the order of their numbers, from 1 on.
    """

    node_kinds: tuple[str, ...]
    edge_kinds: tuple[Orientation | str, ...]

    @staticmethod
    def from_grammar(grammar: SceneGrammar) -> "GraphVocabulary":
        """That of a grammar."""
        return GraphVocabulary(
            (TRAY, OBJECT_SLOT, OPEN_SLOT, END, DUMMY, *grammar.classes), (PRIMITIVE, *Orientation)
        )


def max_edges(nodes: int) -> int:
    """Of a graph of that size: a tree's, and one more for each pair, which takes three nodes below an `end`."""
    return nodes - 1 + max(0, nodes - 2) // 3


class PartialScene:
    """A derivation under way, and what is known of its finished stacks."""

    def __init__(
        self,
        grammar: SceneGrammar,
        task: GenerationTaskConfig,
        config: ClutterConfig,
        judge: StaticStabilityJudge,
    ) -> None:
        """Starts from the tray; `judge` is asked about every stack."""
        vocabulary = GraphVocabulary.from_grammar(grammar)
        self._grammar, self._task, self._config, self._judge = grammar, task, config, judge
        self._budget = NodeBudget(task.nodes)
        self._node_number = {kind: k for k, kind in enumerate(vocabulary.node_kinds, start=1)}
        self._edge_number = {kind: k for k, kind in enumerate(vocabulary.edge_kinds, start=1)}
        self.graph = ClutterGraph()
        self.rules: list[str] = []
        self.object_positions: dict[
            int, NDArray[np.float64]
        ] = {}  # of the objects of finished stacks, m, over the tray's centre
        self.num_hidden = 0
        self.failure: StackFailure | None = None
        self._match_rules()

    def _match_rules(self) -> None:
        self._matches = self._grammar.find_matches(self.graph)
        self.action_mask = self._grammar.feasible_rules(self.graph, self._budget, self._matches)

    @property
    def finished(self) -> bool:
        """Whether no rule is feasible any more."""
        return not self.action_mask.any()

    def apply(self, rule: int) -> None:
        """Applies a feasible rule to its first match, and judges the stack that it finishes, if it finishes one."""
        match = self._matches[self._grammar.pattern_indices[rule]]
        assert match is not None, f"rule {self._grammar.rules[rule].name} is not feasible"
        self._grammar.rewrite_in_place(self.graph, self._grammar.rules[rule], match)
        self.rules.append(self._grammar.rules[rule].name)
        changed = match[self._grammar.rules[rule].left.rewritten]
        if changed != ClutterGraph.TRAY_NODE and (bottom := self._finished_stack(changed)):
            self._judge_stack(Stack(self.graph, self._grammar.classes, bottom, self._config.layout))
        self._match_rules()

    def _finished_stack(self, node: int) -> list[int]:
        """What stands on the tray of the stack that a node belongs to, if all its attributes are terminal; else nothing."""
        above, below = self.graph.nx._adj, self.graph.nx._pred
        while True:
            parent = next(iter(below[node]))
            if parent == ClutterGraph.TRAY_NODE:
                break
            node = parent
        children = list(above[node])
        dummies = [child for child in children if self.graph.kind(child) == DUMMY]
        bottom = list(below[dummies[0]]) if dummies else [node]
        level, edges = bottom, [self.graph.edge_kind(ClutterGraph.TRAY_NODE, bottom[0])]
        while level:
            for at in level:
                if self.graph.kind(at) in NON_TERMINAL_KINDS:
                    return []
                edges += [
                    kind["kind"]
                    for child, kind in above[at].items()
                    if self.graph.kind(child) != END
                ]
            level = list(dict.fromkeys(child for at in level for child in above[at]))
        return [] if PRIMITIVE in edges else bottom

    def _judge_stack(self, stack: Stack) -> None:
        self.object_positions |= dict(zip(stack.nodes, stack.p_T, strict=True))
        scene = Scene(tuple(stack.objects()), self._config.cell.support)
        if stack.upper[2] > self._config.layout.max_stack_height:
            self.failure = StackFailure.TOO_HIGH
        elif isinstance(found := self._judge.find_instability(scene), InconclusiveVerdict):
            self.failure = StackFailure.INCONCLUSIVE
        elif found is not None:
            self.failure = StackFailure.UNSTABLE
        elif self._task.require_disassembly and not self._judge.is_disassemblable(scene):
            self.failure = StackFailure.NOT_DISASSEMBLABLE
        else:
            shares = self._judge.ray_caster.visible_fractions(scene.objects).values()
            self.num_hidden += sum(
                share < self._config.cell.camera.visibility_threshold for share in shares
            )

    def terminal_reward(self, hidden: int) -> float:
        """Of the derived graph, if its scene is stable and hides that many objects."""
        balanced = self.graph.largest_stack_fraction() <= MAX_BALANCED_STACK_FRACTION
        return self._task.hidden_reward * hidden + self._task.balance_reward * balanced

    def lay_out_and_judge(self, rng: np.random.Generator) -> tuple[Scene, Verdict] | None:
        """The finished scene with its stacks in places drawn at random, judged; None if it cannot stand on the tray."""
        derivation = Derivation(self.graph, tuple(self.rules))
        scene = lay_out(derivation, self._grammar.classes, self._config, rng)
        if isinstance(scene, LayoutFailure):
            return None
        verdict = self._judge.judge(scene, rng)
        return (
            None
            if isinstance(verdict, InconclusiveVerdict) or not verdict.stable
            else (scene, verdict)
        )

    def observe(self) -> GenerationObservation:
        """The graph as arrays, see `ClutterGeneration`."""
        nodes, edges = self._task.nodes, max_edges(self._task.nodes)
        kind, flags = np.zeros(nodes, np.int8), np.zeros((nodes, 4), np.int8)
        position = np.zeros((nodes, 3), np.float32)
        count = len(self.graph)
        kind[:count] = [self._node_number[k] for k in self.graph.kinds()]
        for node, p_TO in self.object_positions.items():
            flags[node, 0], position[node] = 1, p_TO
        for column, (pattern, match) in enumerate(
            zip(self._grammar.patterns, self._matches, strict=True)
        ):
            if match is not None and column > 0:  # the tray is the tray
                flags[match[pattern.rewritten], column] = 1
        ends, edge_kind = np.zeros((edges, 2), np.int16), np.zeros(edges, np.int8)
        e = 0
        for parent, children in self.graph.nx._adj.items():
            for child, data in children.items():
                ends[e, 0], ends[e, 1], edge_kind[e] = (
                    parent,
                    child,
                    self._edge_number[data["kind"]],
                )
                e += 1
        remaining = np.array([(self._task.nodes - count) / 25], np.float32)
        return {
            "node_kind": kind,
            "node_mask": (kind > 0).astype(np.int8),
            "node_flags": flags,
            "position": position,
            "edge_links": ends,
            "edge_kind": edge_kind,
            "edge_mask": (edge_kind > 0).astype(np.int8),
            "remaining_nodes": remaining,
        }


class ClutterGeneration(gymnasium.Env[GenerationObservation, int]):
    """Derive a graph whose scene is stable and hides objects.

    Observation, with N = nodes, E = `most_edges(N)`; rows beyond the graph are zeros:
        node_kind: (N,) number of the kind in the `GraphVocabulary`; 0 is padding. node_mask: (N,) where there is a node.
        node_flags: (N, 4) whether it belongs to a finished stack, which has been judged (`is_simulated`); then whether it is what
            the next rule of structure, of insertion, of orientation would rewrite: a rule rewrites the first match of its
            left-hand side, breadth first from the tray.
        position: (N, 3) m, of an object of a finished stack, when that stands over the tray's centre.
        edge: (E, 2) parent and child; edge_kind: (E,) number of the kind, 0 is padding. edge_mask: (E,).
        remaining: (1,) nodes still to be added, in 25.
    Action: a rule of the grammar. `info["action_mask"]` (rules,) says which are feasible; one that is not changes nothing.
    Reward: w_u for each object that a stack hides, as soon as it is finished and stands by itself. A stack that does not
        stand ends the episode: what was earned is taken back, and w_s paid. At the end the finished scene is laid out and judged,
        and what it hides more or less than its stacks is made up for; `balance_reward` is paid for a balanced one. So the rewards
        of an episode sum up to what a stable scene is worth, or to w_s. They are meant to be summed without discount.
    The last `info` has the `scene` and its `verdict`, or the `fault`: a `StackFault`, or None if the whole
    found no room on the tray or does not stand.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012, gymnasium's name

    def __init__(
        self,
        classes: Sequence[ObjectClass] | None = None,
        task: GenerationTaskConfig | None = None,
        config: ClutterConfig | None = None,
    ) -> None:
        """Makes an environment.

        Args:
            classes: of the grammar; None: the seven YCB objects.
            task: what is asked.
            config: the world.
        """
        self.task, self._config = task or GenerationTaskConfig(), config or ClutterConfig()
        self.grammar = SceneGrammar(classes or load_catalog().object_set("ycb7"))
        self.vocabulary = GraphVocabulary.from_grammar(self.grammar)
        self._judge = StaticStabilityJudge(self._config, margin=self.task.contact_margin)
        n, e = self.task.nodes, max_edges(self.task.nodes)
        far = max(*self._config.cell.support.size, self._config.layout.max_stack_height)
        box = gymnasium.spaces.Box
        spaces: dict[str, gymnasium.Space[Any]] = {
            "node_kind": box(0, len(self.vocabulary.node_kinds), (n,), np.int8),
            "node_mask": box(0, 1, (n,), np.int8),
            "node_flags": box(0, 1, (n, 4), np.int8),
            "position": box(-far, far, (n, 3), np.float32),
            "edge_links": box(0, n - 1, (e, 2), np.int16),
            "edge_kind": box(0, len(self.vocabulary.edge_kinds), (e,), np.int8),
            "edge_mask": box(0, 1, (e,), np.int8),
            "remaining_nodes": box(0, np.inf, (1,), np.float32),
        }
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(len(self.grammar.rules))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GenerationObservation, dict[str, Any]]:
        """The start graph: the tray."""
        super().reset(seed=seed)
        self.partial = PartialScene(self.grammar, self.task, self._config, self._judge)
        return self.partial.observe(), {"action_mask": self.partial.action_mask.astype(np.int8)}

    def step(
        self, action: int
    ) -> tuple[GenerationObservation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Applies a rule."""
        partial, earned = self.partial, self.task.hidden_reward * self.partial.num_hidden
        if not partial.action_mask[action]:
            return (
                partial.observe(),
                0.0,
                partial.finished,
                False,
                {"action_mask": partial.action_mask.astype(np.int8)},
            )
        partial.apply(int(action))
        info: dict[str, Any] = {"action_mask": partial.action_mask.astype(np.int8)}
        worth = self.task.hidden_reward * partial.num_hidden
        over = partial.finished or partial.failure is not None
        if over:
            made = partial.lay_out_and_judge(self.np_random) if partial.failure is None else None
            if made is None:
                worth, info["failure"] = self.task.instability_reward, partial.failure
            else:
                info["scene"], info["verdict"] = made
                worth = partial.terminal_reward(len(made[1].hidden))
        return partial.observe(), worth - earned, over, False, info
