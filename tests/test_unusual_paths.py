"""Installations and catalogs may be in folders whose names need escapes in a URI."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, rng, scene_of
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_clutter import resources
from drake_clutter.assets import build_assets
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.sdf_text import mesh_uri, read_sdf_text
from drake_clutter.cli.output import print_line, print_result
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.grammar import Orientation
from drake_clutter.installation_check import probe_assets
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.reports.recording import write_recording
from drake_clutter.resources import resource_path
from drake_clutter.robots.model_parsing import parse_model
from drake_clutter.scenes.interfaces import MotionSample, Verdict
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge

UNUSUAL = "a blank, ümlaut #50% %41?[x]&'\\"
"""Name of a folder: `%41` is an escaped A, `#` and `?` end the path of a URI."""
SCENE = scene_of(
    resting("sugar_box", Orientation.UPRIGHT_0),
    resting("tomato_soup_can", xy=(0.10, 0.0)),
    resting("gelatin_box", Orientation.UPRIGHT_0, (0.10, 0.0), 0.101),
)


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the shipped models in a folder with an unusual name."""
    folder = tmp_path_factory.mktemp("installation") / UNUSUAL
    for name in ("models", "sdf_assets"):
        shutil.copytree(resource_path(name), folder / name)
    return folder


@pytest.fixture
def installed(installation: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Let the package find its shipped files in the copy."""
    monkeypatch.setattr(resources, "_PACKAGE_DIR", installation / "drake_clutter")
    assert resource_path("models").is_relative_to(installation)
    load_catalog.cache_clear()
    yield installation
    load_catalog.cache_clear()


@pytest.fixture
def moved(installed: Path) -> Scene:
    """Return the scene with classes of the copy."""
    classes = load_catalog().classes
    objects = tuple(replace(o, object_class=classes[o.name]) for o in SCENE.objects)
    assert all(o.object_class.folder.is_relative_to(installed) for o in objects)
    return replace(SCENE, objects=objects)


def test_images_are_the_same(moved: Scene) -> None:
    expected = CameraRenderer(DEFAULT_CELL.camera).render(SCENE)
    images = CameraRenderer(DEFAULT_CELL.camera).render(moved)
    assert len(np.unique(expected.color.reshape(-1, 3), axis=0)) > 100
    np.testing.assert_array_equal(images.color, expected.color)
    np.testing.assert_array_equal(images.depth, expected.depth)


def test_objects_settle_the_same(moved: Scene) -> None:
    expected = DrakeJudge(ClutterConfig()).judge(SCENE, rng(1))
    verdict = DrakeJudge(ClutterConfig()).judge(moved, rng(1))
    assert isinstance(expected, Verdict)
    assert isinstance(verdict, Verdict)
    assert verdict.stable
    assert verdict.settled == expected.settled


def test_plans_and_recordings_are_the_same(moved: Scene, tmp_path: Path) -> None:
    pose = moved["gelatin_box"].X_TO
    X_TO_place = Pose((0.2, -0.2, pose.p[2] - 0.1), pose.quaternion)
    plans = []
    for number, scene in enumerate((SCENE, moved)):
        planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
        plan = planner.plan(list(scene.objects), "gelatin_box", X_TO_place)
        assert isinstance(plan, PickPlacePlan)
        plans.append([phase.duration for phase in plan.segments])
        motion = [MotionSample(0.0, scene.poses)]
        write_recording(tmp_path / f"{number}.html", scene, motion, DEFAULT_CELL)
    assert plans[0] == plans[1]
    sizes = [(tmp_path / f"{number}.html").stat().st_size for number in range(2)]
    assert sizes[0] == pytest.approx(sizes[1], abs=100)


@pytest.mark.parametrize("format", ExportFormat)
def test_exports_are_the_same(format: ExportFormat, moved: Scene, tmp_path: Path) -> None:
    folders = []
    for name, scene in (("usual", SCENE), (UNUSUAL, moved)):
        (tmp_path / name).mkdir()
        export_scene(scene, format, tmp_path / name)
        folders.append(tmp_path / name)
    names = [sorted(p.relative_to(f) for p in f.rglob("*") if p.is_file()) for f in folders]
    assert names[0] == names[1]
    for file in names[0]:
        assert (folders[0] / file).read_bytes() == (folders[1] / file).read_bytes(), file


def test_an_own_catalog_is_built_rendered_and_settled(tmp_path: Path) -> None:
    folder = tmp_path / UNUSUAL
    folder.mkdir()
    for name in ("catalog.yaml", "mug.stl"):
        shutil.copyfile(Path("examples/custom_class") / name, folder / name)
    build_assets(folder, None)
    mug = load_catalog(folder).classes["mug"]
    scene = scene_of(replace(resting("sugar_box"), name="mug", object_class=mug))
    height = -mug.corners[:, 2].min()
    scene = replace(scene, objects=(replace(scene["mug"], X_TO=Pose((0.0, 0.0, height))),))
    assert (CameraRenderer(DEFAULT_CELL.camera).render(scene).label == 0).sum() > 100
    verdict = DrakeJudge(ClutterConfig()).judge(scene, rng())
    assert isinstance(verdict, Verdict)
    assert verdict.stable


@pytest.mark.parametrize("kind", ["obj", "stl"])
@pytest.mark.parametrize("model", ["sdf", "urdf"])
def test_meshes_of_robots_are_found(tmp_path: Path, kind: str, model: str) -> None:
    folder = tmp_path / UNUSUAL
    folder.mkdir()
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    (folder / "part.obj").write_text(f"{vertices}vn 0 0 1\nf 1//1 2//1 3//1\n")
    corners = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    facet = f"facet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\n"
    (folder / "part.stl").write_text(f"solid part\n{facet}endsolid part\n")
    mesh = f'<mesh filename="part.{kind}"/>'
    visual = f"<visual><geometry>{mesh}</geometry></visual>"
    text = f'<robot name="r"><link name="l">{visual}</link></robot>'
    if model == "sdf":
        mesh = f"<mesh><uri>part.{kind}</uri></mesh>"
        link = f'<link name="l"><visual name="v"><geometry>{mesh}</geometry></visual></link>'
        text = f'<sdf version="1.10"><model name="r">{link}</model></sdf>'
    (folder / f"robot.{model}").write_text(text)
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    parse_model(plant, str(folder / f"robot.{model}"), visuals=True)
    assert scene_graph.model_inspector().NumGeometriesWithRole(Role.kPerception) == 1


def test_the_check_of_the_installation_renders_a_shipped_object(installed: Path) -> None:
    assert str(installed) in probe_assets()


def test_uris_of_plain_paths_name_the_file_itself() -> None:
    assert mesh_uri(Path("/a/b_c-1.0/~x/visual.gltf")) == "file:///a/b_c-1.0/~x/visual.gltf"


def test_uris_of_unusual_paths_are_stable_and_plain(tmp_path: Path) -> None:
    """The text of a model names its meshes by a link, which is the same for every process."""
    for name in (UNUSUAL, "other #"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "part.obj").write_text(name)
    first, other = (mesh_uri(tmp_path / name / "part.obj") for name in (UNUSUAL, "other #"))
    assert first == mesh_uri(tmp_path / UNUSUAL / "part.obj") != other
    assert Path(first.removeprefix("file://")).read_text() == UNUSUAL
    assert Path(other.removeprefix("file://")).read_text() == "other #"
    assert not set(first) & set(" #%?[]&'\\")


def test_the_text_of_a_model_is_xml(installed: Path) -> None:
    text = read_sdf_text(installed / "sdf_assets/sugar_box/model.sdf", visuals=True)
    (uri,) = ElementTree.fromstring(text).iter("uri")
    assert Path((uri.text or "").removeprefix("file://")).is_file()


def test_commands_print_paths_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = f"Wrote {tmp_path / UNUSUAL / 'scene.sdf'}, [bold]in one line[/bold]."
    print_line(line)
    assert capsys.readouterr().out == f"{line}\n"
    print_result({}, {"page": "[red]x"}, as_json=False, title="[1]")
    assert "[1]" in capsys.readouterr().out
