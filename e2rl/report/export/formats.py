"""The formats of other tools, by name (docs/guide/export.md)."""

from collections.abc import Callable, Iterator
from pathlib import Path

from e2rl.report.export.episode import Episode
from e2rl.run.config import library

# Modules of this package; what they import is in the extra of the format's name.
FORMATS = {
    "commonroad": "commonroad_writer",
    "openscenario": "openscenario",
    "scenarionet": "scenarionet_writer",
    "sumo": "sumo_writer",
    "mcap": "mcap_writer",
    "rerun": "rerun_writer",
    "npz": "archive",
}
OPEN_EGO = ("commonroad", "openscenario")  # in which the ego's place may be left open
SINGLE = ("commonroad", "mcap", "rerun")  # whose file of an episode needs no other


def writer_of(name: str, option: str) -> Callable[..., Iterator[tuple[Episode, Path]]]:
    """Returns `write` of a format, one of FORMATS; InputError, beginning with the
    option that asks for it, where its library is missing."""
    module = library(
        f"e2rl.report.export.{FORMATS[name]}", f"{option} {name}", extra=name
    )
    return module.write
