"""Feedback that is computed from a model: rollouts, energy shaping, path integrals."""
