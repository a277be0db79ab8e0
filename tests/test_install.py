"""The source archive, the wheel built from it, and its installation in an empty environment."""

import json
import os
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import drake_clutter

ROOT = Path(__file__).resolve().parent.parent
VERSIONED = f"drake_clutter-{drake_clutter.__version__}"
PRINT_PATHS = """
from drake_clutter.resources import resource_path
print(resource_path("sdf_assets/catalog.yaml"))
print(resource_path("models"))
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command outside of this test's Python environment; return its output."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    result = subprocess.run(
        command, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the source archive and, from it, the wheel; return the wheel's path."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel and its locked dependencies; return the environment's folder."""
    folder = tmp_path_factory.mktemp("installed")
    python = folder / "bin" / "python"
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--quiet"]
    run(
        *pip,
        "install",
        "--no-compile",
        "--constraint",
        ROOT / "requirements.lock",
        wheel,
        cwd=folder,
    )
    run(*pip, "check", cwd=folder)
    return folder


def test_the_wheel_holds_one_package(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names} == {
        "drake_clutter",
        f"{VERSIONED}.dist-info",
    }
    for folder in ("models", "sdf_assets"):
        paths = (path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file())
        here = {path.as_posix() for path in paths if "generators" not in path.parts}
        assert here
        assert here == {
            name.split("_shipped/")[1]
            for name in names
            if name.startswith(f"drake_clutter/_shipped/{folder}/")
        }
    assert "drake_clutter/py.typed" in names


def test_the_lock_satisfies_the_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        metadata = Parser().parsestr(archive.read(f"{VERSIONED}.dist-info/METADATA").decode())
    locked = {
        line.partition("==")[0].lower()
        for line in (ROOT / "requirements.lock").read_text().splitlines()
    }
    required = {Requirement(value).name.lower() for value in metadata.get_all("Requires-Dist", [])}
    assert required <= locked
    assert not any(name.startswith("nvidia") for name in locked)


def test_the_installed_package_works_from_anywhere(installed: Path, tmp_path: Path) -> None:
    python = installed / "bin" / "python"
    for line in run(python, "-c", PRINT_PATHS, cwd=tmp_path).splitlines():
        assert Path(line).is_relative_to(installed)
    assert "doctor" in run(installed / "bin" / "drake-clutter", "--help", cwd=tmp_path)


def test_the_installed_package_renders_and_finds_its_assets(
    installed: Path, tmp_path: Path
) -> None:
    """Without the extras, `doctor` reports only PyTorch as missing."""
    command = installed / "bin" / "drake-clutter"
    result = subprocess.run(
        [command, "doctor", "--json"],
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    checks = json.loads(result.stdout)
    assert [check["name"] for check in checks if not check["ok"]] == ["torch"], result.stderr
    (assets,) = (check for check in checks if check["name"] == "assets")
    assert str(installed) in assets["detail"]


def test_the_editable_package_works_from_anywhere(tmp_path: Path) -> None:
    """The environment that `make test` creates."""
    for line in run(sys.executable, "-c", PRINT_PATHS, cwd=tmp_path).splitlines():
        assert Path(line).is_relative_to(ROOT)
