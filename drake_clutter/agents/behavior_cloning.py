"""Behavior cloning of a privileged teacher by a student that observes K_t (Kumar et al. 2022).

K_t is the set of the objects that have been in view. Every iteration collects episodes, labels each
state with the teacher's action, and updates the student on all states so far. In plain behavior
cloning, the teacher acts. In DAgger (Ross et al. 2011), the student acts from the second iteration
on, so that it is also trained in states that only its own mistakes lead to.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import (
    ExplorerNetwork,
    PolicyOutput,
    action_log_probs,
    collate_graphs,
    sample_actions,
)
from drake_clutter.agents.rollouts import Rollout, collect_rollouts
from drake_clutter.learning.checkpoint import (
    load_learner,
    save_learner,
    tensors_with_prefix,
    with_current_keys,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.exploration_graph import RENAMED_ARRAYS, ExplorationObservation
from drake_clutter.validation import (
    Count,
    Flag,
    NetworkWidth,
    NonNegative,
    config_class,
    renamed_fields,
)


@config_class
@renamed_fields(
    rounds="iterations",
    episodes="episodes_per_iteration",
    updates="updates_per_iteration",
    batch="batch_size",
)
class BehaviorCloningConfig:
    """Hyperparameters of behavior cloning.

    Attributes:
        iterations: Total number of iterations.
        episodes_per_iteration: Number of episodes per iteration.
        dagger: Whether the student acts from the second iteration on.
        updates_per_iteration: Number of updates per iteration.
        batch_size: Number of states per update.
        learning_rate: Initial learning rate of Adam; annealed linearly to 0.
        width: Width of the network's embeddings.
    """

    iterations: Count = 40
    episodes_per_iteration: Count = 100
    dagger: Flag = True
    updates_per_iteration: Count = 400
    batch_size: Count = 128
    learning_rate: NonNegative = 1e-3
    width: NetworkWidth = 32


class BehaviorCloningLearner:
    """A behavior-cloning run.

    Attributes:
        config: Hyperparameters.
        step: Number of iterations so far.
        network: The student.
        losses: Mean loss of the latest iteration by name.
    """

    def __init__(
        self,
        environment: ClutterExploration,
        teacher: ExplorerNetwork,
        config: BehaviorCloningConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start a run.

        Args:
            environment: Where the student is trained; its observations show K_t.
            teacher: The teacher, which acts on privileged observations.
            config: Hyperparameters.
            seed: Seed of the run.
            device: Device of the networks.
        """
        self.config = config
        self._environment = environment
        self._teacher = teacher
        self._seed = seed
        torch.manual_seed(seed)
        self.network = ExplorerNetwork(
            len(environment.node_kind_ids),
            config.width,
            finds_target=environment.target_text is not None,
        ).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.step = 0
        self.losses: dict[str, float] = {}
        self._observations: ExplorationObservation = {}
        self._expert_actions = np.zeros((0, 2), np.int64)

    def train_iteration(self) -> list[Rollout]:
        """Collect episodes, update the student, and return the episodes."""
        rng = item_rng(self._seed, 1, self.step)
        student_acts = self.config.dagger and self.step > 0

        def policy_fn(
            environments: Sequence[ClutterExploration],
            observations: Sequence[ExplorationObservation],
        ) -> tuple[NDArray[np.int64], list[Any]]:
            """Return the actions to take, and the teacher's as the extras."""
            expert_actions = self.expert_actions(environments)
            actions = expert_actions
            if student_acts:
                actions = sample_actions(self.network, collate_graphs(observations), rng).actions
            return actions, list(expert_actions)

        rollouts = collect_rollouts(
            self._environment,
            self.config.episodes_per_iteration,
            (self._seed, 2, self.step),
            policy_fn,
        )
        new_observations = collate_graphs(
            [observation for rollout in rollouts for observation in rollout.observations]
        )
        new_actions = np.array([action for rollout in rollouts for action in rollout.policy_extras])
        self._observations = {
            name: np.concatenate([self._observations[name], array]) if self._observations else array
            for name, array in new_observations.items()
        }
        self._expert_actions = np.concatenate([self._expert_actions, new_actions])
        self._update(rng)
        self.step += 1
        return rollouts

    def expert_actions(self, environments: Sequence[ClutterExploration]) -> NDArray[np.int64]:
        """Return the teacher's most probable actions, as nodes of the student's graphs.

        Args:
            environments: B environments.

        Returns:
            Picked node and place of each move. Shape (B, 2).
        """
        observations = [environment.observe(privileged=True) for environment in environments]
        teacher_actions = sample_actions(self._teacher, collate_graphs(observations), None).actions
        actions = np.zeros_like(teacher_actions)
        for row, environment in enumerate(environments):
            student_objects = environment.objects
            # Node 0 is the tray in both graphs; the teacher's node k is the scene's k-th object.
            names = environment.task.scene.names
            actions[row] = [
                student_objects.index(names[node - 1]) + 1 if node else 0
                for node in teacher_actions[row].tolist()
            ]
        return actions

    def _update(self, rng: np.random.Generator) -> None:
        """Update the student on random states, and record the mean loss."""
        config = self.config
        device = self.network.pick_marker.device
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - self.step / config.iterations)
        loss_sum = 0.0
        for _ in range(config.updates_per_iteration):
            batch = rng.integers(len(self._expert_actions), size=config.batch_size)
            output: PolicyOutput = self.network(
                {name: array[batch] for name, array in self._observations.items()}
            )
            actions = torch.from_numpy(self._expert_actions[batch]).to(device)
            place_log_probs = self.network.place_log_probs(output, actions[:, 0])
            loss = -action_log_probs(output, place_log_probs, actions).mean()
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            loss_sum += loss.item()
        self.losses = {"cloning": loss_sum / config.updates_per_iteration}

    def save(self, path: Path) -> None:
        """Write the complete state of the run; see `Learner`."""
        arrays = {**self._observations, "moves": self._expert_actions}
        tensors = {f"states.{name}": torch.from_numpy(array) for name, array in arrays.items()}
        save_learner(path, self.network, self._optimizer, {"step": self.step}, tensors)

    def load(self, path: Path) -> None:
        """Restore the state of a run of the same config, seed and teacher; see `Learner`."""
        tensors, state = load_learner(path, self.network, self._optimizer)
        arrays = with_current_keys(tensors_with_prefix(tensors, "states"), RENAMED_ARRAYS)
        self._observations = {name: value.numpy() for name, value in arrays.items()}
        self._expert_actions = self._observations.pop("moves")
        self.step = state["step"]
