"""Checkpoints of networks, and training runs that can be interrupted and resumed."""
