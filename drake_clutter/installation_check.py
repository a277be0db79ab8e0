"""Checks of what drake_clutter needs from the machine, with a remedy for what is missing.

Each probe runs in a process of its own and imports what it needs there, so that a crash or a broken
library is a result of the check.
"""

import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

_PROBE_TIMEOUT = 120.0
"""Time limit of a probe; the first rendering on a machine compiles shaders [s]."""
_MIN_MEMORY = 4.0
"""Memory that one worker process may need [GiB]."""


_EXPECTED_ERROR = re.compile(
    r"^drake_clutter\.(installation_check\.ProbeError|files\.InputError): "
)
"""Types of errors whose message is enough."""


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: Name of the check.
        ok: Whether the component is present and works.
        detail: What was found.
        remedy: How to install what is missing; empty if `ok`.
        required: Whether the package cannot do without; False for an extra that is not installed.
    """

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True


class ProbeError(RuntimeError):
    """A probe found a component insufficient; the message is the detail of the check."""


def run_checks() -> list[Check]:
    """Run all checks, which takes some seconds."""
    return [
        _run_probe(probe_drake, "pip install drake; on Debian: apt-get install libglib2.0-0"),
        _run_probe(
            probe_rendering, "on Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
        ),
        _run_probe(probe_temporary, "set TMPDIR to a folder that can be written"),
        _run_probe(probe_compilation, "set NUMBA_CACHE_DIR to a folder that can be written"),
        _run_probe(probe_solvers, "install Drake's own wheel: pip install --force-reinstall drake"),
        _check_torch(),
        _run_probe(
            probe_assets, "reinstall drake-clutter; in a checkout: drake-clutter assets build"
        ),
        _run_probe(probe_machine, f"use fewer workers; one may need {_MIN_MEMORY:g} GiB"),
    ]


def _check_torch() -> Check:
    """Check PyTorch, which belongs to an extra."""
    remedy = "needed by the trained policies: pip install 'drake-clutter[learned]'"
    if find_spec("torch") is None:
        return Check("torch", False, "not installed", remedy, required=False)
    return _run_probe(probe_torch, remedy)


def probe_drake() -> str:
    """Return the versions of Drake and Python."""
    from importlib.metadata import version

    import pydrake.multibody.plant  # noqa: F401

    return f"Drake {version('drake')}, Python {platform.python_version()}"


def probe_rendering() -> str:
    """Render a cube without a display and check its depth.

    The cube has a side of 1 m, and its front face is 2 m from the camera. The image has 64 x 48
    pixels.
    """
    import numpy as np
    from pydrake.geometry import (
        Box,
        ClippingRange,
        DepthRange,
        DepthRenderCamera,
        GeometryId,
        MakeRenderEngineVtk,
        PerceptionProperties,
        RenderCameraCore,
        RenderEngineVtkParams,
        RenderLabel,
    )
    from pydrake.math import RigidTransform
    from pydrake.systems.sensors import CameraInfo, ImageDepth32F

    engine = MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL"))
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel(1))
    X_WO = RigidTransform(np.array([0.0, 0.0, 2.5]))  # the camera is at W and looks along z
    engine.RegisterVisual(
        GeometryId.get_new_id(), Box(1.0, 1.0, 1.0), properties, X_WO, needs_updates=False
    )
    core = RenderCameraCore(
        "probe", CameraInfo(64, 48, 0.8), ClippingRange(0.1, 10.0), RigidTransform()
    )
    image = ImageDepth32F(64, 48)
    engine.RenderDepthImage(DepthRenderCamera(core, DepthRange(0.1, 9.0)), image)
    depth = float(image.data[24, 32, 0])
    if abs(depth - 2.0) > 0.001:
        raise ProbeError(f"a face at a depth of 2 m is rendered at {depth:g} m")
    return "VTK over EGL renders"


def probe_temporary() -> str:
    """Return the folder for temporary files."""
    from drake_clutter.files import temporary_folder

    return f"temporary files are written to {temporary_folder()}"


def probe_compilation() -> str:
    """Return the version of numba and the folder in which it keeps compiled functions."""
    import numba

    import drake_clutter.stability.static_judge  # noqa: F401, its functions are compiled
    from drake_clutter.compilation import cache_folder

    folder = cache_folder()
    if folder is None:
        raise ProbeError("no folder for compiled functions can be written")
    return f"numba {numba.__version__} keeps compiled functions in {folder}"


def probe_solvers() -> str:
    """Return the solvers that motion planning and static equilibrium use."""
    from pydrake.solvers import ClarabelSolver, IpoptSolver, SnoptSolver

    solvers = {"SNOPT": SnoptSolver(), "IPOPT": IpoptSolver(), "Clarabel": ClarabelSolver()}
    missing = [
        name for name, solver in solvers.items() if not (solver.available() and solver.enabled())
    ]
    if missing:
        raise ProbeError(f"{', '.join(missing)} not available")
    return ", ".join(solvers)


def probe_torch() -> str:
    """Return the version of PyTorch and its device."""
    import torch

    device = (
        torch.cuda.get_device_name()
        if torch.cuda.is_available()
        else "no CUDA device, computes on the CPU"
    )
    return f"PyTorch {torch.__version__}, {device}"


def probe_assets() -> str:
    """Check that every shipped object class has a model, and render one with its texture."""
    import numpy as np

    from drake_clutter.catalog import load_catalog
    from drake_clutter.cell.work_cell import default_cell
    from drake_clutter.resources import resource_path
    from drake_clutter.scenes.scene import Pose, Scene, SceneObject
    from drake_clutter.simulation.camera_renderer import CameraRenderer

    catalog = load_catalog()
    unbuilt = [
        name
        for name, object_class in catalog.classes.items()
        if not object_class.sdf_path.is_file()
    ]
    if unbuilt:
        raise ProbeError(
            f"{len(unbuilt)} of {len(catalog.classes)} object classes have no model, the first is "
            f"{unbuilt[0]}"
        )
    cell = default_cell()
    entry = next(iter(catalog.classes.values()))
    scene = Scene((SceneObject(entry.name, entry, Pose((0.0, 0.0, 0.2))),), cell.support)
    if not np.any(CameraRenderer(cell.camera).render_label(scene) == 0):
        raise ProbeError(f"{entry.sdf_path} is not visible in a rendered image")
    return f"{len(catalog.classes)} object classes in {resource_path('sdf_assets')}"


def probe_machine() -> str:
    """Return the number of cores that this process may use, and the memory."""
    cores = len(os.sched_getaffinity(0))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    detail = f"{cores} cores, {memory:.1f} GiB of memory"
    if memory < _MIN_MEMORY:
        raise ProbeError(detail)
    return detail


def _run_probe(probe: Callable[[], str], remedy: str) -> Check:
    """Run a probe, which is a function of this module, in a new Python process."""
    name = probe.__name__.removeprefix("probe_")
    code = f"from drake_clutter import installation_check as m; print(m.{probe.__name__}())"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        return Check(name, False, f"no answer in {_PROBE_TIMEOUT:g} s", remedy)
    if process.returncode == 0:
        return Check(name, True, _last_line(process.stdout))
    if process.returncode < 0:
        signal_name = signal.Signals(-process.returncode).name
        detail = f"died of {signal_name} {_last_line(process.stderr)}".rstrip()
        return Check(name, False, detail, remedy)
    return Check(name, False, _EXPECTED_ERROR.sub("", _last_line(process.stderr)), remedy)


def _last_line(text: str) -> str:
    return text.strip().rpartition("\n")[2]
