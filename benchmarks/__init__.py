"""Scripts that measure the accuracy and the speed of the simulation and planning code.

Run them from a checkout, as `python -m benchmarks.NAME` or as `python benchmarks/NAME.py`.
"""
