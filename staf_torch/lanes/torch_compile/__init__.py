"""Row programs within somebody's `torch.compile`."""
