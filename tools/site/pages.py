"""Hooks of the documentation site (mkdocs.yml): what its pages share with other
documents, formulas and links.

- `<!-- include FILE: HEADING -->` in a page stands for the section `## HEADING` of
  FILE, a document of the repository; without a HEADING for what FILE says before its
  first section. Thus nothing is written twice.
- Formulas become MathML, which browsers show by themselves: no script is loaded.
- Names of documents, of sections of docs/method.md and of files of e2rl/ become links
  to their pages.
"""

import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from markdown.extensions.toc import slugify
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

ROOT = Path(__file__).parents[2]
INCLUDE = re.compile(r"^<!-- include (\S+):(?: (.+?))? -->$", re.MULTILINE)
SECTION = re.compile(r"^## (.+)$", re.MULTILINE)
VERBATIM = re.compile(
    r"(<pre.*?</pre>|<h\d.*?</h\d>|<a .*?</a>)", re.DOTALL
)  # no links in code, headings and links
FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL
)
DOCUMENT = re.compile(
    r"(?:<code>)?\bdocs/((?:notes/|how-to/)?[\w-]+)\.md(?:</code>)?(?:, sections? (\d+))?(?! to \d)"
)
METHOD = "concepts/index.md"  # stands for docs/method.md as a whole
NUMBER = re.compile(r"\bsection (\d+)")
MODULE = re.compile(r"<code>(e2rl(?:/\w+)+)(?:\.py|/)</code>")
LATEX = (  # what the converter reads otherwise than LaTeX does, and how it reads it right
    (re.compile(r"\\math(bb|cal|bf) (\w)"), r"\\math\1{\2}"),
    (re.compile(r"\\mathrm\{(\w)\}"), r"{\\mathrm \1}"),
    (re.compile(r"(?<=[a-z])\\_(?=[a-z])"), "_"),  # in \texttt
)
BAR = re.compile(
    r"<mo>(&#x0007C;|&#x02016;)</mo>"
)  # of a norm, which browsers would set apart as a relation


def sections(file: str) -> dict[str | None, str]:
    """The sections of a document by their headings; None: what stands before the first,
    without the title."""
    title, *parts = SECTION.split((ROOT / file).read_text())
    found: dict[str | None, str] = {None: re.sub(r"\A# .+\n", "", title)}
    return found | {
        name: f"## {name}{text}"
        for name, text in zip(parts[::2], parts[1::2], strict=True)
    }


def included(match: re.Match[str]) -> str:
    """The section that an include stands for."""
    file, heading = match.groups()
    try:
        return sections(file)[heading]
    except (OSError, KeyError) as error:
        raise PluginError(
            f"{match.group()}: no such section; compare it with the headings of {file}"
        ) from error


def on_page_markdown(markdown: str, **_: object) -> str:
    """The text of a page with its includes."""
    return INCLUDE.sub(included, markdown)


def on_page_content(html: str, page: Page, files: Files, **_: object) -> str:
    """The page with formulas as MathML and with links."""
    html = FORMULA.sub(mathml, html)
    return "".join(
        part if index % 2 else linked(part, page, files)
        for index, part in enumerate(VERBATIM.split(html))
    )


def mathml(match: re.Match[str]) -> str:
    """A formula of LaTeX as MathML."""
    _, kind, latex = match.groups()
    latex = unescape(latex)
    for pattern, replacement in LATEX:
        latex = pattern.sub(replacement, latex)
    formula = convert(latex, display="inline" if kind == "(" else "block")
    return BAR.sub(r'<mo lspace="0" rspace="0">\1</mo>', formula)


def linked(html: str, page: Page, files: Files) -> str:
    """HTML with links to the documents, sections and modules that it names."""

    def link(file: str, anchor: str, text: str) -> str:
        target = files.get_file_from_path(file)
        if target is None or target.page is None:
            raise PluginError(
                f"{page.file.src_uri} names docs/{file}, which is no page"
            )
        text = text or f"{target.page.title}"
        return f'<a href="{get_relative_url(target.url, page.url)}{anchor}">{text}</a>'

    def document(match: re.Match[str]) -> str:
        name, number = match.groups()
        if name != "method":
            return link(f"{name}.md", "", "")
        return (
            method(number, f"The method, section {number}")
            if number
            else link(METHOD, "", "The method")
        )

    def method(number: str, text: str) -> str:
        file, anchor = method_pages(files)[number]
        return link(file, anchor, text)

    html = DOCUMENT.sub(document, html)
    if page.file.src_uri.startswith("concepts/"):
        html = NUMBER.sub(lambda match: method(match[1], match[0]), html)
    return MODULE.sub(
        lambda match: (
            f'<autoref identifier="{match[1].replace("/", ".")}">{match[0]}</autoref>'
        ),
        html,
    )


def method_pages(files: Files) -> dict[str, tuple[str, str]]:
    """The page and anchor of every numbered section of docs/method.md."""
    pages = {}
    for file in files.documentation_pages():
        if file.src_uri.startswith("concepts/"):
            for name, heading in INCLUDE.findall(file.content_string):
                if name == "docs/method.md" and heading[:1].isdigit():
                    pages[heading.split(".")[0]] = (
                        file.src_uri,
                        "#" + slugify(heading, "-"),
                    )
    return pages
