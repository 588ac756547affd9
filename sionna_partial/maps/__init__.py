"""Floor plans: read, written, made and explored."""
