"""Learning while running: what a plant's parameters are, found and used while the plant is controlled."""
