"""Belief about what is hidden: expected values by manual geometry."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, resting, rng, scene_of

from drake_clutter.agents.explorers import BASELINE_POLICIES
from drake_clutter.belief.class_belief import (
    Touch,
    pose_with_same_top,
    touch_likelihoods,
    update_probabilities,
)
from drake_clutter.belief.hidden_belief import HiddenBelief, estimate_hidden
from drake_clutter.belief.hidden_space import find_fits, find_hidden_columns, hidden_area
from drake_clutter.belief.known_supports import (
    SupportState,
    can_fill,
    find_support_states,
    resting_heights,
    stack_heights,
)
from drake_clutter.config import BeliefConfig, ClutterConfig, TouchConfig
from drake_clutter.grammar import Orientation
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.reports.belief_html import belief_html
from drake_clutter.scenes.free_space import CELL_SIZE, Grid
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.tasks.belief import Belief
from drake_clutter.tasks.episode import make_teleport_backend_factory, run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, StopCriterion, TerminationReason
from drake_clutter.tasks.stopping import StoppingPolicy

CAMERA = DEFAULT_CELL.camera
ALTITUDE = CAMERA.X_TC.translation()[2]
EMPTY = CAMERA.floor_depth
CONFIG = BeliefConfig()
YCB7 = [CLASSES[name] for name in ("cracker_box", "sugar_box", "pudding_box", "gelatin_box")]
YCB7 += [CLASSES[name] for name in ("master_chef_can", "tomato_soup_can", "large_marker")]


def seen(*objects: SceneObject) -> Observation:
    """Return the observation of a scene."""
    return RayDetector(CAMERA).perceive(scene_of(*objects)).observation


def believed(known: Sequence[SceneObject], *hidden: SceneObject) -> HiddenBelief:
    """Return the belief in a scene of known and hidden objects."""
    return estimate_hidden(known, seen(*known, *hidden), EMPTY, YCB7, CONFIG)


# --- Supports ---


def state(x: float, doubt: float) -> SupportState:
    """Return how a box is carried whose center is at x on a box whose top ends at 115 mm."""
    objects = [
        resting("cracker_box", name="below"),
        resting("cracker_box", floor=0.060, xy=(x, 0.0), name="above"),
    ]
    states = find_support_states(objects, doubt)
    assert states["below"] is SupportState.CARRIED
    return states["above"]


def test_an_object_is_carried_if_its_center_of_mass_is_over_the_contact() -> None:
    assert state(0.110, 0.001) is SupportState.CARRIED
    assert state(0.1155, 0.001) is SupportState.DOUBTFUL
    assert state(0.1145, 0.001) is SupportState.DOUBTFUL
    assert state(0.120, 0.001) is SupportState.UNCARRIED
    assert state(0.110, 0.006) is SupportState.DOUBTFUL


def test_what_has_nothing_below_is_uncarried_and_what_it_carries_is_carried() -> None:
    floating = resting("cracker_box", floor=0.101, name="floating")
    on_it = resting("pudding_box", floor=0.161, name="on it")
    states = find_support_states([floating, on_it], 0.001)
    assert states == {"floating": SupportState.UNCARRIED, "on it": SupportState.CARRIED}


def test_half_of_a_pair_carries_nothing_alone() -> None:
    """Two sugar boxes of 89 mm lie 2 mm apart; the box above is balanced by both only."""
    pair = [resting("sugar_box", xy=(0.0, y), name=f"at {y}") for y in (-0.0455, 0.0455)]
    above = resting("cracker_box", floor=0.038, name="above")
    assert find_support_states([*pair, above], 0.0005)["above"] is SupportState.CARRIED
    assert find_support_states([pair[0], above], 0.0005)["above"] is SupportState.UNCARRIED


def test_resting_heights_are_the_extents_or_the_only_one() -> None:
    def heights(name: str) -> list[float]:
        return [round(1000 * h) for h in resting_heights(CLASSES[name]).values()]

    assert sorted(heights("cracker_box")) == [60, 160, 230]
    assert heights("tomato_soup_can") == [101]
    assert heights("large_marker") == [18]


@pytest.mark.parametrize(
    ("gap", "names", "expected"),
    [
        (0.101, ("tomato_soup_can",), True),
        (0.104, ("tomato_soup_can",), True),
        (0.106, ("tomato_soup_can",), False),
        (0.202, ("tomato_soup_can",), True),  # two cans
        (0.000, ("tomato_soup_can",), False),  # no stack has no object
        (0.119, ("tomato_soup_can", "large_marker"), True),  # 101 + 18
        (0.012, ("tomato_soup_can", "large_marker"), False),
    ],
)
def test_stacks_that_fill_a_gap(gap: float, names: Sequence[str], expected: bool) -> None:
    assert can_fill(gap, stack_heights([CLASSES[n] for n in names], 0.5)) == expected


# --- Unseen space ---


def height_at(known: Sequence[SceneObject], x: float, y: float = 0.0) -> tuple[float, bool]:
    """Return height and cover of the hidden column nearest to a position."""
    columns = find_hidden_columns(known, seen(*known))
    grid = Grid.over(scene_of().support)
    i, j = np.abs(grid.x - x).argmin(), np.abs(grid.y - y).argmin()
    return float(columns.height[i, j]), bool(columns.is_covered[i, j])


def test_space_below_a_box_is_hidden_up_to_its_bottom() -> None:
    box = resting("cracker_box", floor=0.110)
    height, is_covered = height_at([box], 0.0)
    assert is_covered
    assert height == pytest.approx(0.110, abs=0.003)
    assert height_at([box], 0.2) == (0.0, False)
    assert height_at([resting("cracker_box")], 0.0)[0] == 0.0, "the box itself fills its space"


def test_space_behind_a_can_is_hidden_up_to_the_ray_over_its_rim() -> None:
    """The ray over the rim at 139 mm and x = 301 mm, as seen from the camera."""
    can = resting("master_chef_can", xy=(0.250, 0.0))
    x = 0.3125
    limit = ALTITUDE - x / 0.301 * (ALTITUDE - 0.139)
    assert 0.05 < limit < 0.12
    height, is_covered = height_at([can], x)
    assert not is_covered
    assert height == pytest.approx(limit, abs=0.008)
    assert height_at([can], 0.301 * ALTITUDE / (ALTITUDE - 0.139) + 0.005)[0] == 0.0


def test_the_area_in_which_a_can_fits_below_a_box() -> None:
    """Its top of 66 mm is within the pyramid that the box's top at 170 mm hides."""
    columns_of = [resting("cracker_box", floor=0.110)]
    columns = find_hidden_columns(columns_of, seen(*columns_of))
    scale = (ALTITUDE - 0.101) / (ALTITUDE - 0.170)
    length, width = 0.230 * scale - 0.066, 0.160 * scale - 0.066
    area = hidden_area(find_fits(CLASSES["tomato_soup_can"], columns), columns)
    # What just fits is not missed: the grid adds at most two cells to either side.
    assert length * width < sum(area) < (length + 2 * CELL_SIZE) * (width + 2 * CELL_SIZE)
    chef_can = hidden_area(find_fits(CLASSES["master_chef_can"], columns), columns)
    assert chef_can == (0.0, 0.0), "139 mm do not fit below 110 mm"


# --- What is left ---


def test_nothing_is_left_if_all_is_seen_and_carried() -> None:
    belief = believed([resting("cracker_box"), resting("tomato_soup_can", xy=(0.0, 0.2))])
    assert belief.supports == ()
    assert belief.num_unidentified_points == 0
    assert belief.nothing_left > 0.95


def test_what_carries_a_box_is_named() -> None:
    can = resting("tomato_soup_can")
    box = resting("cracker_box", floor=can.top_height)
    (support,) = believed([box], can).supports
    assert (support.carried, support.is_certain) == ("cracker_box", True)
    assert support.gap == pytest.approx(0.101)
    assert "tomato_soup_can" in support.classes
    assert "master_chef_can" not in support.classes
    assert believed([box], can).nothing_left < 0.05
    assert believed([box, can]).supports == ()


def test_where_nothing_fits_nothing_is_left() -> None:
    """A box that seems to float 10 mm high is at a wrong pose: no object is so flat."""
    for floor, is_left in ((0.010, False), (0.018, True)):
        box = resting("cracker_box", floor=floor)
        belief = believed([box])
        (support,) = belief.supports
        assert support.classes == (("large_marker",) if is_left else ())
        assert (belief.nothing_left < 0.05) == is_left
        assert (belief.nothing_left > 0.95) != is_left


def test_what_carries_an_object_may_be_partly_in_sight() -> None:
    """A box of 89 mm stands on two markers of 121 mm, of which it hides 74 %; one is known."""
    known = [resting("large_marker", xy=(0.0, -0.010), name="known marker")]
    known.append(resting("pudding_box", Orientation.UPRIGHT_0, floor=0.018, name="box"))
    belief = believed(known, resting("large_marker", xy=(0.0, 0.010), name="hidden marker"))
    (support,) = belief.supports
    assert (support.carried, support.is_certain) == ("box", True)
    assert "large_marker" in support.classes
    assert belief.nothing_left < 0.05


def test_points_of_no_known_object_are_something() -> None:
    belief = believed([resting("cracker_box")], resting("sugar_box", xy=(0.0, 0.25)))
    assert belief.supports == ()
    assert belief.num_unidentified_points > 100
    assert belief.nothing_left < 0.05


def test_expected_numbers_of_hidden_objects_multiply() -> None:
    """exp(-rate x area), and the factors of uncertain supports."""
    can = resting("tomato_soup_can")
    box = resting("cracker_box", floor=can.top_height)
    plain = replace(CONFIG, covered_rate=0.0, shadow_rate=0.0, uncarried_probability=0.8)
    observation = seen(box, can)
    areas = believed([box]).areas.values()
    covered = float(np.mean([area.covered for area in areas]))
    assert covered > 0.001
    for rate in (0.0, 10.0):
        config = replace(plain, covered_rate=rate)
        belief = estimate_hidden([box], observation, EMPTY, YCB7, config)
        assert belief.nothing_left == pytest.approx(0.2 * np.exp(-rate * covered))


# --- Episodes ---


def run(
    *objects: SceneObject, max_moves: int = 5, config: BeliefConfig = CONFIG
) -> ExplorationTask:
    """Return the task of an episode that the belief ends."""
    make_backend = make_teleport_backend_factory("static", ClutterConfig())
    policy = StoppingPolicy(BASELINE_POLICIES["largest-clear"], YCB7, EMPTY, config)
    return run_episode(
        make_backend(scene_of(*objects), rng(0)),
        policy,
        max_moves=max_moves,
        until=StopCriterion.BELIEF,
    )


def test_an_agent_stops_when_it_has_found_what_carried_the_box() -> None:
    can = resting("tomato_soup_can")
    task = run(can, resting("cracker_box", floor=can.top_height))
    assert task.initially_hidden == ("tomato_soup_can",)
    assert [t.move for t in task.transitions] == [Move("cracker_box")]
    assert task.termination is TerminationReason.NOTHING_LEFT
    assert task.is_success
    assert task.last_decision is not None
    assert task.last_decision.hidden is not None
    assert task.last_decision.hidden.nothing_left > 0.95


def test_an_agent_stops_without_a_move_where_all_is_seen() -> None:
    task = run(resting("cracker_box"), resting("sugar_box", xy=(0.0, 0.2)))
    assert (task.transitions, task.is_success) == ([], True)


def test_the_ground_truth_does_not_end_an_episode_of_a_doubting_agent() -> None:
    box = resting("cracker_box", Orientation.UPRIGHT_90, xy=(0.2, 0.0))  # it hides a marker's place
    task = run(box, max_moves=1, config=replace(CONFIG, covered_rate=1e9, shadow_rate=1e9))
    assert len(task.transitions) == 1
    assert task.has_found_all
    assert (task.termination, task.is_success) == (TerminationReason.OUT_OF_MOVES, False)


def test_an_early_stop_is_no_success() -> None:
    can = resting("tomato_soup_can")
    box = resting("cracker_box", floor=can.top_height)
    task = run(can, box, config=replace(CONFIG, stop_probability=0.0))
    assert task.termination is TerminationReason.NOTHING_LEFT
    assert not task.is_success


# --- Classes ---


def test_bayes_rule() -> None:
    prior = {"a": 0.5, "b": 0.3, "c": 0.2}
    posterior = update_probabilities(prior, {"a": 0.2, "b": 1.0, "c": 0.0})
    assert posterior == pytest.approx({"a": 0.25, "b": 0.75, "c": 0.0})
    assert update_probabilities(prior, dict.fromkeys(prior, 0.0)) == prior


def touch_odds(believed: SceneObject, touch: Touch, other: str) -> float:
    """Return the likelihood of the believed class relative to another one."""
    classes = [believed.object_class, CLASSES[other]]
    likelihoods = touch_likelihoods(believed, touch, classes, TouchConfig())
    return likelihoods[believed.object_class] / likelihoods[CLASSES[other]]


def test_the_weight_tells_a_pudding_box_from_a_sugar_box() -> None:
    """187 g and 514 g: 12 deviations of 27 g apart; outliers keep the odds finite."""
    pudding = resting("pudding_box", Orientation.SIDE_0)
    assert touch_odds(pudding, Touch(mass=0.187), "sugar_box") > 100
    assert touch_odds(pudding, Touch(mass=0.514), "sugar_box") < 0.01
    assert touch_odds(pudding, Touch(), "sugar_box") == 1.0


def test_the_likelihood_of_a_weight_is_normal_with_outliers() -> None:
    """Deviation of the pudding box: hypot(10 g, 5 % of 187 g) = 13.7 g."""
    pudding = resting("pudding_box")
    sugar = CLASSES["sugar_box"]
    likelihoods = touch_likelihoods(
        pudding, Touch(mass=0.187 + 0.0137), [pudding.object_class, sugar], TouchConfig()
    )
    deviation = np.hypot(0.010, 0.05 * 0.187)
    density = np.exp(-0.5 * (0.0137 / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi))
    assert likelihoods[pudding.object_class] == pytest.approx(0.95 * density + 0.05 / 0.514)


def test_the_height_at_touch_down_tells_boxes_with_the_same_top_apart() -> None:
    """On end, a pudding box shows 35 x 89 mm and is 110 mm high; a sugar box 38 x 89 and 175."""
    pudding = resting("pudding_box", Orientation.UPRIGHT_0)
    assert touch_odds(pudding, Touch(excess_height=0.0), "sugar_box") > 100
    assert touch_odds(pudding, Touch(excess_height=0.065), "sugar_box") < 0.01
    # A sugar box lies 38 mm high, too, but shows another top then.
    assert touch_odds(pudding, Touch(excess_height=0.038 - 0.110), "sugar_box") == pytest.approx(
        1.0
    )


def test_no_seal_speaks_against_the_believed_class() -> None:
    odds = touch_odds(resting("cracker_box"), Touch(has_sealed=False), "sugar_box")
    assert odds == pytest.approx(0.05 / 0.5)


def test_the_touch_revises_the_class_of_the_next_detection() -> None:
    """A box shows 35 x 89 mm at 175 mm: a sugar box on end, or a pudding box on something.

    The detector prefers the pudding box by 7 to 3. The weight of 514 g decides otherwise.
    """
    sugar, pudding = CLASSES["sugar_box"], CLASSES["pudding_box"]
    believed = resting("pudding_box", Orientation.UPRIGHT_90, xy=(0.1, 0.2), floor=0.065)
    belief = Belief((believed,))
    felt = touch_likelihoods(believed, Touch(mass=0.514), [sugar, pudding], TouchConfig())
    move = Move("pudding_box")
    belief = belief.record(move, MoveResult.PLACED, believed.X_TO, touch=felt)
    assert belief.touch == {"pudding_box": felt}
    observation = seen(resting("sugar_box", Orientation.UPRIGHT_90, xy=(0.1, 0.2)))
    probabilities = {"pudding_box": 0.7, "sugar_box": 0.3}
    detection = replace(
        observation.detections[0],
        object_class=pudding,
        X_TO=believed.X_TO,
        class_probabilities=probabilities,
    )
    observation = replace(observation, detections=(detection,))
    belief, revised = belief.revise(observation)
    (known,) = belief.objects
    assert known.object_class is revised.detections[0].object_class is sugar
    expected = resting("sugar_box", Orientation.UPRIGHT_90, xy=(0.1, 0.2))
    assert known.X_TO == revised.detections[0].X_TO
    assert known.X_TO.p == pytest.approx(expected.X_TO.p, abs=1e-9)
    assert known.bounds_T[0] == pytest.approx(expected.bounds_T[0], abs=1e-9)
    certain = replace(observation, detections=(replace(detection, class_probabilities={}),))
    assert Belief((believed,)).revise(observation)[1].detections[0].object_class is pudding
    assert belief.revise(certain)[1].detections[0].object_class is pudding


def test_likelihoods_of_several_moves_multiply() -> None:
    box = resting("pudding_box")
    felt = {CLASSES["pudding_box"]: 0.5, CLASSES["sugar_box"]: 0.25}
    belief = Belief((box,))
    for _ in range(2):
        belief = belief.record(Move("pudding_box"), MoveResult.PLACED, box.X_TO, touch=felt)
    assert belief.touch["pudding_box"] == {c: value**2 for c, value in felt.items()}
    assert belief.remove(["pudding_box"]).touch == {}


def test_an_object_that_was_not_grasped_is_not_picked_again_unchanged() -> None:
    """Another object's move clears the invalid moves, but not those of the object."""
    box, can = resting("sugar_box", xy=(0.2, 0.0)), resting("tomato_soup_can", xy=(-0.2, 0.0))
    observation = seen(box, can)
    belief = Belief().update(observation)
    belief = belief.record(Move("sugar_box"), MoveResult.NOT_GRASPED).update(observation)
    refused = {Move("sugar_box"), Move("sugar_box", "tomato_soup_can")}
    assert set(belief.invalid_moves) == refused
    moved = replace(can, X_TO=can.X_TO.translated((0.0, 0.1, 0.0)))
    belief = belief.record(Move("tomato_soup_can"), MoveResult.PLACED, moved.X_TO)
    belief = belief.update(seen(box, moved))
    assert set(belief.invalid_moves) == refused
    belief = belief.record(Move("tomato_soup_can"), MoveResult.PLACED, can.X_TO)
    shifted = replace(box, X_TO=box.X_TO.translated((0.0, 0.02, 0.0)))
    assert belief.update(seen(shifted, can)).invalid_moves == ()


def test_a_class_that_shows_another_top_is_not_taken() -> None:
    can = resting("tomato_soup_can")
    assert pose_with_same_top(can, CLASSES["cracker_box"]) is None
    on_end = resting("pudding_box", Orientation.UPRIGHT_0, floor=0.065)
    X_TO = pose_with_same_top(on_end, CLASSES["sugar_box"])
    assert X_TO is not None
    assert X_TO.p == pytest.approx([0.0, 0.0, 0.0875])


# --- Page ---


def test_the_page_says_what_must_carry_a_box() -> None:
    can = resting("tomato_soup_can")
    box = resting("cracker_box", floor=can.top_height)
    html = belief_html(believed([box], can).to_dict(), "Belief <before>")
    assert html.startswith("<h4>Belief &lt;before&gt;</h4>")
    assert "Cracker box stands on something hidden, 101 mm above" in html
    assert "Tomato soup can" in html
    assert "Master chef can" not in html
    assert "depth points" not in html
    sure = belief_html(HiddenBelief(0.98).to_dict(), "Belief at the end")
    assert "98 %" in sure
    assert "<li>" not in sure
