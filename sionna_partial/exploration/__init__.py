"""Where a robot should drive next."""
