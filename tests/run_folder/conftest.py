"""Fixtures of the tests of the run folder."""

from tests.report.conftest import usual_run as usual_run
