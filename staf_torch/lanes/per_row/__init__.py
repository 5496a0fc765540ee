"""Objects and decisions that differ from row to row of a batch."""
