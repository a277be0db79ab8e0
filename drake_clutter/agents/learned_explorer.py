"""Trained exploration policies: the student, which acts on K_t, and the privileged teacher.

K_t is the set of the objects seen so far; the teacher has access to the true scene. Both
filter the network's moves at inference time. A move is discarded if the camera sees no free
placement for it. If the tray has a free placement, the object is placed there instead of on the
object that the network chose, where it is less stable and occludes more.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drake_clutter.agents.explorer_network import ExplorerNetwork, collate_graphs, sample_actions
from drake_clutter.config import ExplorationConfig
from drake_clutter.files import InputError, input_error
from drake_clutter.learning.checkpoint import Checkpoint, load_checkpoint, load_weights
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.scene import TRAY
from drake_clutter.tasks.belief import Belief, Decision
from drake_clutter.tasks.episode import Backend
from drake_clutter.tasks.exploration_graph import (
    EDGE_KINDS,
    NODE_FEATURES,
    RENAMED_FEATURES,
    build_exploration_graph,
)
from drake_clutter.tasks.search_target import SearchTarget, no_target_error
from drake_clutter.validation import Flag, NetworkWidth, NonEmptyText, StrictModel, validate

TEACHER = "teacher"
"""Kind of the checkpoints of privileged policies."""
STUDENT = "student"
"""Kind of the checkpoints of policies that observe K_t."""


def explorer_metadata(
    node_kind_ids: dict[str, int], width: int, *, finds_target: bool = False
) -> dict[str, Any]:
    """Return the metadata that a checkpoint needs to recreate an `ExplorerNetwork`.

    Args:
        node_kind_ids: Numbers of the kinds of nodes by name, from 1 on.
        width: Width of the embeddings.
        finds_target: Whether the policy is conditioned on a target.
    """
    metadata = {
        "node_kinds": list(node_kind_ids),
        "features": list(NODE_FEATURES),
        "edge_kinds": list(EDGE_KINDS),
        "width": width,
    }
    return metadata | {"finds_target": True} if finds_target else metadata


class _NetworkEntry(StrictModel):
    """The network in a checkpoint's metadata, see `explorer_metadata`."""

    node_kinds: Annotated[tuple[NonEmptyText, ...], Field(min_length=1)]
    features: tuple[NonEmptyText, ...] = ()
    edge_kinds: tuple[NonEmptyText, ...] = ()
    width: NetworkWidth
    finds_target: Flag = False


def load_explorer(
    checkpoint: Checkpoint, path: Path, kind: str | None = None
) -> tuple[ExplorerNetwork, dict[str, int]]:
    """Return the network of a checkpoint, and the numbers of the kinds of nodes by name.

    Args:
        checkpoint: The checkpoint.
        path: Its file, for error messages.
        kind: `TEACHER` or `STUDENT`; None accepts both.

    Raises:
        InputError: The checkpoint is of another kind or another version of the observation.
    """
    metadata = checkpoint.metadata
    allowed = (TEACHER, STUDENT) if kind is None else (kind,)
    if checkpoint.kind not in allowed:
        raise input_error(
            str(path),
            f"is a checkpoint of a {checkpoint.kind}; expected one of a {' or '.join(allowed)}",
        )
    network_metadata: dict[str, Any] = metadata.get("network", {})
    validate(_NetworkEntry, network_metadata, f"{path.with_suffix('.json')}: network")
    node_kind_ids = {
        name: number for number, name in enumerate(network_metadata["node_kinds"], start=1)
    }
    for key in ("features", "edge_kinds"):
        names = [RENAMED_FEATURES.get(name, name) for name in network_metadata.get(key, ())]
        network_metadata = {**network_metadata, key: names}
    finds_target = network_metadata.get("finds_target", False)
    width = network_metadata["width"]
    if network_metadata != explorer_metadata(node_kind_ids, width, finds_target=finds_target):
        raise InputError(
            f"{path}: was trained on other features; expected a checkpoint of this version"
        )
    network = ExplorerNetwork(len(node_kind_ids), width, finds_target=finds_target)
    load_weights(network, checkpoint.weights, path)
    return network.eval(), node_kind_ids


def _check_classes(classes: Collection[str], known_classes: Collection[str], path: Path) -> None:
    """Raise an `InputError` if a policy was not trained with some object classes."""
    unknown = sorted(set(classes) - set(known_classes))
    if unknown:
        raise InputError(
            f"--agent {path}: was not trained with {', '.join(unknown)}; "
            "train one with your objects"
        )


class LearnedExplorer:
    """Trained policy that takes the most probable move with a free placement (a `Policy`)."""

    def __init__(
        self,
        network: ExplorerNetwork,
        node_kind_ids: dict[str, int],
        path: Path,
        config: ExplorationConfig,
        backend: Backend | None = None,
        target: SearchTarget | None = None,
    ) -> None:
        """Create the policy of an episode.

        Args:
            network: See `load_explorer`.
            node_kind_ids: See `load_explorer`.
            path: File of the checkpoint, for error messages.
            config: Clearances of placements.
            backend: Backend of the episode, whose true scene a privileged policy observes; None for
                a policy that observes K_t.
            target: Target of a policy that is conditioned on one; None for other policies.
        """
        self._network = network
        self._node_kind_ids = node_kind_ids
        self._path = path
        self._config = config
        self._backend = backend
        self._target = target

    def __call__(
        self,
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        """Choose the next move; see `Policy`.

        Raises:
            InputError: The policy was not trained with the class of an object.
        """
        objects = belief.objects if self._backend is None else self._backend.scene.objects
        _check_classes({o.object_class.name for o in objects}, self._node_kind_ids, self._path)
        graph = build_exploration_graph(
            objects,
            observation,
            belief.history,
            self._node_kind_ids,
            belief.invalid_moves,
            target=self._target,
        )
        action_mask = graph["action_mask"]
        names = tuple(o.name for o in objects)
        pick_probabilities: dict[str, float] = {}
        while action_mask.any():
            sampled = sample_actions(self._network, collate_graphs([graph]), None)
            # The reported probabilities are those of the network, before moves are discarded.
            pick_probabilities = pick_probabilities or {
                name: float(sampled.pick_probs[0, k])
                for k, name in enumerate(names, start=1)
                if action_mask[k].any()
            }
            pick, chosen_place = sampled.actions[0].tolist()
            for place in (0, chosen_place):
                move = Move(names[pick - 1], names[place - 1] if place else TRAY)
                if (
                    action_mask[pick, place]
                    and find_free_placements(observation, move, self._config) is not None
                ):
                    return Decision(move, pick_probabilities, names)
                action_mask[pick, place] = 0
        return Decision(None)


class LearnedExplorerFactory:
    """Creates a `LearnedExplorer` for each episode (a `PolicyFactory`).

    Attributes:
        privileged: Whether the policy observes the true scene.
    """

    def __init__(
        self,
        path: Path,
        config: ExplorationConfig,
        classes: Collection[str] = (),
        *,
        with_target: bool = False,
    ) -> None:
        """Load a checkpoint of `train_explorer_ppo.py` or `train_explorer_dagger.py`.

        Args:
            path: File of the checkpoint.
            config: Clearances of placements.
            classes: Names of the object classes that will occur, as far as they are known.
            with_target: Whether the episodes look for a target.

        Raises:
            InputError: The file cannot be read, is not a checkpoint of an exploration policy, the
                policy was not trained with one of the classes, or it needs a target.
        """
        self._path = path
        self._config = config
        checkpoint = load_checkpoint(path)
        self._network, self._node_kind_ids = load_explorer(checkpoint, path)
        _check_classes(classes, self._node_kind_ids, path)
        if self._network.finds_target and not with_target:
            raise no_target_error(path)
        self.privileged = checkpoint.metadata["kind"] == TEACHER

    def __call__(
        self, backend: Backend | None = None, *, target: SearchTarget | None = None
    ) -> LearnedExplorer:
        """Return the policy of an episode; only a privileged policy needs the backend.

        Args:
            backend: Backend of the episode.
            target: Target of the search; None for all objects.

        Raises:
            InputError: The policy was not trained with the class of the target, or needs a target.
        """
        if target is not None:
            _check_classes([target.object_class.name], self._node_kind_ids, self._path)
        elif self._network.finds_target:
            raise no_target_error(self._path)
        return LearnedExplorer(
            self._network,
            self._node_kind_ids,
            self._path,
            self._config,
            backend if self.privileged else None,
            target if self._network.finds_target else None,
        )
