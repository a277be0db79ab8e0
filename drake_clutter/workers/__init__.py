"""Parallel evaluation of a function in processes of this machine or of a Ray cluster."""
