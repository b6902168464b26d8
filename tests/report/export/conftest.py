"""Runs for all exporters."""

import pytest

from tests.report.export import bundled_run
from tests.report.export.small_run import write_run


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("exported"))


@pytest.fixture(scope="session")
def bundled(tmp_path_factory):
    """The folder of a run on a bundled scene."""
    return bundled_run.write_run(tmp_path_factory.mktemp("bundled"))
