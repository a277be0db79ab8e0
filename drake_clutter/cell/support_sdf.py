"""SDF model of a support.

Frame T, the link `tray`: origin at the center of the floor's upper surface, z up.
"""

from drake_clutter.assets.contact_properties import proximity_properties_sdf
from drake_clutter.cell.support import Support

FLOOR = "floor"
"""Name of the geometry of the floor."""
TABLE = "table"
"""Name of the geometry of the table under a support."""
_TABLE_SIZE = (2.4, 2.4, 0.04)
"""Extents of the table [m], those of the shipped cells."""
_TABLE_GAP = 0.001
"""Gap between a support that stands on the table and the table, as in the shipped cells [m]: Drake
is unreliable where faces just touch."""
_FLOOR_COLOR = (0.72, 0.60, 0.46)
_WALL_COLOR = (0.55, 0.42, 0.30)
_TABLE_COLOR = (0.70, 0.70, 0.70)
_WALL_NAMES = {"+x": "rim_front", "-x": "rim_back", "+y": "rim_left", "-y": "rim_right"}
"""Name of the geometry of each wall."""

_Vector = tuple[float, float, float]


def _box(name: str, size: _Vector, p_TG: _Vector, color: _Vector) -> str:
    box = f"""<pose>{" ".join(f"{v:.6g}" for v in p_TG)} 0 0 0</pose>
        <geometry>
          <box><size>{" ".join(f"{v:.6g}" for v in size)}</size></box>
        </geometry>"""
    return f"""
      <visual name="{name}">
        {box}
        <material>
          <diffuse>{" ".join(f"{v:.2f}" for v in color)} 1</diffuse>
        </material>
      </visual>
      <collision name="{name}">
        {box}
{proximity_properties_sdf(1.0, None)}
      </collision>"""


def support_boxes(support: Support) -> list[tuple[str, _Vector, _Vector]]:
    """Return name, size [m] and center in T [m] of the floor and of each wall."""
    x, y = support.size
    thickness = support.wall_thickness
    height = support.wall_height + support.floor_thickness
    z = (support.wall_height - support.floor_thickness) / 2
    walls: dict[str, tuple[_Vector, _Vector]] = {
        "+x": ((thickness, y + 2 * thickness, height), ((x + thickness) / 2, 0, z)),
        "-x": ((thickness, y + 2 * thickness, height), (-(x + thickness) / 2, 0, z)),
        "+y": ((x, thickness, height), (0, (y + thickness) / 2, z)),
        "-y": ((x, thickness, height), (0, -(y + thickness) / 2, z)),
    }
    floor = (FLOOR, (x, y, support.floor_thickness), (0.0, 0.0, -support.floor_thickness / 2))
    return [
        floor,
        *((_WALL_NAMES[side], *walls[side]) for side in _WALL_NAMES if side in support.walls),
    ]


def support_color(name: str) -> _Vector:
    """Return red, green and blue in [0, 1] of the floor or a wall."""
    return _FLOOR_COLOR if name == FLOOR else _WALL_COLOR


def table_box(support: Support) -> tuple[str, _Vector, _Vector]:
    """Return name, size [m] and center in T [m] of the table under a support."""
    z = support.table_height - _TABLE_GAP - _TABLE_SIZE[2] / 2
    return TABLE, _TABLE_SIZE, (0.0, 0.0, z)


def support_sdf(support: Support, *, table: bool) -> str:
    """Return the SDF model of a support.

    Args:
        support: The support.
        table: Whether the model includes the table, on which objects lie that left the support. In
            a work cell, the table is a fixture.
    """
    boxes = [
        _box(name, size, p_TG, support_color(name)) for name, size, p_TG in support_boxes(support)
    ]
    if table:
        boxes.append(_box(*table_box(support), _TABLE_COLOR))
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.support_sdf. Origin: center of the floor's upper surface. -->
<sdf version="1.10" xmlns:drake="drake.mit.edu">
  <model name="tray">
    <link name="tray">{"".join(boxes)}
    </link>
  </model>
</sdf>
"""
