"""Plants with their costs: rates, set-points and paths, bounds, held controls."""
