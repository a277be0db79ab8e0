"""Behaviour cloning of the teacher by a student that sees K_t alone (SPEC section 4), plain or by DAgger (Ross et al. 2011).

Every round plays episodes, notes what the teacher would do in each state, and takes some updates on all states so far. Plain
cloning lets the teacher play; with DAgger the student plays from the second round on, so that it also learns what to do where
only its own mistakes lead.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import (
    ExplorerNetwork,
    action_log_probs,
    collate_graphs,
    sample_actions,
)
from drake_clutter.agents.rollouts import Rollout, collect_rollouts
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    restore_learner,
    save_tensors,
    tensors_with_prefix,
    with_current_keys,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.exploration_graph import RENAMED_ARRAYS, ExplorationObservation
from drake_clutter.validation import Flag, InRange, NonNegative, config_class, renamed_fields


@config_class
@renamed_fields(
    rounds="iterations",
    episodes="episodes_per_iteration",
    updates="updates_per_iteration",
    batch="batch_size",
)
class BehaviorCloningConfig:
    """How a student learns.

    Attributes:
        iterations: in all; episodes_per_iteration: per round.
        dagger: whether the student plays from the second round on.
        updates_per_iteration: per round; batch_size: states per update.
        learning_rate: at the beginning; it falls to 0 in a straight line.
        width: of the network.
    """

    iterations: Annotated[int, InRange(1)] = 40
    episodes_per_iteration: Annotated[int, InRange(1)] = 100
    dagger: Flag = True
    updates_per_iteration: Annotated[int, InRange(1)] = 400
    batch_size: Annotated[int, InRange(1)] = 128
    learning_rate: NonNegative = 1e-3
    width: Annotated[int, InRange(1)] = 32


class BehaviorCloningLearner:
    """One training, round by round.

    Attributes:
        step: rounds so far.
        network: the student.
        losses: of the latest round.
    """

    def __init__(
        self,
        environment: ClutterExploration,
        teacher: ExplorerNetwork,
        config: BehaviorCloningConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        """Begins a training; the environment shows K_t."""
        self.config, self._environment, self._teacher, self._seed = (
            config,
            environment,
            teacher,
            seed,
        )
        torch.manual_seed(seed)
        self.network = ExplorerNetwork(len(environment.node_kind_ids), config.width).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.step = 0
        self.losses: dict[str, float] = {}
        self._states: ExplorationObservation = {}
        self._moves = np.zeros((0, 2), np.int64)

    def train_iteration(self) -> list[Rollout]:
        """One round; returns its episodes."""
        rng = item_rng(self._seed, 1, self.step)
        student_plays = self.config.dagger and self.step > 0

        def act(
            environments: Sequence[ClutterExploration],
            observations: Sequence[ExplorationObservation],
        ) -> tuple[NDArray[np.int64], list[Any]]:
            wanted = self.expert_actions(environments)
            played = (
                sample_actions(self.network, collate_graphs(observations), rng)[0]
                if student_plays
                else wanted
            )
            return played, list(wanted)

        played = collect_rollouts(
            self._environment, self.config.episodes_per_iteration, (self._seed, 2, self.step), act
        )
        states = collate_graphs(
            [observation for episode in played for observation in episode.observations]
        )
        moves = np.array([move for episode in played for move in episode.policy_extras])
        self._states = {
            name: np.concatenate([self._states[name], new]) if self._states else new
            for name, new in states.items()
        }
        self._moves = np.concatenate([self._moves, moves])
        self._learn(rng)
        self.step += 1
        return played

    def expert_actions(self, environments: Sequence[ClutterExploration]) -> NDArray[np.int64]:
        """(B, 2) what the teacher would do, as nodes of the student's graphs."""
        moves = sample_actions(
            self._teacher, collate_graphs([e.observe(privileged=True) for e in environments]), None
        )[0]
        found = np.zeros_like(moves)
        for row, environment in enumerate(environments):
            known = environment.objects
            names = environment.task.scene.names
            found[row] = [
                known.index(names[node - 1]) + 1 if node else 0 for node in moves[row].tolist()
            ]
        return found

    def _learn(self, rng: np.random.Generator) -> None:
        device, total = self.network.pick_marker.device, 0.0
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.learning_rate * (1 - self.step / self.config.iterations)
        for _ in range(self.config.updates_per_iteration):
            part = rng.integers(len(self._moves), size=self.config.batch_size)
            found = self.network({name: array[part] for name, array in self._states.items()})
            moves = torch.from_numpy(self._moves[part]).to(device)
            loss = -action_log_probs(
                found, self.network.place_log_probs(found, moves[:, 0]), moves
            ).mean()
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            total += loss.item()
        self.losses = {"cloning": total / self.config.updates_per_iteration}

    def save(self, path: Path) -> None:
        """Writes all that the training needs to go on as if it had never been interrupted."""
        tensors = learner_tensors(self.network, self._optimizer)
        arrays = {**self._states, "moves": self._moves}
        tensors |= {f"states.{name}": torch.from_numpy(array) for name, array in arrays.items()}
        save_tensors(path, tensors, {"step": self.step})

    def load(self, path: Path) -> None:
        """Goes on where `save` was called, in a training of the same config, seed and teacher."""
        tensors, state = load_tensors(path)
        restore_learner(self.network, self._optimizer, tensors)
        states = with_current_keys(tensors_with_prefix(tensors, "states"), RENAMED_ARRAYS)
        self._states = {name: value.numpy() for name, value in states.items()}
        self._moves = self._states.pop("moves")
        self.step = state["step"]
