"""Materials fitted to measured path gains."""
