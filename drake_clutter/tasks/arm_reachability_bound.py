"""Upper bound on the objects that exploration with the arm can find."""

from drake_clutter.config import ClutterConfig
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.oracle_search import OracleSearch


class ArmReachabilityBound:
    """Finds objects that stay hidden behind objects which the gripper cannot grasp."""

    def __init__(self, config: ClutterConfig) -> None:
        """Create the bound.

        Args:
            config: Configuration of the simulated world.
        """
        self._config = config
        self._judge = StaticStabilityJudge(config)
        self._search = OracleSearch(config, self._judge)

    def find_unrevealable(self, scene: Scene) -> tuple[str, ...]:
        """Return the names of the objects that no sequence of the arm's moves can reveal.

        They stay hidden behind objects that the gripper cannot grasp, or behind their supports.

        Args:
            scene: A scene at rest.
        """
        cell = self._config.cell.with_support(scene.support)
        planner = PickPlacePlanner(cell, PlannerConfig())
        fixed = {o.name for o in scene.objects if not planner.can_grasp(o)}
        supports = self._judge.find_supports(scene)
        if not isinstance(supports, InconclusiveVerdict):
            while below := set[str]().union(*(supports[name] for name in fixed)) - fixed - {TRAY}:
                fixed |= below
        observation, _ = self._judge.ray_caster.observe(scene)
        in_view = [detection.name for detection in observation.detections]
        return self._search.find_unrevealable(scene, in_view, fixed)
