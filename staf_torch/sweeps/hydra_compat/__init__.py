"""The interface to Hydra 1.3 and 1.4; Hydra's inside is imported in `inside` alone."""

from hydra.core.utils import JobReturn as JobReturn
from hydra.core.utils import JobStatus as JobStatus
from hydra.core.utils import env_override as env_override
from hydra.core.utils import filter_overrides as filter_overrides

from .composing import Composer as Composer
from .composing import as_typed as as_typed
from .composing import directory_of as directory_of
from .composing import parse_override as parse_override
from .composing import sweep_size as sweep_size
from .inside import config_loader as config_loader
from .inside import everything_trusted as everything_trusted
from .inside import trusted as trusted
from .inside import trusted_packages as trusted_packages
from .jobs import About as About
from .jobs import Job as Job
from .jobs import Plan as Plan
from .jobs import SweepJobs as SweepJobs
from .program import VERSION as VERSION
from .program import Application as Application
from .program import application as application
from .program import end_sweep as end_sweep
from .program import find_launcher as find_launcher
from .program import full_errors as full_errors
from .program import is_about_settings as is_about_settings
from .program import named_packages as named_packages
from .program import overrides_in as overrides_in
from .program import program as program
from .program import working_directory_imports as working_directory_imports
