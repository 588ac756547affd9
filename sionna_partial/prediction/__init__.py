"""Features, networks and predictors."""
