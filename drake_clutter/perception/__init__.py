"""Perception: rendered images, detectors and the training of the segmentation network."""
