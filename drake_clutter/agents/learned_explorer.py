"""Trained explorers at work: the student, which knows what the camera has shown, and the teacher, which knows everything.

Both look before they move: where the camera sees no free place, nothing is put, and what finds one on the tray goes there. On
another object it might topple, and would hide more; it is put there when the tray is full.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.agents.explorer_network import ExplorerNetwork, collate_graphs, sample_actions
from drake_clutter.config import ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import Checkpoint, load_checkpoint
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

TEACHER, STUDENT = "teacher", "student"


def explorer_metadata(node_kind_ids: dict[str, int], width: int) -> dict[str, Any]:
    """What the inputs of an `ExplorerNetwork` stand for, for its checkpoint."""
    return {
        "node_kinds": list(node_kind_ids),
        "features": list(NODE_FEATURES),
        "edge_kinds": list(EDGE_KINDS),
        "width": width,
    }


def load_explorer(
    checkpoint: Checkpoint, path: Path, kind: str | None = None
) -> tuple[ExplorerNetwork, dict[str, int]]:
    """The network of a checkpoint, and the numbers of the kinds of nodes.

    Raises:
        InputError: the checkpoint is of something else, or of another version of the observation.
    """
    about = checkpoint.metadata
    allowed = (TEACHER, STUDENT) if kind is None else (kind,)
    if about.get("kind") not in allowed:
        raise InputError(
            f"{path}: is a checkpoint of a {about.get('kind')}; allowed is one of a {' or '.join(allowed)}"
        )
    network = about.get("network", {})
    if "node_kinds" not in network or "width" not in network:
        raise InputError(
            f"{path.with_suffix('.json')}: network: lacks node_kinds or width; allowed is the file as it was written"
        )
    numbers = {name: number for number, name in enumerate(network["node_kinds"], start=1)}
    for key in ("features", "edge_kinds"):
        names = [RENAMED_FEATURES.get(name, name) for name in network.get(key, ())]
        network = {**network, key: names}
    if network != explorer_metadata(numbers, network["width"]):
        raise InputError(
            f"{path}: was trained on other features; allowed is a checkpoint of this version"
        )
    made = ExplorerNetwork(len(numbers), network["width"])
    try:
        made.load_state_dict(checkpoint.weights)
    except RuntimeError as error:
        raise InputError(
            f"{path}: its weights do not fit {path.with_suffix('.json')}; allowed are the files of one training"
        ) from error
    return made.eval(), numbers


def _check_classes(classes: Collection[str], numbers: Collection[str], path: Path) -> None:
    unknown = sorted(set(classes) - set(numbers))
    if unknown:
        raise InputError(
            f"--agent {path}: was not trained with {', '.join(unknown)}; train one with your objects"
        )


class LearnedExplorer:
    """Takes the likeliest pick and place for which there is room (a `Policy`)."""

    def __init__(
        self,
        network: ExplorerNetwork,
        node_kind_ids: dict[str, int],
        path: Path,
        config: ExplorationConfig,
        backend: Backend | None = None,
    ) -> None:
        """With a network.

        Args:
            network, node_kind_ids: see `load_explorer`; path: of the checkpoint, for errors.
            config: how objects are put down.
            backend: of the episode whose true scene the agent knows; None: it knows K_t.
        """
        self._network, self._numbers, self._path = network, node_kind_ids, path
        self._config, self._backend = config, backend

    def __call__(
        self,
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        """Choose the next move.

        Raises:
            InputError: an object of a class that the agent has not learned.
        """
        shown = belief.objects if self._backend is None else self._backend.scene.objects
        _check_classes({o.object_class.name for o in shown}, self._numbers, self._path)
        graph = build_exploration_graph(
            shown,
            observation,
            belief.history,
            self._numbers,
            belief.invalid_moves,
        )
        allowed, names = graph["action_mask"], tuple(o.name for o in shown)
        chances: dict[str, float] = {}
        while allowed.any():
            moves, _, _, picks = sample_actions(self._network, collate_graphs([graph]), None)
            # As the network had it first: what has no room and is passed over stays among them.
            chances = chances or {
                name: float(picks[0, k])
                for k, name in enumerate(names, start=1)
                if allowed[k].any()
            }
            x, y = moves[0].tolist()
            for place in (0, y):
                move = Move(names[x - 1], names[place - 1] if place else TRAY)
                if (
                    allowed[x, place]
                    and find_free_placements(observation, move, self._config) is not None
                ):
                    return Decision(move, chances, names)
                allowed[x, place] = 0
        return Decision(None)


class LearnedExplorerFactory:
    """Makes a `LearnedExplorer` for each episode.

    Attributes:
        privileged: whether it knows everything.
    """

    def __init__(
        self, path: Path, config: ExplorationConfig, classes: Collection[str] = ()
    ) -> None:
        """Loads a checkpoint of `training/train_explorer_ppo.py` or `training/train_explorer_dagger.py`.

        Args:
            path: of the checkpoint.
            config: how objects are put down.
            classes: names of those that it will meet, as far as that is known.

        Raises:
            InputError: it cannot be read, is none of an explorer, or has not learned one of the classes.
        """
        self._path, self._config = path, config
        checkpoint = load_checkpoint(path)
        self._network, self._numbers = load_explorer(checkpoint, path)
        _check_classes(classes, self._numbers, path)
        self.privileged = checkpoint.metadata["kind"] == TEACHER

    def __call__(self, backend: Backend | None = None) -> LearnedExplorer:
        """Return the policy of an episode; only a privileged one needs its backend."""
        true = backend if self.privileged else None
        return LearnedExplorer(self._network, self._numbers, self._path, self._config, true)
