"""Experiments, one a module, and the command line over them."""
