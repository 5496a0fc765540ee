"""The theorems, computable."""

from .power_function import power_function as power_function
