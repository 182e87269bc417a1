"""What later processes find in the user's cache folder, and what damage does."""

import os

import numpy as np
import pytest

from plumbline.processes.user_cache import CheckedFiles, DamagedFile, content_key, recall, remember
from plumbline.scenario.yaml_reader import read_yaml
from plumbline.truth import taylor
from tests.helpers.catalogue import catalogue_scenario

pytestmark = pytest.mark.usefixtures("nothing_remembered")


def stored_files(own_cells):
    return sorted((own_cells.parent / "remembered").iterdir())


def test_a_value_is_recalled_by_its_content_only(own_cells):
    key = content_key("a", b"bc")
    assert key != content_key("ab", b"c")
    assert recall(key) is None
    remember(key, {"x": 1.5})
    assert recall(key) == {"x": 1.5}
    assert recall(content_key("ab", b"c")) is None


@pytest.mark.parametrize("damage", [b"", b"x" * 40, None])
def test_a_damaged_file_is_as_good_as_none(own_cells, damage):
    key = content_key("a")
    remember(key, 1)
    (path,) = stored_files(own_cells)
    path.write_bytes(path.read_bytes()[:-1] if damage is None else damage)
    assert recall(key) is None
    with pytest.raises(DamagedFile):
        CheckedFiles(path.parent).read(path.name)
    remember(key, 2)
    assert recall(key) == 2


def test_a_folder_that_cannot_be_made_costs_time_only(own_cells, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PLUMBLINE_CACHE", str(tmp_path / "file"))
    remember(content_key("a"), 1)
    assert recall(content_key("a")) is None


def test_the_least_used_files_are_removed(tmp_path):
    files = CheckedFiles(tmp_path)
    for age, name in enumerate("abc"):
        files.write(name, b"x" * 10)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    files.read("c")
    files.trim(2 * 42)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]


def test_a_parsed_file_is_recalled_and_a_changed_one_parsed(own_cells, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: [1, 2]\n")
    first, again = read_yaml(path), read_yaml(path)
    assert first == again and first.data == {"a": [1, 2]} and len(stored_files(own_cells)) == 1
    path.write_text("a: [1, 3]\n")
    assert read_yaml(path).data == {"a": [1, 3]}


def test_a_compiled_integrator_is_recalled_with_equal_bits(own_cells):
    pytest.importorskip("heyoka")
    s = catalogue_scenario("double-tumbling-balls")
    runs = []
    for count in (1, 1):
        taylor._compiled_integrator.cache_clear()
        runs.append(np.asarray(taylor.simulate_taylor(s.model, s.state, s.times[:5])[0].r, float))
        names = [path for path in stored_files(own_cells) if path.stat().st_size > 1e5]
        assert len(names) == count
    taylor._compiled_integrator.cache_clear()
    assert np.array_equal(runs[0], runs[1])
