"""Experiments, one a module; `registry` knows them by the setting `task`."""
