"""The commands `staf`, `staf-table` and `staf-export`."""
