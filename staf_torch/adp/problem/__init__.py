"""What is controlled and what it costs: rates, set-points and paths, bounds, held controls."""
