"""Generating scenes: an agent derives graphs, they are laid out and judged."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.stats import norm

from drake_clutter.catalogue import load_catalogue
from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Derivation, NodeBudget, SceneGrammar, canonical_form, uniform_choice
from drake_clutter.runner import item_rng
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.seams import Verdict
from drake_clutter.simulation.judge import DrakeJudge

LAYOUT_TRIES = 1000
"""Graphs in a row that may fail to be laid out before the budget is called too large for the tray."""


class GenerationAgent(Protocol):
    """Derives terminal graphs."""

    def derive(self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator) -> Derivation:
        """A terminal graph within the budget."""


class RandomGenerator:
    """RG: uniform over the feasible rules, the first match of the rule that is drawn (SPEC section 3)."""

    def derive(self, grammar: SceneGrammar, budget: NodeBudget, rng: np.random.Generator) -> Derivation:
        """See `GenerationAgent.derive`."""
        return grammar.derive(budget, uniform_choice(rng))


GENERATION_AGENTS: dict[str, type[RandomGenerator]] = {"random": RandomGenerator}


@dataclass(frozen=True)
class GenerationJob:
    """Everything that decides what a batch of scenes looks like, scene by scene.

    Attributes:
        agent: one of `GENERATION_AGENTS`.
        objects: name of an object set.
        catalogue_folder: a user's asset folder, or None.
        nodes: exact size of the graphs.
        seed: of the batch.
        config: the world.
    """

    agent: str
    objects: str
    catalogue_folder: Path | None
    nodes: int
    seed: int
    config: ClutterConfig


@dataclass(frozen=True)
class GeneratedScene:
    """One scene of a batch.

    Attributes:
        scene: as laid out.
        verdict: the judge's.
        layout_failures: graphs that were drawn before it and could not be laid out, by reason.
    """

    scene: Scene
    verdict: Verdict
    layout_failures: Counter[str]


class SceneGenerator:
    """Makes scene after scene of a job; a worker for the runner."""

    def __init__(self, job: GenerationJob) -> None:
        self._job = job
        self._grammar = SceneGrammar(load_catalogue(job.catalogue_folder).object_set(job.objects))
        self._budget = NodeBudget(job.nodes)
        self._agent: GenerationAgent = GENERATION_AGENTS[job.agent]()
        self._judge = DrakeJudge(job.config)

    def __call__(self, index: int) -> GeneratedScene:
        """The scene of an index, judged; it depends on nothing but the job and the index."""
        rng = item_rng(self._job.seed, index)
        scene, failures = self.lay_out(rng)
        return GeneratedScene(scene, self._judge.judge(scene, rng), failures)

    def lay_out(self, rng: np.random.Generator) -> tuple[Scene, Counter[str]]:
        """A scene as laid out, and why the graphs drawn before it could not be."""
        failures: Counter[str] = Counter()
        for _ in range(LAYOUT_TRIES):
            derivation = self._agent.derive(self._grammar, self._budget, rng)
            scene = lay_out(derivation, self._grammar.classes, self._job.config.layout, rng, self._job.seed)
            if not isinstance(scene, LayoutFailure):
                return scene, failures
            failures[scene.reason.value] += 1
        raise RuntimeError(f"{LAYOUT_TRIES} graphs of {self._job.nodes} nodes in a row could not be laid out: {dict(failures)}")


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """95 % confidence interval of a proportion (Wilson 1927)."""
    if count == 0:
        return 0.0, 1.0
    z = float(norm.ppf(0.975))
    share = successes / count
    centre = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * float(np.sqrt(share * (1 - share) / count + z * z / (4 * count * count)))
    return max(0.0, centre - half), min(1.0, centre + half)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """95 % confidence interval of a mean, by the normal approximation; None for fewer than two values."""
    if len(values) < 2:
        return None
    half = float(norm.ppf(0.975) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return float(np.mean(values)) - half, float(np.mean(values)) + half


def summarise(job: GenerationJob, scenes: Iterable[tuple[Scene, Verdict]]) -> dict[str, Any]:
    """The figures of a batch: stability over all scenes, hidden objects over the stable ones (SPEC section 6)."""
    classes = load_catalogue(job.catalogue_folder).classes
    stable, hidden, stacks, forms, objects = 0, [], [], set(), []
    reasons: Counter[str] = Counter()
    for scene, verdict in scenes:
        assert scene.graph is not None
        stacks.append(len(scene.graph.stacks()))
        objects.append(len(scene.objects))
        forms.add(canonical_form(scene.graph, classes))
        if verdict.instability is None:
            stable += 1
            hidden.append(len(verdict.hidden))
        else:
            reasons[verdict.instability.reason.value] += 1
    count = len(stacks)
    return {
        "nodes": job.nodes,
        "count": count,
        "stability_rate": stable / count,
        "stability_ci95": wilson_interval(stable, count),
        "hidden_mean": float(np.mean(hidden)) if hidden else None,
        "hidden_ci95": mean_interval(hidden),
        "distinct_share": len(forms) / count,
        "mean_stacks": float(np.mean(stacks)),
        "mean_objects": float(np.mean(objects)),
        "instability_reasons": dict(reasons.most_common()),
        "agent": job.agent,
        "objects": job.objects,
        "seed": job.seed,
    }
