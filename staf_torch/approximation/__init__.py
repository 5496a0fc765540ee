"""Approximation around a state: basis, module, coefficient format, conditioning, sensitivity."""
