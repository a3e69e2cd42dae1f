"""What the site holds beside docs/: README, notebooks, reports and the Python reference; links into the repository.

Hooks of MkDocs (`mkdocs.yml`). A page outside docs/ keeps its links: those to pages of the site are turned into
links to these, and other files of the repository that pages link to are copied to `repository/`.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter
from traitlets.config import Config

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages of the site by their path in the repository; those of docs/ keep their names."""
GROUPS = ("reports/**/README.md", "reports/*/details.md", "models/**/README.md", "notebooks/*.ipynb")
LINK = re.compile(r"(?<!\\)(!?\[(?:[^\[\]]|\[[^\]]*\])*\]\()([^)\s#]+)?(#[^)\s]*)?(\))")
MOVING = "image/gif"
CODE = re.compile(r"(```.*?```)", re.DOTALL)
INLINE = re.compile(r"<pre.*?</pre>|<code>[^<]*</code>", re.DOTALL)
OPTION = re.compile(r"(?<![\w-])--?[a-z][\w.-]*")


def site_path(path: str) -> str | None:
    """Where a file of the repository is in the site; None for one that is not in it."""
    if path in PAGES:
        return PAGES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    room, _, rest = path.partition("/")
    report = room in ("reports", "models") and rest.endswith(("README.md", "/details.md"))
    if room == "notebooks" and rest.endswith(".ipynb"):
        return path.replace(".ipynb", ".md")
    return path if report else None


def repository_path(source: str) -> str:
    """Where a page of the site is in the repository."""
    back = {page: path for path, page in PAGES.items()}
    if source.startswith("notebooks/"):
        return source.replace(".md", ".ipynb")
    if source in back:
        return back[source]
    return source if (ROOT / source).is_file() and not source.startswith("reference/") else f"docs/{source}"


def target(page: str, link: str) -> str | None:
    """The file of the repository that a link of a page means; None for an address outside it."""
    if re.match(r"[a-z]+:", link):
        return None
    found = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    if (ROOT / found).is_dir():
        found = posixpath.join(found, "README.md")
    return found if (ROOT / found).is_file() else None


def text_of(path: str) -> str:
    return (ROOT / path).read_text()


def notebook(path: str) -> str:
    """A notebook with its outputs as Markdown, its pictures inside.

    The exporter knows no moving pictures; they become HTML. The theme lets tables scroll on a narrow screen, but not
    those that have a class, as pandas gives to its own.
    """
    content = nbformat.read(ROOT / path, as_version=4)
    for output in (output for cell in content.cells for output in cell.get("outputs", ())):
        data = output.get("data", {})
        if MOVING in data:
            data["text/html"] = f'<img alt="film" src="data:{MOVING};base64,{data[MOVING].strip()}">'
    exporter = MarkdownExporter(config=Config({"ExtractOutputPreprocessor": {"enabled": False}}))
    text = str(exporter.from_notebook_node(content)[0])
    return re.sub(r'<table [^>]*class="dataframe"[^>]*>', "<table>", text)


def python_reference() -> str:
    """A page with every public name, by its home."""
    import rfdropo_bayes

    lines = ["# Python", "", "`import rfdropo_bayes as rb`; [From Python](../python.md) shows how they are used.", ""]
    for name in sorted(rfdropo_bayes.__all__, key=str.lower):
        if name == "__version__":
            continue
        found = getattr(rfdropo_bayes, name)
        lines += [f"::: {found.__module__}.{found.__qualname__}", "    options:", f"      heading: rb.{name}", ""]
    return "\n".join(lines)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages from outside docs/, and the files that pages link to."""
    outside = [*PAGES, *sorted(str(p.relative_to(ROOT)) for group in GROUPS for p in ROOT.glob(group))]
    for path in outside:
        where = site_path(path)
        assert where is not None
        if path.endswith(".ipynb"):
            files.append(File.generated(config, where, content=notebook(path)))
        else:
            files.append(File.generated(config, where, abs_src_path=str(ROOT / path)))
    files.append(File.generated(config, "reference/python_api.md", content=python_reference()))
    known = {f.src_uri for f in files}
    pages = [*outside, *(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
    for page in pages:
        if not page.endswith(".md"):
            continue
        for match in LINK.finditer(CODE.sub("", text_of(page))):
            found = target(page, match[2]) if match[2] else None
            if found and site_path(found) is None and (where := f"repository/{found}") not in known:
                known.add(where)
                files.append(File.generated(config, where, abs_src_path=str(ROOT / found)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links at pages of the site and at copied files."""
    here = page.file.src_uri
    home = repository_path(here)

    def turned(match: re.Match[str]) -> str:
        if not match[2] or re.match(r"[a-z]+:", match[2]):  # an anchor of the page, an address, a picture inside
            return match[0]
        found = target(home, match[2])
        if found is None:  # a folder without a page is named, not linked
            folder = (ROOT / posixpath.dirname(home) / match[2]).is_dir()
            return match[1].lstrip("!").removeprefix("[").removesuffix("](") if folder else match[0]
        where = site_path(found) or f"repository/{found}"
        link = posixpath.relpath(where, posixpath.dirname(here) or ".")
        return f"{match[1]}{link}{match[3] or ''}{match[4]}"

    parts = CODE.split(markdown)
    return "".join(part if index % 2 else LINK.sub(turned, part) for index, part in enumerate(parts))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Keep options of commands whole."""
    return whole_options(html)


def whole_options(html: str) -> str:
    """A page whose options of commands do not break at their hyphens, where code stands in a line of text."""

    def whole(match: re.Match[str]) -> str:
        if match[0].startswith("<pre"):
            return match[0]
        return OPTION.sub(lambda option: f'<span class="option">{option[0]}</span>', match[0])

    return INLINE.sub(whole, html)
