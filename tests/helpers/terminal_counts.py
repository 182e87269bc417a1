"""Counts in the last line of a run."""

import re


def agreed(output):
    """Number of rows that agree, 0 where the run says none."""
    found = re.search(r"(\d+) agree\b", output)
    return int(found[1]) if found else 0
