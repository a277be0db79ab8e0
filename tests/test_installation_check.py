"""Checks of the installation: a broken component is reported with a remedy."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from drake_clutter import installation_check
from drake_clutter.cli import app
from drake_clutter.installation_check import Check


@pytest.fixture
def torch_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Path of a module that replaces PyTorch in new processes."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path / "torch.py"


def test_all_checks_pass() -> None:
    found = {check.name: check for check in installation_check.run_checks()}
    names = [
        "drake",
        "rendering",
        "temporary",
        "compilation",
        "solvers",
        "torch",
        "assets",
        "machine",
    ]
    assert list(found) == names
    assert [check for check in found.values() if not check.ok] == []
    assert all(check.detail and not check.remedy for check in found.values())
    assert "SNOPT" in found["solvers"].detail


def test_an_extra_that_is_not_installed_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation_check, "find_spec", lambda name: None)
    missing = installation_check._check_torch()
    assert (missing.ok, missing.required, missing.detail) == (False, False, "not installed")
    monkeypatch.setattr(installation_check, "run_checks", lambda: [missing])
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0
    assert "optional" in result.stdout
    broken = replace(missing, required=True)
    monkeypatch.setattr(installation_check, "run_checks", lambda: [broken])
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 1


def test_a_broken_library_is_reported(torch_module: Path) -> None:
    torch_module.write_text("raise ImportError('broken')")
    assert installation_check._run_probe(installation_check.probe_torch, "remedy") == Check(
        "torch", False, "ImportError: broken", "remedy"
    )


def test_a_probe_error_is_reported_without_its_type(torch_module: Path) -> None:
    module = installation_check.__name__
    torch_module.write_text(f"from {module} import ProbeError\nraise ProbeError('too old')")
    check = installation_check._run_probe(installation_check.probe_torch, "remedy")
    assert check == Check("torch", False, "too old", "remedy")


def test_a_crash_is_reported(torch_module: Path) -> None:
    torch_module.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)")
    assert installation_check._run_probe(installation_check.probe_torch, "remedy") == Check(
        "torch", False, "died of SIGSEGV", "remedy"
    )


def test_a_timeout_is_reported(torch_module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch_module.write_text("import time\ntime.sleep(60)")
    monkeypatch.setattr(installation_check, "_PROBE_TIMEOUT", 1.0)
    assert installation_check._run_probe(installation_check.probe_torch, "remedy") == Check(
        "torch", False, "no answer in 1 s", "remedy"
    )


def test_missing_models_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = SimpleNamespace(classes={"crate": SimpleNamespace(sdf_path=tmp_path / "model.sdf")})
    monkeypatch.setattr("drake_clutter.catalog.load_catalog", lambda: catalog)
    with pytest.raises(
        installation_check.ProbeError,
        match="1 of 1 object classes have no model, the first is crate",
    ):
        installation_check.probe_assets()
