"""Gather the pages of the documentation site in build/docs, from which `make docs` builds it.

Pages are those of docs/, those that stand elsewhere in the repository (`ELSEWHERE`), the help of every command, and the
public names of every package. Links between files of the repository become links on the site, and files that are no
pages are copied. So links in Markdown are those of the repository, and work on a Git host, too.

    python docs/gather_pages.py
"""

from __future__ import annotations

import io
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from importlib import import_module
from itertools import chain
from pathlib import Path, PurePosixPath
from textwrap import wrap
from unittest.mock import patch

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
OUT = ROOT / "build" / "docs"
SOURCES = ROOT / "build" / "docs_sources"
"""The package as it is installed, from which docstrings are read: some of its folders stand beside it here."""

ELSEWHERE = {
    "schema/SPEC.md": "spec.md",
    "schema/CHANGES.md": "spec_changes.md",
    "schema/samples/README.md": "samples.md",
    "schema/PROPOSAL.md": "proposal.md",
    "schema/GLTF_EXTENSION.md": "gltf_extension.md",
    "benchmarks/README.md": "benchmarks.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
"""Pages outside docs/, and their names on the site."""

README = ROOT / "README.md"
"""What a Git host shows first; on the site, docs/index.md is there in its place."""

LINK = re.compile(r"""(?:(?<=\]\()|(?<=href=")|(?<=src="))(?!\w+:|#)[^)#\s"]+""")
"""Target of a link or picture, in Markdown or HTML, that is a file of the repository."""

HELP_COLUMNS = 88
"""Characters of a line of help; the site shows them without scrolling."""

Pages = dict[PurePosixPath, str]
"""Text of pages by their path on the site."""


def sources() -> list[Path]:
    """Return the Markdown files that are pages of the site."""
    return [*sorted(DOCS.rglob("*.md")), *(ROOT / name for name in ELSEWHERE)]


def place(path: Path) -> PurePosixPath:
    """Return where the site has a file of the repository."""
    name = path.relative_to(ROOT).as_posix()
    if path.is_relative_to(DOCS):
        return PurePosixPath(path.relative_to(DOCS).as_posix())
    return PurePosixPath(ELSEWHERE.get(name, f"files/{name}"))


def links(page: Path) -> Iterator[tuple[re.Match[str], Path]]:
    """Yield the links of a page to files of the repository: the match, and the file."""
    for match in LINK.finditer(page.read_text(encoding="utf-8")):
        yield match, (page.parent / match[0]).resolve()


def on_site(page: Path) -> str:
    """Return a page of the repository with links as the site has them."""
    here, targets = place(page).parent, {match[0]: target for match, target in links(page)}
    return LINK.sub(lambda match: os.path.relpath(place(targets[match[0]]), here), page.read_text(encoding="utf-8"))


def help_page() -> str:
    """Return the help of every command, all options, as one page."""
    from beam_warp.cli import convert, main, validate

    charts = [("chart", study) for study in ("tracing", "materials", "reconstruct", "render", "delivery", "all")]
    words = [*((word,) for word in main.COMMANDS if word != "chart"), *charts]
    calls = [
        ("beam", main.main, ["--help"]),
        *((" ".join(("beam", *each)), main.main, [*each, "--help-all"]) for each in words),
        ("beam-convert", convert.main, ["--help"]),
        ("beam-convert inspect", convert.main, ["inspect", "--help"]),
        ("beam-validate", validate.main, ["--help"]),
        ("beam-validate --rules", validate.main, ["--rules"]),
    ]
    sections = []
    for name, command, arguments in calls:
        said = io.StringIO()
        plain = patch.dict(os.environ, COLUMNS=str(HELP_COLUMNS), NO_COLOR="1")
        with plain, redirect_stdout(said), suppress(SystemExit):
            command(arguments)
        lines = (wrap(line, HELP_COLUMNS) or [""] for line in said.getvalue().strip().splitlines())
        sections.append("\n".join([f"## {name}\n", "```text", *chain.from_iterable(lines), "```\n"]))
    return "# Commands\n\nThis page is what the commands print with `--help-all`.\n\n" + "\n".join(sections)


def reference() -> Pages:
    """Return the pages that are generated: the commands, the root, and every package that states public names."""
    pages = {PurePosixPath("reference/commands.md"): help_page()}
    for stub in sorted((ROOT / "beam_warp").rglob("__init__.pyi")):
        face = ".".join(stub.parent.relative_to(ROOT).parts)
        module = import_module(face)
        names = "\n".join(f"::: {face}.{name}\n" for name in module.__all__)
        pages[PurePosixPath(f"reference/{face}.md")] = f"# {face}\n\n{module.__doc__}\n\n{names}"
    return pages


def main() -> None:
    """Write all pages, and the files that they link to."""
    shutil.rmtree(OUT, ignore_errors=True)
    shutil.copytree(DOCS, OUT, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    pages: Pages = {place(page): on_site(page) for page in sources()} | reference()
    for path, text in pages.items():
        (OUT / path).parent.mkdir(parents=True, exist_ok=True)
        (OUT / path).write_text(text, encoding="utf-8")
    shutil.rmtree(SOURCES, ignore_errors=True)
    for folder in ("beam_warp", "schema", "converters", "kernels"):
        inside = SOURCES / "beam_warp" / ("" if folder == "beam_warp" else folder)
        shutil.copytree(ROOT / folder, inside, ignore=shutil.ignore_patterns("__pycache__"))
    for target in {target for page in sources() for _, target in links(page)}:
        if place(target).parts[0] == "files":
            (OUT / place(target)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(target, OUT / place(target))


if __name__ == "__main__":
    main()
