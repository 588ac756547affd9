"""Figures of the package; the values that they show are computed elsewhere."""
