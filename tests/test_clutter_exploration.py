"""The exploration environment, and the trainings and agents of exploration."""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from conftest import CATALOG, DEFAULT_CELL, cell_with, random_scene, rng, training_script
from gymnasium.utils.env_checker import check_env

from drake_clutter.agents.backend_factory import FIDELITIES, make_backend_factory
from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.explorer_network import ExplorerNetwork, action_log_probs, collate_graphs
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, explorer_metadata
from drake_clutter.agents.ppo import PPOConfig, PPOLearner, compute_gae
from drake_clutter.agents.rollouts import Rollout, collect_rollouts, episode_metrics, make_policy_fn
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint, save_checkpoint
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.scene import TRAY, Pose
from drake_clutter.scenes.scene_dataset import (
    SceneDataset,
    SceneRecord,
    load_scene_dataset,
    save_scene_dataset,
)
from drake_clutter.tasks.belief import Belief, Decision, legal_moves
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_graph import NODE_FEATURES
from drake_clutter.tasks.exploration_task import TerminationReason

ROOT = Path(__file__).parents[1]


def entry(seed: int) -> SceneRecord:
    scene = random_scene(seed, 16, 20)
    return SceneRecord(scene.derivation, str(seed), 1, "", tuple(scene.poses.values()))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three stable scenes of the random generator that hide seven, three and two objects."""
    path = tmp_path_factory.mktemp("scenes") / "few.json"
    save_scene_dataset(
        path, {"objects": "ycb7"}, [entry(seed) for seed in (22, 10, 19)], DEFAULT_CELL
    )
    return path


@pytest.fixture(scope="module")
def scenes(file: Path) -> SceneDataset:
    return load_scene_dataset(file, CATALOG)


def random_move(
    observation: dict[str, np.ndarray], generator: np.random.Generator
) -> tuple[int, int]:
    moves = np.argwhere(observation["action_mask"])
    x, y = moves[generator.integers(len(moves))].tolist()
    return x, y


def test_the_environment_passes_gymnasium_s_checks(file: Path) -> None:
    environment = gymnasium.make(
        "drake_clutter.tasks:ClutterExploration-v0", scenes=file, max_moves=4
    )
    check_env(environment.unwrapped, skip_render_check=True)


def test_observations_stay_in_their_space_in_long_episodes(file: Path) -> None:
    """One object is placed on the tray again and again."""
    environment = gymnasium.make(
        "drake_clutter.tasks:ClutterExploration-v0", scenes=str(file), max_moves=40
    ).unwrapped
    assert isinstance(environment, ClutterExploration)
    observation, _ = environment.reset(options={"scene": 1})
    picked = 0
    while (
        environment.task.termination is None
        and (moves := np.flatnonzero(observation["action_mask"][:, 0])).size
    ):
        least = observation["node_features"][:, NODE_FEATURES.index("z")][moves].argmin()
        observation, *_ = environment.step((moves[least], 0))
        picked += 1
        assert environment.observation_space.contains(observation)
    assert observation["node_features"][:, NODE_FEATURES.index("pick_count")].max() == 10, picked


@pytest.mark.parametrize("privileged", [False, True])
def test_observations_rewards_and_termination_of_random_episodes(
    privileged: bool, scenes: SceneDataset
) -> None:
    environment, generator = (
        ClutterExploration(scenes, privileged=privileged, max_moves=6),
        np.random.default_rng(0),
    )
    ends = set()
    for seed in range(12):
        observation, _ = environment.reset(seed=seed)
        total, known = 0.0, environment.objects
        while environment.task.termination is None:
            names = (TRAY, *known)
            moves = [
                Move(names[x], names[y])
                for x, y in np.argwhere(observation["action_mask"]).tolist()
            ]
            legal = set(legal_moves(environment.task.perception.observation))
            assert len(moves) == len(set(moves))
            assert set(moves) == legal - set(environment.backend.belief.invalid_moves)
            shown = (
                environment.task.scene.names
                if privileged
                else tuple(sorted(environment.task.detected))
            )
            assert (known if privileged else tuple(sorted(known))) == shown
            observation, reward, terminated, truncated, info = environment.step(
                random_move(observation, generator)
            )
            total += float(reward)
            assert environment.objects[: len(known)] == known
            known = environment.objects
            assert (terminated or truncated) == ("termination" in info)
        ends.add(environment.task.termination)
        collapsed = environment.task.termination is TerminationReason.COLLAPSED
        assert total == len(environment.task.found) - collapsed
    assert len(ends) > 1


def test_masked_moves_change_nothing(scenes: SceneDataset) -> None:
    environment = ClutterExploration(scenes, privileged=True)
    observation, _ = environment.reset(options={"scene": 0})
    hidden = next(
        k for k in range(1, len(environment.objects) + 1) if not observation["action_mask"][k].any()
    )
    seen = next(
        k for k in range(1, len(environment.objects) + 1) if observation["action_mask"][k].any()
    )
    for move in ((0, seen), (seen, seen), (hidden, 0), (seen, hidden), (seen, 24), (24, 0)):
        again, reward, terminated, truncated, _ = environment.step(move)
        assert (reward, terminated, truncated) == (0.0, False, False)
        assert all(np.array_equal(again[name], observation[name]) for name in observation)
    assert environment.task.transitions == []


def test_masked_moves_count_as_moves(scenes: SceneDataset) -> None:
    environment = ClutterExploration(scenes, max_moves=3)
    observation, _ = environment.reset(seed=0)
    for number in range(1, 4):
        *_, terminated, truncated, info = environment.step(
            (0, 0) if number < 3 else random_move(observation, np.random.default_rng(1))
        )
        assert (terminated, truncated) == (False, number == 3)
    assert info["termination"] is TerminationReason.OUT_OF_MOVES
    assert len(environment.task.transitions) == 1


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_every_fidelity_executes_a_move(scenes: SceneDataset, fidelity: str) -> None:
    environment = ClutterExploration(
        scenes, fidelity=make_backend_factory(fidelity, ClutterConfig())
    )
    before, _ = environment.reset(options={"scene": 2})
    height = before["node_features"][:, NODE_FEATURES.index("z")]
    highest = max(
        np.flatnonzero(before["action_mask"][:, 0]).tolist(), key=lambda node: float(height[node])
    )
    after, *_, info = environment.step((highest, 0))
    assert info["transition"].outcome.result is MoveResult.PLACED
    assert after["node_features"][highest, NODE_FEATURES.index("z")] < height[highest] - 0.05
    assert after["global_features"].tolist() == [pytest.approx(1 / 20)]


def test_a_reset_samples_a_new_layout_or_uses_a_given_scene(scenes: SceneDataset) -> None:
    environment = ClutterExploration(replace(scenes, scenes=(scenes.scenes[1],)))
    starts: list[dict[str, Pose]] = []
    for options in (None, None, {"scene": 0}, {"scene": 0}):
        environment.reset(seed=len(starts), options=options)
        starts.append(environment.task.initial_scene.poses)
    assert starts[0].keys() == starts[1].keys()
    assert starts[0] != starts[1]
    assert starts[2] == starts[3]
    assert [p.p for p in starts[2].values()] == [
        pytest.approx(p.p, abs=1e-6) for p in random_scene(10, 16, 20).poses.values()
    ]


def test_scenes_with_too_many_objects_are_rejected(scenes: SceneDataset) -> None:
    with pytest.raises(InputError, match="none stands and hides something, with at most 2 objects"):
        ClutterExploration(scenes, max_objects=2).reset(seed=0)
    with pytest.raises(InputError, match="max_objects: 2; this scene has 11"):
        ClutterExploration(scenes, max_objects=2).reset(options={"scene": 0})
    with pytest.raises(InputError, match="scene: 3; expected 0 to 2"):
        ClutterExploration(scenes).reset(options={"scene": 3})


def test_the_environment_does_not_import_the_arm() -> None:
    code = "import sys, drake_clutter.tasks.clutter_exploration; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    loaded = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert "drake_clutter.tasks.clutter_exploration" in loaded
    arm = ("drake_clutter.station", "drake_clutter.planning")
    assert [name for name in loaded if name.startswith(arm)] == []


# --- Learning ---


def test_ppo_increases_the_probability_of_rewarded_moves(scenes: SceneDataset) -> None:
    """All moves of two of four episodes are rewarded, and all of the others are penalized."""
    environment = ClutterExploration(scenes, privileged=True, max_moves=4)
    learner = PPOLearner(
        environment, PPOConfig(width=8, learning_rate=0.01), 0, torch.device("cpu")
    )
    rng = np.random.default_rng(0)
    played = collect_rollouts(environment, 4, (0,), make_policy_fn(learner.network, rng))
    for number, episode in enumerate(played):
        episode.rewards = [1.0 if number < 2 else -1.0] * len(episode.actions)
        episode.policy_extras = [(chance, 0.0) for chance, _ in episode.policy_extras]

    def lead() -> float:
        good, bad = (
            mean_log_prob(learner.network, played[:2]),
            mean_log_prob(learner.network, played[2:]),
        )
        return good - bad

    before = lead()
    learner.update(played, rng)
    assert lead() > before + 0.05


def entropy(log_probs: torch.Tensor) -> torch.Tensor:
    """Return the entropy of each distribution. Shape of the log-probabilities: (B, N)."""
    probabilities = log_probs.exp()
    return -torch.where(probabilities > 0, probabilities * log_probs, 0.0).sum(dim=1)


def test_the_losses_of_ppo_are_means_over_all_moves(scenes: SceneDataset) -> None:
    """With a learning rate of 0, every epoch has the same losses; the normalized advantages,
    and with them the policy loss, are 0 on average."""
    environment = ClutterExploration(scenes, privileged=True, max_moves=4)
    config = PPOConfig(width=8, learning_rate=0.0, update_epochs=3, gamma=0.9, gae_lambda=0.8)
    learner = PPOLearner(environment, config, 0, torch.device("cpu"))
    played = collect_rollouts(environment, 3, (0,), make_policy_fn(learner.network, rng()))
    learner.update(played, rng())
    observations = [observation for episode in played for observation in episode.observations]
    actions = torch.from_numpy(np.array([a for episode in played for a in episode.actions]))
    returns = np.concatenate(
        [
            compute_gae(episode, 0.9, 0.8) + [value for _, value in episode.policy_extras]
            for episode in played
        ]
    )
    with torch.no_grad():
        output = learner.network(collate_graphs(observations))
        place_log_probs = learner.network.place_log_probs(output, actions[:, 0])
        error = np.abs(output.value.numpy() - returns)
        spread = entropy(output.pick_log_probs) + entropy(place_log_probs)
    assert learner.losses == {
        "policy": pytest.approx(0.0, abs=1e-5),
        "value": pytest.approx(np.where(error < 1, error**2 / 2, error - 0.5).mean(), rel=1e-5),
        "entropy": pytest.approx(float(spread.mean()), rel=1e-5),
    }


def test_the_loss_of_cloning_is_the_mean_of_the_batches(scenes: SceneDataset) -> None:
    """With a learning rate of 0, the student stays the same."""
    environment = ClutterExploration(scenes, max_moves=3)
    torch.manual_seed(1)
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 8)
    config = BehaviorCloningConfig(
        episodes_per_iteration=2, updates_per_iteration=3, batch_size=5, learning_rate=0.0, width=8
    )
    learner = BehaviorCloningLearner(environment, teacher, config, 0, torch.device("cpu"))
    played = learner.train_iteration()
    learner._update(rng(7))
    generator = rng(7)
    states = [
        replace(episode, observations=[observation], actions=[note])
        for episode in played
        for observation, note in zip(episode.observations, episode.policy_extras, strict=True)
    ]
    batches = [generator.integers(len(states), size=5) for _ in range(3)]
    losses = [
        -mean_log_prob(learner.network, [states[k] for k in batch.tolist()]) for batch in batches
    ]
    assert learner.losses == {"cloning": pytest.approx(np.mean(losses), rel=1e-5)}


@pytest.mark.parametrize("dagger", [False, True])
def test_behavior_cloning_increases_the_probability_of_the_teacher_s_moves(
    dagger: bool, scenes: SceneDataset
) -> None:
    environment = ClutterExploration(scenes, max_moves=5)
    torch.manual_seed(3)
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 8)
    config = BehaviorCloningConfig(
        width=8,
        iterations=3,
        episodes_per_iteration=4,
        updates_per_iteration=60,
        batch_size=16,
        learning_rate=0.01,
        dagger=dagger,
    )
    learner, fresh = (
        BehaviorCloningLearner(environment, teacher, config, 0, torch.device("cpu"))
        for _ in range(2)
    )
    first, second = learner.train_iteration(), learner.train_iteration()
    for played, student_plays in ((first, False), (second, dagger)):
        differs = [
            (move != note).any()
            for episode in played
            for move, note in zip(episode.actions, episode.policy_extras, strict=True)
        ]
        assert any(differs) == student_plays
        expert_rollouts = [replace(episode, actions=episode.policy_extras) for episode in played]
        assert (
            mean_log_prob(learner.network, expert_rollouts)
            > mean_log_prob(fresh.network, expert_rollouts) + 0.5
        )


def mean_log_prob(network: ExplorerNetwork, played: Sequence[Rollout]) -> float:
    """Return the mean log-probability of the moves."""
    with torch.no_grad():
        found = network(
            collate_graphs(
                [observation for episode in played for observation in episode.observations]
            )
        )
        moves = torch.from_numpy(np.array([move for episode in played for move in episode.actions]))
        return float(
            action_log_probs(found, network.place_log_probs(found, moves[:, 0]), moves).mean()
        )


def test_rollouts_depend_only_on_the_seed(scenes: SceneDataset) -> None:
    environment = ClutterExploration(scenes, max_moves=5)
    torch.manual_seed(0)
    network = ExplorerNetwork(len(environment.node_kind_ids), 8)

    def played(side_by_side: int, seed: int) -> list[Rollout]:
        return collect_rollouts(
            environment, 7, (seed, 1), make_policy_fn(network, None), side_by_side
        )

    one, other = played(3, 5), played(7, 5)
    assert [[m.tolist() for m in e.actions] for e in one] == [
        [m.tolist() for m in e.actions] for e in other
    ]
    assert (
        [e.rewards for e in one] == [e.rewards for e in other] != [e.rewards for e in played(7, 6)]
    )
    metrics = episode_metrics(one)
    assert metrics["success"] == sum(e.termination is TerminationReason.ALL_FOUND for e in one) / 7
    assert metrics["score"] == pytest.approx(np.mean([sum(e.rewards) for e in one]))


def test_gae_is_the_discounted_sum_of_temporal_difference_errors() -> None:
    values, rewards, gamma, gae_lambda = [1.0, -0.5, 2.0], [0.0, 3.0, -1.0], 0.9, 0.8
    episode = Rollout(
        actions=[np.zeros(2, int)] * 3,
        rewards=rewards,
        policy_extras=[(0.0, value) for value in values],
    )
    errors = [rewards[k] + gamma * (*values, 0.0)[k + 1] - values[k] for k in range(3)]
    expected = [
        sum((gamma * gae_lambda) ** (j - k) * errors[j] for j in range(k, 3)) for k in range(3)
    ]
    assert compute_gae(episode, gamma, gae_lambda) == pytest.approx(expected, abs=1e-6)


def test_the_teacher_s_actions_refer_to_nodes_of_the_student_s_graph(scenes: SceneDataset) -> None:
    """An object has different nodes in the two graphs."""
    environment = ClutterExploration(scenes, max_moves=5)
    torch.manual_seed(1)
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 8)
    cloning = BehaviorCloningLearner(
        environment, teacher, BehaviorCloningConfig(width=8), 0, torch.device("cpu")
    )
    for seed in range(5):
        environment.reset(seed=seed)
        ((x, y),) = cloning.expert_actions([environment]).tolist()
        privileged_environment = ClutterExploration(scenes, privileged=True, max_moves=5)
        privileged_environment.reset_to_scene(environment.task.scene)
        ((a, b),) = make_policy_fn(teacher, None)(
            [privileged_environment], [privileged_environment.observe()]
        )[0].tolist()
        named = [
            TRAY if node == 0 else names[node - 1]
            for names, node in (
                (privileged_environment.objects, a),
                (privileged_environment.objects, b),
            )
        ]
        assert [environment.objects[x - 1], TRAY if y == 0 else environment.objects[y - 1]] == named


TEACHER_SETTINGS = [
    "learning.total_timesteps=240",
    "learning.episodes_per_iteration=6",
    "learning.width=8",
    "max_moves=4",
    "evaluate_every=40",
]
TEACHER_SETTINGS += ["evaluation_episodes=4"]
STUDENT_SETTINGS = [
    "learning.iterations=6",
    "learning.episodes_per_iteration=5",
    "learning.width=8",
    "learning.updates_per_iteration=4",
    "max_moves=4",
]
STUDENT_SETTINGS += ["evaluate_every=1", "evaluation_episodes=4"]


@pytest.mark.parametrize("script", ["train_explorer_ppo", "train_explorer_dagger"])
def test_an_interrupted_training_ends_with_the_same_weights(
    script: str, file: Path, tmp_path: Path
) -> None:
    settings = [
        f"scenes={file}",
        *(TEACHER_SETTINGS if script == "train_explorer_ppo" else STUDENT_SETTINGS),
    ]
    if script == "train_explorer_dagger":
        node_kind_ids = ClutterExploration(file).node_kind_ids
        torch.manual_seed(3)
        save_checkpoint(
            tmp_path / "t.safetensors",
            ExplorerNetwork(len(node_kind_ids), 8),
            {"kind": TEACHER, "network": explorer_metadata(node_kind_ids, 8)},
        )
        settings += [f"teacher={tmp_path / 't.safetensors'}"]
    options = [argument for setting in settings for argument in ("--set", setting)]
    command = [
        sys.executable,
        str(ROOT / "training" / f"{script}.py"),
        "--out",
        str(tmp_path / "killed"),
        *options,
    ]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (tmp_path / "killed" / "state.safetensors").exists():
        assert killed.poll() is None
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    assert not (tmp_path / "killed" / "explorer.safetensors").exists()
    train = training_script(script)
    train.main(tmp_path / "whole", settings=settings)
    train.main(tmp_path / "killed", settings=settings)
    whole, again = (
        load_checkpoint(tmp_path / name / "explorer.safetensors") for name in ("whole", "killed")
    )
    assert all(torch.equal(whole.weights[name], again.weights[name]) for name in whole.weights)
    histories = [
        json.loads((tmp_path / name / "history.json").read_text()) for name in ("whole", "killed")
    ]
    assert [row["score"] for row in histories[0]] == [row["score"] for row in histories[1]]
    # What was written plays.
    environment = ClutterExploration(file, max_moves=4)
    environment.reset(options={"scene": 0})
    make_policy = make_policy_factory(
        str(tmp_path / "whole" / "explorer.safetensors"), ClutterConfig()
    )
    task = run_episode(environment.backend, make_policy(environment.backend), max_moves=4)
    decision = task.transitions[0].decision
    assert sum(decision.pick_probabilities.values()) == pytest.approx(1, abs=1e-5)
    assert set(decision.pick_probabilities) == {
        d.name for d in task.initial_perception.observation.detections
    }
    everything = set(environment.task.initial_scene.names)
    assert (set(decision.considered) == everything) == (script == "train_explorer_ppo")


def test_ppo_starts_from_a_cloned_student(file: Path, tmp_path: Path) -> None:
    """At a learning rate of 0 the weights are unchanged; a teacher is rejected as a student."""
    node_kind_ids, start_file = ClutterExploration(file).node_kind_ids, tmp_path / "s.safetensors"
    torch.manual_seed(3)
    cloned = ExplorerNetwork(len(node_kind_ids), 8)
    save_checkpoint(
        start_file, cloned, {"kind": STUDENT, "network": explorer_metadata(node_kind_ids, 8)}
    )
    settings = [
        f"scenes={file}",
        f"warm_start={start_file}",
        *TEACHER_SETTINGS,
        "learning.total_timesteps=10",
        "learning.learning_rate=1.0e-30",
    ]
    train = training_script("train_explorer_ppo")
    train.main(tmp_path / "tuned", settings=[*settings, "privileged=false"])
    tuned = load_checkpoint(tmp_path / "tuned" / "explorer.safetensors")
    assert tuned.metadata["kind"] == STUDENT
    assert all(
        torch.equal(value, tuned.weights[name]) for name, value in cloned.state_dict().items()
    )
    with pytest.raises(
        InputError,
        match=r"s\.safetensors: is a checkpoint of a student; expected one of a teacher",
    ):
        train.main(tmp_path / "teacher", settings=settings)
    with pytest.raises(InputError, match=r"warm_start: .* another width"):
        train.main(tmp_path / "wide", settings=[*settings, "privileged=false", "learning.width=16"])


def test_invalid_agents_are_rejected(file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--agent unknown; expected random, .*full-knowledge"):
        make_policy_factory("unknown", ClutterConfig())
    path = tmp_path / "s.safetensors"
    node_kind_ids = ClutterExploration(file).node_kind_ids
    about = {"kind": STUDENT, "network": explorer_metadata(node_kind_ids, 8)}
    save_checkpoint(path, ExplorerNetwork(len(node_kind_ids), 8), about | {"kind": "generator"})
    with pytest.raises(
        InputError,
        match=r"s\.safetensors: is a checkpoint of a generator; "
        r"expected one of a teacher or student",
    ):
        make_policy_factory(str(path), ClutterConfig())
    save_checkpoint(
        path,
        ExplorerNetwork(len(node_kind_ids), 8),
        about | {"network": {**explorer_metadata(node_kind_ids, 8), "features": []}},
    )
    with pytest.raises(InputError, match="was trained on other features"):
        make_policy_factory(str(path), ClutterConfig())
    save_checkpoint(
        path,
        ExplorerNetwork(2, 8),
        {"kind": STUDENT, "network": explorer_metadata({TRAY: 1, "sugar_box": 2}, 8)},
    )
    environment = ClutterExploration(file)
    environment.reset(options={"scene": 0})
    agent = make_policy_factory(str(path), ClutterConfig())(environment.backend)
    with pytest.raises(InputError, match="was not trained with"):
        run_episode(environment.backend, agent, max_moves=1)


def test_a_learned_explorer_discards_moves_without_a_free_placement(config: ClutterConfig) -> None:
    """With 39 objects the tray is soon full."""
    scenes = ROOT / "training/scenes/sg_star_40.json"
    environment = ClutterExploration(scenes, config=config, max_moves=20, max_objects=39)
    explorers = make_policy_factory("student", config)
    on_the_tray = set()
    for number in range(3):
        environment.reset(options={"scene": number})
        agent = explorers(environment.backend)

        def checked(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
            decision = agent(belief, observation, rng)  # noqa: B023, called in this round
            move = decision.move
            mean_log_prob = sum(decision.pick_probabilities.values())
            assert mean_log_prob in (0, pytest.approx(1)), "as the network had it, with room or not"
            legal = legal_moves(observation)
            room = {m for m in legal if find_free_placements(observation, m, config.exploration)}
            if move is None:
                assert not room
                return decision
            assert move in room
            assert move.place == TRAY or Move(move.pick, TRAY) not in room
            on_the_tray.add(move.place == TRAY)
            return decision

        run_episode(environment.backend, checked, max_moves=20)
    assert on_the_tray == {True, False}


def test_the_oracle_finds_all_objects(scenes: SceneDataset, config: ClutterConfig) -> None:
    environment = ClutterExploration(scenes, max_moves=20)
    environment.reset(options={"scene": 1})
    policy = make_policy_factory("full-knowledge", config)(environment.backend)
    task = run_episode(environment.backend, policy, max_moves=20)
    assert task.initially_hidden
    assert task.termination is TerminationReason.ALL_FOUND
    assert task.transitions[-1].newly_found


def test_the_default_work_cell_is_that_of_the_scenes(tmp_path: Path) -> None:
    camera = "cameras.overhead.pose={translation: [0.0, 0.3, 1.5], rpy_deg: [170, 0, 0]}"
    save_scene_dataset(
        tmp_path / "tilted.json",
        {"objects": "ycb7"},
        [entry(22)],
        cell_with(camera, "support.size=[0.75, 0.75]"),
    )
    environment = ClutterExploration(tmp_path / "tilted.json")
    environment.reset(options={"scene": 0})
    observation = environment.backend.perception.observation
    assert observation.camera == environment.scenes.cell.camera
    assert observation.support.size == (0.75, 0.75)
