"""The tray: a square floor with a low rim. `models/tray.sdf` is the one of the default config."""

from drake_clutter.assets.contact import proximity_properties

FLOOR_THICKNESS = 0.010
RIM_HEIGHT = 0.025
RIM_THICKNESS = 0.008
_FLOOR_COLOUR, _RIM_COLOUR = "0.72 0.60 0.46 1", "0.55 0.42 0.30 1"

_Vector = tuple[float, float, float]


def _box(name: str, size: _Vector, p_TG: _Vector, colour: str) -> str:
    box = f"""<pose>{" ".join(f"{v:.6g}" for v in p_TG)} 0 0 0</pose>
        <geometry>
          <box><size>{" ".join(f"{v:.6g}" for v in size)}</size></box>
        </geometry>"""
    return f"""
      <visual name="{name}">
        {box}
        <material>
          <diffuse>{colour}</diffuse>
        </material>
      </visual>
      <collision name="{name}">
        {box}
{proximity_properties(1.0, compliant=False)}
      </collision>"""


def tray_sdf(side: float) -> str:
    """The SDF model of a tray, as text. Its frame T, the link `tray`, has its origin on the floor at the centre, z up.

    Args:
        side: m, inner side of the square.
    """
    outer = side + 2 * RIM_THICKNESS
    height = RIM_HEIGHT + FLOOR_THICKNESS
    aside, middle = (side + RIM_THICKNESS) / 2, (RIM_HEIGHT - FLOOR_THICKNESS) / 2
    boxes = [
        _box("floor", (side, side, FLOOR_THICKNESS), (0, 0, -FLOOR_THICKNESS / 2), _FLOOR_COLOUR),
        _box("rim_front", (RIM_THICKNESS, outer, height), (aside, 0, middle), _RIM_COLOUR),
        _box("rim_back", (RIM_THICKNESS, outer, height), (-aside, 0, middle), _RIM_COLOUR),
        _box("rim_left", (side, RIM_THICKNESS, height), (0, aside, middle), _RIM_COLOUR),
        _box("rim_right", (side, RIM_THICKNESS, height), (0, -aside, middle), _RIM_COLOUR),
    ]
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.assets.tray. Frame T: origin at the centre of the floor's upper surface, z up. -->
<sdf version="1.10" xmlns:drake="drake.mit.edu">
  <model name="tray">
    <link name="tray">{"".join(boxes)}
    </link>
  </model>
</sdf>
"""
