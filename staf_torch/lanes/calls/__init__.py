"""Calls: their inputs, the choice between compiled code and plain torch, and what is prepared of them."""
