"""`python tools/licences.py > docs/licences.md`: what e2rl installs, and under which licences, as the packages say.

Read from the metadata of the packages that are installed here; nothing is looked up elsewhere. Packages of an extra
that are not installed are named as such.
"""

import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = "e2rl"
LONGEST = 60  # characters of a field that names a licence; longer ones are its text
FOLDERS = ("", "licenses/")  # in which metadata hold the texts
CLASSIFIER = "License :: "
HEAD = """# Licences

e2rl is under Apache-2.0. This is what it installs, with the licence that each package's metadata names, as
`python tools/licences.py` found it: here with a CPU build of torch on Linux. Builds for CUDA bring NVIDIA's libraries,
under NVIDIA's own licences.
"""


def licence_of(package: Distribution) -> str:
    """The licence that a package's metadata names: an SPDX expression, a short text or its classifiers; else the first
    line of its text."""
    about = package.metadata
    text = about.get("License-Expression") or about.get("License") or ""
    if text and len(text) <= LONGEST and "\n" not in text and text.upper() != "UNKNOWN":
        return text
    classes = [line.rpartition(" :: ")[2] for line in about.get_all("Classifier", ()) if line.startswith(CLASSIFIER)]
    texts = (package.read_text(folder + name) for name in about.get_all("License-File", ()) for folder in FOLDERS)
    begins = [line.strip() for each in (text, *texts) for line in (each or "").splitlines() if line.strip()]
    return ", ".join(classes) or (begins[0][:LONGEST] if begins else "not named")


def required(name: str, extras: frozenset[str]) -> Iterator[tuple[str, frozenset[str]]]:
    """(name, extras) of what a package with some extras asks for on this machine."""
    for requirement in map(Requirement, distribution(name).requires or ()):
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras | {""}):
            yield canonicalize_name(requirement.name), frozenset(requirement.extras)


def closure(extra: str = "") -> tuple[dict[str, Distribution], set[str]]:
    """Packages by name that e2rl with an extra brings, and names of those that are not installed."""
    found: dict[str, Distribution] = {}
    missing: set[str] = set()
    left, seen = [*required(ROOT, frozenset({extra} - {""}))], set()
    while left:
        name, extras = one = left.pop()
        if one in seen:
            continue
        seen.add(one)
        try:
            if name != ROOT:
                found[name] = distribution(name)
            left += required(name, extras)
        except PackageNotFoundError:
            missing.add(name)
    return found, missing


def table(packages: dict[str, Distribution]) -> str:
    """Markdown, a row a package."""
    rows = [(name, each.version, licence_of(each).replace("|", "/")) for name, each in sorted(packages.items())]
    lines = ["| package | version | licence |", "| --- | --- | --- |"]
    return "\n".join(lines + [f"| {' | '.join(row)} |" for row in rows])


def main() -> None:
    core, missing = closure()
    if missing:
        sys.exit(f"error: {', '.join(sorted(missing))}: not installed; install e2rl with its dependencies first")
    parts = [HEAD, "## Always\n", table(core)]
    for extra in sorted(distribution(ROOT).metadata.get_all("Provides-Extra", ())):
        found, missing = closure(extra)
        more = {name: package for name, package in found.items() if name not in core}
        parts += [f"\n## Extra `{extra}`\n", table(more) if more else "Nothing more."]
        if missing:
            parts.append(f"\nNot installed where this list was made: {', '.join(sorted(missing))}.")
    print("\n".join(parts))


if __name__ == "__main__":
    main()
