"""Predict coverage maps, networks of transmitters and link budgets."""
