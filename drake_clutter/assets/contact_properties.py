"""The contact properties of everything that Drake simulates here (DRAKE_NOTES, "Verdicts")."""

HYDROELASTIC_MODULUS = 1e8
"""Pa; softer objects buckle under a stack, harder ones need a shorter time step."""
DISSIPATION = 10.0
"""s/m, Hunt-Crossley: objects settle without bouncing."""
SURFACE_FRICTION = 0.5
"""Coulomb coefficient, static and dynamic, of every surface."""


def proximity_properties_sdf(resolution_hint: float, *, compliant: bool) -> str:
    """The SDF element of hydroelastic contact properties.

    Args:
        resolution_hint: m, edge of the contact mesh.
        compliant: False for a rigid surface.
    """
    rigidity = "compliant" if compliant else "rigid"
    modulus = (
        f"\n          <drake:hydroelastic_modulus>{HYDROELASTIC_MODULUS:g}</drake:hydroelastic_modulus>"
        if compliant
        else ""
    )
    return f"""        <drake:proximity_properties>
          <drake:{rigidity}_hydroelastic/>{modulus}
          <drake:mesh_resolution_hint>{resolution_hint:.6g}</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>{DISSIPATION:g}</drake:hunt_crossley_dissipation>
          <drake:mu_static>{SURFACE_FRICTION:g}</drake:mu_static>
          <drake:mu_dynamic>{SURFACE_FRICTION:g}</drake:mu_dynamic>
        </drake:proximity_properties>"""
