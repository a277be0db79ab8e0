"""The reference judge: hydroelastic contact simulation and rendered images."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, perturb_poses
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.settle import SettleResult, settle
from drake_clutter.stability.static_judge import StaticStabilityJudge

TOUCHING_MARGIN = 0.003
"""Objects farther apart than this settle independently [m].

The distance includes the random offsets.
"""


class DrakeJudge:
    """Settles a scene in Drake and renders its camera image (a `SceneJudge`).

    Groups of objects that do not touch are settled separately. The first group that falls decides,
    as a scene is stable only if all groups are; the effect of a fall on other groups changes no
    verdict. Groups that the static judge expects to fall, or cannot judge, come first, because an
    early fall saves the other simulations.
    """

    def __init__(self, config: ClutterConfig) -> None:
        self._config = config
        self._renderer = CameraRenderer(config.cell.camera)
        self._static_judge = StaticStabilityJudge(config)
        self._single_results: dict[
            tuple[ObjectClass, Support, float, tuple[float, ...]], SettleResult
        ] = {}

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict:
        """Return the verdict; see `SceneJudge.judge`."""
        settled: dict[str, Pose] = dict(scene.poses)
        for _, result in self.settle_groups(scene, rng):
            settled |= result.poses
            if result.instability is not None:
                return Verdict(result.instability, settled, {}, ())
        return self.judge_at_rest(scene.with_poses(settled))

    def settle_groups(
        self, scene: Scene, rng: np.random.Generator
    ) -> Iterator[tuple[tuple[SceneObject, ...], SettleResult]]:
        """Settle groups of touching objects one after the other.

        Args:
            scene: The scene.
            rng: Draws the random offsets of the objects.

        Yields:
            The objects of a group, offsets included, and the result of settling them.
        """
        config = self._config.settle
        groups = group_touching_objects(
            perturb_poses(scene.objects, config.jitter, rng), TOUCHING_MARGIN
        )
        for group in sorted(
            groups,
            key=lambda group: (
                self._static_judge.find_instability(replace(scene, objects=tuple(group))) is None
            ),
        ):
            if len(group) == 1 and _is_clear_of_rim(group[0], scene.support):
                yield tuple(group), self._settle_single(group[0], scene.support)
            else:
                yield tuple(group), settle(group, scene.support, config)

    def _settle_single(self, single: SceneObject, support: Support) -> SettleResult:
        """Settle an object that touches no other one.

        The result does not depend on its position, so it is simulated once, at the center.
        """
        x, y, z = single.X_TO.translation
        key = (single.object_class, support, z, single.X_TO.quaternion)
        if key not in self._single_results:
            centered = replace(single, X_TO=single.X_TO.translated((-x, -y, 0.0)))
            self._single_results[key] = settle([centered], support, self._config.settle)
        settled = self._single_results[key]
        (pose,) = settled.poses.values()
        instability = settled.instability
        if instability is not None:
            instability = replace(instability, object=single.name)
        return SettleResult(instability, {single.name: pose.translated((x, y, 0.0))}, ())

    def judge_at_rest(self, scene: Scene) -> Verdict:
        """Return the verdict on a scene that is at rest: which objects it hides."""
        fractions = self._renderer.visible_fractions(scene)
        return Verdict(None, scene.poses, fractions, self._renderer.hidden_objects(fractions))


def _is_clear_of_rim(scene_object: SceneObject, support: Support) -> bool:
    """Return whether an object is clear of the rim of the support."""
    lower, upper = scene_object.bounds_T
    return bool((np.abs([lower[:2], upper[:2]]) < support.half_size - TOUCHING_MARGIN).all())
