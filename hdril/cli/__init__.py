"""Commands. Each parses its options with draccus, as LeRobot's own commands do."""
