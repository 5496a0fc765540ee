from staf_torch.metrics import Metric


class Digits(Metric):
    """Decimal digits of V that the corrected approximation has at the state."""

    name = "digits"
    unit = "digits"
    larger_is_better = True

    def __call__(self, result, problem):  # -> (B, T)
        error = (result.value - result.estimate).abs()
        return -(error / (1 + result.value.abs())).log10()
