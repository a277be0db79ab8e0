"""Traces of episodes and generated scenes: one function for each backend.

A trace is a list of lines of text that describe an episode move by move, or a scene part by part.
`behavior_hashes.py` compares traces with recorded ones. This module is its only interface to the
package. The texts are those of the records, also where the package has changed its wording.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import PolicyFactory, make_policy_factory
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import InconclusiveVerdict, MoveResult, Verdict
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.station.motion_recorder import DEFAULT_RATE
from drake_clutter.systems.closed_loop import ClosedLoop
from drake_clutter.systems.image_backend import ImageBackend
from drake_clutter.systems.scenario import Scenario, make_perception, make_policy
from drake_clutter.tasks.episode import BackendFactory, run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, TerminationReason, Transition

WORLD = ClutterConfig()
"""Configuration of all scenes and episodes."""
MAX_MOVES = 10
"""Number of moves after which an episode ends."""
OBJECTS = "ycb7"
"""Object set of generated scenes and of detectors."""
NODES = 25
"""Number of nodes of generated scene graphs."""
DRAKE_INTERVAL = 10
"""Every tenth generated scene is also judged in Drake."""
DECIMALS = 9
"""Decimals to which numbers are compared: poses to a nanometer."""

Part = str | Sequence[float]
"""What a line states by its hash: a text, or numbers."""


@dataclass(frozen=True)
class Case:
    """One episode or generated scene.

    Attributes:
        scenes: Name of the scene dataset; of a generated scene, name of its generator.
        number: Number of the scene, and seed of every random choice.
        agent: Name of the explorer; "" for a generated scene.
    """

    scenes: str
    number: int
    agent: str = ""

    def __str__(self) -> str:
        """Return the case for messages."""
        return f"{self.scenes} {self.number} {self.agent}".strip()


@dataclass(frozen=True)
class Line:
    """One line of a trace.

    Attributes:
        words: Readable text.
        parts: What is too long for a text, by name; it is hashed.
    """

    words: str
    parts: Mapping[str, Part] = field(default_factory=dict)

    def __str__(self) -> str:
        """Return the text of the line."""
        hashes = (f"{name} {hash_of(part)[:12]}" for name, part in self.parts.items())
        return " | ".join([self.words, *hashes])


def hash_of(part: Part) -> str:
    """Return the SHA-256 of a text, or of numbers that are rounded to `DECIMALS`."""
    if isinstance(part, str):
        return hashlib.sha256(part.encode()).hexdigest()
    rounded = np.round(np.asarray(part, np.float64), DECIMALS) + 0.0  # -0.0 + 0.0 is 0.0
    return hashlib.sha256(rounded.tobytes()).hexdigest()


@cache
def _load_scenes(name: str) -> SceneDataset:
    return load_scene_dataset(resource_path(f"training/scenes/{name}.json"), load_catalog())


def _scene(case: Case) -> Scene:
    """Return the scene of a case at rest."""
    scenes = _load_scenes(case.scenes)
    return scenes.settled_scene(case.number, scenes.grammar, WORLD)


@cache
def _policy_factory(agent: str) -> PolicyFactory:
    return make_policy_factory(agent, WORLD)


@cache
def _backend_factory(fidelity: str) -> BackendFactory:
    return make_backend_factory(fidelity, WORLD, simulate_collapse=True)


def _run_at_fidelity(case: Case, fidelity: str) -> list[Line]:
    backend = _backend_factory(fidelity)(_scene(case), item_rng(case.number))
    policy = _policy_factory(case.agent)(backend)
    return _trace(run_episode(backend, policy, max_moves=MAX_MOVES))


def static(case: Case) -> list[Line]:
    """Run an episode with teleported moves and the static stability model."""
    return _run_at_fidelity(case, "static")


def settle(case: Case) -> list[Line]:
    """Run an episode with teleported moves that settle in Drake."""
    return _run_at_fidelity(case, "settle")


def arm(case: Case) -> list[Line]:
    """Run an episode with moves of the arm and perfect detections."""
    return _run_at_fidelity(case, "arm")


def _scenario(case: Case, perception: str) -> Scenario:
    return Scenario(
        agent=case.agent,
        perception=perception,
        objects=OBJECTS,
        max_moves=MAX_MOVES,
        seed=case.number,
        world=WORLD,
    )


def _run_closed_loop(case: Case, perception: str) -> list[Line]:
    scenario = _scenario(case, perception)
    scene = _scene(case)
    loop = ClosedLoop(
        scene,
        perceive=make_perception(scenario, scene),
        seed=scenario.seed,
        config=scenario.world,
        rate=DEFAULT_RATE,
    )
    policy = make_policy(scenario.agent, scenario.world)
    task = run_episode(loop, policy, max_moves=scenario.max_moves)
    return _trace(task, loop.belief.objects, "nothing feasible")


def closed_loop_labels(case: Case) -> list[Line]:
    """Run a closed-loop episode with perfect detections."""
    return _run_closed_loop(case, "labels")


def closed_loop_depth(case: Case) -> list[Line]:
    """Run a closed-loop episode with detections in depth images."""
    return _run_closed_loop(case, "depth")


def images(case: Case) -> list[Line]:
    """Run an episode with teleported moves and detections in depth images."""
    scenario = _scenario(case, "depth")
    scene = _scene(case)
    perceive = make_perception(scenario, scene)
    assert perceive is not None
    backend = ImageBackend(scene, perceive, seed=scenario.seed, config=scenario.world)
    policy = make_policy(scenario.agent, scenario.world)
    task = run_episode(backend, policy, max_moves=scenario.max_moves)
    return _trace(task, backend.belief.objects)


@cache
def _generator_and_judges(agent: str) -> tuple[SceneGenerator, StaticStabilityJudge, DrakeJudge]:
    job = GenerationJob(agent, OBJECTS, None, NODES, 0, WORLD)
    return SceneGenerator(job), StaticStabilityJudge(WORLD), DrakeJudge(WORLD)


def generation(case: Case) -> list[Line]:
    """Generate, lay out and judge a scene."""
    generator, static_judge, drake_judge = _generator_and_judges(case.scenes)
    rng = item_rng(0, case.number)
    scene, failures = generator.lay_out(rng)
    assert scene.graph is not None
    graph = scene.graph.digraph
    nodes = [f"{node} {kind}" for node, kind in graph.nodes(data="kind")]
    # The kind of an edge is an orientation, which has a name, or a text.
    edges = [f"{a} {b} {getattr(kind, 'name', kind)}" for a, b, kind in graph.edges(data="kind")]
    words = f"{len(nodes)} nodes, layout failures before: {failures.total()}"
    parts = {"graph": "\n".join([*nodes, *edges]), "rules": "\n".join(scene.derivation)}
    names = "\n".join(scene.names)
    poses = _pose_numbers(scene.poses.values())
    laid_out = Line(f"{len(scene.objects)} objects", {"names": names, "poses": poses})
    lines = [Line(words, parts), laid_out]
    lines.append(_verdict_line("static", static_judge.judge(scene, deepcopy(rng))))
    if case.number % DRAKE_INTERVAL == 0:
        lines.append(_verdict_line("Drake", drake_judge.judge(scene, deepcopy(rng))))
    return lines


def _verdict_line(judge: str, verdict: Verdict | InconclusiveVerdict) -> Line:
    if isinstance(verdict, InconclusiveVerdict):
        return Line(f"{judge}: cannot be judged, {verdict}")
    words = str(verdict.instability or f"stable, hidden {_name_list(verdict.hidden)}")
    poses = _pose_numbers(verdict.settled.values())
    fractions = [*verdict.visible_fractions.values()]
    return Line(f"{judge}: {words}", {"poses": poses, "shares": fractions})


def _trace(
    task: ExplorationTask,
    known: Sequence[SceneObject] = (),
    end: str = TerminationReason.GAVE_UP.value,
) -> list[Line]:
    """Return the trace of an episode.

    Args:
        task: The episode.
        known: Objects in the belief at the end, for a backend with its own belief.
        end: Recorded reason of the end if the agent ended the episode.
    """
    ended = task.termination.value if task.termination else end
    belief: dict[str, Part] = {}
    if known:
        names = "\n".join(f"{o.name} {o.object_class.name}" for o in known)
        belief = {"known": names, "at": _pose_numbers(o.X_TO for o in known)}
    poses = _pose_numbers(task.initial_scene.poses.values())
    start = Line(f"hidden {_name_list(task.initially_hidden)}", {"poses": poses})
    return [
        start,
        *(_move_line(transition) for transition in task.transitions),
        Line(ended, belief),
    ]


def _move_line(transition: Transition) -> Line:
    outcome = transition.outcome
    came_off = outcome.result is MoveResult.CAME_OFF  # recorded as placed; the detail says so
    texts = [
        "placed" if came_off else outcome.result.value,
        _recorded_detail(outcome.detail),
        outcome.instability,
        outcome.inconclusive,
    ]
    words = f"{transition.move}: {'; '.join(str(text) for text in texts if text)}"
    words += f"; found {_name_list(transition.newly_found)}"
    parts = {"poses": _pose_numbers(outcome.scene.poses.values())}
    if outcome.X_TO_released is not None:
        parts["released"] = _pose_numbers([outcome.X_TO_released])
    if outcome.samples is not None:
        q = outcome.samples.q.tolist()
        parts |= {"q_middle": q[len(q) // 2], "q_last": q[-1]}
    return Line(words, parts)


def _recorded_detail(detail: str) -> str:
    """Return the detail of an outcome as the recorded hashes have it."""
    if placed := re.fullmatch(r"placed with an error of (.*)", detail):
        return f"{placed[1]} from where it was to be"
    detail = detail.replace("came off the gripper", "came off the cup")
    detail = detail.replace("the gripper did not grasp the object", "the cup did not seal")
    if moved := re.fullmatch(r"(placed|came off the cup) with a horizontal error of (.*)", detail):
        result = "put down" if moved[1] == "placed" else moved[1]
        return f"{result}, {moved[2]} from where it was to be"
    return detail


def _pose_numbers(poses: Iterable[Pose]) -> list[float]:
    """Return translations and rotation matrices; the sign of a quaternion is arbitrary."""
    return [float(v) for X in poses for v in (*X.translation, *X.rotation.ravel())]


def _name_list(names: Sequence[str]) -> str:
    return ", ".join(names) or "nothing"
