"""Scripts that train and evaluate the shipped networks.

Run them from the folder of the checkout: `python -m training.NAME`, or, after an editable
installation (`pip install --editable .`), also `python training/NAME.py`.
"""
