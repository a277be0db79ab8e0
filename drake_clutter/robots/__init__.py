"""Robot models: parsed from SDF or URDF, their limits, kinematics, inverse kinematics, and how they join a plant."""
