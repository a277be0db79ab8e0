"""Soft Q-learning: policy, values and targets, a small grammar, and resumed trainings."""

import json
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import rng, training_script

from drake_clutter.agents.generators import make_generation_agent
from drake_clutter.agents.replay_buffer import ReplayBuffer
from drake_clutter.agents.soft_q import (
    SoftQConfig,
    SoftQLearner,
    action_probabilities,
    retrace_targets,
    sample_episodes,
    sample_softmax_actions,
    soft_value,
)
from drake_clutter.assets import build_assets
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import NodeBudget, SceneGrammar
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig

CPU = torch.device("cpu")
SMALL = SoftQConfig(
    total_timesteps=400, num_envs=4, batch_size=16, buffer_size=200, learning_starts=60, width=8
)
SCRIPT = Path(__file__).parents[1] / "training" / "train_generator.py"


def small_environment() -> ClutterGeneration:
    return ClutterGeneration(task=GenerationTaskConfig(nodes=6))


def test_actions_follow_the_softmax() -> None:
    values = np.array([0.3, 0.1, 0.7, 9.0], np.float32)
    mask = np.array([True, True, True, False])
    drawn = sample_softmax_actions(
        np.tile(values, (40_000, 1)), np.tile(mask, (40_000, 1)), 0.2, rng(0)
    )
    expected = np.exp(values[:3] / 0.2) / np.exp(values[:3] / 0.2).sum()
    assert np.bincount(drawn, minlength=4)[:3] / 40_000 == pytest.approx(expected, abs=0.01)
    assert (drawn != 3).all()


def test_the_soft_value() -> None:
    values = torch.tensor([[1.0, 2.0, 5.0], [1.0, 1.0, 1.0]])
    mask = torch.tensor([[True, True, False], [False, False, False]])
    expected = 0.5 * np.log((np.exp(2.0) + np.exp(4.0)) / 2)
    torch.testing.assert_close(
        soft_value(values, mask, 0.5), torch.tensor([expected, 0.0], dtype=torch.float32)
    )


def test_retrace_targets() -> None:
    """Two sequences of two steps; the first step of the second one ends an episode."""
    values = torch.tensor([[[1.0, 2.0, 9.0], [0.5, 1.0, 0.0], [3.0, 1.0, 2.0]]] * 2)
    mask = torch.tensor([[[True, True, False], [True, True, True], [False, True, False]]] * 2)
    action = torch.tensor([[0, 2, 1]] * 2)
    reward = torch.tensor([[0.1, 0.2, 7.0]] * 2)
    terminated = torch.tensor([[False, False, False], [True, False, False]])
    v1 = 0.5 * np.log((np.exp(1.0) + np.exp(2.0) + np.exp(0.0)) / 3)
    second = 0.2 + 1.0  # the third state has one feasible action
    policy = float(np.exp((0.0 - v1) / 0.5)) / 3
    for retrace_lambda, behavior_prob, passed_on in (
        (0.0, 0.3, 0.0),
        (0.5, policy / 2, 0.5),
        (1.0, policy, 1.0),
        (1.0, 4 * policy, 0.25),
    ):
        found = retrace_targets(
            values,
            mask,
            action,
            torch.full((2, 3), behavior_prob),
            reward,
            terminated,
            0.5,
            retrace_lambda,
        )
        expected = [[0.1 + v1 + passed_on * (second - 0.0), second], [0.1, second]]
        torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float32))


def test_action_probabilities_are_those_of_the_sampling() -> None:
    values, mask = (
        np.array([[0.3, 0.1, 0.7, 9.0]], np.float32),
        np.array([[True, True, True, False]]),
    )
    given = [action_probabilities(values, mask, np.array([action]), 0.2)[0] for action in range(3)]
    expected = np.exp(values[0, :3] / 0.2) / np.exp(values[0, :3] / 0.2).sum()
    assert given == pytest.approx(expected.tolist())


def test_sampled_sequences_are_consecutive_steps_of_the_buffer() -> None:
    example, _ = small_environment().reset(seed=0)
    replay = ReplayBuffer(capacity=60, num_envs=4, observation=example, num_actions=5)
    generator, seen = rng(0), set[int]()
    assert replay.sample_sequences(3, 4, generator) is None
    for moment in range(40):  # the ring of 15 is filled more than twice
        step = {
            name: np.repeat(array[None], 4, axis=0)
            for name, array in example.items()
            if name in replay.arrays
        }
        numbers = 10 * moment + np.arange(4)
        replay.add(
            **step,
            action_mask=np.ones((4, 5), bool),
            action=numbers,
            behavior_prob=np.ones(4, np.float32),
            reward=numbers.astype(np.float32),
            terminated=numbers % 3 == 0,
        )
        if moment >= 5:
            sequences = replay.sample_sequences(50, 4, generator)
            assert sequences is not None
            assert sequences["action_mask"].shape == (50, 5, 5)
            assert (np.diff(sequences["action"], axis=1) == 10).all()
            assert (sequences["action"] == sequences["reward"]).all()
            assert sequences["action"].max() <= 10 * moment + 3
            assert sequences["action"].min() >= 10 * max(0, moment - 14)
            seen |= set(sequences["action"].ravel().tolist())
    assert seen <= {10 * moment + k for moment in range(40) for k in range(4)}
    assert len(seen) >= 150


def test_a_small_grammar_is_learned() -> None:
    """Graphs of five nodes have at most three objects in a stack, which hides two of them."""
    config = SoftQConfig(
        total_timesteps=8_000,
        num_envs=16,
        batch_size=64,
        train_frequency=8,
        buffer_size=8_000,
        learning_starts=500,
        temperature=0.02,
    )

    def environment() -> ClutterGeneration:
        return ClutterGeneration(task=GenerationTaskConfig(nodes=5))

    learner = SoftQLearner(environment, config, 0, CPU)

    def mean_score(temperature: float) -> float:
        return float(
            np.mean(
                [
                    episode.episodic_return
                    for episode in sample_episodes(
                        learner.network, environment, 100, temperature, 7
                    )
                ]
            )
        )

    by_chance = mean_score(1e6)
    while learner.step < config.total_timesteps:
        learner.train_iteration()
    assert by_chance < 0.4
    assert mean_score(config.temperature) > 0.8


def state_of(learner: SoftQLearner) -> list[torch.Tensor]:
    return [value.clone() for value in learner.network.state_dict().values()]


@pytest.mark.parametrize("at", [32, 200, 396])
def test_a_resumed_training_continues_identically(at: int, tmp_path: Path) -> None:
    """Before the first update, later, and after the buffer was filled twice."""
    learner = SoftQLearner(small_environment, SMALL, 3, CPU)
    while learner.step < at:
        learner.train_iteration()
    learner.save(tmp_path / "state.safetensors")
    resumed = SoftQLearner(small_environment, SMALL, 3, CPU, num_threads=1)
    resumed.load(tmp_path / "state.safetensors")
    assert resumed.step == at
    for _ in range(15):
        ended, resumed_ended = learner.train_iteration(), resumed.train_iteration()
        assert [episode.episodic_return for episode in ended] == [
            episode.episodic_return for episode in resumed_ended
        ]
    assert learner.losses == resumed.losses
    for mine, other in zip(state_of(learner), state_of(resumed), strict=True):
        assert torch.equal(mine, other)


def test_the_weights_depend_only_on_the_seed() -> None:
    def trained(seed: int) -> torch.Tensor:
        learner = SoftQLearner(small_environment, SMALL, seed, CPU)
        while learner.step < 160:
            learner.train_iteration()
        return torch.cat([value.flatten() for value in state_of(learner)])

    assert torch.equal(trained(1), trained(1))
    assert not torch.equal(trained(1), trained(2))


SETTINGS = [
    "task.nodes=6",
    "learning.total_timesteps=480",
    "learning.num_envs=4",
    "learning.batch_size=16",
    "learning.learning_starts=60",
]
SETTINGS += [
    "learning.buffer_size=300",
    "learning.width=8",
    "evaluate_every=160",
    "evaluation_scenes=8",
    "save_every=80",
]


def test_an_interrupted_training_ends_with_the_same_weights(tmp_path: Path) -> None:
    options = [argument for setting in SETTINGS for argument in ("--set", setting)]
    command = [sys.executable, str(SCRIPT), "--out", str(tmp_path / "killed"), *options]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    train = training_script("train_generator")
    train.main(tmp_path / "whole", settings=SETTINGS)
    while not (tmp_path / "killed" / "state.safetensors").exists():
        assert killed.poll() is None
        time.sleep(0.02)
    killed.kill()
    killed.wait()
    (tmp_path / "killed" / "generator.safetensors").unlink(
        missing_ok=True
    )  # if the kill came too late
    train.main(tmp_path / "killed", settings=SETTINGS)
    whole, again = (
        load_checkpoint(tmp_path / name / "generator.safetensors") for name in ("whole", "killed")
    )
    assert whole.weights.keys() == again.weights.keys()
    assert all(torch.equal(whole.weights[name], again.weights[name]) for name in whole.weights)
    histories = [
        json.loads((tmp_path / name / "history.json").read_text()) for name in ("whole", "killed")
    ]
    for history in histories:
        for row in history:
            del row["seconds"]
    assert histories[0] == histories[1]
    assert len({row["loss"] for row in histories[0]}) > 1
    assert whole.metadata["metrics"]["step"] == 480
    with pytest.raises(InputError, match=r"config\.yaml"):
        train.main(tmp_path / "whole", settings=[*SETTINGS, "seed=1"])


REFUSED = [
    "evaluate_every=0",
    "evaluation_scenes=0",
    "save_every=0",
    "task.nodes=2",
    "warm_start=1",
    "learning.total_timesteps=many",
]
REFUSED += [
    "learning.lr_halving_steps=0",
    "learning.sequence_length=0",
    "learning.width=0",
    "learning.retrace_lambda=1.5",
    "learning.tau=2",
]
REFUSED += ["learning.buffer_size=35"]


@pytest.mark.parametrize("setting", REFUSED)
def test_invalid_settings_are_rejected(setting: str, tmp_path: Path) -> None:
    """Nothing is written before the error."""
    with pytest.raises(InputError, match=setting.partition("=")[0]):
        training_script("train_generator").main(tmp_path / "out", settings=[*SETTINGS, setting])
    assert not (tmp_path / "out").exists()


def test_the_smallest_replay_buffer_holds_a_sequence_of_each_environment() -> None:
    """Four environments with sequences of eight steps need 36."""
    assert SMALL.sequence_length == 8
    SoftQLearner(small_environment, replace(SMALL, buffer_size=36), 0, CPU)
    with pytest.raises(InputError, match="35; expected 36"):
        SoftQLearner(small_environment, replace(SMALL, buffer_size=35), 0, CPU)


def test_the_learning_rate_is_halved_at_intervals() -> None:
    config = replace(SMALL, learning_rate=0.08, lr_halving_steps=100)
    learner = SoftQLearner(small_environment, config, 0, CPU)
    rates = []
    for learner.step in (0, 99, 100, 199, 200, 350):
        rates.append(learner.learning_rate)
    assert rates == [0.08, 0.08, 0.04, 0.04, 0.02, 0.01]


def test_a_warm_start_of_another_width_is_rejected() -> None:
    narrow, wide = (
        SoftQLearner(small_environment, replace(SMALL, width=width), 0, CPU) for width in (8, 12)
    )
    with pytest.raises(InputError, match=r"learning\.width: 12"):
        wide.warm_start(narrow.network)
    other = SoftQLearner(small_environment, SMALL, 1, CPU)
    other.warm_start(narrow.network)
    assert all(
        torch.equal(mine, theirs)
        for mine, theirs in zip(state_of(other), state_of(narrow), strict=True)
    )


def test_a_training_with_additional_classes_and_a_warm_start(tmp_path: Path) -> None:
    """The checkpoint of a training with a new object class generates scenes."""
    folder = tmp_path / "own"
    folder.mkdir()
    brick = "  brick: {shape: box, size_mm: [60, 100, 40], mass_g: 300}\n"
    (folder / "catalog.yaml").write_text(
        f"classes:\n{brick}object_sets:\n  mine: [sugar_box, tomato_soup_can, brick]\n"
    )
    build_assets(folder)
    train = training_script("train_generator")
    train.main(tmp_path / "first", settings=SETTINGS)
    own = [
        *SETTINGS,
        f"catalog={folder}",
        "objects=mine",
        f"warm_start={tmp_path / 'first/generator.safetensors'}",
    ]
    train.main(tmp_path / "second", settings=own)
    agent = make_generation_agent(
        str(tmp_path / "second" / "generator.safetensors"), ClutterConfig()
    )
    grammar = SceneGrammar(load_catalog(folder).object_set("mine"))
    kinds = [
        kind
        for seed in range(10)
        for kind in agent.derive(grammar, NodeBudget(6), rng(seed)).graph.kinds()
    ]
    assert any("brick" in kind for kind in kinds)


def test_a_missing_checkpoint_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.safetensors"):
        load_checkpoint(tmp_path / "none.safetensors")


def test_updates_are_due_at_intervals_after_the_first_steps() -> None:
    """The first after 60 + 4 steps, then one every 4 steps."""
    learner = SoftQLearner(small_environment, SMALL, 0, CPU)
    due = []
    for learner.step in (0, 59, 60, 63, 64, 67, 68, 100):
        due.append(learner._num_updates_due())
    assert due == [0, 0, 0, 0, 1, 1, 2, 10]


def test_the_gradient_of_an_update_is_that_of_the_mean_loss_of_the_batch() -> None:
    """The batch is computed in parts, whose gradients are added up."""
    learner = SoftQLearner(small_environment, replace(SMALL, batch_size=64), 0, CPU)
    while learner.step < SMALL.learning_starts:
        learner.train_iteration()
    rng = deepcopy(learner._rng)
    batch = learner._buffer.sample_sequences(8, SMALL.sequence_length, rng)
    assert batch is not None
    loss, gradients = learner._shard_loss(batch)
    clipped = [torch.nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for parameter, gradient in zip(clipped, gradients, strict=True):
        parameter.grad = gradient / 64
    torch.nn.utils.clip_grad_norm_(clipped, 10.0)
    assert learner._update() == pytest.approx(loss / 64, rel=1e-5)
    for parameter, expected in zip(learner.network.parameters(), clipped, strict=True):
        assert parameter.grad is not None
        assert expected.grad is not None
        torch.testing.assert_close(parameter.grad, expected.grad, rtol=1e-4, atol=1e-6)
