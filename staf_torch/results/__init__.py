"""Run directories: written, and read back. Nothing here needs torch."""
