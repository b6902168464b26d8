"""Hooks of the documentation site (mkdocs.yml): formulas and links of its pages.

- Formulas become MathML, which browsers show by themselves: no script is loaded.
- Names of pages (docs/guide/data.md) and of files of e2rl/ become links.
"""

import re
from html import unescape

from latex2mathml.converter import convert
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

# No links are made in code, headings and links.
VERBATIM = re.compile(r"(<pre.*?</pre>|<h\d.*?</h\d>|<a .*?</a>)", re.DOTALL)
FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL
)
DOCUMENT = re.compile(r"(?:<code>)?\bdocs/([\w/-]+\.md)(?:</code>)?")
MODULE = re.compile(r"<code>(e2rl(?:/\w+)+)(?:\.py|/)</code>")
# What the converter reads otherwise than LaTeX does, and how it reads it right.
LATEX = (
    (re.compile(r"\\math(bb|cal|bf) (\w)"), r"\\math\1{\2}"),
    (re.compile(r"\\mathrm\{(\w)\}"), r"{\\mathrm \1}"),
    (re.compile(r"(?<=[a-z])\\_(?=[a-z])"), "_"),  # in \texttt
)
# The bar of a norm, which browsers would set apart as a relation.
BAR = re.compile(r"<mo>(&#x0007C;|&#x02016;)</mo>")


def on_page_content(html: str, page: Page, files: Files, **_: object) -> str:
    """The page with formulas as MathML and with links."""
    parts = VERBATIM.split(FORMULA.sub(mathml, html))
    return "".join(
        part if index % 2 else linked(part, page, files)
        for index, part in enumerate(parts)
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
    """HTML with links to the pages and modules that it names."""

    def document(match: re.Match[str]) -> str:
        target = files.get_file_from_path(match[1])
        if target is None or target.page is None:
            return match[0]  # tests/test_documents.py finds names of what is not there
        address = get_relative_url(target.url, page.url)
        return f'<a href="{address}">{target.page.title}</a>'

    def module(match: re.Match[str]) -> str:
        name = match[1].replace("/", ".")
        return f'<autoref identifier="{name}" optional>{match[0]}</autoref>'

    return MODULE.sub(module, DOCUMENT.sub(document, html))
