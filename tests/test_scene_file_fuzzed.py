"""Scene files with anything anywhere: they load, or are refused by an error that names them."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from test_scene_file import DOCUMENT, GONE, SCENE, Path_, changed, loads_or_is_refused

from drake_clutter.grammar.graph import OBJECT_SLOT


def places(value: Any, at: Path_ = ()) -> Iterator[Path_]:
    """The paths of all values in a document."""
    for key, item in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield (*at, key)
        yield from places(item, (*at, key))


PLACES = list(places(DOCUMENT))
STRANGE = [GONE, None, True, False, 0, -1, 7, 10**9, 0.5, -0.0, math.nan, math.inf, -math.inf, 1e308, 1e-320, "", "tray", "end"]
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
    """A file to be overwritten again and again."""
    return tmp_path_factory.mktemp("fuzz") / "scene.yaml"


@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
@settings(max_examples=400)
@given(changes=st.lists(st.tuples(st.sampled_from(PLACES), st.sampled_from(STRANGE)), min_size=1, max_size=3))
def test_any_value_anywhere_loads_or_is_refused(fuzzed: Path, changes: list[tuple[Path_, Any]]) -> None:
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
def test_any_edit_of_the_text_loads_or_is_refused(fuzzed: Path, start: int, taken: int, inserted: str) -> None:
    fuzzed.write_text(WHOLE[:start] + inserted + WHOLE[start + taken :], encoding="utf-8")
    loads_or_is_refused(fuzzed)
