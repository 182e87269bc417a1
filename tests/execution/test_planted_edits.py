"""Mistakes of one line in real adapters: a run reports and names them, and accuses no control."""

from functools import cache

import pytest

from plumbline.judging.rows import Verdict
from tests.helpers.nightly_tests import fast_are, some_fast
from tests.helpers.planted_edits import EDITS, rows_of_run
from tests.helpers.requirements import require_engines

require_engines()

STATES = 20  # of 51 that a run compares: some mistakes act at few
DEFECTS = [edit for edit in EDITS if not edit.is_control]
CONTROLS = [edit for edit in EDITS if edit.is_control]


@cache
def attention(name):
    """The rows of all runs of one edit that need attention and are not on record."""
    (edit,) = [edit for edit in EDITS if edit.name == name]
    found = [row for run in edit.runs for row in rows_of_run(edit, *run, STATES)]
    unrecorded = [row for row in found if row.known_issue is None and row.verdict.needs_attention]
    return [row for row in unrecorded if row.verdict != Verdict.UNSUPPORTED]


def test_every_edit_fits_its_file():
    """By day, since the runs of most are left to the night."""
    assert not [edit.name for edit in EDITS if not edit.fits]


@pytest.mark.parametrize("edit", some_fast(DEFECTS, len(DEFECTS)))
def test_every_defect_is_reported(edit):
    assert attention(edit.name), f"nothing reports {edit.name}"


@pytest.mark.parametrize("edit", some_fast([d for d in DEFECTS if d.expected], len(DEFECTS)))
def test_every_defect_with_words_is_named(edit):
    names = {row.diagnosis for row in attention(edit.name) if row.diagnosis}
    assert any(edit.expected in name and "cannot distinguish" not in name for name in names), names


@pytest.mark.parametrize("edit", fast_are([CONTROLS[1].name], CONTROLS))
def test_no_control_is_accused(edit):
    assert not [row.reason for row in attention(edit.name)]
