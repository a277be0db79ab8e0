"""Feasibility studies: what an arm can do in a work cell, and where to put it."""
