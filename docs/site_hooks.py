"""MkDocs hooks: root documents become pages, and links that leave docs/ become plain paths.

A code host follows a link from docs/ to src/ or examples/; the site holds no such files, so it prints the path instead.
"""

import re
from pathlib import Path, PurePosixPath
from posixpath import normpath
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = {name: f"{name.split('.')[0].lower()}.md" for name in ("ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md")}
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#:\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the documents of the repository's root."""
    for name, page in PAGES.items():
        text = LINK.sub(lambda link: _from_root(link), (ROOT / name).read_text())
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Point links at the pages of the site."""
    folder = PurePosixPath(page.file.src_uri).parent
    return LINK.sub(lambda link: _inside(link, folder), markdown)


def _from_root(link: re.Match[str]) -> str:
    text, target, anchor = link[1], link[2], link[3] or ""
    if target.startswith("docs/"):
        return f"[{text}]({target.removeprefix('docs/')}{anchor})"
    return f"[{text}](../{target}{anchor})"


def _inside(link: re.Match[str], folder: PurePosixPath) -> str:
    text, target, anchor = link[1], link[2], link[3] or ""
    path = normpath(folder / target)
    if not path.startswith("../"):
        return link[0]
    outside = path.removeprefix("../")
    if outside in PAGES:
        up = "../" * (len(folder.parts))
        return f"[{text}]({up}{PAGES[outside]}{anchor})"
    return text if outside in text else f"{text} (`{outside}`)"
