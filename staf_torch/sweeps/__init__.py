"""Sweeps: what runs are recorded as, the batched launcher, and how a sweep is taken up again."""
