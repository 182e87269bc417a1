"""Rules for every test: a skip in continuous integration is an error unless it is listed here."""

import os
import re

import pytest

ALLOWED_SKIPS = {  # pattern of the skip's reason: why continuous integration cannot run the test
    r"root may read everything": "the test needs a user without root's permissions",
}


def _is_unexpected(report):
    if not (os.environ.get("CI") and report.skipped) or hasattr(report, "wasxfail"):
        return False
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return not any(re.search(pattern, reason) for pattern in ALLOWED_SKIPS)


def _fail(report):
    report.outcome = "failed"
    report.longrepr = f"skipped without being listed in tests/conftest.py: {report.longrepr}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if _is_unexpected(report):
        _fail(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    report = yield
    if _is_unexpected(report):
        _fail(report)
    return report
