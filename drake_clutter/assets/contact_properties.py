"""Contact properties of everything that is simulated, in Drake or elsewhere."""

HYDROELASTIC_MODULUS = 1e8
"""Hydroelastic modulus of objects that are not thin [Pa].

Softer objects buckle under a stack; harder ones need a shorter time step.
"""
MAX_SQUARED_FREQUENCY = 5e8
"""Largest squared natural frequency of an object on its largest face [rad^2/s^2].

The shipped boxes have up to 4.6e8. A plate of 6 mm has 3.4e9 with `HYDROELASTIC_MODULUS`: it then
chatters on the support at the time steps of the simulation, and loads the suction cup.
"""
DISSIPATION = 10.0
"""Hunt-Crossley dissipation, with which objects settle without bouncing [s/m]."""
SURFACE_FRICTION = 0.5
"""Coulomb coefficient of every surface, static and dynamic."""
FIXTURE_RESOLUTION = 0.02
"""Edge length of the contact mesh of curved fixed geometry [m]; boxes and meshes need none."""
ROLLING_FRICTION = 1e-3
"""Coefficient of rolling friction of exported objects that can roll [m].

A contact resists rolling with moments of up to this length times the normal force: an object of
radius r rests on slopes of up to `ROLLING_FRICTION` / r. A real marker rests on steeper ones, as it
has a clip. Drake has no rolling friction; there, damping stops lying cylinders.
"""


def hydroelastic_modulus(mass: float, face_area: float, depth: float) -> float:
    """Return the modulus of a geometry, smaller for thin ones.

    The pressure rises from 0 at the surface to the modulus at the largest depth (Elandt et al.
    2019, "A pressure field model for fast, robust approximation of net contact force and moment
    between nominally rigid objects"), so the stiffness of a face is modulus * area / depth.

    Args:
        mass: Mass of the object [kg].
        face_area: Area of its largest face [m^2].
        depth: Largest depth inside of the geometry [m].
    """
    return min(HYDROELASTIC_MODULUS, MAX_SQUARED_FREQUENCY * mass * depth / face_area)


def proximity_properties_sdf(resolution_hint: float, modulus: float | None) -> str:
    """Return the SDF element with the hydroelastic contact properties.

    Args:
        resolution_hint: Edge length of the contact mesh [m].
        modulus: Hydroelastic modulus [Pa]; None for a rigid geometry.
    """
    rigidity = "rigid" if modulus is None else "compliant"
    modulus_element = ""
    if modulus is not None:
        tag = "drake:hydroelastic_modulus"
        modulus_element = f"\n          <{tag}>{modulus:.4g}</{tag}>"
    return f"""        <drake:proximity_properties>
          <drake:{rigidity}_hydroelastic/>{modulus_element}
          <drake:mesh_resolution_hint>{resolution_hint:.6g}</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>{DISSIPATION:g}</drake:hunt_crossley_dissipation>
          <drake:mu_static>{SURFACE_FRICTION:g}</drake:mu_static>
          <drake:mu_dynamic>{SURFACE_FRICTION:g}</drake:mu_dynamic>
        </drake:proximity_properties>"""
