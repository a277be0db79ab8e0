"""Static moves: what stays, what falls, agreement with Drake, and the hybrid executor."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import executed, resting, rng, scene_of
from scipy.spatial.transform import Rotation
from test_settle_executor import STACKS, put_on

from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    InstabilityReason,
    Move,
    MoveExecutor,
    MovePart,
    MoveResult,
    Observation,
    Outcome,
)
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject
from drake_clutter.simulation.hybrid import HybridExecutor
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.episode import SteppedBackend

CONFIG = ClutterConfig()
JUDGE = StaticStabilityJudge(CONFIG)
EXECUTOR = StaticExecutor(CONFIG, JUDGE)


def seen(scene: Scene) -> Observation:
    return JUDGE.ray_caster.observe(scene)[0]


def execute_move(
    scene: Scene, move: Move, seed: int = 0, executor: MoveExecutor = EXECUTOR
) -> Outcome:
    return executed(executor, scene, seen(scene), move, rng(seed))


def lowest(o: SceneObject) -> float:
    return float(o.bounds_T[0][2])


# --- Placed ---


@pytest.mark.parametrize(
    ("move", "floor"),
    [
        (Move("above"), 0.0),
        (Move("marker"), 0.0),
        (Move("on the can"), 0.0),
        (Move("on the can", "above"), 0.098),
        (Move("marker", "above"), 0.098),
        (Move("marker", "on the can"), 0.129),
        (Move("above", "on the can"), 0.129),
    ],
    ids=str,
)
def test_what_is_placed_rests_on_what_is_below(move: Move, floor: float) -> None:
    """The object rests within the random offset of its placement; no other object moves."""
    outcome = execute_move(STACKS, move)
    assert (outcome.result, outcome.instability, outcome.inconclusive, outcome.motion) == (
        MoveResult.PLACED,
        None,
        None,
        (),
    )
    after = outcome.scene
    assert lowest(after[move.pick]) == pytest.approx(floor, abs=1e-9)
    command = resolve_placement(move, seen(STACKS), CONFIG.exploration, rng())
    assert command is not None
    place = command.X_TO_place
    assert after[move.pick].X_TO.quaternion == place.quaternion
    assert np.hypot(*(after[move.pick].X_TO.p - place.p)[:2]) <= CONFIG.settle.jitter
    assert after.names == STACKS.names
    assert all(after[name] == STACKS[name] for name in STACKS.names if name != move.pick)
    assert (after.support, after.graph, after.derivation) == (
        STACKS.support,
        STACKS.graph,
        STACKS.derivation,
    )
    assert JUDGE.find_instability(after) is None


def test_the_same_rng_gives_the_same_outcome() -> None:
    """Outcomes do not depend on earlier moves."""
    one = execute_move(STACKS, Move("marker"), 7)
    execute_move(STACKS, Move("above"), 1)
    assert execute_move(STACKS, Move("marker"), 7) == one
    assert execute_move(STACKS, Move("marker"), 7, StaticExecutor(CONFIG)) == one
    assert execute_move(STACKS, Move("marker"), 8).scene != one.scene


# --- Collapsed ---

OVERHANG = [
    resting("cracker_box", name="below"),
    resting("sugar_box", xy=(0.100, 0.0), floor=0.060, name="over"),
]
HEAVY = resting("granola_box", Orientation.FLAT_0, (-0.2, 0.25), name="heavy")
WEIGHED_DOWN = scene_of(
    *(
        resting("cracker_box", name="below"),
        resting("sugar_box", xy=(0.132, 0.0), floor=0.060, name="over"),
    ),
    *(
        resting("granola_box", xy=(0.05, 0.0), floor=0.098, name="weight"),
        resting("gelatin_box", xy=(-0.2, 0.25), name="beside"),
    ),
)
# What is free of the overhang's top is beyond the can, and beyond the edge.
OUTSIDE_ONLY = scene_of(
    *OVERHANG, resting("tomato_soup_can", xy=(0.055, 0.0), floor=0.098, name="can"), HEAVY
)


@pytest.mark.parametrize(
    ("scene", "move", "falls"),
    [
        (STACKS, Move("below"), "above"),
        (STACKS, Move("below", "on the can"), "above"),
        (WEIGHED_DOWN, Move("weight"), "over"),
        (WEIGHED_DOWN, Move("weight", "beside"), "over"),
    ],
)
def test_what_loses_its_support_falls(scene: Scene, move: Move, falls: str) -> None:
    """Falls are not followed: the picked object is at its placement, the others unmoved."""
    outcome = execute_move(scene, move)
    assert (outcome.result, outcome.inconclusive) == (MoveResult.COLLAPSED, None)
    assert outcome.instability == Instability(InstabilityReason.UNSUPPORTED, falls)
    assert outcome.scene[falls].X_TO == scene[falls].X_TO
    assert outcome.scene[move.pick].X_TO != scene[move.pick].X_TO
    assert outcome.scene.names == scene.names


@pytest.mark.parametrize("pick", ["on the can", "above"])
@pytest.mark.parametrize("seed", range(4))
def test_nothing_stays_on_a_lying_marker(pick: str, seed: int) -> None:
    move = Move(pick, "marker")
    assert execute_move(STACKS, move, seed).result is MoveResult.NO_FREE_PLACEMENT
    outcome = EXECUTOR.execute(STACKS, put_on(STACKS, move), rng(seed))
    assert outcome.result is MoveResult.COLLAPSED
    assert outcome.instability is not None
    assert outcome.instability.object == pick
    assert outcome.instability.reason in (InstabilityReason.ROLLS, InstabilityReason.UNBALANCED)


def test_where_nothing_balances() -> None:
    assert JUDGE.find_instability(OUTSIDE_ONLY) is None
    move = Move("heavy", "over")
    assert execute_move(OUTSIDE_ONLY, move).result is MoveResult.NO_FREE_PLACEMENT
    without_can = scene_of(*OVERHANG, HEAVY)
    outcome = EXECUTOR.execute(without_can, put_on(without_can, move, 0.060), rng())
    assert outcome.result is MoveResult.COLLAPSED
    assert outcome.instability is not None
    assert outcome.instability.reason is InstabilityReason.UNBALANCED
    # The center of the top is free, which is 15 mm inside the edge.
    assert execute_move(without_can, move).result is MoveResult.PLACED


# --- Not carried out ---


def test_no_free_spot_changes_nothing() -> None:
    scene = scene_of(resting("cracker_box", name="box"), side=0.26)
    outcome = execute_move(scene, Move("box"))
    assert (outcome.result, outcome.instability, outcome.inconclusive) == (
        MoveResult.NO_FREE_PLACEMENT,
        None,
        None,
    )
    assert outcome.scene is scene


def leaning(o: SceneObject) -> SceneObject:
    R_TO = Rotation.from_euler("y", 3, degrees=True).as_matrix() @ o.X_TO.rotation
    floor = float((o.object_class.corners @ R_TO.T)[:, 2].min())
    return replace(o, X_TO=Pose.from_rotation(R_TO, (*o.X_TO.p[:2], -floor)))


LEANS = scene_of(*STACKS.objects, leaning(resting("gelatin_box", xy=(0.2, -0.2), name="leaning")))
# As settling may leave it: its center 1 mm inside the edge, but the judge requires 2 mm.
JUST_RESTS = scene_of(
    *(
        resting("cracker_box", name="below"),
        resting("sugar_box", xy=(0.114, 0.0), floor=0.060, name="over"),
    ),
    *(
        resting("gelatin_box", xy=(0.114, 0.0), floor=0.098, name="on it"),
        resting("large_marker", xy=(-0.2, -0.2), name="marker"),
    ),
)
LEANING = InconclusiveVerdict(InconclusiveReason.LEANING, "leaning")


@pytest.mark.parametrize(
    ("scene", "move", "answer"),
    [
        (LEANS, Move("leaning"), LEANING),
        (LEANS, Move("leaning", "above"), LEANING),
        (LEANS, Move("marker", "leaning"), LEANING),
        (
            JUST_RESTS,
            Move("on it"),
            InconclusiveVerdict(InconclusiveReason.RESTS_NEVERTHELESS, "over"),
        ),
        (
            JUST_RESTS,
            Move("marker", "on it"),
            InconclusiveVerdict(InconclusiveReason.RESTS_NEVERTHELESS, "over"),
        ),
    ],
)
def test_what_it_cannot_judge_is_a_result(
    scene: Scene, move: Move, answer: InconclusiveVerdict
) -> None:
    """A scene that the model lets fall before the move is inconclusive."""
    outcome = (
        execute_move(scene, move)
        if move.place in (TRAY, "above")
        else EXECUTOR.execute(scene, put_on(scene, move), rng())
    )
    assert (outcome.result, outcome.inconclusive, outcome.instability) == (
        MoveResult.INCONCLUSIVE,
        answer,
        None,
    )
    assert outcome.scene is scene


@pytest.mark.parametrize(
    "move",
    [Move("above"), Move("marker", "above"), Move("below"), Move("on the can", "marker")],
    ids=str,
)
def test_objects_that_a_move_does_not_touch_are_not_judged(move: Move) -> None:
    """The outcome equals that without the leaning box, for any target."""
    outcome, without = execute_move(LEANS, move), execute_move(STACKS, move)
    assert (outcome.result, outcome.instability) == (without.result, without.instability)
    assert outcome.result is not MoveResult.INCONCLUSIVE
    assert outcome.scene["leaning"] == LEANS["leaning"]


@pytest.mark.parametrize("executor", [EXECUTOR, HybridExecutor(CONFIG)])
@pytest.mark.parametrize(
    "move",
    [Move("ghost"), Move("marker", "ghost"), Move("can", "marker"), Move("marker", "can")],
    ids=str,
)
def test_only_what_is_in_view_can_be_moved(move: Move, executor: MoveExecutor) -> None:
    """The can is hidden in this scene."""
    name = move.pick if move.pick != "marker" else move.place
    with pytest.raises(KeyError, match=f"'{name}' is not in view"):
        execute_move(STACKS, move, executor=executor)


# --- And Drake ---


@pytest.mark.parametrize(
    ("move", "result"),
    [
        (Move("above"), MoveResult.PLACED),
        (Move("on the can", "above"), MoveResult.PLACED),
        (Move("below"), MoveResult.COLLAPSED),
        (Move("on the can", "marker"), MoveResult.COLLAPSED),
    ],
    ids=str,
)
def test_drake_lets_it_go_at_the_same_place(
    move: Move, result: MoveResult, detector: LabelDetector
) -> None:
    """Observations of ray caster and renderer give equal results.

    In Drake, a box then creeps by less than 0.1 mm, and a fall goes on.
    """
    rendered, cast = detector.perceive(STACKS).observation, seen(STACKS)
    executor = SettleExecutor(CONFIG, simulate_collapse=False)
    if move.place == "marker":  # where nothing is put
        mine, drakes = (
            e.execute(STACKS, put_on(STACKS, move), rng(3)) for e in (EXECUTOR, executor)
        )
    else:
        mine = executed(EXECUTOR, STACKS, rendered, move, rng(3))
        assert mine == executed(EXECUTOR, STACKS, cast, move, rng(3))
        drakes = executed(executor, STACKS, rendered, move, rng(3))
    assert mine.result is drakes.result is result
    let_go = drakes.motion[0].poses[move.pick]
    down = np.array([0.0, 0.0, CONFIG.exploration.release_height])
    assert mine.scene[move.pick].X_TO.p == pytest.approx(let_go.p - down, abs=1e-12)
    if result is MoveResult.PLACED:
        assert drakes.scene[move.pick].X_TO.p == pytest.approx(
            mine.scene[move.pick].X_TO.p, abs=1e-4
        )
        assert JUDGE.find_instability(drakes.scene) is None
    else:
        assert mine.instability is not None
        assert drakes.instability is not None
        assert mine.instability.object == drakes.instability.object


def test_inconclusive_moves_are_settled_in_drake() -> None:
    """Drake draws the same random offsets as without the static executor."""
    generator, other = rng(5), rng(5)
    outcome = executed(HybridExecutor(CONFIG), LEANS, seen(LEANS), Move("leaning"), generator)
    drakes = executed(SettleExecutor(CONFIG), LEANS, seen(LEANS), Move("leaning"), other)
    assert outcome == drakes
    assert outcome.result is MoveResult.PLACED
    assert outcome.motion
    assert generator.random() == other.random()


@pytest.mark.parametrize(
    "move", [Move("above"), Move("below"), Move("on the can", "marker")], ids=str
)
def test_conclusive_moves_are_not_settled_in_drake(move: Move) -> None:
    """Conclusive collapses are not simulated either."""
    generator, other = rng(5), rng(5)
    outcome = executed(HybridExecutor(CONFIG), STACKS, seen(STACKS), move, generator)
    assert outcome == executed(EXECUTOR, STACKS, seen(STACKS), move, other)
    assert outcome.motion == ()
    assert generator.random() == other.random()


def test_no_free_spot_is_no_question_for_an_executor() -> None:
    class Unasked:
        def execute(self, *arguments: object) -> Outcome:
            raise AssertionError("there is nothing to carry out")

    scene = scene_of(leaning(resting("gelatin_box", name="box")), side=0.12)
    detector = RayDetector(CONFIG.cell.camera)
    backend = SteppedBackend(Unasked(), detector, CONFIG.exploration, scene, rng())
    outcome = Outcome(MoveResult.NO_FREE_PLACEMENT, scene, failed_part=MovePart.PLACE)
    assert backend.step(Move("box")) == outcome
    assert backend.belief.invalid_moves == backend.belief.history == (Move("box"),)


# --- What it promises ---

FIXED = ("foot", "held", "weight")
HELD_DOWN = scene_of(
    resting("sugar_box", Orientation.UPRIGHT_0, (-0.0445, 0.0), name="foot"),
    resting("cracker_box", xy=(0.032, 0.0), floor=0.175, name="held"),
    resting("cereal_box_large", xy=(-0.060, 0.0), floor=0.235, name="weight"),
    *(resting("gelatin_box", xy=(x, 0.25), name=f"{x}") for x in (-0.2, 0.0, 0.2)),
    resting("tomato_soup_can", xy=(0.25, -0.25), name="can"),
)


@pytest.mark.parametrize("seed", range(4))
def test_no_moves_ever_take_what_can_never_be_moved(seed: int) -> None:
    """In random play with loads on everything, picking an immovable object always collapses."""
    assert JUDGE.immovable_objects(HELD_DOWN) == frozenset(FIXED)
    scene, generator = HELD_DOWN, rng(seed)
    moved, tried = 0, 0
    for _ in range(25):
        observation = seen(scene)
        names = [d.name for d in observation.detections]
        pick = names[generator.integers(len(names))]
        place = [name for name in (*names, "tray") if name != pick][generator.integers(len(names))]
        outcome = executed(EXECUTOR, scene, observation, Move(pick, place), generator)
        if outcome.result is MoveResult.PLACED:
            assert pick not in FIXED
            scene = outcome.scene
            moved += 1
        tried += pick in FIXED
    assert all(scene[name].X_TO == HELD_DOWN[name].X_TO for name in FIXED)
    assert moved >= 3
    assert tried >= 3
