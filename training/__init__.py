"""Scripts that train, evaluate and document the shipped networks.

Run them from a checkout, as `python -m training.NAME` or as `python training/NAME.py`.
"""
