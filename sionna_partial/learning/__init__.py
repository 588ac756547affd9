"""Traced links -> features -> predicted distributions."""
