"""What the package does with a case, as lines of text: one function for each backend.

All that `behavior_hashes.py` asks of the package is here; when interfaces change, this follows.
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
from drake_clutter.scenes.interfaces import InconclusiveVerdict, Verdict
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.systems.closed_loop import ClosedLoop
from drake_clutter.systems.image_backend import ImageBackend
from drake_clutter.systems.scenario import Scenario, make_perception, make_policy
from drake_clutter.tasks.episode import BackendFactory, run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, TerminationReason, Transition

WORLD, MAX_MOVES, OBJECTS = ClutterConfig(), 10, "ycb7"
NODES = 25
"""Of generated scenes."""
DRAKE_EVERY = 10
"""Of a generator's scenes, one in so many is judged by Drake, too."""
DECIMALS = 9
"""To which numbers are compared."""

Part = str | Sequence[float]


@dataclass(frozen=True)
class Case:
    """What is played or made.

    Attributes:
        scenes: name of a frozen set; of a generated scene, of its generator.
        number: of the scene in the set or batch; the seed of every random choice.
        agent: the explorer, or "".
    """

    scenes: str
    number: int
    agent: str = ""

    def __str__(self) -> str:
        return f"{self.scenes} {self.number} {self.agent}".strip()


@dataclass(frozen=True)
class Line:
    """One move, or another fact of an episode or scene.

    Attributes:
        words: readable.
        parts: what is too long for that, by name: texts, or numbers to be compared to `DECIMALS`.
    """

    words: str
    parts: Mapping[str, Part] = field(default_factory=dict)

    def __str__(self) -> str:
        hashes = (f"{name} {hash_of(part)[:12]}" for name, part in self.parts.items())
        return " | ".join([self.words, *hashes])


def hash_of(part: Part) -> str:
    """Of a text, or of rounded numbers."""
    if isinstance(part, str):
        return hashlib.sha256(part.encode()).hexdigest()
    rounded = np.round(np.asarray(part, np.float64), DECIMALS) + 0.0  # -0.0 + 0.0 is 0.0
    return hashlib.sha256(rounded.tobytes()).hexdigest()


@cache
def _scene_set(name: str) -> SceneDataset:
    return load_scene_dataset(resource_path(f"training/scenes/{name}.json"), load_catalog())


def _scene(case: Case) -> Scene:
    """The scene of a case, at rest."""
    held = _scene_set(case.scenes)
    return held.settled_scene(case.number, held.grammar, WORLD)


@cache
def _explorers(agent: str) -> PolicyFactory:
    return make_policy_factory(agent, WORLD)


@cache
def _backends(fidelity: str) -> BackendFactory:
    return make_backend_factory(fidelity, WORLD, follow_falls=True)


def _at_fidelity(case: Case, fidelity: str) -> list[Line]:
    backend = _backends(fidelity)(_scene(case), item_rng(case.number))
    policy = _explorers(case.agent)(backend)
    return _episode(run_episode(backend, policy, max_moves=MAX_MOVES))


def static(case: Case) -> list[Line]:
    """Moves by teleport, judged by the static judge alone."""
    return _at_fidelity(case, "static")


def settle(case: Case) -> list[Line]:
    """Moves by teleport, settled in Drake."""
    return _at_fidelity(case, "settle")


def arm(case: Case) -> list[Line]:
    """Moves by the arm, with perfect detections."""
    return _at_fidelity(case, "arm")


def _scenario(case: Case, perception: str) -> Scenario:
    return Scenario(
        agent=case.agent,
        perception=perception,
        objects=OBJECTS,
        max_moves=MAX_MOVES,
        seed=case.number,
        world=WORLD,
    )


def _closed_loop(case: Case, perception: str) -> list[Line]:
    scenario, scene = _scenario(case, perception), _scene(case)
    loop = ClosedLoop(
        scene,
        perceive=make_perception(scenario, scene.support),
        seed=scenario.seed,
        world=scenario.world,
        record_motion=True,
    )
    policy = make_policy(scenario.agent, scenario.world)
    task = run_episode(loop, policy, max_moves=scenario.max_moves)
    return _episode(task, loop.belief.objects, "nothing feasible")


def closed_loop_labels(case: Case) -> list[Line]:
    """The closed loop with the perfect detector."""
    return _closed_loop(case, "labels")


def closed_loop_depth(case: Case) -> list[Line]:
    """The closed loop that sees depth images."""
    return _closed_loop(case, "depth")


def images(case: Case) -> list[Line]:
    """The loop without an arm, which sees depth images."""
    scenario, scene = _scenario(case, "depth"), _scene(case)
    perceive = make_perception(scenario, scene.support)
    assert perceive is not None
    backend = ImageBackend(scene, perceive, seed=scenario.seed, world=scenario.world)
    policy = make_policy(scenario.agent, scenario.world)
    task = run_episode(backend, policy, max_moves=scenario.max_moves)
    return _episode(task, backend.belief.objects)


@cache
def _generator(agent: str) -> tuple[SceneGenerator, StaticStabilityJudge, DrakeJudge]:
    job = GenerationJob(agent, OBJECTS, None, NODES, 0, WORLD)
    return SceneGenerator(job), StaticStabilityJudge(WORLD), DrakeJudge(WORLD)


def generation(case: Case) -> list[Line]:
    """A scene by a generator, with its graph and layout, and judged."""
    generator, fast, drake = _generator(case.scenes)
    rng = item_rng(0, case.number)
    scene, failures = generator.lay_out(rng)
    assert scene.graph is not None
    graph = scene.graph.nx
    nodes = [f"{node} {kind}" for node, kind in graph.nodes(data="kind")]
    # An orientation has a name, other kinds of edges are one.
    edges = [f"{a} {b} {getattr(kind, 'name', kind)}" for a, b, kind in graph.edges(data="kind")]
    words = f"{len(nodes)} nodes, layout failures before: {failures.total()}"
    parts = {"graph": "\n".join([*nodes, *edges]), "rules": "\n".join(scene.derivation)}
    names, poses = "\n".join(scene.names), _numbers(scene.poses.values())
    laid_out = Line(f"{len(scene.objects)} objects", {"names": names, "poses": poses})
    lines = [Line(words, parts), laid_out]
    lines.append(_verdict("static", fast.judge(scene, deepcopy(rng))))
    if case.number % DRAKE_EVERY == 0:
        lines.append(_verdict("Drake", drake.judge(scene, deepcopy(rng))))
    return lines


def _verdict(judge: str, verdict: Verdict | InconclusiveVerdict) -> Line:
    if isinstance(verdict, InconclusiveVerdict):
        return Line(f"{judge}: cannot be judged, {verdict}")
    words = str(verdict.instability or f"stable, hidden {_named(verdict.hidden)}")
    poses, shares = _numbers(verdict.settled.values()), [*verdict.visible_fractions.values()]
    return Line(f"{judge}: {words}", {"poses": poses, "shares": shares})


def _episode(
    task: ExplorationTask,
    known: Sequence[SceneObject] = (),
    end: str = TerminationReason.GAVE_UP.value,
) -> list[Line]:
    """An episode.

    Args:
        task: the episode's book.
        known: K_t at the end, of an agent that keeps it.
        end: why the agent ended by itself, as it is recorded.
    """
    ended = task.termination.value if task.termination else end
    belief: dict[str, Part] = {}
    if known:
        names = "\n".join(f"{o.name} {o.object_class.name}" for o in known)
        belief = {"known": names, "at": _numbers(o.X_TO for o in known)}
    poses = _numbers(task.initial_scene.poses.values())
    start = Line(f"hidden {_named(task.initially_hidden)}", {"poses": poses})
    return [start, *(_move(step) for step in task.transitions), Line(ended, belief)]


def _move(step: Transition) -> Line:
    outcome = step.outcome
    texts = [
        outcome.result.value,
        _recorded_detail(outcome.detail),
        outcome.instability,
        outcome.inconclusive,
    ]
    words = f"{step.move}: {'; '.join(str(text) for text in texts if text)}"
    words += f"; found {_named(step.newly_found)}"
    parts = {"poses": _numbers(outcome.scene.poses.values())}
    if outcome.X_TO_released is not None:
        parts["released"] = _numbers([outcome.X_TO_released])
    arms = [frame.arm for frame in outcome.motion if frame.arm is not None]
    if arms:
        parts |= {"q_middle": [*arms[len(arms) // 2].q], "q_last": [*arms[-1].q]}
    return Line(words, parts)


def _recorded_detail(detail: str) -> str:
    """Return the detail of an outcome as the recorded hashes have it."""
    placed = re.fullmatch(r"placed with an error of (.*)", detail)
    return f"{placed[1]} from where it was to be" if placed else detail


def _numbers(poses: Iterable[Pose]) -> list[float]:
    """Translations and rotation matrices: a quaternion's sign says nothing."""
    return [float(v) for X in poses for v in (*X.translation, *X.rotation.ravel())]


def _named(names: Sequence[str]) -> str:
    return ", ".join(names) or "nothing"
