"""A step of one row, written down: from tensor operations to a scalar program."""
