"""The closed loop as systems: perception, the exploring agent, planning, and the diagram that joins them to the station."""
