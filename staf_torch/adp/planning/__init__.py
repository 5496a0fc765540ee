"""Optimal trajectories, and policies that follow or remember them."""
