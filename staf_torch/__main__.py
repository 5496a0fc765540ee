"""`python -m staf_torch` is the command `staf`."""

from .cli.staf import main

if __name__ == "__main__":
    main()
