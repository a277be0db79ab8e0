"""Fuzzed scene files and configs load, or are refused with an error that names them."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from test_scene_file import DOCUMENT, GONE, SCENE, Path_, changed, loads_or_is_refused

from drake_clutter.config import upgrade_config
from drake_clutter.files import InputError
from drake_clutter.grammar.clutter_graph import OBJECT_SLOT
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import load_config_as
from drake_clutter.yaml_io import to_yaml


def places(value: Any, at: Path_ = ()) -> Iterator[Path_]:
    """Return the paths of all values in a document."""
    for key, item in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield (*at, key)
        yield from places(item, (*at, key))


PLACES = list(places(DOCUMENT))
STRANGE = [
    GONE,
    None,
    True,
    False,
    0,
    -1,
    7,
    10**9,
    0.5,
    -0.0,
    math.nan,
    math.inf,
    -math.inf,
    1e308,
    1e-320,
    "",
    "tray",
    "end",
]
STRANGE += [
    SCENE.names[0],
    "flat_0",
    OBJECT_SLOT,
    "sugar_box",
    [],
    {},
    [[]],
    [1, 2, 3],
    [1, 0, 0, 0],
    {"a": 1},
    {1: 2},
    "\0",
    "x" * 200,
]


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file that each example overwrites."""
    return tmp_path_factory.mktemp("fuzz") / "scene.yaml"


@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
@settings(max_examples=400)
@given(
    changes=st.lists(
        st.tuples(st.sampled_from(PLACES), st.sampled_from(STRANGE)), min_size=1, max_size=3
    )
)
def test_any_value_anywhere_loads_or_is_refused(
    fuzzed: Path, changes: list[tuple[Path_, Any]]
) -> None:
    document = DOCUMENT
    for path, value in changes:
        try:
            document = changed(document, path, value)
        except (KeyError, IndexError, TypeError):  # an earlier change took the place away
            continue
    fuzzed.write_text(yaml.dump(document, sort_keys=False))
    loads_or_is_refused(fuzzed)


WHOLE = yaml.dump(DOCUMENT, sort_keys=False, default_flow_style=None, width=160)


@settings(max_examples=300)
@given(
    start=st.integers(0, len(WHOLE)),
    taken=st.integers(0, 40),
    inserted=st.text(alphabet="0123456789.-:,[]{}'\"&*!|>%@?#\n\t abcez\x00é", max_size=6),
)
def test_any_edit_of_the_text_loads_or_is_refused(
    fuzzed: Path, start: int, taken: int, inserted: str
) -> None:
    fuzzed.write_text(WHOLE[:start] + inserted + WHOLE[start + taken :], encoding="utf-8")
    loads_or_is_refused(fuzzed)


POSE = {"translation": [0, 0, 2], "rpy_deg": [180, 0, 0]}
SCENARIO: dict[str, Any] = {
    "nodes": 25,
    "camera_noise": True,
    "arm": {
        "base": [-0.65, 0.0, 0.3, 0.0],
        "home": [0] * 6,
        "suction": {"cup_diameter": 0.03},
        "payload": 10.0,
    },
    "world": {
        "camera": {"width": 320, "altitude": 2.0, "hidden_below": 0.2},
        "layout": {"tray_side": 0.5, "stack_gap": 0.02},
        "cell": {
            "support": {"wall_height": 0.1},
            "cameras": {"overhead": {"pose": POSE, "height": 240}},
        },
    },
}
SCENARIO_PLACES = list(places(SCENARIO))


@settings(max_examples=300)
@given(
    changes=st.lists(
        st.tuples(st.sampled_from(SCENARIO_PLACES), st.sampled_from(STRANGE)), max_size=3
    )
)
def test_any_value_anywhere_in_a_config_loads_or_is_refused(
    fuzzed: Path, changes: list[tuple[Path_, Any]]
) -> None:
    document = SCENARIO
    for path, value in changes:
        try:
            document = changed(document, path, value)
        except (KeyError, IndexError, TypeError):
            continue
    fuzzed.write_text(to_yaml(document))
    message = f"{fuzzed}: "
    try:
        load_config_as(Scenario(), fuzzed, upgrade=upgrade_config)
    except InputError as refusal:
        message = str(refusal)
    assert message.startswith(f"{fuzzed}: ")
    assert "\n" not in message
    assert len(message) <= len(f"{fuzzed}: ") + 300
