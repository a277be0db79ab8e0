"""Robot models: parsing, limits, kinematics, inverse kinematics and plants."""
