"""The environments keep to gymnasium's interface, also for agents that ignore masks."""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import drake_clutter.tasks  # noqa: F401, registers the environments
from drake_clutter.catalog import load_catalog
from drake_clutter.files import InputError
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.environment_interface import index_type
from drake_clutter.tasks.generation_task import (
    MAX_INFEASIBLE_ACTIONS_PER_NODE,
    ClutterGeneration,
    GenerationTaskConfig,
)

GENERATION, EXPLORATION = "ClutterGeneration-v0", "ClutterExploration-v0"


@pytest.fixture(scope="module")
def exploration() -> ClutterExploration:
    environment = ClutterExploration()
    environment.reset(seed=0)
    return environment


@pytest.fixture(scope="module")
def flat_exploration() -> ClutterExploration:
    environment = ClutterExploration(flat_actions=True)
    environment.reset(seed=0)
    return environment


@pytest.fixture
def generation() -> ClutterGeneration:
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=6))
    environment.reset(seed=0)
    return environment


@pytest.mark.filterwarnings("error:.*WARN")
@pytest.mark.parametrize(
    ("name", "options"),
    [(GENERATION, {}), (EXPLORATION, {}), (EXPLORATION, {"flat_actions": True})],
)
def test_the_checker_of_gymnasium_finds_nothing(name: str, options: dict[str, Any]) -> None:
    check_env(gymnasium.make(name, render_mode="rgb_array", **options).unwrapped)


def test_an_episode_ends_for_an_agent_that_ignores_the_mask(generation: ClutterGeneration) -> None:
    (infeasible, *_) = np.flatnonzero(~generation.action_masks())
    limit = MAX_INFEASIBLE_ACTIONS_PER_NODE * 6
    flags = [generation.step(int(infeasible))[2:4] for _ in range(limit)]
    assert flags == [(False, False)] * (limit - 1) + [(False, True)]
    generation.reset(seed=0)
    assert generation.step(int(infeasible))[3] is False


def test_feasible_actions_do_not_count_toward_the_limit(generation: ClutterGeneration) -> None:
    rng = np.random.default_rng(0)
    terminated = False
    while not terminated:
        feasible = np.flatnonzero(generation.action_masks())
        _, _, terminated, truncated, info = generation.step(int(rng.choice(feasible)))
        assert not truncated
        assert np.array_equal(info["action_mask"], generation.action_masks())


def test_the_flat_mask_marks_the_allowed_pairs(
    exploration: ClutterExploration, flat_exploration: ClutterExploration
) -> None:
    pairs = exploration.observe()["action_mask"].astype(bool)
    mask = flat_exploration.action_masks()
    assert mask.dtype == bool
    assert isinstance(flat_exploration.action_space, gymnasium.spaces.Discrete)
    assert mask.shape == (flat_exploration.action_space.n,)
    assert np.array_equal(mask.reshape(pairs.shape), pairs)


def test_the_masks_of_two_nodes_are_those_of_their_pairs(exploration: ClutterExploration) -> None:
    pairs = exploration.observe()["action_mask"]
    mask = exploration.action_masks()
    assert isinstance(exploration.action_space, gymnasium.spaces.MultiDiscrete)
    assert mask.shape == (exploration.action_space.nvec.sum(),)
    n = len(pairs)
    assert set(np.flatnonzero(mask[:n])) == set(np.nonzero(pairs)[0])
    assert set(np.flatnonzero(mask[n:])) == set(np.nonzero(pairs)[1])


def test_flat_actions_are_the_same_moves() -> None:
    environments = [ClutterExploration(), ClutterExploration(flat_actions=True)]
    for environment in environments:
        environment.reset(seed=3)
    x, y = np.argwhere(environments[0].observe()["action_mask"])[0]
    n = len(environments[0].observe()["action_mask"])
    steps = [environments[0].step((x, y)), environments[1].step(x * n + y)]
    assert steps[0][1:4] == steps[1][1:4]
    assert steps[0][4]["transition"].move == steps[1][4]["transition"].move
    for name, value in steps[0][0].items():
        np.testing.assert_array_equal(value, steps[1][0][name])


@pytest.mark.parametrize("action", [-1, 30, 1.5, "a", None, True, np.True_, [1, 2], np.nan])
def test_an_odd_rule_is_refused(action: Any, generation: ClutterGeneration) -> None:
    with pytest.raises(ValueError, match=r"^action: .*; expected an integer in \[0, 29\]$"):
        generation.step(action)


@pytest.mark.parametrize("action", [3, (1,), (1, 2, 3), (-1, 0), (0, 25), (0.5, 1), "ab", None])
def test_an_odd_move_is_refused(action: Any, exploration: ClutterExploration) -> None:
    with pytest.raises(ValueError, match=r"^action.*; expected (two nodes|an integer in)"):
        exploration.step(action)


@pytest.mark.parametrize("action", [np.int64(1), np.array(1), np.array([1]), np.int8(1)])
def test_integers_of_numpy_are_actions(action: Any, generation: ClutterGeneration) -> None:
    assert generation.step(action)[0] is not None


@pytest.mark.parametrize("options", [{"scenes": 1}, {"scene": 1.5}, {"scene": "1"}, {"scene": -1}])
def test_odd_options_are_refused(options: dict[str, Any], exploration: ClutterExploration) -> None:
    with pytest.raises(ValueError, match=r"^(options|scene): .*; expected "):
        exploration.reset(options=options)


def test_options_that_an_environment_lacks_are_refused(generation: ClutterGeneration) -> None:
    with pytest.raises(InputError, match=r"^options: 'scene'; expected none$"):
        generation.reset(options={"scene": 1})


def test_an_odd_render_mode_is_refused() -> None:
    for environment in (ClutterGeneration, ClutterExploration):
        with pytest.raises(InputError, match=r"^render_mode: 'human'; expected "):
            environment(render_mode="human")


def test_pictures_show_the_scene() -> None:
    """An empty tray and a stack, and a scene before and after a move."""
    generation = ClutterGeneration(task=GenerationTaskConfig(nodes=6), render_mode="rgb_array")
    exploration = ClutterExploration(render_mode="rgb_array")
    rng = np.random.default_rng(0)
    generation.reset(seed=0)
    empty = generation.render()
    assert empty.shape == (480, 640, 3)
    assert empty.dtype == np.uint8
    terminated = False
    while not terminated:
        feasible = np.flatnonzero(generation.action_masks())
        terminated = generation.step(int(rng.choice(feasible)))[2]
    assert not np.array_equal(generation.render(), empty)
    exploration.reset(seed=0)
    before = exploration.render()
    exploration.step(np.argwhere(exploration.observe()["action_mask"])[0])
    assert not np.array_equal(exploration.render(), before)
    assert ClutterExploration().render() is None


@pytest.mark.parametrize("make", [ClutterGeneration, ClutterExploration])
def test_an_episode_starts_with_a_reset(make: type[ClutterGeneration | ClutterExploration]) -> None:
    environment = make(render_mode="rgb_array")
    for use in (lambda: environment.step(0), environment.action_masks, environment.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
            use()


@pytest.mark.parametrize("largest", [1, 127, 128, 32767, 32768])
def test_numbers_of_kinds_are_of_the_smallest_type_that_holds_them(largest: int) -> None:
    kind = index_type(largest)
    assert np.iinfo(kind).max >= largest
    assert kind == np.int8 or np.iinfo(np.dtype(f"i{kind.itemsize // 2}")).max < largest


def test_a_set_of_many_classes_has_numbers_above_127() -> None:
    (box,) = (c for c in load_catalog().object_set("ycb7") if c.name == "sugar_box")
    classes = [replace(box, name=f"box_{k}") for k in range(130)]
    environment = ClutterGeneration(classes, GenerationTaskConfig(nodes=4))
    observation, info = environment.reset(seed=0)
    while not environment.partial.finished:
        action = int(np.flatnonzero(info["action_mask"])[-1])
        observation, *_, info = environment.step(action)
        assert environment.observation_space.contains(observation)
    assert observation["node_kind"].max() > 127


def test_too_many_objects_are_refused() -> None:
    with pytest.raises(InputError, match=r"max_objects: 70000; expected 1 to 200"):
        ClutterExploration(max_objects=70_000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": {"nodes": 3}}, r"task: \{'nodes': 3\}; expected a GenerationTaskConfig or None"),
        ({"config": "tray"}, "config: 'tray'; expected a ClutterConfig or None"),
        ({"classes": []}, r"classes: \[\]; expected some ObjectClass"),
        ({"classes": ["mug"]}, r"classes: \['mug'\]; expected some ObjectClass"),
    ],
)
def test_odd_arguments_of_generation_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}$"):
        gymnasium.make(f"drake_clutter.tasks:{GENERATION}", **arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        *({"max_moves": -1}, {"max_moves": 1.5}, {"flat_actions": "yes"}, {"privileged": 1}),
        {"config": {"settle": {}}},
    ],
)
def test_odd_arguments_of_exploration_are_refused(arguments: dict[str, Any]) -> None:
    (name,) = arguments
    with pytest.raises(InputError, match=f"^{name}: .*; expected "):
        gymnasium.make(f"drake_clutter.tasks:{EXPLORATION}", **arguments)
