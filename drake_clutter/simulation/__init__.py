"""Simulation in Drake: plants, settling, rendering, and the judge that uses them."""
