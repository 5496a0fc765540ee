"""A controller in a closed loop: its interface, one step, many steps, what is recorded."""
