"""One run for all exporters."""

import pytest

from tests.report.export.small_run import write_run


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("exported"))
