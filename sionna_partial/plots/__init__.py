"""Figures of results that other packages compute."""
