"""`staf docs [FOLDER [ROOM ...]]`: the site of guides, manuals and reference pages (extra `docs`).

mkdocs-material with mkdocstrings: docstrings here are Markdown with sections in Google's style, which both
read as they are (Sphinx would take `|x|`, `x_` and single backticks for marks of its own); the source is read
and not imported, so that no text of torch's base classes can appear; search and theme need no server.
"""

from __future__ import annotations

import html
import importlib
import importlib.util
import json
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import __version__
from ...signs import Sign
from .pages import PACKAGE, ROOMS, manuals, write_pages

_HERE = Path(__file__).resolve().parent
_HEAD = '<!doctype html><meta charset="utf-8"><title>staf_torch</title>'
"""Of pages that lead to others."""
_NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers")


@Sign("building the site", log=False)
def main(words: Sequence[str]) -> str:
    """Build the site into a folder, `site` where none is named, with reference pages of the rooms that the
    further words name, all of `ROOMS` by default; return where it begins.

    The pages are in a folder named after the version, 0.2; `latest` leads to the version built last.

    Raises ValueError without the extra `docs`, for a room that has no pages, where a site would take the
    place of something else, or if the generator warns.
    """
    rooms = tuple(words[1:]) or tuple(ROOMS)
    if unknown := [room for room in rooms if room not in ROOMS]:
        raise ValueError(
            f"`staf docs FOLDER ROOM ...` takes rooms of {', '.join(ROOMS)}; got {unknown[0]!r}."
        )
    if any(importlib.util.find_spec(name) is None for name in _NEEDED):
        raise ValueError(
            "`staf docs` needs mkdocs-material and mkdocstrings: install the extra, "
            "pip install 'staf_torch[docs]'."
        )
    folder = Path(words[0] if words else "site").resolve()
    version = ".".join(__version__.split(".")[:2])
    if others := [place for place in (version, "latest", "index.html") if not _replaceable(folder / place)]:
        raise ValueError(
            f"`staf docs FOLDER` takes the place of an earlier site alone, and {folder / others[0]} is none: "
            "name another folder."
        )
    with tempfile.TemporaryDirectory() as scratch:
        write_pages(Path(scratch) / "docs", rooms)
        (Path(scratch) / "docs" / "versions.js").touch()  # of all versions, when this one is there
        for name in ("style.css", "iframe-worker.js"):
            shutil.copy(_HERE / name, Path(scratch) / "docs" / name)
        _build(Path(scratch), folder / version, rooms)
    _lead_to(folder, version)
    return f"site: {folder / 'index.html'}"


def _replaceable(place: Path) -> bool:
    """Return whether nothing is there, or what an earlier call wrote."""
    if place.is_symlink() or (place.exists() and place.is_dir() == (place.suffix == ".html")):
        return False
    if place.is_dir():
        marks = [place / "versions.js", place / "index.html"]
        return not any(place.iterdir()) or marks[0].is_file() or _leads_on(marks[1])
    return not place.exists() or _leads_on(place)


def _leads_on(page: Path) -> bool:
    """Return whether a page is one of `_redirect`."""
    return page.is_file() and page.read_bytes().startswith(_HEAD.encode())


def _build(scratch: Path, folder: Path, rooms: Sequence[str]) -> None:
    """Run the generator; a warning of it is an error."""
    settings = scratch / "mkdocs.yml"
    settings.write_text(json.dumps(_settings(folder, rooms)), encoding="utf-8")  # JSON is YAML
    os.environ.setdefault("NO_MKDOCS_2_WARNING", "1")
    said: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    listener = Listener(level=logging.WARNING)
    log = logging.getLogger("mkdocs")
    log.addHandler(listener)
    try:
        config: Any = importlib.import_module("mkdocs.config").load_config(str(settings))
        importlib.import_module("mkdocs.commands.build").build(config)
    finally:
        log.removeHandler(listener)
    if said:
        raise ValueError("`staf docs` built pages with warnings:\n" + "\n".join(said))


def _settings(folder: Path, rooms: Sequence[str]) -> dict[str, Any]:
    """Return the generator's settings."""
    return {
        "site_name": "staf_torch",
        "site_description": "State Following (StaF) kernels in PyTorch",
        "docs_dir": "docs",
        "site_dir": str(folder),
        "use_directory_urls": False,  # links work from a folder
        "nav": _navigation(rooms),
        "not_in_nav": "*.md\n",
        "validation": {"links": {"anchors": "warn", "unrecognized_links": "warn"}},
        "theme": {
            "name": "material",
            "font": False,  # no server is asked
            "features": ["navigation.tabs", "navigation.indexes", "navigation.top", "content.code.copy"],
            "palette": [
                {
                    "media": "(prefers-color-scheme: light)",
                    "scheme": "default",
                    "primary": "indigo",
                    "toggle": {"icon": "material/weather-night", "name": "Dark"},
                },
                {
                    "media": "(prefers-color-scheme: dark)",
                    "scheme": "slate",
                    "primary": "indigo",
                    "toggle": {"icon": "material/weather-sunny", "name": "Light"},
                },
            ],
        },
        "extra": {
            "generator": False,
            "polyfills": ["iframe-worker.js", "versions.js"],  # in place of the theme's, which is on a server
        },
        "extra_css": ["style.css"],
        "hooks": [str(_HERE / "formulas.py")],
        "plugins": [{"search": {}}, {"offline": {}}, {"mkdocstrings": {"handlers": {"python": _reader()}}}],
        "markdown_extensions": [
            "admonition",
            "attr_list",
            "md_in_html",
            "tables",
            {"toc": {"permalink": True, "toc_depth": 3}},
            "pymdownx.superfences",
            {"pymdownx.highlight": {"use_pygments": True}},
        ],
    }


def _reader() -> dict[str, Any]:
    """Return the settings of what reads docstrings."""
    return {
        "paths": [str(PACKAGE.parent)],
        "options": {
            "docstring_style": "google",
            "docstring_options": {"warnings": False},
            "extensions": ["staf_torch.cli.site.docstrings"],
            "filters": ["!^_"],
            "heading_level": 1,
            "inherited_members": False,
            "members_order": "source",
            "merge_init_into_class": True,
            "separate_signature": True,
            "show_root_heading": True,
            "show_root_full_path": False,
            "show_source": True,
            "show_if_no_docstring": False,
            "show_signature_annotations": True,
        },
    }


def _navigation(rooms: Sequence[str]) -> list[Any]:
    places = manuals()
    guides = [place for place in places if place.startswith("staf_torch/guides/")]
    first = [
        place for place in ("staf_torch/guides/README.md", "staf_torch/guides/GALLERY.md") if place in guides
    ]
    rest = [place for place in places if place not in guides and place not in ("README.md", "CHANGELOG.md")]
    benchmarks = [place for place in rest if place.startswith("tests/benchmarks/")]
    return [
        {"Tasks": "index.md"},
        {"Guides": [first[0], *(place for place in guides if place not in first)]}
        if guides
        else {"Front": "front.md"},
        *({"Gallery": place} for place in first[1:]),
        {"Manuals": [place for place in rest if place not in benchmarks]},
        {"Reference": ["reference/index.md", *({room: f"reference/{room}/index.md"} for room in rooms)]},
        *({"Benchmarks": benchmarks} for _ in benchmarks[:1]),
        {"About": ["front.md", "CHANGELOG.md"]},
    ]


def _lead_to(folder: Path, version: str) -> None:
    """Write `latest`, whose pages lead to those of a version, the first page, and the list of versions."""
    built = folder / version
    shutil.rmtree(folder / "latest", ignore_errors=True)
    for page in built.rglob("*.html"):
        place = page.relative_to(built).as_posix()
        up = "../" * (place.count("/") + 1)
        target = folder / "latest" / place
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(_redirect(f"{up}{version}/{place}"), encoding="utf-8")
    (folder / "index.html").write_text(_redirect(f"{version}/index.html"), encoding="utf-8")
    places = (path.parent.parent.name for path in folder.glob("*/search/search_index.js"))
    versions = {place for place in places if re.fullmatch(r"[0-9]+(\.[0-9]+)*", place)}
    order = sorted(versions, key=lambda each: [int(part) for part in each.split(".")], reverse=True)
    for each in versions:
        (folder / each / "versions.js").write_text(
            f"window.__versions = {json.dumps(order)}\n", encoding="utf-8"
        )


def _redirect(target: str) -> str:
    there = html.escape(target)
    return f'{_HEAD}<meta http-equiv="refresh" content="0; url={there}"><a href="{there}">{there}</a>\n'
