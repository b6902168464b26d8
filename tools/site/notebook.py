"""Hook of the documentation site (mkdocs.yml): docs/tutorial.ipynb as a page, in the
site's own style.

The repository holds the notebook without outputs. With E2RL_EXECUTE=true in the
environment it is run first, which takes some two minutes, and the page shows what its
cells print and draw.
"""

import json
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

NOTEBOOK = "tutorial.ipynb"
PAGE = "tutorial.md"
PICTURES = ("image/png", "image/gif")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the page to those of docs/; the notebook itself can be downloaded."""
    path = Path(config.docs_dir) / NOTEBOOK
    notebook = json.loads(path.read_text())
    if config.extra["execute"]:
        notebook = executed(path)
    files.append(File.generated(config, PAGE, content=page(notebook)))


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Links to the notebook lead to its page here; on a code host they open the notebook."""
    if page.file.src_uri == PAGE:
        return markdown
    return markdown.replace(f"{NOTEBOOK})", f"{PAGE})")


def executed(path: Path) -> dict:
    """The notebook with the outputs of its cells, run in its folder."""
    import nbformat  # of the extra test, as nbclient is
    from nbclient import NotebookClient

    node = nbformat.read(path, as_version=4)
    NotebookClient(
        node, timeout=600, resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    return node


def page(notebook: dict) -> str:
    """A notebook as Markdown: text, code and what it gave."""
    parts = []
    for number, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        parts.append(
            f"```python\n{source}\n```" if cell["cell_type"] == "code" else source
        )
        parts += [shown(output) for output in cell.get("outputs", [])]
        if number == 0:
            parts.append(f"[Download the notebook]({NOTEBOOK})")
    return "\n\n".join(parts)


def shown(output: dict) -> str:
    """What a cell printed, or the picture that it drew."""
    data = output.get("data", {})
    for kind in PICTURES:
        if kind in data:
            return f"![output](data:{kind};base64,{''.join(data[kind].split())})"
    return f"```text\n{''.join(output.get('text', data.get('text/plain', ''))).rstrip()}\n```"
