"""`hydra/launcher=batched`: the jobs of a sweep as tensor batches.

Every Hydra program of the environment imports this module, so it imports neither torch nor staf_torch.
"""

# No postponed annotations: Hydra 1.3 runs this module before `sys.modules` has it, where dataclasses look.
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.plugins import launcher  # the module: a base class imported by name is listed as a plugin itself
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


@dataclass
class BatchedLauncherConf:
    """The settings of `hydra.launcher`, with what they mean."""

    _target_: str = "hydra_plugins.staf_batched.BatchedLauncher"
    executor: str = "inline"  # where tensor batches are computed: inline, process, submitit or ray
    workers: int | None = None  # batches at once; null: one a core, or as many as the cluster takes
    batch: int | None = None  # jobs in a tensor batch at most; null: as many as memory allows
    foreign: str = "warn"  # jobs of another program, which cannot be batched: run, warn and run, or refuse
    submitit: dict[str, Any] = field(default_factory=dict)  # arguments of submitit's executor
    ray: dict[str, Any] = field(default_factory=dict)  # arguments of ray.init


ConfigStore.instance().store(
    group="hydra/launcher", name="batched", node=BatchedLauncherConf, provider="staf_torch"
)


class BatchedLauncher(launcher.Launcher):
    """Groups jobs that may share a tensor batch, solves the batches, replays every job as Hydra's own.

    Args:
        executor, workers, batch, foreign, submitit, ray: as in `BatchedLauncherConf`.
    """

    def __init__(
        self,
        executor: str = "inline",
        workers: int | None = None,
        batch: int | None = None,
        foreign: str = "warn",
        submitit: dict[str, Any] | None = None,
        ray: dict[str, Any] | None = None,
    ) -> None:
        self.executor, self.workers, self.batch, self.foreign = executor, workers, batch, foreign
        self.arguments = {"submitit": submitit or {}, "ray": ray or {}}
        self.hydra_context: HydraContext | None = None
        self.task_function: TaskFunction | None = None
        self.config: DictConfig | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what Hydra hands over before the sweep."""
        from staf_torch.sweeps.hydra_compat import SweepJobs

        if not isinstance(hydra_context.config_loader, SweepJobs):
            SweepJobs(hydra_context, config)
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[Any]:
        """Run the jobs and return Hydra's records of them (`JobReturn`), in order."""
        from staf_torch.sweeps.launcher import Launch

        launch = Launch(self)
        launch.begin()
        if launch.in_table:
            launch.fill_table(job_overrides)
            return ()
        return launch.fill_directories(job_overrides, initial_job_idx)
