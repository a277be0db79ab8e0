"""Scene generation: reproducibility, agents, and the summary of a batch."""

from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import CLASSES, DEFAULT_CELL, GRAMMARS, rng, world_with

from drake_clutter.agents.generators import (
    GenerationAgent,
    GenerationJob,
    HillClimber,
    RandomGenerator,
    SceneGenerator,
    make_generation_agent,
    summarize_scenes,
)
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Derivation, NodeBudget
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.layout import lay_out
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import scene_to_dict
from drake_clutter.statistics import mean_interval, wilson_interval
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig
from drake_clutter.tasks.oracle_search import Solvability
from drake_clutter.workers.parallel_map import map_ordered


def job(nodes: int = 10, seed: int = 5) -> GenerationJob:
    return GenerationJob("random", "ycb7", None, nodes, seed, ClutterConfig())


def batch(which: GenerationJob, count: int, workers: int = 1) -> list[str]:
    """Return the scenes with their verdicts, as scene files."""
    made = map_ordered(partial(SceneGenerator, which), range(count), workers=workers)
    return [
        yaml.dump(scene_to_dict(generated.scene, DEFAULT_CELL, generated.verdict))
        for generated in made
    ]


def test_scenes_do_not_depend_on_the_number_of_workers() -> None:
    alone = batch(job(), 4)
    assert batch(job(), 4, workers=2) == alone
    assert len(set(alone)) == 4


def test_a_scene_depends_only_on_its_index() -> None:
    """The order of generation does not matter."""
    generator, other = SceneGenerator(job(6)), SceneGenerator(job(6))
    forwards = [generator(index) for index in (0, 1, 2)]
    backwards = [other(index) for index in (2, 1, 0)][::-1]
    for one, same in zip(forwards, backwards, strict=True):
        assert one.scene.objects == same.scene.objects
        assert one.verdict == same.verdict
        assert one.layout_failures == same.layout_failures
        assert one.scene.graph is not None
        assert len(one.scene.graph) == 6
    assert SceneGenerator(job(6, seed=6))(0).scene.objects != forwards[0].scene.objects


def test_graphs_that_cannot_be_laid_out_are_counted_and_replaced() -> None:
    """Few graphs can be laid out on a tray of 0.3 m."""
    world = world_with("layout.tray_side=0.30", "layout.max_stack_height=0.25")
    generator = SceneGenerator(GenerationJob("random", "ycb7", None, 7, 1, world))
    made = [generator(index) for index in range(4)]
    failures = sum((m.layout_failures for m in made), start=Counter())
    assert set(failures) <= {"no room on the tray", "stack too high"}
    assert failures.total() > 0
    for m in made:
        assert max(o.top_height for o in m.scene.objects) <= 0.25


def test_the_random_generator_is_uniform_over_feasible_rules() -> None:
    """After the first rule, three rules are feasible if nodes remain."""
    grammar = GRAMMARS["ycb7"]
    generator = rng(0)
    second = Counter(
        RandomGenerator().derive(grammar, NodeBudget(8), generator).rules[1] for _ in range(600)
    )
    assert set(second) == {"drop_object", "stack_object", "end"}
    assert min(second.values()) > 200 - 4 * 11.5  # four standard deviations


def test_stable_scenes_have_a_solvability() -> None:
    made = [SceneGenerator(job(12))(index) for index in range(6)]
    assert {m.verdict.stable for m in made} == {True, False}
    for m in made:
        assert (m.solvability is None) == (not m.verdict.stable)
        if m.verdict.stable and not m.verdict.hidden:
            assert m.solvability is Solvability.SOLVABLE


def test_the_hill_climber_hides_more_objects_than_the_random_generator() -> None:
    grammar, config = GRAMMARS["ycb7"], ClutterConfig()
    environment = ClutterGeneration(
        list(grammar.classes.values()), GenerationTaskConfig(nodes=12), config
    )

    def worth(agent: GenerationAgent, seed: int) -> float:
        environment.reset(seed=0)
        total, over = 0.0, False
        for name in agent.derive(grammar, NodeBudget(12), rng(seed)).rules:
            if not over:
                _, reward, over, _, _ = environment.step(environment.grammar.rule_indices[name])
                total += float(reward)
        assert over
        return total

    climbed = [worth(HillClimber(config), seed) for seed in range(5)]
    chance = [worth(RandomGenerator(), seed) for seed in range(20)]
    assert np.mean(climbed) > np.mean(chance) + 1.0
    assert min(climbed) > 0


def test_invalid_agents_are_rejected() -> None:
    for name, temperature, named in (
        ("clever", None, "clever"),
        ("none.safetensors", None, "none.safetensors"),
        ("random", 0.5, "temperature"),
        ("sg-star", -1.0, "temperature"),
    ):
        with pytest.raises(InputError, match=named):
            make_generation_agent(name, ClutterConfig(), temperature)


# --- Figures ---


def laid_out(*rules: str) -> Scene:
    scene = lay_out(
        Derivation(GRAMMARS["ycb7"].replay(rules), rules), CLASSES, ClutterConfig(), rng()
    )
    assert isinstance(scene, Scene)
    return scene


def test_summary_of_a_small_batch() -> None:
    can, box = (
        ("drop_object", "end", f"insert_{name}") for name in ("tomato_soup_can", "sugar_box")
    )
    scenes = [
        laid_out(*can, "orient_flat_0", *box, "orient_side_0"),  # two stacks, two objects
        laid_out(
            *box, "orient_side_0", *can, "orient_upright_90"
        ),  # the same graph: a can is symmetric
        laid_out("drop_object", "end", "insert_meta_sugar_box_1"),  # one stack of two objects
        laid_out(
            "drop_object",
            "stack_object",
            "end",
            "insert_meta_sugar_box_2",
            "insert_cracker_box",
            "orient_flat_0",
        ),
    ]
    slid = Instability(InstabilityReason.SLID, "sugar_box_3", 0.02, 0.0)
    verdicts = [
        Verdict(None, {}, {}, ("a", "b")),
        Verdict(None, {}, {}, ()),
        Verdict(slid, {}, {}, ()),
        Verdict(None, {}, {}, ("c",)),
    ]
    answers = [Solvability.SOLVABLE, Solvability.UNDECIDED, None, Solvability.SOLVABLE]
    summary = summarize_scenes(job(), list(zip(scenes, verdicts, strict=True)), answers)
    assert summary.pop("solvable_ci95") == pytest.approx(wilson_interval(2, 3))
    assert summary.pop("largest_stack_share") == pytest.approx((0.5 + 0.5 + 1 + 1) / 4)
    assert summary.pop("class_entropy") == pytest.approx(
        -sum(n / 9 * np.log2(n / 9) for n in (6, 2, 1))
    )
    low, high = summary.pop("stability_ci95")
    assert (low, high) == pytest.approx((0.3006, 0.9544), abs=5e-5)
    # A graph of 10 nodes has at most 8 objects, beside the tray and an end.
    assert summary.pop("hidden_ci95") == mean_interval([2, 0, 1], 0, 8)
    assert summary == {
        "nodes": 10,
        "count": 4,
        "stability_rate": 0.75,
        "hidden_mean": 1.0,  # over the three that are stable
        "solvable_share": 2 / 3,
        "balanced_share": 0.5,
        "classes": {"cracker_box": 1, "sugar_box": 6, "tomato_soup_can": 2},
        "absent_classes": ["pudding_box", "gelatin_box", "master_chef_can", "large_marker"],
        "distinct_share": 0.75,
        "mean_stacks": (2 + 2 + 1 + 1) / 4,
        "mean_objects": (2 + 2 + 2 + 3) / 4,
        "instability_reasons": {"slid": 1},
        "agent": "random",
        "temperature": None,
        "objects": "ycb7",
        "seed": 5,
    }


def test_summary_of_a_batch_without_stable_scenes() -> None:
    scene = laid_out("drop_object", "end", "insert_sugar_box", "orient_flat_0")
    toppled = Verdict(Instability(InstabilityReason.TOPPLED, "sugar_box_1", 0.0, 1.0), {}, {}, ())
    summary = summarize_scenes(job(), [(scene, toppled)])
    assert (summary["stability_rate"], summary["hidden_mean"], summary["hidden_ci95"]) == (
        0.0,
        None,
        None,
    )
    assert (summary["solvable_share"], summary["solvable_ci95"]) == (None, None)


def test_graphs_that_do_not_fit_are_refused_by_means_of_random_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A graph of the hill climber takes a hundred times as long as a random one."""
    derived = list[Derivation]()
    derive = HillClimber.derive

    def counted(*arguments: Any) -> Derivation:
        derived.append(derive(*arguments))
        return derived[-1]

    monkeypatch.setattr(HillClimber, "derive", counted)
    world = world_with("cell.support.size=[0.2,0.2]")
    generator = SceneGenerator(GenerationJob("hill-climbing", "ycb7", None, 16, 5, world))
    with pytest.raises(InputError, match=r"nodes: 16; 300 graphs in a row could not be laid out"):
        generator.lay_out(rng())
    assert len(derived) == 1
