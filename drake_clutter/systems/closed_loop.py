"""The closed loop: station, camera, perception, agent, planner and executor in one Diagram."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import MakeRenderEngineVtk
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.sensors import ImageDepth32F, RgbdSensor

from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.attempts import PlannerConfig
from drake_clutter.planning.plan import NoPlan, Plan, PlanFailure
from drake_clutter.planning.planner import PickPlacePlanner
from drake_clutter.scenes.geometry import carried
from drake_clutter.scenes.interfaces import Frame, Move, MoveResult, Observation, Outcome
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.scenes.unseen import unseen_blocks
from drake_clutter.simulation.camera import ENGINE, RENDERER, Intrinsics
from drake_clutter.station.arm_executor import LOOK, TIME_STEP, disturbed_by, judged, nearest, taking_part
from drake_clutter.station.clutter_station import ClutterStation, Freedom, Vacuum
from drake_clutter.station.pick_place import PickPlaceExecutor
from drake_clutter.systems.exploration_agent import (
    AgentState,
    ExplorationAgent,
    Phase,
    Request,
    in_true_names,
    infeasible_moves,
)
from drake_clutter.systems.move_planner import Answer, MovePlanner
from drake_clutter.systems.scene_perception import LabelPerception, Perceive, ScenePerception, for_who_sees
from drake_clutter.systems.tracking import tracked
from drake_clutter.tasks.belief import Belief, Policy
from drake_clutter.tasks.exploration import Attempt

LATENCY = 1.15
"""s, from an image to the plan: 0.15 for perception, 1 for planning."""
GUARDED = PlannerConfig(descent=0.08, above=0.007)
"""For objects known from images: of a box in a pile they show the top, and with a wrong class its height is wrong; what it is to
stand on may be a little higher, too."""
PATIENCE = 1.0
"""s, after a plan's end, for which what has fallen is followed."""


@dataclass(frozen=True)
class Timing:
    """How long an episode took.

    Attributes:
        robot: s simulated. wall: s.
        planning: s, of all plans.
    """

    robot: float
    wall: float
    planning: float


class ClosedLoop:
    """One scene and everything that searches it (a `Backend`).

    Attributes:
        diagram: all of it.
        scene: The true objects, as they were when the agent last looked.
        look: What a perfect detector sees of them.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        perceive: Perceive | None = None,
        seed: int,
        world: ClutterConfig,
        record: bool = False,
    ) -> None:
        """Builds the diagram around a scene at rest.

        Args:
            scene: the objects.
            perceive: what sees; None: the perfect detector.
            seed: of all chances.
            world: config.
            record: Whether outcomes have motions.
        """
        self.scene, self._record = scene, record
        world = replace(world, cell=world.cell.with_support(scene.support))
        self._world = world if perceive is None else for_who_sees(world)
        builder, camera, eye = DiagramBuilder(), world.cell.camera, Intrinsics.of(world.cell.camera)
        self.station: ClutterStation = builder.AddSystem(
            ClutterStation(
                world.cell,
                [(o.name, o.object_class) for o in scene.objects],
                time_step=TIME_STEP,
                visuals=True,
            )
        )
        self.station.set_name("clutter_station")
        seen = self.station.camera_scene_graph
        assert seen is not None
        seen.AddRenderer(RENDERER, MakeRenderEngineVtk(ENGINE))
        sensor = builder.AddSystem(RgbdSensor(seen.world_frame_id(), eye.X_TC, eye.color, eye.depth))
        sensor.set_name("overhead_camera")
        sees: Perceive = perceive or LabelPerception(scene, self.station, world)
        perception = ScenePerception.AddToBuilder(builder, perceive=sees, width=camera.width, height=camera.height)
        self._tracks = perceive is not None
        ways = GUARDED if self._tracks else PlannerConfig()
        self._ways = PickPlacePlanner(world.cell, ways)
        self.agent = ExplorationAgent.AddToBuilder(
            builder,
            config=self._world.exploration,
            seed=seed,
            tracker=tracked if self._tracks else None,
            action_filter=self._infeasible_moves,
        )
        self._planner = planner = MovePlanner.AddToBuilder(builder, plan=self._plan, seed=seed, latency=LATENCY)
        self.executor = PickPlaceExecutor.AddToBuilder(builder, cell=world.cell)
        for source, target, ports in (
            (self.station, sensor, {"query": "geometry_query"}),
            (sensor, perception, {"depth_image_32f": "depth_image", "color_image": "color_image"}),
            (self.station, perception, {"body_poses": "body_poses"}),
            (perception, self.agent, {"observation": "observation"}),
            (planner, self.agent, {"answer": "answer"}),
            (self.executor, self.agent, {"finished": "finished"}),
            (self.agent, planner, {"request": "request"}),
            (planner, self.executor, {"plan": "plan"}),
            (self.executor, self.station, {"command": "command"}),
            (self.station, self.executor, {"bellows": "bellows"}),
        ):
            for output, input_ in ports.items():
                builder.Connect(source.GetOutputPort(output), target.GetInputPort(input_))
        self.diagram = builder.Build()
        self.diagram.set_name("closed_loop")
        self.simulator = Simulator(self.diagram)
        self.vacuum = Vacuum(self.station, self._suction)
        self._detector = LabelDetector(camera)
        self.look = self._detector.look(scene)
        self._planning, self._begun_at = 0.0, time.perf_counter()
        self._empty = self._empty_cell(sensor)

    def _empty_cell(self, sensor: RgbdSensor) -> NDArray[np.float32]:
        """(height, width) m, the depth of the cell as it is without objects: they are below the floor, where nobody sees them."""
        root = self.diagram.CreateDefaultContext()
        below = [replace(o, X_TO=o.X_TO.moved((0.0, 0.0, -10.0))) for o in self.scene.objects]
        self.station.set_scene(root, np.array(self._world.cell.robot.home), below)
        image: ImageDepth32F = sensor.depth_image_32F_output_port().Eval(sensor.GetMyContextFromRoot(root))
        return np.asarray(image.data[..., 0].copy())

    def _suction(self, root: Context) -> bool:
        context = self.executor.GetMyContextFromRoot(root)
        return bool(self.executor.GetOutputPort("suction").Eval(context)[0] > 0.5)

    def _infeasible_moves(self, belief: Belief, observation: Observation) -> list[Move]:
        """Moves of what no cup holds, and those that are not worth trying with any hand."""
        known = belief.objects
        able = {o.name for o in known if self._ways.can_pick(o, known)}
        return infeasible_moves(known, observation, able, self._empty, self.config)

    def _plan(self, request: Request, rng: np.random.Generator) -> Plan | NoPlan:
        if request.command is None:
            return NoPlan(PlanFailure.NO_FREE_SPOT, request.move.place)
        known = request.belief.objects
        unseen = unseen_blocks(known, request.observation, self._empty)
        found = self._ways.plan(known, request.move.pick, request.command.X_TO_place, unseen)
        self._planning += found.seconds
        return found

    def _agent_state(self, root: Context) -> AgentState:
        state: AgentState = self.agent.GetOutputPort("state").Eval(self.agent.GetMyContextFromRoot(root))
        return state

    @property
    def config(self) -> ExplorationConfig:
        """The task's config."""
        return self._world.exploration

    @property
    def belief(self) -> Belief:
        """What the agent knows now."""
        return self._agent_state(self.simulator.get_context()).belief

    @property
    def timing(self) -> Timing:
        """How long the episode has taken so far."""
        robot = self.simulator.get_context().get_time()
        return Timing(robot, time.perf_counter() - self._begun_at, self._planning)

    def rollout(self, policy: Policy) -> Iterator[Attempt]:
        """See `Backend.rollout`."""
        self.agent.policy = policy
        self._begun_at = time.perf_counter()
        root = self.simulator.get_mutable_context()
        self.station.set_scene(root, np.array(self._world.cell.robot.home), self.scene.objects)
        self.simulator.set_monitor(self.vacuum)
        freedom = Freedom(self.station, self.vacuum)
        freedom.begin(root)
        self.simulator.Initialize()
        plan: Plan | None = None
        beside, motion, answers, k = (set[str](), set[str]()), list[Frame](), dict[int, Answer](), 0
        state = self._agent_state(root)
        while state.phase is not Phase.DONE:
            now = root.get_time()
            running = self.executor.running(self.executor.GetMyContextFromRoot(root))
            if running.plan is not plan and running.plan is not None:
                plan, beside = running.plan, disturbed_by(self._objects(root), running.plan)
            wanted, must_hold = set[str](), False
            if running.schedule is not None:
                elapsed = now - running.begun
                wanted = taking_part(running.schedule, *beside, elapsed)
                must_hold = running.schedule.suction_on + LOOK <= elapsed < running.schedule.end + PATIENCE
            freedom.update(root, wanted, must_hold=must_hold)
            k += 1
            self.simulator.AdvanceTo(k * LOOK + TIME_STEP / 2)
            moving = running.schedule is not None and now - running.begun < running.schedule.end
            if self._record and moving:
                context = self.station.plant_context(root)
                arm = self.station.arm_state(context, self._suction(root))
                motion.append(Frame(root.get_time() - running.begun, self.station.scene.poses(context), arm))
            answer: Answer = self._planner.GetOutputPort("answer").Eval(self._planner.GetMyContextFromRoot(root))
            answers[answer.number] = answer
            before, state = state, self._agent_state(root)
            looked_again = state.phase is Phase.DONE or state.request is not before.request
            if looked_again and before.request is not None:
                answer = answers[before.request.number]
                yield self._judged(root, before.request, answer, tuple(motion))
                motion.clear()

    def _objects(self, root: Context) -> tuple[SceneObject, ...]:
        return self.scene.at(self.station.scene.poses(self.station.plant_context(root))).objects

    def _judged(
        self,
        root: Context,
        request: Request,
        answer: Answer,
        motion: tuple[Frame, ...],
    ) -> Attempt:
        """How a move went, by the truth, once the agent has looked again."""
        before, plan, decision = self.scene, answer.plan, request.decision
        assert plan is not None
        if self._tracks:
            decision = in_true_names(decision, request.belief, request.observation, before.objects)
        move = decision.move
        assert move is not None
        if isinstance(plan, NoPlan):
            no_spot = plan.reason is PlanFailure.NO_FREE_SPOT
            result = MoveResult.NO_FREE_SPOT if no_spot else MoveResult.NOT_PLANNED
            outcome = Outcome(result, before, detail="" if no_spot else str(plan))
            return Attempt(decision, outcome, self.look)
        after = replace(before, objects=self._objects(root))
        # What hung on the cup, which may not be what the agent took it for.
        picked = self.vacuum.taken or nearest(before.objects, plan.X_TO_pick).name
        decision = replace(decision, move=replace(move, pick=picked))
        # Seen a little off, or as what its symmetry makes alike, it is put down as far off.
        lowered = self.executor.running(self.executor.GetMyContextFromRoot(root)).lowered
        X_TO_place = carried(plan.X_TO_pick, plan.X_TO_place, before[picked].X_TO).moved((0.0, 0.0, -lowered))
        came_off = not self.vacuum.sealed or not math.isnan(self.vacuum.dropped)
        outcome = judged(before, after, picked, X_TO_place, came_off, self._world.settle)
        error = float(np.linalg.norm((after[picked].X_TO.p - X_TO_place.p)[:2]))
        detail = "came off the cup" if came_off else "put down"
        detail += f", {1000 * error:.1f} mm from where it was to be"
        # The simulation goes on from where things are in it.
        outcome = replace(outcome, scene=after, motion=motion, detail=detail)
        self.scene, self.look = after, self._detector.look(after)
        return Attempt(decision, outcome, self.look)
