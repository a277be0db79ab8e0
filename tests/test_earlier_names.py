"""Checkpoints, training states and run folders of version 0.1 load under the current names."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import CATALOG, GRAMMARS

from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.explorer_network import ExplorerNetwork
from drake_clutter.agents.explorer_training import ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, load_explorer
from drake_clutter.agents.learned_generator import load_rule_network
from drake_clutter.agents.ppo import PPOConfig
from drake_clutter.agents.replay_buffer import RENAMED_ARRAYS as RENAMED_REPLAY_ARRAYS
from drake_clutter.agents.soft_q import RENAMED_STATE, SoftQConfig, SoftQLearner
from drake_clutter.config import load_config
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint, load_tensors, save_tensors
from drake_clutter.learning.training_run import CONFIG_FILE, TrainingRun
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import RENAMED_FIDELITIES, make_teleport_backend_factory
from drake_clutter.tasks.exploration_graph import RENAMED_ARRAYS
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig
from drake_clutter.validation import validate

ROOT = Path(__file__).parents[1]
CPU = torch.device("cpu")
CHECKPOINTS = sorted((ROOT / "training/checkpoints").glob("*.safetensors"))
EXPLORERS = [path for path in CHECKPOINTS if path.stem.startswith(("student", "teacher"))]
GENERATORS = [path for path in CHECKPOINTS if path.stem.startswith("sg")]


def assert_same_weights(network: torch.nn.Module, weights: Mapping[str, torch.Tensor]) -> None:
    """The network has the tensors of a checkpoint, under whatever names."""

    def contents(tensors: Mapping[str, torch.Tensor]) -> list[tuple[tuple[int, ...], bytes]]:
        return sorted((tuple(t.shape), t.numpy().tobytes()) for t in tensors.values())

    assert contents(network.state_dict()) == contents(weights)


@pytest.mark.parametrize("path", EXPLORERS, ids=lambda path: path.stem)
def test_shipped_explorers_load(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    network, _ = load_explorer(checkpoint, path, TEACHER if "teacher" in path.stem else STUDENT)
    assert "network.glob.weight" in checkpoint.weights
    assert_same_weights(network, checkpoint.weights)


@pytest.mark.parametrize("path", GENERATORS, ids=lambda path: path.stem)
def test_shipped_generators_load(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    objects = "pantry14" if path.stem == "sg_14" else "ycb7"
    network = load_rule_network(checkpoint, GRAMMARS[objects])
    assert "network.glob.weight" in checkpoint.weights
    assert_same_weights(network, checkpoint.weights)


def test_configs_of_trainings_accept_earlier_names() -> None:
    soft_q = {"steps": 10, "environments": 2, "trace": 0.5, "halve_every": 7, "replay": 99}
    assert validate(SoftQConfig, soft_q, "test") == SoftQConfig(
        total_timesteps=10, num_envs=2, retrace_lambda=0.5, lr_halving_steps=7, buffer_size=99
    )
    ppo = {"passes": 2, "batch": 8, "discount": 0.9, "trace": 0.5, "entropy": 0.1, "value": 0.2}
    assert validate(PPOConfig, ppo, "test") == PPOConfig(
        update_epochs=2, minibatch_size=8, gamma=0.9, gae_lambda=0.5, ent_coef=0.1, vf_coef=0.2
    )
    cloning = {"rounds": 2, "episodes": 3, "updates": 4, "batch": 5}
    assert validate(BehaviorCloningConfig, cloning, "test") == BehaviorCloningConfig(
        iterations=2, episodes_per_iteration=3, updates_per_iteration=4, batch_size=5
    )
    training = {"most_objects": 9, "fidelity": "equilibrium"}
    assert validate(ExplorerTrainingConfig, training, "test") == ExplorerTrainingConfig(
        max_objects=9, fidelity="static"
    )


@pytest.mark.parametrize(("earlier", "name"), RENAMED_FIDELITIES.items())
def test_fidelities_have_earlier_names(earlier: str, name: str, config: Any) -> None:
    factories = [make_teleport_backend_factory(f, config) for f in (earlier, name)]
    first, second = (type(f.args[0]) for f in factories)  # type: ignore[attr-defined]
    assert first is second
    with pytest.raises(InputError, match="expected static, static_or_drake, settle"):
        make_teleport_backend_factory("quick", config)


def with_earlier_names(path: Path, prefix: str, renamed: Mapping[str, str]) -> None:
    """Rewrite a training state as version 0.1 wrote it."""
    tensors, state = load_tensors(path)
    earlier = {f"{prefix}.{name}": f"{prefix}.{old}" for old, name in renamed.items()}
    # Attributes of the networks, as far as their names have changed.
    parameters = {
        "encoder": "network",
        "node_kind_embedding": "kind",
        "node_encoder": "feature",
        "edge_kind_embedding": "edge",
        "global_encoder": "glob",
        "max_message": "maximum",
        "global_to_node": "glob",
        "global_self": "old",
        "hidden_layer": "joined",
        "q_head": "value",
        "pick_head": "pick",
        "pick_marker": "mark",
        "post_pick_layers": "after_pick",
        "place_head": "place",
        "value_head": "value",
    }

    def earlier_name(name: str) -> str:
        if name in earlier:
            return earlier[name]
        if name.startswith(("network.", "target.")):
            return ".".join(parameters.get(part, part) for part in name.split("."))
        return name

    def earlier_state(value: Any) -> Any:
        keys = {name: old for old, name in RENAMED_STATE.items()}
        if isinstance(value, dict):
            return {keys.get(key, key): earlier_state(item) for key, item in value.items()}
        return [earlier_state(item) for item in value] if isinstance(value, list) else value

    renamed_tensors = {earlier_name(name): value for name, value in tensors.items()}
    assert renamed_tensors.keys() != tensors.keys()
    save_tensors(path, renamed_tensors, earlier_state(state))


def test_a_soft_q_training_of_version_0_1_resumes(tmp_path: Path) -> None:
    classes = list(GRAMMARS["ycb7"].classes.values())
    config = SoftQConfig(
        num_envs=4, batch_size=16, sequence_length=4, buffer_size=80, learning_starts=20, width=8
    )

    def make_env() -> ClutterGeneration:
        return ClutterGeneration(classes, GenerationTaskConfig(nodes=7))

    learner, resumed = (SoftQLearner(make_env, config, 0, CPU) for _ in range(2))
    for _ in range(12):
        learner.train_iteration()
    learner.save(tmp_path / "state.safetensors")
    with_earlier_names(tmp_path / "state.safetensors", "replay", RENAMED_REPLAY_ARRAYS)
    resumed.load(tmp_path / "state.safetensors")
    for _ in range(5):
        learner.train_iteration()
        resumed.train_iteration()
    assert resumed.step == learner.step
    assert_same_weights(resumed.network, learner.network.state_dict())


def test_a_cloning_of_version_0_1_resumes(tmp_path: Path) -> None:
    scenes = load_scene_dataset(ROOT / "training/scenes/sg_star_10.json", CATALOG)
    environment = ClutterExploration(scenes, fidelity="static", max_moves=2)
    torch.manual_seed(0)
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 8)
    config = BehaviorCloningConfig(
        iterations=3, episodes_per_iteration=2, updates_per_iteration=2, batch_size=8, width=8
    )
    learner, resumed = (
        BehaviorCloningLearner(environment, teacher, config, 0, CPU) for _ in range(2)
    )
    learner.train_iteration()
    learner.save(tmp_path / "state.safetensors")
    with_earlier_names(tmp_path / "state.safetensors", "states", RENAMED_ARRAYS)
    resumed.load(tmp_path / "state.safetensors")
    rollouts = [one.train_iteration() for one in (learner, resumed)]
    first, second = ([np.array(r.actions).tolist() for r in rollout] for rollout in rollouts)
    assert first == second
    assert_same_weights(resumed.network, learner.network.state_dict())


@dataclass
class NoLearner:
    """A learner without state."""

    step: int = 0
    network = torch.nn.Module()

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.touch()

    def load(self, path: Path) -> None:
        """See `Learner`."""


def test_a_run_folder_of_version_0_1_is_taken_up(tmp_path: Path) -> None:
    start: Callable[[ExplorerTrainingConfig], TrainingRun] = lambda config: TrainingRun(  # noqa: E731
        tmp_path / "run", config, NoLearner(), 1
    )
    start(ExplorerTrainingConfig(max_objects=9))
    path = tmp_path / "run" / CONFIG_FILE
    text = path.read_text().replace("max_objects", "most_objects")
    path.write_text(text.replace("fidelity: static", "fidelity: equilibrium"))
    start(ExplorerTrainingConfig(max_objects=9))
    assert path.read_text().count("most_objects") == 1, "the folder is left as it was"
    with pytest.raises(InputError, match="another config"):
        start(replace(ExplorerTrainingConfig(), max_objects=10))


def test_a_field_is_not_set_under_two_names() -> None:
    settings = ["settle.rest_drift=0.001", "settle.max_rest_displacement=0.002"]
    for order in (settings, settings[::-1]):
        with pytest.raises(InputError) as refused:
            load_config(settings=order)
        message = "rest_drift is the earlier name of max_rest_displacement; expected one of them"
        assert str(refused.value) == f"--set: {message}"
    assert load_config(settings=settings[:1]).settle.max_rest_displacement == 0.001
