"""Contact properties of everything that is simulated, in Drake or elsewhere."""

HYDROELASTIC_MODULUS = 1e8
"""Hydroelastic modulus [Pa].

Softer objects buckle under a stack; harder ones need a shorter time step.
"""
DISSIPATION = 10.0
"""Hunt-Crossley dissipation, with which objects settle without bouncing [s/m]."""
SURFACE_FRICTION = 0.5
"""Coulomb coefficient of every surface, static and dynamic."""
ROLLING_FRICTION = 1e-3
"""Coefficient of rolling friction of exported objects that can roll [m].

A contact resists rolling with moments of up to this length times the normal force: an object of
radius r rests on slopes of up to `ROLLING_FRICTION` / r. A real marker rests on steeper ones, as it
has a clip. Drake has no rolling friction; there, damping stops lying cylinders.
"""


def proximity_properties_sdf(resolution_hint: float, *, compliant: bool) -> str:
    """Return the SDF element with the hydroelastic contact properties.

    Args:
        resolution_hint: Edge length of the contact mesh [m].
        compliant: Whether the geometry is compliant; otherwise it is rigid.
    """
    rigidity = "compliant" if compliant else "rigid"
    modulus = ""
    if compliant:
        tag = "drake:hydroelastic_modulus"
        modulus = f"\n          <{tag}>{HYDROELASTIC_MODULUS:g}</{tag}>"
    return f"""        <drake:proximity_properties>
          <drake:{rigidity}_hydroelastic/>{modulus}
          <drake:mesh_resolution_hint>{resolution_hint:.6g}</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>{DISSIPATION:g}</drake:hunt_crossley_dissipation>
          <drake:mu_static>{SURFACE_FRICTION:g}</drake:mu_static>
          <drake:mu_dynamic>{SURFACE_FRICTION:g}</drake:mu_dynamic>
        </drake:proximity_properties>"""
