"""Hooks of the documentation site (mkdocs.yml): links work as on GitHub, and the commands' help becomes a page.

Files of the repository that pages link to are put into the site at the same path, and links between docs/ and the rest
are rewritten to the pages' places in the site.
"""

import os
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from importlib.metadata import entry_points
from io import StringIO
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from armlink import cli

ROOT = Path(__file__).parent.parent
OUTSIDE = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "CITATION.cff",
    "examples/*.*",
    "notebooks/*.ipynb",
    "tests/models/*.*",
    "packaging/*.service",
)
"""Files of the site that lie outside docs/."""
HOME = {"README.md": "index.md"}
"""Pages that are not in the site, and the page that a link to them leads to instead."""
COMMANDS = "<!-- commands -->"
"""Replaced by the help of every command."""
LINK = re.compile(r"(\]\()([^)\s:#]+)((?:#[^)\s]*)?\))")
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files from outside docs/."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite relative links from places in the repository to places in the site; fill in the commands."""
    here = page.file.src_uri
    folder = PurePosixPath(here if page.file.generated_by else f"docs/{here}").parent

    def rewritten(link: re.Match[str]) -> str:
        opening, target, closing = link.groups()
        place = normpath(str(folder / target))
        place = HOME.get(place, place).removeprefix("docs/")
        return f"{opening}{relpath(place, str(PurePosixPath(here).parent))}{closing}"

    parts = FENCE.split(markdown)
    parts[::2] = [LINK.sub(rewritten, part) for part in parts[::2]]
    markdown = "".join(parts)
    return markdown.replace(COMMANDS, "\n\n".join(command_help())) if COMMANDS in markdown else markdown


def command_help() -> Iterator[str]:
    """A section for each command: its help, as a terminal of 80 columns shows it."""
    os.environ["COLUMNS"] = "80"
    for point in sorted(entry_points(group="armlink.commands"), key=lambda point: point.name):
        words, target = [[point.name]], point.load()
        if isinstance(target, typer.Typer):
            target.rich_markup_mode = None  # plain text, no boxes
            words += [[point.name, _name(command)] for command in target.registered_commands]
        for each in words:
            with redirect_stdout(StringIO()) as printed:
                cli.run([*each, "--help"])
            yield f"## armlink {' '.join(each)}\n\n```text\n{printed.getvalue().strip()}\n```"


def _name(command: typer.models.CommandInfo) -> str:
    return command.name or getattr(command.callback, "__name__", "").replace("_", "-")
