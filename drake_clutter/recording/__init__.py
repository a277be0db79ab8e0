"""Recorded episodes: every attempted move with its samples and images, and their files."""
