"""Pick-and-place moves by teleport, settled in Drake."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.interfaces import MotionSample, MoveResult, Outcome, PickPlaceCommand
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, perturb_poses
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import SettleResult, settle

_COLLAPSE_TIME_STEP = 0.005
"""Time step for the aftermath of a fall, which is only recorded [s]."""


class SettleExecutor:
    """Executes moves by teleport and settles affected objects (a `MoveExecutor`).

    The picked object appears at its placement, and objects that it carried fall. The scene
    collapses when any other object moves or rotates past the limits of stability, or the picked
    object does, relative to its pose of release. Only the groups of objects that touch the picked
    one before or after the move are settled. If one of them falls, the whole scene is settled
    again, so that it can hit its neighbors.
    """

    def __init__(self, config: ClutterConfig, *, simulate_collapse: bool = True) -> None:
        """Create an executor.

        Args:
            config: The simulated world.
            simulate_collapse: Whether to simulate the effect of a fall on the whole scene.
                Otherwise, the scene and motion of the outcome contain only the falling group, up to
                the detection of the fall. The result is the same.
        """
        self._config = config
        self._simulate_collapse = simulate_collapse

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Return the outcome of a command; see `MoveExecutor.execute`.

        The pose of release gets a random offset.
        """
        pick = command.move.pick
        # The released object sinks by the release height and must count as calm afterwards.
        displacement = (
            self._config.settle.early_stop_displacement + self._config.exploration.release_height
        )
        settle_config = replace(self._config.settle, early_stop_displacement=displacement)
        placed = replace(scene[pick], X_TO=command.X_TO_place)
        (released,) = perturb_poses([placed], settle_config.jitter, rng)
        moved = scene.with_poses({pick: released.X_TO})
        beside = {pick} if command.is_beside(scene.support) else set[str]()

        groups = group_touching_objects(scene.objects, TOUCHING_MARGIN)
        affected = next(names for group in groups if pick in (names := {o.name for o in group}))
        settled = []
        for group in _groups_to_settle(moved, released):
            if affected.isdisjoint(o.name for o in group):
                continue
            settled.append(settle(group, scene.support, settle_config, record=True, beside=beside))
            if settled[-1].instability is not None:
                if self._simulate_collapse:
                    coarse_config = replace(settle_config, time_step=_COLLAPSE_TIME_STEP)
                    whole = settle(
                        moved.objects,
                        scene.support,
                        coarse_config,
                        record=True,
                        simulate_collapse=True,
                        beside=beside,
                    )
                    poses, motion = whole.poses, whole.motion
                else:
                    poses, motion = settled[-1].poses, _merge_motions(moved.poses, settled)
                return Outcome(
                    MoveResult.of_instability(settled[-1].instability),
                    moved.with_poses(poses),
                    settled[-1].instability,
                    motion,
                    X_TO_released=released.X_TO,
                )
        motion = _merge_motions(moved.poses, settled)
        return Outcome(
            MoveResult.PLACED,
            moved.with_poses(_merge_poses(settled)),
            None,
            motion,
            X_TO_released=released.X_TO,
        )


def _groups_to_settle(scene: Scene, released: SceneObject) -> list[list[SceneObject]]:
    """Return groups of objects that may touch each other.

    The released object may fall on all objects below it, however far, so these share its group.
    """
    lower, upper = (bound[:2] for bound in released.bounds_T)
    with_released, others = list[SceneObject](), []
    for group in group_touching_objects(scene.objects, TOUCHING_MARGIN):
        if any(
            (lower <= o.bounds_T[1][:2]).all() and (o.bounds_T[0][:2] <= upper).all() for o in group
        ):
            with_released += group
        else:
            others.append(group)
    return [with_released, *others]


def _merge_poses(settled: Sequence[SettleResult]) -> dict[str, Pose]:
    """Return the last poses of separately settled groups, by name."""
    return {name: pose for result in settled for name, pose in result.poses.items()}


def _merge_motions(
    start: dict[str, Pose], settled: Sequence[SettleResult]
) -> tuple[MotionSample, ...]:
    """Return the motions of separately settled groups as one motion of the scene.

    Groups whose motion has ended keep their last poses.
    """
    longest = max((result.motion for result in settled), key=len)
    poses, frames = dict(start), []
    for index, frame in enumerate(longest):
        for result in settled:
            poses |= result.motion[min(index, len(result.motion) - 1)].poses
        frames.append(MotionSample(frame.time, dict(poses)))
    return tuple(frames)
