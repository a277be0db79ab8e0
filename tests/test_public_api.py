"""The public API: what `drake_clutter` exports."""

import importlib.metadata
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import drake_clutter

ROOT = Path(__file__).parent.parent
EXPORTED = sorted(set(drake_clutter.__all__) - {"__version__"})


@pytest.mark.parametrize("name", EXPORTED)
def test_every_export_is_there_and_documented(name: str) -> None:
    exported = getattr(drake_clutter, name)
    assert exported.__name__ == name
    assert exported.__module__.startswith("drake_clutter.")
    first_line = (inspect.getdoc(exported) or "").split("\n")[0]
    assert re.fullmatch(r"[A-Z].{5,90}[.]", first_line), first_line


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = (
        "import sys, drake_clutter; drake_clutter.__version__; dir(drake_clutter); "
        "drake_clutter.InputError; "
        "print({'pydrake', 'torch', 'numba', 'networkx', 'scipy'} & set(sys.modules))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout == "set()\n"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="SceneGraph"):
        _ = drake_clutter.SceneGraph  # type: ignore[attr-defined]


def test_there_is_one_version() -> None:
    assert drake_clutter.__version__ == importlib.metadata.version("drake-clutter")
    heading = re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert heading
    assert heading[1] == "Unreleased"
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited
    assert drake_clutter.__version__.startswith(cited[1])
