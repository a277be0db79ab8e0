"""Trained scene generators: checkpoints, other object sets and generation jobs."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import GRAMMARS, rng

from drake_clutter.agents.generators import GenerationJob, SceneGenerator, make_generation_agent
from drake_clutter.agents.graph_network import RuleQNetwork
from drake_clutter.agents.learned_generator import (
    LearnedGenerator,
    load_rule_network,
    rule_network_metadata,
)
from drake_clutter.agents.replay_buffer import collate
from drake_clutter.agents.soft_q import SoftQConfig
from drake_clutter.commands.generate_scenes import generate_scenes
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import NodeBudget, canonical_form
from drake_clutter.learning.checkpoint import load_checkpoint, save_checkpoint
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.generation_task import (
    ClutterGeneration,
    GenerationTaskConfig,
    GraphVocabulary,
)

WIDTH = 8


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """Checkpoint of an untrained network for the seven YCB objects."""
    grammar = GRAMMARS["ycb7"]
    torch.manual_seed(0)
    vocabulary = GraphVocabulary.from_grammar(grammar)
    network = RuleQNetwork(
        len(vocabulary.node_kinds), len(vocabulary.edge_kinds), len(grammar.rules), WIDTH
    )
    config = {"task": asdict(GenerationTaskConfig()), "learning": asdict(SoftQConfig())}
    path = tmp_path / "untrained.safetensors"
    metadata = {
        "kind": "generator",
        "network": rule_network_metadata(grammar, WIDTH),
        "temperature": 0.3,
        "config": config,
    }
    save_checkpoint(path, network, metadata)
    return path


@pytest.mark.parametrize("nodes", [7, 12, 30])
def test_derived_graphs_are_terminal_and_of_the_given_size(checkpoint: Path, nodes: int) -> None:
    agent, grammar = LearnedGenerator(checkpoint, ClutterConfig()), GRAMMARS["ycb7"]
    derived = [agent.derive(grammar, NodeBudget(nodes), rng(seed)) for seed in (0, 0, 1)]
    assert all(
        derivation.graph.is_terminal and len(derivation.graph) == nodes for derivation in derived
    )
    assert derived[0].rules == derived[1].rules != derived[2].rules


def test_a_low_temperature_gives_a_deterministic_policy(checkpoint: Path) -> None:
    grammar = GRAMMARS["ycb7"]
    cold, hot = (
        LearnedGenerator(checkpoint, ClutterConfig(), temperature) for temperature in (1e-6, 10.0)
    )
    assert len({cold.derive(grammar, NodeBudget(8), rng(seed)).rules for seed in range(5)}) == 1
    assert len({hot.derive(grammar, NodeBudget(8), rng(seed)).rules for seed in range(5)}) == 5


def test_a_generation_job_accepts_a_checkpoint(checkpoint: Path) -> None:
    job = GenerationJob(str(checkpoint), "ycb7", None, nodes=6, seed=1, config=ClutterConfig())
    first, again = SceneGenerator(job)(0), SceneGenerator(job)(0)
    assert first.scene.objects == again.scene.objects
    assert first.scene.graph is not None
    assert len(first.scene.graph) == 6


def test_unknown_object_classes_are_rejected(checkpoint: Path) -> None:
    with pytest.raises(InputError, match="was not trained with"):
        LearnedGenerator(checkpoint, ClutterConfig()).derive(
            GRAMMARS["pantry14"], NodeBudget(6), rng()
        )


def test_a_refused_agent_leaves_no_output_folder(checkpoint: Path, tmp_path: Path) -> None:
    job = GenerationJob(str(checkpoint), "pantry14", None, nodes=6, seed=1, config=ClutterConfig())
    out = tmp_path / "scenes"
    with pytest.raises(InputError, match="was not trained with"):
        generate_scenes(job, 1, out, 1, lambda scenes, done, total: scenes)
    assert not out.exists()


def test_other_checkpoints_are_rejected(checkpoint: Path) -> None:
    metadata = load_checkpoint(checkpoint).metadata
    save_checkpoint(checkpoint, torch.nn.Linear(1, 1), metadata | {"kind": "explorer"})
    with pytest.raises(InputError, match="another kind"):
        LearnedGenerator(checkpoint, ClutterConfig())
    checkpoint.write_bytes(b"broken")
    with pytest.raises(InputError, match="cannot be read"):
        LearnedGenerator(checkpoint, ClutterConfig())


def test_a_warm_start_with_more_objects_keeps_the_learned_values(checkpoint: Path) -> None:
    """For graphs of the old objects, the values of the old rules are unchanged."""
    small, large = GRAMMARS["ycb7"], GRAMMARS["pantry14"]
    loaded = load_checkpoint(checkpoint)
    old, new = (load_rule_network(loaded, grammar) for grammar in (small, large))
    environments = [
        ClutterGeneration(list(g.classes.values()), GenerationTaskConfig(nodes=12))
        for g in (small, large)
    ]
    both = [large.rule_indices[rule.name] for rule in small.rules]
    generator = rng(3)
    for episode in range(5):
        (one, info), (other, _) = (environment.reset(seed=episode) for environment in environments)
        terminated = False
        while not terminated:
            torch.testing.assert_close(new(collate([other]))[:, both], old(collate([one])))
            action = int(generator.choice(np.flatnonzero(info["action_mask"])))
            one, _, terminated, _, info = environments[0].step(action)
            other, *_ = environments[1].step(both[action])


@pytest.mark.parametrize(
    ("name", "objects", "hidden"), [("sg-star", "ycb7", 8.0), ("sg-14", "pantry14", 7.0)]
)
def test_shipped_agents_hide_objects_in_stable_stacks(
    name: str, objects: str, hidden: float, static_judge: StaticStabilityJudge
) -> None:
    """Stability and hidden objects are those of the static judge."""
    agent, grammar, generator = (
        make_generation_agent(name, ClutterConfig()),
        GRAMMARS[objects],
        rng(3),
    )
    counts, forms = list[int](), set[object]()
    for _ in range(16):
        derivation = agent.derive(grammar, NodeBudget(25), generator)
        forms.add(canonical_form(derivation.graph, grammar.classes))
        scene = lay_out(derivation, grammar.classes, ClutterConfig(), generator)
        if isinstance(scene, LayoutFailure):
            continue
        verdict = static_judge.judge(scene, generator)
        if isinstance(verdict, Verdict) and verdict.stable:
            counts.append(len(verdict.hidden))
    assert len(counts) >= 11
    assert np.mean(counts) > hidden
    assert len(forms) == 16
