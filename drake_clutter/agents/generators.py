"""Generating scenes: an agent derives graphs, they are laid out and judged."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import (
    Derivation,
    NodeBudget,
    SceneGrammar,
    canonical_form,
    uniform_choice,
)
from drake_clutter.learning.pretrained import checkpoint_path, checkpoint_sha256
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.statistics import mean_interval, wilson_interval
from drake_clutter.tasks.generation_task import (
    MAX_BALANCED_STACK_FRACTION,
    GenerationTaskConfig,
    PartialScene,
)
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.validation import to_plain

SEARCH_BUDGET = 400
"""Moves that are tried to find out whether a scene is solvable."""
MAX_LAYOUT_ATTEMPTS = 1000
"""Graphs in a row that may fail to be laid out before the budget is called too large for the tray."""


class GenerationAgent(Protocol):
    """Derives terminal graphs."""

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """A terminal graph within the budget."""


PRETRAINED_GENERATORS = {
    "sg": "training/checkpoints/sg.safetensors",
    "sg-star": "training/checkpoints/sg_star.safetensors",
    "sg-14": "training/checkpoints/sg_14.safetensors",
}
"""The shipped checkpoints, by the agent's name."""


class RandomGenerator:
    """RG: uniform over the feasible rules, the first match of the rule that is drawn (SPEC section 3)."""

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """See `GenerationAgent.derive`."""
        return grammar.derive(budget, uniform_choice(rng))


class HillClimber:
    """HC: begins with a random graph, and derives it anew from a random rule on, as long as that makes no worse scene.

    Scenes are rated as `ClutterGeneration` does, without learning anything from one to the next.
    """

    NUM_CANDIDATES = 150
    """Graphs that are derived for each scene."""

    def __init__(self, config: ClutterConfig) -> None:
        self._config = config
        self._judge = StaticStabilityJudge(config, margin=GenerationTaskConfig().contact_margin)

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """See `GenerationAgent.derive`."""
        task = GenerationTaskConfig(nodes=budget.nodes)
        best, best_worth = None, -np.inf
        for _ in range(self.NUM_CANDIDATES):
            partial = PartialScene(grammar, task, self._config, self._judge)
            kept: tuple[str, ...] = best.rules[: rng.integers(len(best.rules))] if best else ()
            for name in kept:
                partial.apply(grammar.rule_indices[name])
            while not partial.finished:
                partial.apply(int(rng.choice(np.flatnonzero(partial.action_mask))))
            worth = (
                task.instability_reward
                if partial.failure
                else partial.terminal_reward(partial.num_hidden)
            )
            if worth >= best_worth:
                best, best_worth = Derivation(partial.graph, tuple(partial.rules)), worth
        assert best is not None
        return best


def make_generation_agent(
    name: str, config: ClutterConfig, temperature: float | None = None
) -> GenerationAgent:
    """A generation agent: `random`, `hill-climbing`, one of `TRAINED`, or the checkpoint in a file.

    Args:
        name: which.
        config: the world.
        temperature: of a trained agent's policy; None: the one that its checkpoint names.

    Raises:
        InputError: no such agent, a file that is no checkpoint of one, or a temperature for an agent that has none.
    """
    learned = name in PRETRAINED_GENERATORS or name.endswith(".safetensors")
    if temperature is not None and not (learned and temperature > 0):
        raise InputError(
            f"--temperature {temperature:g} for {name}; allowed is a positive one, for a trained agent"
        )
    if name == "random":
        return RandomGenerator()
    if name == "hill-climbing":
        return HillClimber(config)
    if not learned:
        raise InputError(
            f"--agent {name}; allowed are random, hill-climbing, {', '.join(PRETRAINED_GENERATORS)}, or a .safetensors file"
        )
    path = checkpoint_path(name, PRETRAINED_GENERATORS)
    from drake_clutter.agents.learned_generator import (
        LearnedGenerator,
    )  # takes PyTorch, which the others do without

    return LearnedGenerator(path, config, temperature)


@dataclass(frozen=True)
class GenerationJob:
    """Everything that decides what a batch of scenes looks like, scene by scene.

    Attributes:
        agent: see `make_generation_agent`.
        objects: name of an object set.
        catalog_folder: a user's asset folder, or None.
        nodes: exact size of the graphs.
        seed: of the batch.
        config: the world.
        temperature: see `make_generation_agent`.
    """

    agent: str
    objects: str
    catalog_folder: Path | None
    nodes: int
    seed: int
    config: ClutterConfig
    temperature: float | None = None

    @property
    def to_dict(self) -> dict[str, Any]:
        """The same for JSON, with the hash of a trained agent's weights: all that decides what the scenes are."""
        folder = str(self.catalog_folder.resolve()) if self.catalog_folder else None
        weights = (
            {"weights": found}
            if (found := checkpoint_sha256(self.agent, PRETRAINED_GENERATORS))
            else {}
        )
        return {**to_plain(self), **weights, "catalog_folder": folder}


@dataclass(frozen=True)
class GeneratedScene:
    """One scene of a batch.

    Attributes:
        scene: as laid out.
        verdict: the judge's.
        layout_failures: graphs that were drawn before it and could not be laid out, by reason.
        solvable: what the full-knowledge search says of a stable scene, once settled; None for an unstable one.
    """

    scene: Scene
    verdict: Verdict
    layout_failures: Counter[str]
    solvable: Solvability | None


class SceneGenerator:
    """Makes scene after scene of a job; a worker for the runner."""

    def __init__(self, job: GenerationJob) -> None:
        self._job = job
        self._grammar = SceneGrammar(load_catalog(job.catalog_folder).object_set(job.objects))
        self._budget = NodeBudget(job.nodes)
        self._agent: GenerationAgent = make_generation_agent(job.agent, job.config, job.temperature)
        self._judge = DrakeJudge(job.config)
        self._search = OracleSearch(job.config)

    def __call__(self, index: int) -> GeneratedScene:
        """The scene of an index, judged; it depends on nothing but the job and the index."""
        rng = item_rng(self._job.seed, index)
        scene, failures = self.lay_out(rng)
        verdict = self._judge.judge(scene, rng)
        solvable = None
        if verdict.stable:
            solvable = self._search.solve(
                scene.with_poses(verdict.settled), self._job.seed, SEARCH_BUDGET, optimal=False
            ).solvability
        return GeneratedScene(scene, verdict, failures, solvable)

    def lay_out(self, rng: np.random.Generator) -> tuple[Scene, Counter[str]]:
        """A scene as laid out, and why the graphs drawn before it could not be."""
        failures: Counter[str] = Counter()
        for _ in range(MAX_LAYOUT_ATTEMPTS):
            derivation = self._agent.derive(self._grammar, self._budget, rng)
            scene = lay_out(
                derivation, self._grammar.classes, self._job.config, rng, self._job.seed
            )
            if not isinstance(scene, LayoutFailure):
                return scene, failures
            failures[scene.reason.value] += 1
        raise RuntimeError(
            f"{MAX_LAYOUT_ATTEMPTS} graphs of {self._job.nodes} nodes in a row could not be laid out: {dict(failures)}"
        )


def summarize_scenes(
    job: GenerationJob,
    scenes: Iterable[tuple[Scene, Verdict]],
    solvable: Sequence[Solvability | None] | None = None,
) -> dict[str, Any]:
    """The figures of a batch: stability over all scenes, hidden and solvable over the stable ones (SPEC section 6).

    `largest_stack_share` is of a scene's objects, on average; `balanced_share` is of the scenes in which no stack holds more than
    60 % of them; `class_entropy` is in bits, over all objects.
    """
    classes = load_catalog(job.catalog_folder).classes
    stable, hidden, stacks, forms, objects = 0, [], [], set(), []
    reasons: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    largest = []
    for scene, verdict in scenes:
        assert scene.graph is not None
        stacks.append(len(scene.graph.stack_bases()))
        objects.append(len(scene.objects))
        largest.append(scene.graph.largest_stack_fraction())
        kinds.update(o.object_class.name for o in scene.objects)
        forms.add(canonical_form(scene.graph, classes))
        if verdict.instability is None:
            stable += 1
            hidden.append(len(verdict.hidden))
        else:
            reasons[verdict.instability.reason.value] += 1
    count = len(stacks)
    shares = np.array([*kinds.values()]) / kinds.total()
    solved = sum(answer is Solvability.SOLVABLE for answer in solvable or ())
    return {
        "nodes": job.nodes,
        "count": count,
        "stability_rate": stable / count,
        "stability_ci95": wilson_interval(stable, count),
        "hidden_mean": float(np.mean(hidden)) if hidden else None,
        "hidden_ci95": mean_interval(hidden),
        "solvable_share": solved / stable if solvable and stable else None,
        "solvable_ci95": wilson_interval(solved, stable) if solvable and stable else None,
        "distinct_share": len(forms) / count,
        "mean_stacks": float(np.mean(stacks)),
        "mean_objects": float(np.mean(objects)),
        "largest_stack_share": float(np.mean(largest)),
        "balanced_share": float(np.mean(np.array(largest) <= MAX_BALANCED_STACK_FRACTION)),
        "class_entropy": float(-(shares * np.log2(shares)).sum()),
        "classes": dict(sorted(kinds.items())),
        "instability_reasons": dict(reasons.most_common()),
        "agent": job.agent,
        "temperature": job.temperature,
        "objects": job.objects,
        "seed": job.seed,
    }
