"""The processor: its name and what results depend on."""

import pytest

from plumbline.processes import processor


@pytest.mark.parametrize(
    ("lines", "name", "features"),
    [
        (
            ["processor : 0", "model name : A 1", "flags : fma", "cpu MHz : 1200.1"],
            "A 1",
            "flags : fmamodel name : A 1",
        ),
        (["CPU part : 0xd0c", "Features : asimd"], None, "CPU part : 0xd0cFeatures : asimd"),
        ([], None, None),
    ],
    ids=["x86", "Arm", "not Linux"],
)
def test_of_a_machine(monkeypatch, lines, name, features):
    """The clock rate is not among the features: it changes while a run goes on."""
    monkeypatch.setattr(processor, "_cpuinfo", lambda: lines)
    machine = processor.platform.processor() or processor.platform.machine()
    assert processor.processor_name() == (name or machine)
    assert processor.processor_features() == (features or machine)


def test_of_this_machine():
    assert processor.processor_name() and processor.processor_features()
