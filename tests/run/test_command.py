"""What is typed reaches Hydra as it was meant."""

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from e2rl.run.command import with_path

PATHS = {  # typed; the value that is read
    "data.path=~/logs/x.zip": str(Path.home() / "logs" / "x.zip"),
    "data.path=/data/łogs ü/fährten.zip": "/data/łogs ü/fährten.zip",
    "data.path=/data/o'neill é (1).zip": "/data/o'neill é (1).zip",
    r"data.path=/data/a\ü": r"/data/a\ü",
    r"data.path=/data/a\\ü\'b\\'c\\": r"/data/a\\ü\'b\\'c\\",
    "prior.checkpoint=~/a=b.pt": str(Path.home() / "a=b.pt"),
}


@pytest.mark.parametrize("typed", PATHS)
def test_a_path_is_read_whatever_letters_it_has(typed):
    override = OverridesParser.create().parse_override(with_path(typed))
    assert override.value() == PATHS[typed]


@pytest.mark.parametrize(
    "typed",
    ["seeds=[0,1]", "data=bundled", "+egos={idm:{ego:idm}}", "~data", "-m", "name='ü'"],
)
def test_anything_else_stays_as_it_is(typed):
    assert with_path(typed) == typed
