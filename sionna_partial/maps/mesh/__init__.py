"""Scans, models and point clouds: read, cut, turned into cells."""
