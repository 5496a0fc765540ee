"""Calls of compiled code: inputs, checked, and what is prepared for those of one form."""
