"""From settings to the objects that they describe."""

from pathlib import Path


def config_directory() -> str:
    """Return `conf/`: inside the package when it is installed from a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    return str(package / "conf" if (package / "conf").is_dir() else package.parent / "conf")
