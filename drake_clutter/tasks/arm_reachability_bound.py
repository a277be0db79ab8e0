"""What no arm finds in a scene, whatever it does: the ceiling for explorers that have one."""

from drake_clutter.config import ClutterConfig
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.oracle_search import OracleSearch


class ArmReachabilityBound:
    """Knows everything of a scene, and what the cup holds."""

    def __init__(self, world: ClutterConfig) -> None:
        """For scenes in a world."""
        self._world, self._judge = world, StaticStabilityJudge(world)
        self._search = OracleSearch(world, self._judge)

    def find_unrevealable(self, scene: Scene) -> tuple[str, ...]:
        """What stays hidden behind what no cup holds, and behind what carries that; the scene is at rest."""
        planner = PickPlacePlanner(self._world.cell.with_support(scene.support), PlannerConfig())
        fixed = {o.name for o in scene.objects if not planner.can_grasp(o)}
        supports = self._judge.find_supports(scene)
        if not isinstance(supports, InconclusiveVerdict):
            while below := set[str]().union(*(supports[name] for name in fixed)) - fixed - {TRAY}:
                fixed |= below
        in_view = self._judge.ray_caster.observe(scene)[0].detections
        return self._search.find_unrevealable(scene, [d.name for d in in_view], fixed)
