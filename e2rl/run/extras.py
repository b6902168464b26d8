"""How the optional libraries of e2rl are installed."""

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

CHECKOUT = Path(__file__).parents[2]
EXTRA = re.compile(
    r"(?P<requirement>[^;]+?)\s*;.*\bextra == ['\"](?P<extra>[\w-]+)['\"]"
)


def how_to_install(extra: str) -> str:
    """Returns the command that installs an extra of pyproject.toml here, for a message.

    e2rl is in no registry: in a checkout it is installed from there, elsewhere the
    libraries are named.
    """
    if (CHECKOUT / "pyproject.toml").is_file():
        place = "." if Path.cwd() == CHECKOUT else str(CHECKOUT)
        return f"install its extra: pip install -e {quoted(f'{place}[{extra}]')}"
    libraries = " ".join(map(quoted, requirements(extra)))
    return f"install what its extra {extra} names: pip install {libraries}"


def requirements(extra: str) -> list[str]:
    """Returns the requirements of an extra, as the installed package has them."""
    try:
        lines = requires("e2rl") or []
    except PackageNotFoundError:
        lines = []
    missing = [
        match
        for match in map(EXTRA.fullmatch, lines)
        if match and match["extra"] == extra
    ]
    return [match["requirement"] for match in missing]


def quoted(text: str) -> str:
    """Returns the text in single quotes, for any shell that expands brackets."""
    return f"'{text}'" if "'" not in text else shlex.quote(text)
