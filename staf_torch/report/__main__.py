"""`python -m staf_torch.report` is the command `staf-table`."""

import sys

from .command import main

if __name__ == "__main__":
    sys.exit(main())
