"""The settings of `staf` as the package `staf_torch.conf`, for `hydra.searchpath=[pkg://staf_torch.conf]`."""
