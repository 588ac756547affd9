"""Exact path candidates of floor plans."""
