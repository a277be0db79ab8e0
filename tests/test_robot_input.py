"""Invalid robots are refused in one line with field, value and what is allowed."""

from pathlib import Path
from typing import Any

import pytest
from conftest import DEFAULT_CELL
from PIL import Image
from test_robot_model import bullet_iiwa, robot, ros_spec, ros_urdf

from drake_clutter.cell.robot_spec import RobotSpec
from drake_clutter.files import InputError
from drake_clutter.robots.model_parsing import read_model_text
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.simulation.cell_plant import validate_models

JOINTS = ", ".join(robot("ur5e").joint_names)
SHIPPED = "package://drake_clutter_models/FILE"
ORDER = "the lower, then the upper limit"
PLACES = "a value for each joint, here or in"


def changed(spec: RobotSpec, **fields: Any) -> RobotSpec:
    """Return the specification with other fields; those of the limits have the prefix `limits_`."""
    limits = {k.removeprefix("limits_"): v for k, v in fields.items() if k.startswith("limits_")}
    others = {k: v for k, v in fields.items() if not k.startswith("limits_")}
    return spec.model_copy(update={**others, "limits": spec.limits.model_copy(update=limits)})


def message(spec: RobotSpec) -> str:
    with pytest.raises(InputError) as raised:
        load_robot(spec)
    text = str(raised.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        (
            {"model": "ur6.sdf"},
            f"robot.model: 'ur6.sdf'; expected an SDF or URDF file, or {SHIPPED}",
        ),
        ({"base_link": "foot"}, "robot.base_link: 'foot'; expected in ur5e.sdf: base"),
        (
            {"tool_frame": "hand"},
            "robot.tool_frame: 'hand'; expected in ur5e.sdf: base, shoulder, upper_arm, "
            "forearm, wrist_1, wrist_2, wrist_3, flange",
        ),
        ({"tool_frame": "base"}, "robot.tool_frame: 'base'; expected a frame that joints move"),
        ({"home": (0.0,) * 5}, f"robot.home: 5 values; expected 6 values, for {JOINTS}"),
        (
            {"home": (0.0, 0.0, 7.0, 0.0, 0.0, 0.0)},
            "robot.home: 7 for joint 'elbow_joint'; expected from -3.14159 to 3.14159",
        ),
        (
            {"limits_velocity": (1.0,) * 7},
            f"robot.limits.velocity: 7 values; expected 6 values, for {JOINTS}",
        ),
        (
            {"limits_jerk": (1.0,)},
            f"robot.limits.jerk: 1 values; expected 6 values, for {JOINTS}",
        ),
        (
            {"limits_position": ((1.0, -1.0),) * 6},
            f"robot.limits.position: 1, -1 for joint 'shoulder_pan_joint'; expected {ORDER}",
        ),
    ],
)
def test_a_specification_that_does_not_match_its_model_is_refused(
    fields: dict[str, Any], expected: str
) -> None:
    assert message(changed(robot("ur5e").spec, **fields)) == expected


def test_a_frame_below_the_last_moving_joint_only(tmp_path: Path) -> None:
    """If the tool frame is at the wrist, the last joint does not move it."""
    spec = changed(robot("ur5e").spec, tool_frame="wrist_2")
    allowed = "does not move the tool frame; expected a model of one arm"
    assert message(spec).endswith(f"ur5e.sdf: joint 'wrist_3_joint' {allowed}")


@pytest.mark.parametrize(
    ("taken_out", "kind"),
    [
        ('lower="-6.2" upper="6.2"', "position"),
        ('velocity="3"', "velocity"),
        ('effort="150"', "torque"),
    ],
)
def test_a_joint_without_a_limit_is_refused(tmp_path: Path, taken_out: str, kind: str) -> None:
    before, after = ros_urdf().split('<joint name="elbow_joint"')
    text = before + '<joint name="elbow_joint"' + after.replace(taken_out, "", 1)
    if kind == "position":
        text = text.replace('elbow_joint" type="revolute"', 'elbow_joint" type="continuous"')
    spec = ros_spec(tmp_path, text)
    assert message(spec) == (
        f"robot.limits.{kind}: is missing for joint 'elbow_joint'; expected {PLACES} {spec.model}"
    )
    given: Any = ((-3.0, 3.0),) * 6 if kind == "position" else (2.0,) * 6
    arm = load_robot(changed(spec, **{f"limits_{kind}": given}))
    assert arm.joint_names[2] == "elbow_joint"


def test_a_closed_form_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    """A seventh joint, or an elbow axis that is not parallel to the shoulder axis."""
    spec = changed(robot("iiwa14").spec, ik="ur")
    expected = "robot.ik: 'ur' (iiwa14.sdf is no arm of the UR family: 7 joints)"
    assert message(spec) == f"{expected}; expected 'numerical'"
    skew = ros_spec(tmp_path, ros_urdf(offset=0.01))
    text = message(skew)
    assert text.startswith("robot.ik: 'ur' (ur5e.urdf is no arm of the UR family: off by 0.0")
    assert text.endswith("; expected 'numerical'")
    assert load_robot(changed(skew, ik="numerical")).ur_fit is None


@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_a_missing_mesh_is_refused(tmp_path: Path, kind: str) -> None:
    mesh = f'<{kind}><geometry><mesh filename="package://arms/tool.obj"/></geometry></{kind}>'
    text = ros_urdf().replace('<link name="tool0">', f'<link name="tool0">{mesh}')
    spec = ros_spec(tmp_path, text)
    expected = f"{spec.model}: mesh: 'package://arms/tool.obj' is missing; expected a file"
    assert message(spec) == expected
    (tmp_path / "package.xml").write_text("<package><name>arms</name></package>")
    (tmp_path / "tool.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    assert load_robot(changed(spec, payload=4.0)).num_joints == 6


def test_other_model_files_are_refused(tmp_path: Path) -> None:
    spec = ros_spec(tmp_path, "<robot")
    text = message(spec)
    assert text.startswith(f"{spec.model}: is not XML (")
    assert text.endswith("; expected an SDF or URDF")
    spec = ros_spec(tmp_path, '<robot name="empty"></robot>')
    assert message(changed(spec, payload=3.0)).startswith(("robot.base_link:", f"{spec.model}:"))


def test_an_invalid_stl_is_refused(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="tool.stl"/></geometry></visual>'
    text = ros_urdf().replace('<link name="tool0">', f'<link name="tool0">{mesh}')
    spec = ros_spec(tmp_path, text)
    (tmp_path / "tool.stl").write_bytes(b"solid nothing")
    allowed = "is not an STL mesh; expected OBJ, glTF, VTK or STL"
    assert message(spec) == f"{tmp_path / 'tool.stl'}: {allowed}"
    corner = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    (tmp_path / "tool.stl").write_text(
        f"solid one\nfacet normal 0 0 1\nouter loop\n{corner}endloop\nendfacet\nendsolid one\n"
    )
    assert load_robot(changed(spec, payload=2.0)).num_joints == 6


def test_a_gripper_in_the_file_of_the_arm_is_refused() -> None:
    spec = bullet_iiwa()
    assert message(changed(spec, tool_frame="lbr_iiwa_link_5")).endswith(
        "model.urdf: joint 'lbr_iiwa_joint_6' does not move the tool frame; expected a model of"
        " one arm"
    )


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (
            'xyz="0 0 0.1625"',
            'xyz="${height} 0 0"',
            "Expected 3 values for attribute xyz got ${height} 0 0",
        ),
        (
            'lower="-6.2"',
            'lower="7"',
            "condition '(pos_lower_limits.array() <= pos_upper_limits.array()).all()'",
        ),
        (
            "</robot>",
            '<link name="loose"/></robot>',
            "link 'loose' has no parent joint; expected a model of one arm",
        ),
        (
            "<limit",
            '<mimic joint="elbow_joint"/><limit',
            "joint 'shoulder_pan_joint' mimics another; expected joints",
        ),
    ],
)
def test_a_damaged_arm_is_refused(tmp_path: Path, before: str, after: str, expected: str) -> None:
    spec = ros_spec(tmp_path, ros_urdf().replace(before, after, 1))
    text = message(spec)
    assert text.startswith(f"{spec.model}: ")
    assert expected in text


def test_an_arm_without_collision_geometry_is_refused(tmp_path: Path) -> None:
    """Its plans would pass through obstacles."""
    spec = ros_spec(tmp_path, ros_urdf())
    with pytest.raises(InputError) as raised:
        validate_models(DEFAULT_CELL.model_copy(update={"robot": spec}))
    found = f"robot.model: {spec.model!r}: no link has collision geometry"
    assert str(raised.value) == f"{found}; expected a model with collision geometry"


def test_a_damaged_texture_of_a_model_is_refused(tmp_path: Path) -> None:
    """Where it is rendered; planning reads no visual geometry."""
    path = tmp_path / "cover.sdf"
    mesh = "<mesh><uri>cover.obj</uri></mesh>"
    path.write_text(
        '<sdf version="1.9"><model name="cover"><link name="cover"><visual name="cover">'
        f"<geometry>{mesh}</geometry></visual></link></model></sdf>"
    )
    faces = "vt 0 0\nvn 0 0 1\nusemtl paint\nf 1/1/1 2/1/1 3/1/1\n"
    (tmp_path / "cover.obj").write_text(f"mtllib cover.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n{faces}")
    (tmp_path / "cover.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    texture = tmp_path / "paint.png"
    Image.new("RGB", (32, 32), "#804020").save(texture)
    assert "cover.obj" in read_model_text(path, visuals=True)
    texture.write_bytes(texture.read_bytes()[:-20])
    read_model_text.cache_clear()
    with pytest.raises(InputError, match=r"paint\.png: cannot be read .*; expected an image"):
        read_model_text(path, visuals=True)
    assert "cover.obj" not in read_model_text(path, visuals=False)
