"""Placement of transmitters."""
