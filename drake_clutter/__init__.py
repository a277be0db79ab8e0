"""Clutter that is generated, judged, looked at and searched, on Drake (Kumar, Essa, Ha, ICRA 2022)."""
