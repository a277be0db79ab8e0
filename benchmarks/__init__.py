"""Scripts that measure the accuracy and the speed of simulation and planning.

Run them from the folder of the checkout: `python -m benchmarks.NAME`, or, after an editable
installation (`pip install --editable .`), also `python benchmarks/NAME.py`.
"""
