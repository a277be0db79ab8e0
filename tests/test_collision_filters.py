"""Collision filters exclude only collisions that cannot occur."""

from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting
from pydrake.math import RigidTransform
from test_robot_model import CELLS, robot

from drake_clutter.cell.robot_spec import RobotSpec
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.robot_plant import stationary_links
from drake_clutter.validation import override_config, to_plain

_LINK = """
  <link name="{name}">
    <inertial>
      <mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>
      <origin xyz="{x} 0 0.1"/><geometry><box size="{length} 0.1 0.1"/></geometry>
    </collision>
  </link>"""
_JOINT = """
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/><axis xyz="{axis}"/>
    <limit lower="-3" upper="3" velocity="1" effort="200"/>
  </joint>"""


def arm(folder: Path, kind: str, axis: str, length: float) -> RobotSpec:
    """Return an arm of two links; the first has a length [m] and a joint of a type."""
    links = [("foot", 0.1), ("boom", length), ("end", 0.1)]
    elements = "".join(
        _LINK.format(name=name, length=size, x=size / 2 - 0.05) for name, size in links
    )
    elements += _JOINT.format(name="first", kind=kind, parent="foot", child="boom", x=0, axis=axis)
    elements += _JOINT.format(
        name="second", kind="revolute", parent="boom", child="end", x=length, axis="0 0 1"
    )
    path = folder / f"{kind}.urdf"
    path.write_text(f'<robot name="arm">{elements}</robot>')
    spec = {
        "model": str(path),
        "base_link": "foot",
        "tool_frame": "end",
        "base": {"translation": [-0.9, 0.0, 0.8], "rpy_deg": [0.0, 0.0, 0.0]},
        "home": [0.0, 0.0],
        "limits": {"acceleration": [1.0, 1.0]},
        "payload": 5.0,
        "pedestal_side": 0.16,
    }
    return RobotSpec.model_validate(spec)


def among_posts(spec: RobotSpec, p_TF: tuple[float, float, float]) -> WorkCell:
    post = {"name": "post", "pose": {"translation": list(p_TF)}, "box": [0.1, 0.1, 0.6]}
    return override_config(DEFAULT_CELL, {"robot": to_plain(spec), "fixtures": [post]}, "cell")


@pytest.mark.parametrize("name", CELLS)
def test_the_first_link_of_an_articulated_arm_is_stationary(name: str) -> None:
    links = robot(name).link_depths
    assert set(stationary_links(robot(name))) == {
        link for link, moved_by in links.items() if moved_by <= 1
    }


@pytest.mark.parametrize(
    ("kind", "axis", "q", "p_TF"),
    [
        ("revolute", "0 0 1", np.pi / 2, (-0.9, 0.5, 0.9)),
        ("prismatic", "0 1 0", 0.5, (-0.7, 0.5, 0.9)),
    ],
)
def test_a_first_link_that_is_long_or_slides_is_checked_against_fixtures(
    kind: str, axis: str, q: float, p_TF: tuple[float, float, float], tmp_path: Path
) -> None:
    spec = arm(tmp_path, kind, axis, 0.7)
    assert stationary_links(load_robot(spec)) == ("foot",)
    scene = CollisionModel(among_posts(spec, p_TF), [])

    def close_to_boom(first: float) -> set[str]:
        pairs = (here.pair for here in scene.distances_below(np.array([first, 0.0]), 0.01))
        return {other for link, other in pairs if link == "boom"} & {"post", "pedestal", "floor"}

    assert close_to_boom(0.0) == set()
    assert close_to_boom(q) == {"post"}


def test_an_object_may_share_the_name_of_a_link() -> None:
    """Distances and gradients do not depend on the name."""
    found = {}
    tool = next(iter(DEFAULT_CELL.gripper.tools.values()))
    for name in (tool.frame, "other"):
        held, near = (
            resting("gelatin_box", floor=0.2, name="held"),
            resting("sugar_box", xy=(0.1, 0.0), name=name),
        )
        scene = CollisionModel(DEFAULT_CELL, [(o.name, o.object_class) for o in (held, near)])
        scene.set_object_poses([held, near])
        q = np.array([-2.9, -1.5, 2.0, -2.0, -1.6, 0.0])
        scene.attach_object("held", tool.name, RigidTransform([0.0, 0.0, -0.02]))
        found[name] = {
            here.pair: gradient for here, gradient in scene.distances_and_gradients(q, 2.0)
        }
    assert np.abs(found["other"]["held", "other"]).max() > 0.01
    assert found[tool.frame]["held", tool.frame] == pytest.approx(found["other"]["held", "other"])
