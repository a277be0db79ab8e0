"""The loop without an arm: a detector sees rendered images, what the agent picks appears at its place, and Drake settles it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.geometry import carried, rests_on
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation, Outcome
from drake_clutter.scenes.placement import choose_placement
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera import OverheadCamera
from drake_clutter.simulation.executor import SettleExecutor
from drake_clutter.station.arm_executor import nearest
from drake_clutter.systems.exploration_agent import AgentState, Choose, ExplorationAgent, Phase, hopeless
from drake_clutter.systems.scene_perception import Perceive, for_who_sees
from drake_clutter.systems.tracking import tracked
from drake_clutter.tasks.exploration import ExplorationTask, Step


def explore_images(
    scene: Scene,
    choose: Choose,
    perceive: Perceive,
    *,
    max_moves: int,
    seed: int,
    world: ClutterConfig,
    report: Callable[[Step], None] = lambda _: None,
) -> tuple[ExplorationTask, tuple[SceneObject, ...]]:
    """Plays an episode on a scene at rest: the book of a referee who knows the truth, and what the agent knows at the end.

    Arguments: as of `ClosedLoop`.
    """
    world = for_who_sees(world)
    executor, camera = SettleExecutor(world, follow_falls=False), OverheadCamera(world.cell.camera)
    task = ExplorationTask(scene, executor, LabelDetector(world.cell.camera), world.exploration, max_moves)
    empty = camera.render(replace(scene, objects=())).depth

    def not_worth_trying(known: Sequence[SceneObject], observation: Observation) -> list[Move]:
        free = {o.name for o in known if not rests_on(o, known)}
        return hopeless(known, observation, free, empty, world.exploration)

    options: dict[str, Any] = {"max_moves": max_moves, "seed": seed, "hopeless": not_worth_trying}
    agent, state = ExplorationAgent(choose=choose, track=tracked, **options), AgentState()

    def seen() -> Observation:
        images = camera.render(task.scene)
        return perceive(images.depth, images.color, ())

    while task.end is None:
        state = agent.decided(state, seen())
        if state.phase is Phase.DONE or state.request is None:
            return task, state.known
        request, rng = state.request, item_rng(seed, state.request.number, 1)
        move, decision = request.truly(task.scene.objects)
        X_TO = choose_placement(request.observation, request.move, world.exploration, rng)
        if X_TO is None:
            state = state.refused
            report(task.note(move, Outcome(MoveResult.NO_FREE_SPOT, task.scene), decision))
            continue
        believed = next(o for o in request.known if o.name == request.move.pick).X_TO
        outcome = executor.put(task.scene, move.pick, carried(believed, X_TO, nearest(task.scene.objects, believed).X_TO), rng)
        state = state.placed(X_TO)
        report(task.note(move, replace(outcome, released=X_TO), decision))
    return task, agent.looked(state, seen())[0].known
