class Valley:
    """V(x) = x1^2 + depth x1 x2 + x2^4."""

    def __init__(self, depth=0.5):
        self.depth = depth

    def __call__(self, x):
        return x[..., 0] ** 2 + self.depth * x[..., 0] * x[..., 1] + x[..., 1] ** 4
