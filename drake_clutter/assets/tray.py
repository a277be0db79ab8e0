"""The tray: a square floor with a low rim."""

FLOOR_THICKNESS = 0.010
RIM_HEIGHT = 0.025
RIM_THICKNESS = 0.008
FRICTION = 0.5


def _box(name: str, size: tuple[float, float, float], p_TG: tuple[float, float, float], colour: str) -> str:
    geometry = f"<pose>{' '.join(f'{v:.6g}' for v in p_TG)} 0 0 0</pose><geometry><box><size>{' '.join(f'{v:.6g}' for v in size)}</size></box></geometry>"
    return f"""
      <visual name="{name}">{geometry}<material><diffuse>{colour}</diffuse></material></visual>
      <collision name="{name}">{geometry}
        <drake:proximity_properties>
          <drake:rigid_hydroelastic/>
          <drake:mesh_resolution_hint>1</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>10</drake:hunt_crossley_dissipation>
          <drake:mu_static>{FRICTION}</drake:mu_static>
          <drake:mu_dynamic>{FRICTION}</drake:mu_dynamic>
        </drake:proximity_properties>
      </collision>"""


def tray_sdf(side: float) -> str:
    """The SDF model of a tray, as text. Its frame T, the link `tray`, has its origin on the floor at the centre, z up.

    Args:
        side: m, inner side of the square.
    """
    outer = side + 2 * RIM_THICKNESS
    height = RIM_HEIGHT + FLOOR_THICKNESS
    aside, middle = (side + RIM_THICKNESS) / 2, (RIM_HEIGHT - FLOOR_THICKNESS) / 2
    boxes = [_box("floor", (side, side, FLOOR_THICKNESS), (0, 0, -FLOOR_THICKNESS / 2), "0.62 0.64 0.66 1")]
    for name, sign in (("left", -1), ("right", 1)):
        boxes.append(_box(f"rim_{name}", (RIM_THICKNESS, outer, height), (sign * aside, 0, middle), "0.35 0.37 0.40 1"))
    for name, sign in (("near", -1), ("far", 1)):
        boxes.append(_box(f"rim_{name}", (side, RIM_THICKNESS, height), (0, sign * aside, middle), "0.35 0.37 0.40 1"))
    return f"""<?xml version="1.0"?>
<sdf version="1.10" xmlns:drake="drake.mit.edu">
  <model name="tray">
    <link name="tray">{"".join(boxes)}
    </link>
  </model>
</sdf>
"""
