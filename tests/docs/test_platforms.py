"""The table of platforms is what markers and code say, and says of this machine what it is."""

import platform
import sys

import numpy as np

from plumbline.truth.step_formulas import HAS_EXTENDED_PRECISION
from tests.helpers import ROOT
from tools.platform_table import PLATFORMS, absent_packages, table

PAGE = ROOT / "docs/platforms.md"


def test_the_page_has_the_table():
    assert "\n".join(table()) in PAGE.read_text(encoding="utf-8")


def test_markers_of_packages_are_in_the_table():
    windows, linux = PLATFORMS[-1], PLATFORMS[0]
    assert absent_packages("all", windows, "3.11") == ["pin"]
    assert absent_packages("truth", windows, "3.11") == ["heyoka"]
    assert absent_packages("all", linux, "3.15") == ["exudyn"]
    assert absent_packages("all", linux, "3.11") == []


def test_this_machine_is_as_the_table_says():
    processors = {"x86_64": "x86-64", "AMD64": "x86-64", "aarch64": "arm64", "arm64": "arm64"}
    here = (sys.platform, processors.get(platform.machine(), ""))
    for one in PLATFORMS:
        if (one.sys_platform, one.processor) == here:
            assert one.long_double_bits == np.finfo(np.longdouble).nmant + 1
            row = next(line for line in table() if line.startswith(f"| {one.system}, {one.processor}"))
            assert ("no extended precision" in row) is not HAS_EXTENDED_PRECISION
            return
    assert here[1] == "" or sys.platform not in {one.sys_platform for one in PLATFORMS}
