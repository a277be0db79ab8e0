"""`ClutterExploration-v0`: the exploration task as a gymnasium environment (SPEC section 4)."""

from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene import TRAY, Scene, SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset, relayout
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.episode import BackendFactory, make_teleport_backend_factory
from drake_clutter.tasks.exploration_graph import (
    EDGE_KINDS,
    FEATURE_BOUND,
    GLOBAL_FEATURES,
    NODE_FEATURES,
    ExplorationObservation,
    build_exploration_graph,
)
from drake_clutter.tasks.exploration_task import ExplorationTask, MoveAttempt, TerminationReason

DEFAULT_SCENES = "training/scenes/train_sg_star.json"
MAX_RESET_ATTEMPTS = 100


class ClutterExploration(gymnasium.Env[ExplorationObservation, Any]):
    """Find every object that is hidden.

    A reset draws a graph from a set of scenes and lays it out with its stacks in new places; with `options={"scene": k}` it takes
    the k-th scene of a frozen set as it is.

    Observation: see `exploration_graph`, with room for `most_objects`; of K_t (pose and class of what has ever been in view), or,
        if `privileged`, of all objects as they are. Node 0 is the tray. Nodes keep their numbers while an episode lasts.
    Action: (x, y), nodes: x goes onto y. `allowed` of the observation says which moves may be made; any other changes nothing but
        counts as one of `max_moves`.
    Reward: r_d per newly detected object; r_s, and the end, when the scene collapses. `truncated` after `max_moves`, or when
        no move is left that has not failed.
    The `info` of a step has the `step` (a `tasks.exploration.Step`), if the move was allowed, and, when the episode is over, the
    `end`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012, gymnasium's name

    def __init__(
        self,
        scenes: SceneDataset | Path | str | None = None,
        *,
        privileged: bool = False,
        fidelity: str | BackendFactory = "static_or_drake",
        max_moves: int | None = None,
        max_objects: int = 24,
        config: ClutterConfig | None = None,
    ) -> None:
        """Makes an environment.

        Args:
            scenes: a set, or the file of one; None: the shipped training set.
            privileged: whether all objects are seen, or K_t.
            fidelity: one of `TELEPORT_FIDELITIES`, or what starts episodes on other backends.
            max_moves: after which an episode ends; None: the config's.
            max_objects: that a scene may have.
            config: the world; None: the default one, in the cell that the scenes were made with.
        """
        if not isinstance(scenes, SceneDataset):
            scenes = load_scene_dataset(
                resource_path(DEFAULT_SCENES) if scenes is None else Path(scenes), load_catalog()
            )
        self._config = config or ClutterConfig(cell=scenes.cell)
        self._privileged, self.scenes = privileged, scenes
        self._max_moves = max_moves or self._config.exploration.max_moves
        self._nodes = max_objects + 1
        self.grammar = scenes.grammar
        self.node_kind_ids = assign_node_kind_ids([c.name for c in scenes.classes])
        if isinstance(fidelity, str):
            fidelity = make_teleport_backend_factory(fidelity, self._config)
        self._start_backend = fidelity
        self._judge = StaticStabilityJudge(self._config)
        box, n, e = gymnasium.spaces.Box, self._nodes, self._nodes * (self._nodes - 1) // 2
        spaces: dict[str, gymnasium.Space[Any]] = {
            "node_kind": box(0, len(self.node_kind_ids), (n,), np.int8),
            "node_features": box(
                -FEATURE_BOUND, FEATURE_BOUND, (n, len(NODE_FEATURES)), np.float32
            ),
            "edge_links": box(0, n - 1, (e, 2), np.int16),
            "edge_kind": box(0, len(EDGE_KINDS), (e,), np.int8),
            "global_features": box(0, FEATURE_BOUND, (len(GLOBAL_FEATURES),), np.float32),
            "action_mask": box(0, 1, (n, n), np.int8),
        }
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.MultiDiscrete([n, n])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ExplorationObservation, dict[str, Any]]:
        """A scene at rest, and the first look at it."""
        super().reset(seed=seed)
        number = None if options is None else options.get("scene")
        if number is None:
            return self._begin_anew(), {}
        if not 0 <= number < len(self.scenes.scenes):
            raise InputError(
                f"scene: {number}; allowed is 0 to {len(self.scenes.scenes) - 1}, as {self.scenes.name} has them"
            )
        return self.reset_to_scene(
            self.scenes.settled_scene(number, self.grammar, self._config)
        ), {}

    def _begin_anew(self) -> ExplorationObservation:
        """With a scene that stands and hides something where its stacks are put now."""
        for _ in range(MAX_RESET_ATTEMPTS):
            index = int(self.np_random.integers(len(self.scenes.scenes)))
            scene = relayout(
                self.scenes.derivation(index, self.grammar),
                self.grammar,
                self._config,
                self.np_random,
            )
            if self._judge.find_instability(scene) is None and len(scene.objects) < self._nodes:
                observation = self.reset_to_scene(scene)
                if self.task.termination is None:
                    return observation
        most = self._nodes - 1
        raise InputError(
            f"{self.scenes.name}: of {MAX_RESET_ATTEMPTS} scenes none stands and hides something, with at most {most} objects"
        )

    def reset_to_scene(self, scene: Scene) -> ExplorationObservation:
        """Starts an episode on a scene at rest, and looks.

        Raises:
            InputError: it has more objects than there is room for.
        """
        if len(scene.objects) >= self._nodes:
            raise InputError(f"max_objects: {self._nodes - 1}; this scene has {len(scene.objects)}")
        self.backend, self._refused = self._start_backend(scene, self.np_random), 0
        self.task = ExplorationTask(
            scene,
            self.backend.perception,
            self._config.exploration,
            self._max_moves,
        )
        return self._noted(self.observe())

    def _noted(self, observation: ExplorationObservation) -> ExplorationObservation:
        """Keeps which moves it allows, for the next step."""
        self._allowed = observation["action_mask"].copy()
        return observation

    @property
    def _spent(self) -> bool:
        """Whether all moves have been made, those included that were not allowed."""
        return len(self.task.transitions) + self._refused >= self._max_moves

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects that nodes 1, 2, ... stand for."""
        return tuple(o.name for o in self._shown(self._privileged))

    def _shown(self, privileged: bool) -> tuple[SceneObject, ...]:
        return self.backend.scene.objects if privileged else self.backend.belief.objects

    def observe(self, *, privileged: bool | None = None) -> ExplorationObservation:
        """The observation; or the other one, for a teacher that watches a student."""
        shown = self._shown(self._privileged if privileged is None else privileged)
        belief, observation = self.backend.belief, self.backend.perception.observation
        return build_exploration_graph(
            shown,
            observation,
            belief.history,
            self.node_kind_ids,
            belief.invalid_moves,
            max_nodes=self._nodes,
        )

    def step(
        self, action: Any
    ) -> tuple[ExplorationObservation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Carries a move out; one that is not allowed changes nothing, but counts towards the number of moves."""
        x, y = (int(v) for v in action)
        names = self.objects
        if not self._allowed[x, y]:
            self._refused += 1
            return (
                self.observe(),
                0.0,
                False,
                self._spent,
                {"termination": TerminationReason.OUT_OF_MOVES} if self._spent else {},
            )
        move = Move(names[x - 1], names[y - 1] if y else TRAY)
        outcome = self.backend.step(move)
        if outcome.result is not MoveResult.COLLAPSED:
            self.backend.update_belief()
        step = self.task.record(MoveAttempt(Decision(move), outcome, self.backend.perception))
        observation, end = self._noted(self.observe()), self.task.termination
        if end is None and self._spent:
            end = TerminationReason.OUT_OF_MOVES
        if end is None and not observation["action_mask"].any():
            end = TerminationReason.GAVE_UP
        over = end in (TerminationReason.ALL_FOUND, TerminationReason.COLLAPSED)
        info: dict[str, Any] = {"transition": step}
        if end is not None:
            info["termination"] = end
        return observation, step.reward, over, end is not None and not over, info


def assign_node_kind_ids(classes: list[str]) -> dict[str, int]:
    """The kinds of nodes of `exploration_graph`, by name: the tray's, then the classes'."""
    return {name: number for number, name in enumerate((TRAY, *classes), start=1)}
