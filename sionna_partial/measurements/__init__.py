"""Measured path gains."""
