"""Static stability of scenes and visibility of their objects, without simulation."""
