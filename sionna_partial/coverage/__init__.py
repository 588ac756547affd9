"""Predict coverage maps, and the networks and link budgets that follow from them."""
