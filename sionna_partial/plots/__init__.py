"""Every figure of the package; what a figure shows is computed elsewhere."""
