"""Locks of objects that threads share, and small operations in one thread."""
