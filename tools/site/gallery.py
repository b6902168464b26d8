"""Hook of the documentation site (mkdocs.yml): the failure report that docs/guide/report.md shows.

The repository does not hold it. With E2RL_EXECUTE=true in the environment the commands of the page make it, which takes
a minute or two; otherwise the page says how.
"""

import os
import re
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGE, REPORT = "guide/report.md", "gallery.html"
PLACE = "<!-- the report -->"  # of the report in the page
SHOWN = """[**Open the report**](../assets/gallery.html){target=_blank} in a tab of its own.

<iframe src="../assets/gallery.html" title="A failure report" class="report"></iframe>"""
LEFT_OUT = "This copy of the documentation was built without it; `E2RL_EXECUTE=true mkdocs build` includes it."
COMMANDS = re.compile(r"```bash\n(.+?)^```$", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the report to the files of the site."""
    if config.extra["execute"]:
        text = (Path(config.docs_dir) / PAGE).read_text()
        files.append(File.generated(config, f"assets/{REPORT}", content=report(text)))


def on_page_markdown(
    markdown: str, page: Page, config: MkDocsConfig, **_: object
) -> str:
    """The page with the report, or with how it is made."""
    if page.file.src_uri != PAGE:
        return markdown
    return markdown.replace(PLACE, SHOWN if config.extra["execute"] else LEFT_OUT)


@cache  # `mkdocs serve` builds after every change of a page
def report(text: str) -> str:
    """The report that the commands of a page write; raises PluginError where they do not."""
    folder = str(Path(sys.executable).parent)
    variables = os.environ | {"PATH": os.pathsep.join([folder, os.environ["PATH"]])}
    with tempfile.TemporaryDirectory() as place:
        command = [
            "bash",
            "-euo",
            "pipefail",
            "-c",
            COMMANDS.search(text, text.index(PLACE))[1],
        ]
        done = subprocess.run(
            command, cwd=place, env=variables, capture_output=True, text=True
        )
        if done.returncode:
            raise PluginError(
                f"{PAGE}: its commands failed\n{done.stdout}{done.stderr}"
            )
        return (Path(place) / REPORT).read_text()
