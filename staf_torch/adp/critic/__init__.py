"""Learn a value while it is used: bases, Bellman errors, laws, the actor-critic."""
