"""Gradients of row programs: the adjoint of a step, and the backward pass over all times."""
