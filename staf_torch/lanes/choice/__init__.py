"""The automatic choice between compiled code and plain torch."""
