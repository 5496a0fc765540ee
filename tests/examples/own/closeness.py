from staf_torch.approximation.staf import StaF
from staf_torch.results.files import write_metrics
from staf_torch.settings.chase import chase_problem


def closeness(cfg, directory, progress=None):
    """How far V^ with ideal weights is from V, half a radius beside the initial state."""
    problem = chase_problem(cfg)
    x = problem.initial_states[0]
    staf = StaF(problem.basis).fit_(x, problem.target)
    y = (x + 0.5 * float(problem.basis.centers.radius(x)) * problem.basis.centers.directions[0])[None]
    metrics = {"distance": float((staf(y) - problem.target(y)).abs().detach())}
    write_metrics(directory / "metrics.json", metrics)
    return metrics
