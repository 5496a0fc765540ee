"""What a program depends on: objects, names in code, tensors; and whether they are what they were."""
