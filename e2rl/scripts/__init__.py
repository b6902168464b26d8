"""The commands as modules: train, evaluate and conf. A wheel has them in this folder, a
checkout at its top level."""

from pathlib import Path

__path__.append(
    str(Path(__file__).parents[2])
)  # this file itself is no part of the wheel
