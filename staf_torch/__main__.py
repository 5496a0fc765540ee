"""`python -m staf_torch` is the command `staf`."""

from .experiments.app import main

if __name__ == "__main__":
    main()
