"""Closed-loop systems: perception, policy, planner, and the diagram that connects them."""
