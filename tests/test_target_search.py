"""Searches for one object: targets, rewards, least moves, the area policy and hand-over."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import CATALOG, CLASSES, DEFAULT_CELL, WORLD, random_scene, resting, rng, scene_of
from gymnasium.utils.env_checker import check_env
from typer.testing import CliRunner

from drake_clutter.agents.area_reduction import uncovered_areas
from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.episode_evaluation import EpisodeResult, EpisodeRunner, EpisodeSpec
from drake_clutter.agents.explorer_network import ExplorerNetwork, collate_graphs, sample_actions
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.agents.learned_explorer import (
    STUDENT,
    explorer_metadata,
    load_explorer,
)
from drake_clutter.agents.ppo import PPOConfig, PPOLearner
from drake_clutter.cli import app
from drake_clutter.commands.explore_scene import episode_to_dict, explore_scene
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.learning.checkpoint import load_checkpoint, save_checkpoint
from drake_clutter.scenes.interfaces import Move, MoveResult, PickPlaceCommand
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, SceneRecord, load_scene_dataset
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import make_teleport_backend_factory, run_episode
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.tasks.search_target import RANDOM_HIDDEN, find_target, require_target
from training import evaluate_target_search as evaluation
from training.script import SCENES
from training.target_set import TARGETS, TargetPair, TargetSet, load_target_set

JUDGE = StaticStabilityJudge(WORLD)
SEARCH = OracleSearch(WORLD, JUDGE)


def covered(x: float, y: float, tag: str) -> list[SceneObject]:
    """Return a gelatin box below a cracker box, which hides it."""
    return [
        resting("gelatin_box", xy=(x, y), name=f"small {tag}"),
        resting("cracker_box", xy=(x, y), floor=0.028, name=f"cover {tag}"),
    ]


# "small deep" lies below two boxes, "small shallow" below one.
SCENE = scene_of(
    *covered(-0.15, -0.15, "deep"),
    resting("cereal_box_large", xy=(-0.15, -0.15), floor=0.088, name="on top"),
    *covered(0.2, 0.2, "shallow"),
    resting("tomato_soup_can", xy=(0.25, -0.25), name="can"),
)
IN_VIEW = {d.name for d in JUDGE.ray_caster.observe(SCENE)[0].detections}


def test_what_a_target_is() -> None:
    assert {"on top", "cover shallow", "can"} == IN_VIEW
    of_class = require_target("gelatin_box", SCENE, IN_VIEW, rng())
    assert of_class.object_class.name == "gelatin_box"
    assert of_class.names == {"small deep", "small shallow"}
    named = require_target("small deep", SCENE, IN_VIEW, rng())
    assert named.object_class.name == "gelatin_box"
    assert named.names == {"small deep"}
    drawn = [require_target(RANDOM_HIDDEN, SCENE, IN_VIEW, rng(seed)).names for seed in range(40)]
    assert frozenset().union(*drawn) == {"small deep", "cover deep", "small shallow"}
    assert {len(names) for names in drawn} == {1}


def test_targets_that_a_scene_lacks() -> None:
    assert find_target("large_marker", SCENE, IN_VIEW, rng()) is None
    with pytest.raises(
        InputError,
        match=r"^target: large_marker: is not in the scene; expected cereal_box_large, "
        r".*gelatin_box.*small deep.*random-hidden$",
    ):
        require_target("large_marker", SCENE, IN_VIEW, rng())
    with pytest.raises(InputError, match=r"^target: random-hidden: every object is in view; exp"):
        require_target(RANDOM_HIDDEN, SCENE, SCENE.names, rng())


@pytest.mark.parametrize(
    ("targets", "moves"),
    [
        (["small shallow"], 1),
        (["cover deep"], 1),
        (["small deep"], 2),
        (["small deep", "small shallow"], 1),
        (["small deep", "cover deep"], 1),
        (["can", "small deep"], 0),
    ],
)
def test_fewest_moves_that_reveal_one_of_the_targets(targets: Sequence[str], moves: int) -> None:
    solution = SEARCH.solve(SCENE, targets=targets)
    assert solution.solvability is Solvability.SOLVABLE
    assert (len(solution.plan), solution.is_optimal) == (moves, True)
    assert len(SEARCH.solve(SCENE).plan) == 3  # all objects: the targets of before are forgotten


def test_a_target_outside_of_the_image_is_unsolvable_but_not_its_twin() -> None:
    scene = scene_of(
        *covered(-0.2, -0.2, "free"), resting("gelatin_box", xy=(0.9, 0.9), name="outside")
    )
    outside = SEARCH.solve(scene, targets=["outside"])
    assert (outside.solvability, outside.unrevealable) == (Solvability.UNSOLVABLE, ("outside",))
    both = SEARCH.solve(scene, targets=["outside", "small free"])
    assert (both.solvability, both.plan) == (Solvability.SOLVABLE, (Move("cover free"),))


def test_only_the_target_earns_a_reward_and_ends_the_episode() -> None:
    backend = make_teleport_backend_factory("static", WORLD)(SCENE, rng())
    target = require_target("small deep", SCENE, IN_VIEW, rng())
    moves = iter([Move("cover shallow"), Move("on top"), Move("cover deep"), Move("can")])
    task = run_episode(backend, lambda *_: Decision(next(moves)), max_moves=9, target=target)
    assert task.termination is TerminationReason.TARGET_FOUND
    assert [t.newly_found for t in task.transitions] == [
        ("small shallow",),
        ("cover deep",),
        ("small deep",),
    ]
    assert [t.reward for t in task.transitions] == [0.0, 0.0, 1.0]
    assert task.termination.is_success


def areas_of(target: str, *objects: SceneObject) -> dict[str, float]:
    scene = scene_of(*objects)
    observation = JUDGE.ray_caster.observe(scene)[0]
    known = [o for o in objects if o.name in {d.name for d in observation.detections}]
    return uncovered_areas(CLASSES[target], known, observation)


def test_area_in_which_a_target_can_lie() -> None:
    """Below a cracker box that lies 28 mm above the tray, whose outline is 230 mm by 160 mm.

    Gelatin boxes (28 mm flat) fit, soup cans (101 mm) and upright boxes do not. The space that the
    camera does not see is the shadow of the cover, larger by its distance from the camera.
    """
    below_cover = areas_of("gelatin_box", *covered(0.0, 0.0, "a"))
    shadow = 0.230 * 0.160 * (1.6 / (1.6 - 0.088)) ** 2
    assert below_cover == {"cover a": pytest.approx(shadow, rel=0.08)}
    assert areas_of("tomato_soup_can", *covered(0.0, 0.0, "a")) == {"cover a": 0.0}
    on_the_tray = resting("cracker_box", name="low")
    assert areas_of("gelatin_box", on_the_tray) == {"low": 0.0}


def high_board(name: str, xy: tuple[float, float]) -> list[SceneObject]:
    """Return a sugar box that stands, 175 mm high, and a cracker box on it, which hides it."""
    return [
        resting("sugar_box", Orientation.UPRIGHT_0, xy=xy, name=f"leg {name}"),
        resting("cracker_box", xy=xy, floor=0.175, name=f"board {name}"),
    ]


@pytest.mark.parametrize(
    ("target", "first"), [("tomato_soup_can", "board high"), ("gelatin_box", "big low")]
)
def test_the_area_policy_looks_where_the_target_fits(target: str, first: str) -> None:
    """A can fits only below the high board; for a gelatin box, the larger cover comes first."""
    scene = scene_of(
        *high_board("high", (-0.2, -0.15)),
        resting("gelatin_box", xy=(0.18, 0.15), name="foot"),
        resting("cereal_box_large", xy=(0.18, 0.15), floor=0.028, name="big low"),
        resting(target, xy=(0.25, -0.25), name="another"),
    )
    assert JUDGE.find_instability(scene) is None
    backend = make_teleport_backend_factory("static", WORLD)(scene, rng())
    sought = require_target("another", scene, [], rng())
    policy = make_policy_factory("area-reduction", WORLD, with_target=True)(backend, target=sought)
    assert policy(backend.belief, backend.observation, rng()).move == Move(first)


def test_policies_that_need_a_target(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--agent area-reduction: looks for one object; "):
        make_policy_factory("area-reduction", WORLD)
    kinds = {"tray": 1, "cracker_box": 2, "gelatin_box": 3}
    path = tmp_path / "student.safetensors"
    metadata = {"kind": STUDENT, "network": explorer_metadata(kinds, 8, finds_target=True)}
    save_checkpoint(path, ExplorerNetwork(3, 8, finds_target=True), metadata)
    network, numbers = load_explorer(load_checkpoint(path), path)
    assert (network.finds_target, numbers) == (True, kinds)
    with pytest.raises(InputError, match="looks for one object; expected a target"):
        make_policy_factory(str(path), WORLD)
    backend = make_teleport_backend_factory("static", WORLD)(SCENE, rng())
    can = require_target("can", SCENE, IN_VIEW, rng())
    make_policy = make_policy_factory(str(path), WORLD, with_target=True)
    with pytest.raises(InputError, match="was not trained with tomato_soup_can; train one"):
        make_policy(backend, target=can)
    for agent in ("area-reduction", str(path)):
        make_policy = make_policy_factory(agent, WORLD, with_target=True)
        with pytest.raises(InputError, match="looks for one object; expected a target"):
            make_policy(backend)


@pytest.mark.parametrize("agent", ["area-reduction", "student", "full-knowledge"])
def test_a_policy_is_loaded_once_for_all_targets(agent: str) -> None:
    """Episodes of one runner have the results that a new runner for each of them has."""
    scenes = SCENES / "sg_star_10.json"
    dataset = load_scene_dataset(scenes, CATALOG)
    episodes = []
    for index in range(3):
        scene = dataset.settled_scene(index, dataset.grammar, WORLD)
        in_view = {d.name for d in JUDGE.ray_caster.observe(scene)[0].detections}
        target = sorted(set(scene.names) - in_view)[0]
        episodes.append(EpisodeSpec(scenes, index, agent, index, target))

    def runner() -> EpisodeRunner:
        return EpisodeRunner(WORLD, None, 4, 0, "static")

    shared = runner()
    results = [shared(episode) for episode in episodes]
    assert results == [runner()(episode) for episode in episodes]
    assert any(result.ended == "target found" for result in results)


@pytest.fixture(scope="module")
def scenes() -> SceneDataset:
    """Two stable scenes of the random generator that hide three and two objects."""
    records = tuple(
        SceneRecord(scene.derivation, "", 1, "", tuple(scene.poses.values()))
        for scene in (random_scene(seed, 16, 20) for seed in (10, 19))
    )
    classes = tuple(CATALOG.object_set("ycb7"))
    return SceneDataset("few", classes, {}, records, "", DEFAULT_CELL)


def test_the_environment_with_a_target(scenes: SceneDataset) -> None:
    environment = ClutterExploration(scenes, target=RANDOM_HIDDEN, fidelity="static", max_moves=5)
    check_env(environment, skip_render_check=True)
    observation, _ = environment.reset(seed=1)
    assert environment.target is not None
    kind = environment.node_kind_ids[environment.target.object_class.name]
    assert observation["target_kind"].tolist() == [kind]
    assert not observation["is_target"].any()  # the policy has not seen it
    everything = environment.observe(privileged=True)
    names = environment.task.scene.names
    marked = {names[k - 1] for k in np.flatnonzero(everything["is_target"])}
    assert marked == environment.target.names
    with pytest.raises(InputError, match="none stands and hides the target cup, with at most 24"):
        ClutterExploration(scenes, target="cup", fidelity="static").reset(seed=0)
    with pytest.raises(InputError, match=r"^target: cup: is not in the scene; expected "):
        ClutterExploration(scenes, target="cup", fidelity="static").reset(options={"scene": 0})


def test_an_untrained_target_changes_nothing_and_a_trained_one_does(scenes: SceneDataset) -> None:
    environment = ClutterExploration(scenes, target=RANDOM_HIDDEN, fidelity="static")
    batch = collate_graphs([environment.reset(seed=seed)[0] for seed in range(4)])
    num_kinds = len(environment.node_kind_ids)
    plain, conditioned = ExplorerNetwork(num_kinds), ExplorerNetwork(num_kinds, finds_target=True)
    conditioned.load_state_dict(conditioned.state_dict() | plain.state_dict())
    outputs = [sample_actions(network, batch, None) for network in (plain, conditioned)]
    assert np.array_equal(outputs[0].pick_probs, outputs[1].pick_probs)
    assert np.array_equal(outputs[0].values, outputs[1].values)
    torch.nn.init.normal_(conditioned.target_embedding.weight)
    assert not np.allclose(sample_actions(conditioned, batch, None).values, outputs[0].values)


def test_students_learn_the_target(scenes: SceneDataset) -> None:
    """Cloning labels the states by a teacher that sees the target; both learn its embedding."""
    environment = ClutterExploration(scenes, target=RANDOM_HIDDEN, fidelity="static", max_moves=3)
    device = torch.device("cpu")
    teacher = ExplorerNetwork(len(environment.node_kind_ids), 8, finds_target=True)
    cloning = BehaviorCloningConfig(
        episodes_per_iteration=2, updates_per_iteration=1, batch_size=4, width=8
    )
    ppo = PPOConfig(episodes_per_iteration=2, update_epochs=1, width=8)
    for learner in (
        BehaviorCloningLearner(environment, teacher, cloning, 0, device),
        PPOLearner(environment, ppo, 0, device),
    ):
        rollouts = learner.train_iteration()
        sought = {int(o["target_kind"][0]) for r in rollouts for o in r.observations}
        changed = learner.network.target_embedding.weight.abs().sum(dim=1) > 0
        assert changed.any()
        assert {k + 1 for k in np.flatnonzero(changed.numpy())} <= sought


BESIDE = "-0.15,0.55,0.005,0"


def test_a_pose_beside_the_tray_is_reached_and_not_lost() -> None:
    """The hand-over place is 11 mm below the tray's floor; the box's middle is 14 mm above it."""
    scene = scene_of(resting("gelatin_box", name="box"), resting("sugar_box", xy=(0.1, 0.1)))
    move = Move("box", BESIDE)
    X_TO_place = move.place_pose(scene["box"].X_TO)
    assert X_TO_place is not None
    command = PickPlaceCommand(move, scene["box"].X_TO, X_TO_place)
    assert command.is_beside(scene.support)
    assert not PickPlaceCommand(Move("box"), scene["box"].X_TO, X_TO_place).is_beside(scene.support)
    outcome = SettleExecutor(WORLD).execute(scene, command, rng())
    assert outcome.result is MoveResult.PLACED
    assert outcome.scene["box"].X_TO.p == pytest.approx([-0.15, 0.55, 0.003], abs=0.0015)


def test_a_found_target_is_cleared_and_handed_over() -> None:
    """A box that leaves a part of the target in view stands on it, and is moved first."""
    scene = scene_of(
        resting("cracker_box", name="target"),
        resting("pudding_box", xy=(0.03, 0.0), floor=0.06, name="above"),
    )
    moves: list[str] = []
    task = explore_scene(
        scene,
        "largest-clear",
        "settle",
        5,
        0,
        WORLD,
        lambda t: moves.append(f"{t.move.pick} {t.outcome.result.value}"),
        "cracker_box",
        retrieve=True,
    )
    assert moves == ["above placed", "target placed"]
    assert task.termination is TerminationReason.RETRIEVED
    place = DEFAULT_CELL.handover
    assert place is not None
    assert task.scene["target"].X_TO.p[:2] == pytest.approx(place.translation[:2], abs=0.002)
    assert task.scene["target"].bounds_T[0][2] == pytest.approx(place.translation[2], abs=5e-4)
    document = episode_to_dict(task, "largest-clear", "settle", 0)
    assert document["success"] is True
    assert document["target"] == {
        "asked": "cracker_box",
        "object_class": "cracker_box",
        "objects": ["target"],
        "found": ["target"],
        "retrieved": ["target"],
    }


def test_the_arm_plans_and_hands_over() -> None:
    scene = scene_of(resting("gelatin_box", name="target"))
    task = explore_scene(
        scene, "random", "arm", 2, 0, WORLD, lambda _: None, "target", retrieve=True
    )
    (only,) = task.transitions
    assert (only.outcome.result, task.termination) == (
        MoveResult.PLACED,
        TerminationReason.RETRIEVED,
    )
    assert only.outcome.samples is not None
    place = DEFAULT_CELL.handover
    assert place is not None
    assert task.scene["target"].X_TO.p[:2] == pytest.approx(place.translation[:2], abs=0.002)


SETS = sorted(TARGETS.glob("*.json"))


@pytest.mark.parametrize("path", SETS, ids=[path.stem for path in SETS])
def test_shipped_target_sets(path: Path, tmp_path: Path) -> None:
    """The target of the first pair is hidden, and the oracle finds the stored number of moves."""
    scenes = load_scene_dataset(SCENES / path.name, CATALOG)
    targets = load_target_set(path, scenes)
    assert [pair.scene for pair in targets.pairs] == list(range(len(scenes.scenes)))
    pair = targets.pairs[0]
    scene = scenes.settled_scene(pair.scene, scenes.grammar, WORLD)
    observation, _ = JUDGE.ray_caster.observe(scene)
    assert pair.target in {*scene.names} - {d.name for d in observation.detections}
    plan = SEARCH.solve(scene, seed=pair.scene, targets=[pair.target]).plan
    assert (len(plan) or None) == pair.moves
    changed = tmp_path / path.name
    changed.write_text(path.read_text().replace(f'"moves": {pair.moves}', '"moves": 17', 1))
    with pytest.raises(InputError, match="sha256: does not match the pairs"):
        load_target_set(changed, scenes)
    with pytest.raises(InputError, match="scenes_sha256: is that of other scenes than few"):
        load_target_set(path, SceneDataset("few", (), {}, (), "", DEFAULT_CELL))


def result(ended: str, moves: int) -> EpisodeResult:
    return EpisodeResult("scene", "agent", ended, 1, 1, moves, (0,) * moves, 0)


def test_metrics_of_a_search() -> None:
    """Three solvable pairs, one of which is revealed late and one not at all, and another one."""
    pairs = [
        TargetPair(scene=k, target="a", solvable=solvable, moves=moves, is_optimal=True)
        for k, (solvable, moves) in enumerate(
            [("solvable", 4), ("solvable", 2), ("solvable", 3), ("undecided", None)]
        )
    ]
    targets = TargetSet("set", "scenes", tuple(pairs), "")
    ours = [
        result("target found", 5),  # 1.25 times the oracle's
        result("target found", 3),
        result("collapsed", 1),
        result("target found", 8),
    ]
    area = [result("target found", 10), result("out of moves", 20), result("target found", 3)]
    row = evaluation.summarize(targets, ours, area)
    assert (row["episodes"], row["revealed"], row["collapsed"]) == (4, 0.75, 0.25)
    assert row["moves"] == pytest.approx(16 / 3)
    solvable = row["solvable"]
    assert (solvable["episodes"], solvable["oracle_moves"]) == (3, 3.0)
    assert (solvable["revealed"], solvable["efficient"]) == (2 / 3, 1 / 3)
    assert (row["to_oracle"]["ratio"], row["to_oracle"]["episodes"]) == (8 / 6, 2)
    assert (row["to_area"]["ratio"], row["to_area"]["episodes"]) == (0.5, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--retrieve"], "--retrieve: nothing to retrieve; expected --target"),
        (
            ["--retrieve", "--target", "cracker_box", "--set", "handover=null"],
            "--retrieve: the cell has no handover; expected a pose in --cell, or as --set "
            "handover.translation=[X,Y,Z]",
        ),
        (["--target", "cup"], "target: cup: is not in the scene; expected cracker_box, random-"),
        (["--agent", "area-reduction"], "--agent area-reduction: looks for one object; expected a"),
    ],
)
def test_misuse_of_explore_is_one_line(
    options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_scene(Path("scene.yaml"), scene_of(resting("cracker_box")), DEFAULT_CELL)
    result = CliRunner().invoke(app, ["explore", "scene.yaml", *options, "--out", "out"])
    assert isinstance(result.exception, InputError)
    assert str(result.exception).startswith(message)
    assert "\n" not in str(result.exception)
    assert not Path("out/episode.json").exists()
