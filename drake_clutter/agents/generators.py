"""Scene generation: agents derive graphs, which are laid out and judged.

The agents are the random generator (RG) and the trained generators (SG) of Kumar et al. 2022, and a
hill climber (HC).
"""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
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
"""Maximum number of moves that are evaluated to decide whether a scene is solvable."""
MAX_LAYOUT_ATTEMPTS = 300
"""Maximum number of graphs in a row that cannot be laid out.

More failures mean that graphs of this size do not fit on the support.
"""


class GenerationAgent(Protocol):
    """An agent that derives terminal graphs."""

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """Derive a terminal graph.

        Args:
            grammar: The scene grammar.
            budget: Size of the graph.
            rng: Random generator.
        """


PRETRAINED_GENERATORS = {
    "sg": "training/checkpoints/sg.safetensors",
    "sg-star": "training/checkpoints/sg_star.safetensors",
    "sg-14": "training/checkpoints/sg_14.safetensors",
}
"""Checkpoints that ship with the package, by the name of the agent."""


class RandomGenerator:
    """Samples uniformly among the feasible rules (RG; a `GenerationAgent`).

    A rule is applied to its first match.
    """

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """Derive a terminal graph; see `GenerationAgent`."""
        return grammar.derive(budget, uniform_choice(rng))


class HillClimber:
    """Improves a random graph by re-deriving its end (HC; a `GenerationAgent`).

    Each candidate repeats the best derivation up to a random rule and continues with random rules.
    It replaces the best one if its reward in `ClutterGeneration` is not lower. Nothing is learned
    from one scene to the next.
    """

    NUM_CANDIDATES = 150
    """Number of graphs that are derived for each scene."""

    def __init__(self, config: ClutterConfig) -> None:
        """Create an agent.

        Args:
            config: Configuration of the simulated world.
        """
        self._config = config
        self._judge = StaticStabilityJudge(config, margin=GenerationTaskConfig().contact_margin)

    def derive(
        self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator
    ) -> Derivation:
        """Derive a terminal graph; see `GenerationAgent`."""
        task = GenerationTaskConfig(nodes=budget.nodes)
        best: Derivation | None = None
        best_reward = -np.inf
        for _ in range(self.NUM_CANDIDATES):
            partial = PartialScene(grammar, task, self._config, self._judge)
            kept_rules = best.rules[: rng.integers(len(best.rules))] if best else ()
            for name in kept_rules:
                partial.apply(grammar.rule_indices[name])
            while not partial.finished:
                partial.apply(int(rng.choice(np.flatnonzero(partial.action_mask))))
            reward = task.instability_reward
            if not partial.failure:
                reward = partial.terminal_reward(partial.num_hidden)
            if reward >= best_reward:
                best = Derivation(partial.graph, tuple(partial.rules))
                best_reward = reward
        assert best is not None
        return best


def make_generation_agent(
    name: str,
    config: ClutterConfig,
    temperature: float | None = None,
    classes: Collection[str] = (),
) -> GenerationAgent:
    """Return a generation agent.

    Args:
        name: `random`, `hill-climbing`, one of `PRETRAINED_GENERATORS`, or the file of a
            checkpoint.
        config: Configuration of the simulated world.
        temperature: Temperature of a trained agent's softmax; None selects that of its checkpoint.
        classes: Names of the object classes that will occur, as far as they are known.

    Raises:
        InputError: The agent is unknown, the file is not a checkpoint of a scene generator, a
            temperature is given for an agent without one, or the agent was not trained with one of
            the classes.
    """
    is_learned = name in PRETRAINED_GENERATORS or name.endswith(".safetensors")
    if temperature is not None and not (is_learned and temperature > 0):
        raise InputError(
            f"--temperature {temperature:g} for {name}; "
            "expected a positive one, for a trained agent"
        )
    if name == "random":
        return RandomGenerator()
    if name == "hill-climbing":
        return HillClimber(config)
    if not is_learned:
        raise InputError(
            f"--agent {name}; expected random, hill-climbing, "
            f"{', '.join(PRETRAINED_GENERATORS)}, or a .safetensors file"
        )
    path = checkpoint_path(name, PRETRAINED_GENERATORS)
    # Imported late: needs PyTorch, which is not required for the other agents.
    from drake_clutter.agents.learned_generator import LearnedGenerator

    agent = LearnedGenerator(path, config, temperature)
    agent.require_classes(classes)
    return agent


@dataclass(frozen=True)
class GenerationJob:
    """All parameters that determine the scenes of a batch.

    Attributes:
        agent: See `make_generation_agent`.
        objects: Name of the object set.
        catalog_folder: Folder with additional object classes, or None.
        nodes: Number of nodes of each graph.
        seed: Seed of the batch.
        config: Configuration of the simulated world.
        temperature: See `make_generation_agent`.
    """

    agent: str
    objects: str
    catalog_folder: Path | None
    nodes: int
    seed: int
    config: ClutterConfig
    temperature: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON, with the hash of a trained agent's weights."""
        folder = str(self.catalog_folder.resolve()) if self.catalog_folder else None
        weights_hash = checkpoint_sha256(self.agent, PRETRAINED_GENERATORS)
        weights = {"weights": weights_hash} if weights_hash else {}
        return {**to_plain(self), **weights, "catalog_folder": folder}


@dataclass(frozen=True)
class GeneratedScene:
    """One scene of a batch.

    Attributes:
        scene: The scene as laid out.
        verdict: Verdict of the judge.
        layout_failures: Number of graphs, derived before this one, that could not be laid out, by
            reason.
        solvability: Result of the oracle search in the settled scene; None for an unstable scene.
    """

    scene: Scene
    verdict: Verdict
    layout_failures: Counter[str]
    solvability: Solvability | None


class SceneGenerator:
    """Generates the scenes of a job by their index; a worker for `map_ordered`."""

    def __init__(self, job: GenerationJob) -> None:
        """Create a generator.

        Args:
            job: The batch.
        """
        self._job = job
        self._grammar = SceneGrammar(load_catalog(job.catalog_folder).object_set(job.objects))
        self._budget = NodeBudget(job.nodes)
        self._agent: GenerationAgent = make_generation_agent(job.agent, job.config, job.temperature)
        self._random_agent = RandomGenerator()
        self._has_room = False
        self._judge = DrakeJudge(job.config)
        self._search = OracleSearch(job.config)

    def __call__(self, index: int) -> GeneratedScene:
        """Generate and judge a scene that depends only on the job and an index."""
        scene, verdict, failures = self.generate(index)
        solvability = None
        if verdict.stable:
            result = self._search.solve(
                scene.with_poses(verdict.settled), self._job.seed, SEARCH_BUDGET, optimal=False
            )
            solvability = result.solvability
        return GeneratedScene(scene, verdict, failures, solvability)

    def generate(self, index: int) -> tuple[Scene, Verdict, Counter[str]]:
        """Return the scene of an index, its verdict, and the layout failures before it."""
        rng = item_rng(self._job.seed, index)
        scene, failures = self.lay_out(rng)
        return scene, self._judge.judge(scene, rng), failures

    def lay_out(self, rng: np.random.Generator) -> tuple[Scene, Counter[str]]:
        """Derive graphs until one can be laid out.

        Args:
            rng: Random generator.

        Returns:
            The scene, and the number of graphs before it that could not be laid out, by reason.

        Raises:
            InputError: `MAX_LAYOUT_ATTEMPTS` graphs in a row could not be laid out.
        """
        return self._lay_out(self._agent, rng)

    def _lay_out(
        self, agent: GenerationAgent, rng: np.random.Generator
    ) -> tuple[Scene, Counter[str]]:
        """Derive graphs of an agent until one can be laid out, see `lay_out`."""
        failures: Counter[str] = Counter()
        for _ in range(MAX_LAYOUT_ATTEMPTS):
            derivation = agent.derive(self._grammar, self._budget, rng)
            scene = lay_out(
                derivation, self._grammar.classes, self._job.config, rng, self._job.seed
            )
            if not isinstance(scene, LayoutFailure):
                return scene, failures
            failures[scene.reason.value] += 1
            if agent is not self._random_agent and not self._has_room:
                # A graph of another agent takes up to seconds, a random one milliseconds.
                self._lay_out(self._random_agent, item_rng(self._job.seed))
                self._has_room = True
        reasons = ", ".join(f"{count} times {reason}" for reason, count in failures.items())
        raise InputError(
            f"nodes: {self._job.nodes}; {MAX_LAYOUT_ATTEMPTS} graphs in a row could not be laid "
            f"out ({reasons}); expected fewer nodes, or a larger support"
        )


def summarize_scenes(
    job: GenerationJob,
    scenes: Iterable[tuple[Scene, Verdict]],
    solvable: Sequence[Solvability | None] | None = None,
) -> dict[str, Any]:
    """Return the statistics of a batch, as `summary.json` stores them.

    The numbers of hidden objects and the solvable fraction are taken over the stable scenes, all
    others over all scenes. `largest_stack_share` is the mean fraction of a scene's objects that are
    in its largest stack; `balanced_share` is the fraction of scenes in which that is at most
    `MAX_BALANCED_STACK_FRACTION`; `class_entropy` is the entropy of the classes of all objects
    [bit]; `absent_classes` are the classes of the object set that no scene has. Keys that end in
    `ci95` hold 95 % confidence intervals: those of Wilson for rates, that of Gaffke for the mean
    (`drake_clutter.statistics`).

    Args:
        job: The batch.
        scenes: The scenes and their verdicts.
        solvable: Results of the oracle search; None if it was not run.
    """
    catalog = load_catalog(job.catalog_folder)
    classes = catalog.classes
    num_stable = 0
    num_hidden = list[int]()
    num_stacks = list[int]()
    num_objects = list[int]()
    largest_stack_fractions = list[float]()
    canonical_forms = set[Any]()
    reasons: Counter[str] = Counter()
    class_counts: Counter[str] = Counter()
    for scene, verdict in scenes:
        assert scene.graph is not None
        num_stacks.append(len(scene.graph.stack_bases()))
        num_objects.append(len(scene.objects))
        largest_stack_fractions.append(scene.graph.largest_stack_fraction())
        class_counts.update(o.object_class.name for o in scene.objects)
        canonical_forms.add(canonical_form(scene.graph, classes))
        if verdict.instability is None:
            num_stable += 1
            num_hidden.append(len(verdict.hidden))
        else:
            reasons[verdict.instability.reason.value] += 1
    count = len(num_stacks)
    class_fractions = np.array([*class_counts.values()]) / class_counts.total()
    num_solvable = sum(result is Solvability.SOLVABLE for result in solvable or ())
    has_solvable = bool(solvable and num_stable)
    is_balanced = np.array(largest_stack_fractions) <= MAX_BALANCED_STACK_FRACTION
    return {
        "nodes": job.nodes,
        "count": count,
        "stability_rate": num_stable / count,
        "stability_ci95": wilson_interval(num_stable, count),
        "hidden_mean": float(np.mean(num_hidden)) if num_hidden else None,
        "hidden_ci95": mean_interval(num_hidden, 0, job.nodes - 2),  # tray, end
        "solvable_share": num_solvable / num_stable if has_solvable else None,
        "solvable_ci95": wilson_interval(num_solvable, num_stable) if has_solvable else None,
        "distinct_share": len(canonical_forms) / count,
        "mean_stacks": float(np.mean(num_stacks)),
        "mean_objects": float(np.mean(num_objects)),
        "largest_stack_share": float(np.mean(largest_stack_fractions)),
        "balanced_share": float(np.mean(is_balanced)),
        "class_entropy": float(-(class_fractions * np.log2(class_fractions)).sum()),
        "classes": dict(sorted(class_counts.items())),
        "absent_classes": [
            object_class.name
            for object_class in catalog.object_set(job.objects)
            if object_class.name not in class_counts
        ],
        "instability_reasons": dict(reasons.most_common()),
        "agent": job.agent,
        "temperature": job.temperature,
        "objects": job.objects,
        "seed": job.seed,
    }
