"""Gymnasium environment of scene exploration."""

from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, format_value
from drake_clutter.limits import MAX_NODES
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.scene import TRAY, Scene, SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset, relayout
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.environment_interface import (
    RENDER_METADATA,
    check_index,
    check_instance,
    check_is_reset,
    check_render_mode,
    check_reset_options,
    index_type,
    render_picture,
)
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
from drake_clutter.tasks.search_target import SearchTarget, find_target, missing_target_error
from drake_clutter.validation import Count, Flag, validate

DEFAULT_SCENES = "training/scenes/train_sg_star.json"
"""Scene dataset of the environment by default."""
MAX_RESET_ATTEMPTS = 100
"""Maximum number of scenes that a reset lays out until one is stable and hides objects."""


class ClutterExploration(gymnasium.Env[ExplorationObservation, Any]):
    """Environment `ClutterExploration-v0`: find every hidden object, or a target.

    A reset samples a scene of a dataset, and lays it out with its stacks at new places. With
    `options={"scene": k}` it uses the settled scene k of the dataset instead.

    Observation space, a `Dict` with N = `max_objects` + 1: the arrays of `build_exploration_graph`,
    of K_t (the objects that have been in view) or, if privileged, of all objects. Node 0 is the
    tray. Nodes keep their indices during an episode.

    Action space: `MultiDiscrete([N, N])`, the nodes x and y of a move of x onto y; with
    `flat_actions`, `Discrete(N * N)`, the number x * N + y. `action_mask` of the observation marks
    the allowed moves; any other changes nothing, but counts as a move.

    Reward: `detection_reward` per newly detected object; `collapse_penalty` if the scene collapses
    or an object leaves the support.

    Termination: all objects have been detected, the scene has collapsed, or an object has left the
    support. Truncation: after `max_moves` moves, or if no move is allowed.

    With a target, an episode ends when an object of the target has been detected, which alone earns
    the `detection_reward`, and observations have two more arrays: `target_kind` and `is_target`.
    The policy observes the class. A privileged one observes which nodes are the target. A reset
    samples scenes in which the target is hidden.

    The `info` of a step has the `transition` (a `Transition`) if the move was allowed, and at the
    end of an episode the `termination` (a `TerminationReason`). The outcome of the transition names
    the object that fell, and its scene has the poses at the end.
    """

    metadata: dict[str, Any] = RENDER_METADATA

    def __init__(
        self,
        scenes: SceneDataset | Path | str | None = None,
        *,
        privileged: bool = False,
        fidelity: str | BackendFactory = "static_or_drake",
        max_moves: int | None = None,
        max_objects: int = 24,
        config: ClutterConfig | None = None,
        flat_actions: bool = False,
        render_mode: str | None = None,
        target: str | None = None,
    ) -> None:
        """Create an environment.

        Args:
            scenes: A scene dataset or its file; None selects `DEFAULT_SCENES`.
            privileged: Whether observations show all objects at their true poses, instead of K_t.
            fidelity: One of `TELEPORT_FIDELITIES`, or a factory of other backends.
            max_moves: Maximum number of moves of an episode; None selects that of the config.
            max_objects: Maximum number of objects of a scene.
            config: Configuration of the simulated world; None selects the default with the
                dataset's work cell.
            flat_actions: Whether an action is the number x * N + y instead of the pair (x, y).
            render_mode: "rgb_array" for pictures, or None.
            target: What an episode looks for: any object of a class, the object of a name, or
                "random-hidden", an object that is drawn among the hidden ones. None looks for all
                objects.

        Raises:
            InputError: There is no such file, fidelity or render mode, or another argument is not
                allowed.
        """
        self.render_mode = check_render_mode(render_mode)
        check_instance(config, ClutterConfig, "config")
        if max_moves is not None:
            validate(Count, max_moves, "max_moves")
        validate(Flag, privileged, "privileged")
        validate(Flag, flat_actions, "flat_actions")
        if not 1 <= max_objects <= MAX_NODES:
            raise InputError(f"max_objects: {max_objects}; expected 1 to {MAX_NODES}")
        if not isinstance(scenes, SceneDataset):
            path = resource_path(DEFAULT_SCENES) if scenes is None else Path(scenes)
            scenes = load_scene_dataset(path, load_catalog())
        self.scenes = scenes
        self._config = config or ClutterConfig(cell=scenes.cell)
        self._privileged = privileged
        self._max_moves = max_moves or self._config.exploration.max_moves
        self._max_nodes = max_objects + 1
        self.grammar = scenes.grammar
        self.node_kind_ids = assign_node_kind_ids([c.name for c in scenes.classes])
        if isinstance(fidelity, str):
            fidelity = make_teleport_backend_factory(fidelity, self._config)
        self._make_backend = fidelity
        self._judge = StaticStabilityJudge(self._config)
        n = self._max_nodes
        e = n * (n - 1) // 2
        num_kinds = len(self.node_kind_ids)
        box = gymnasium.spaces.Box
        spaces: dict[str, gymnasium.Space[Any]] = {
            "node_kind": box(0, num_kinds, (n,), index_type(num_kinds)),
            "node_features": box(
                -FEATURE_BOUND, FEATURE_BOUND, (n, len(NODE_FEATURES)), np.float32
            ),
            "edge_links": box(0, n - 1, (e, 2), np.int16),
            "edge_kind": box(0, len(EDGE_KINDS), (e,), np.int8),
            "global_features": box(0, FEATURE_BOUND, (len(GLOBAL_FEATURES),), np.float32),
            "action_mask": box(0, 1, (n, n), np.int8),
        }
        self.target_text = target
        if target is not None:
            spaces |= {
                "target_kind": box(1, num_kinds, (1,), index_type(num_kinds)),
                "is_target": box(0, 1, (n,), np.int8),
            }
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self._flat_actions = flat_actions
        self.action_space: gymnasium.Space[Any] = (
            gymnasium.spaces.Discrete(n * n)
            if flat_actions
            else gymnasium.spaces.MultiDiscrete([n, n])
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ExplorationObservation, dict[str, Any]]:
        """Start an episode on a scene at rest, and observe it.

        Raises:
            InputError: The dataset has no scene of the given index, or no suitable scene was found.
        """
        super().reset(seed=seed)
        index = check_reset_options(options, ("scene",)).get("scene")
        if index is None:
            return self._reset_to_random_scene(), {}
        is_integer = isinstance(index, int | np.integer) and not isinstance(index, bool)
        if not is_integer or not 0 <= index < len(self.scenes.scenes):
            raise InputError(
                f"scene: {format_value(index)}; expected 0 to {len(self.scenes.scenes) - 1}, "
                f"as {self.scenes.name} has them"
            )
        scene = self.scenes.settled_scene(index, self.grammar, self._config)
        return self.reset_to_scene(scene), {}

    def _reset_to_random_scene(self) -> ExplorationObservation:
        """Start an episode on a new layout that is stable and hides objects."""
        for _ in range(MAX_RESET_ATTEMPTS):
            index = int(self.np_random.integers(len(self.scenes.scenes)))
            scene = relayout(
                self.scenes.derivation(index, self.grammar),
                self.grammar,
                self._config,
                self.np_random,
            )
            is_stable = self._judge.find_instability(scene) is None
            if is_stable and len(scene.objects) < self._max_nodes:
                is_started = self._start(scene)
                if is_started and self.task.termination is None:
                    return self._observe_and_keep_mask()
        wanted = "something" if self.target_text is None else f"the target {self.target_text}"
        raise InputError(
            f"{self.scenes.name}: of {MAX_RESET_ATTEMPTS} scenes none stands and hides {wanted}, "
            f"with at most {self._max_nodes - 1} objects"
        )

    def reset_to_scene(self, scene: Scene) -> ExplorationObservation:
        """Start an episode on a given scene at rest, and return the observation.

        Raises:
            InputError: The scene has more than `max_objects` objects, or has no target.
        """
        if len(scene.objects) >= self._max_nodes:
            raise InputError(
                f"max_objects: {self._max_nodes - 1}; this scene has {len(scene.objects)}"
            )
        if not self._start(scene):
            raise missing_target_error(self.target_text or "", scene)
        return self._observe_and_keep_mask()

    def _start(self, scene: Scene) -> bool:
        """Start an episode on a scene at rest; return whether the scene has a target."""
        self.backend = self._make_backend(scene, self.np_random)
        self._num_masked_moves = 0
        self.target: SearchTarget | None = None
        if self.target_text is not None:
            in_view = [d.name for d in self.backend.perception.observation.detections]
            self.target = find_target(self.target_text, scene, in_view, self.np_random)
            if self.target is None:
                return False
        self.task = ExplorationTask(
            scene,
            self.backend.perception,
            self._config.exploration,
            self._max_moves,
            self.target,
        )
        return True

    def _observe_and_keep_mask(self) -> ExplorationObservation:
        """Return the observation, and keep its action mask for the next step."""
        observation = self.observe()
        self._action_mask = observation["action_mask"].copy()
        return observation

    @property
    def _is_out_of_moves(self) -> bool:
        """Whether the maximum number of moves was made, including masked ones."""
        return len(self.task.transitions) + self._num_masked_moves >= self._max_moves

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects of nodes 1, 2, ..."""
        return tuple(o.name for o in self._observed_objects(self._privileged))

    def _observed_objects(self, privileged: bool) -> tuple[SceneObject, ...]:
        return self.backend.scene.objects if privileged else self.backend.belief.objects

    def observe(self, *, privileged: bool | None = None) -> ExplorationObservation:
        """Return the current observation.

        Args:
            privileged: Whether to show all objects, instead of K_t; None selects the setting of the
                environment. A teacher that labels a student's states needs the other observation.
        """
        if privileged is None:
            privileged = self._privileged
        belief = self.backend.belief
        return build_exploration_graph(
            self._observed_objects(privileged),
            self.backend.perception.observation,
            belief.history,
            self.node_kind_ids,
            belief.invalid_moves,
            max_nodes=self._max_nodes,
            target=self.target,
        )

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions are allowed, as sb3-contrib requires.

        Returns:
            With flat actions, the mask of the pairs. Shape (N * N,). Otherwise the masks of x and
            y, which sb3-contrib samples independently: nodes that are part of an allowed pair, so
            that some of their pairs are not allowed. Shape (2 * N,).

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
        """
        check_is_reset(self, "backend")
        mask = self._action_mask.astype(bool)
        return mask.ravel() if self._flat_actions else np.concatenate([mask.any(1), mask.any(0)])

    def render(self) -> Any:
        """Return the camera's picture as (height, width, 3) uint8; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
        """
        if self.render_mode is None:
            return None
        check_is_reset(self, "backend")
        return render_picture(self.backend.scene, self._config)

    def _node_pair(self, action: Any) -> tuple[int, int]:
        """Return the nodes x and y of an action."""
        n = self._max_nodes
        if self._flat_actions:
            return divmod(check_index(action, n * n, "action"), n)
        if np.shape(action) != (2,):
            raise InputError(f"action: {format_value(action)}; expected two nodes, x and y")
        return check_index(action[0], n, "action[0]"), check_index(action[1], n, "action[1]")

    def step(
        self, action: Any
    ) -> tuple[ExplorationObservation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Carry out a move; a masked move changes nothing, but counts as a move.

        Raises:
            gymnasium.error.ResetNeeded: There is no episode.
            InputError: There is no such action.
        """
        check_is_reset(self, "backend")
        x, y = self._node_pair(action)
        names = self.objects
        if not self._action_mask[x, y]:
            self._num_masked_moves += 1
            truncated = self._is_out_of_moves
            masked_info = {"termination": TerminationReason.OUT_OF_MOVES} if truncated else {}
            return self.observe(), 0.0, False, truncated, masked_info
        move = Move(names[x - 1], names[y - 1] if y else TRAY)
        outcome = self.backend.step(move)
        if not outcome.result.ends_episode:
            self.backend.update_belief()
        transition = self.task.record(MoveAttempt(Decision(move), outcome, self.backend.perception))
        observation = self._observe_and_keep_mask()
        termination = self.task.termination
        if termination is None and self._is_out_of_moves:
            termination = TerminationReason.OUT_OF_MOVES
        if termination is None and not observation["action_mask"].any():
            termination = TerminationReason.GAVE_UP
        terminated = termination is not None and (
            termination.is_success or termination.is_failed_move
        )
        truncated = termination is not None and not terminated
        info: dict[str, Any] = {"transition": transition}
        if termination is not None:
            info["termination"] = termination
        return observation, transition.reward, terminated, truncated, info


def assign_node_kind_ids(classes: list[str]) -> dict[str, int]:
    """Return the numbers of the kinds of nodes by name: the tray's, then the classes', from 1 on.

    Args:
        classes: Names of the object classes.
    """
    return {name: number for number, name in enumerate((TRAY, *classes), start=1)}
