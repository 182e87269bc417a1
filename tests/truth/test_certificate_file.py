"""The reader of certificates: malformed, truncated and damaged files."""

import json
import random
from collections import Counter
from importlib.util import find_spec

import pytest

from plumbline.truth.certificate_file import MalformedCertificate, parse_certificate
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time
from tests.helpers.stored_certificates import FOLDER, many_joints, stored_document
from tests.helpers.tables import table


def parsed(document):
    return parse_certificate(json.dumps(document).encode())


def test_a_truncated_file_is_malformed():
    raw = (FOLDER / "one-ball.json.gz").read_bytes()
    for length in (0, 1, 10, len(raw) // 2, len(raw) - 4):
        with pytest.raises(MalformedCertificate, match="not a complete gzip or JSON file"):
            parse_certificate(raw[:length])


@pytest.mark.parametrize(
    "change, message",
    table(__file__),
)  # fmt: skip
def test_a_malformed_field_is_named(change, message):
    with pytest.raises(MalformedCertificate, match=message):
        parsed(stored_document("one-ball") | change)


@pytest.mark.skipif(not find_spec("flint"), reason="the truth tools are not installed")
def test_damaged_documents_are_malformed_or_rejected():
    """No other exception, whatever the document holds."""
    from plumbline.truth import certificate_checker as checker

    document, draw, outcomes = stored_document("one-ball"), random.Random(8), Counter()
    for _ in range(40):
        damaged = json.dumps(damaged_document(document | {"steps": document["steps"][:1]}, draw)).encode()
        with limited_time():
            try:
                checker.enclose_motion(parse_certificate(damaged))
            except (MalformedCertificate, checker.Rejected) as error:
                outcomes[type(error)] += 1
    assert outcomes[MalformedCertificate] and outcomes[checker.Rejected], outcomes


@pytest.mark.parametrize(
    "change", [{"bits": 16}, {"bits": 2000}, {"time_exponent": -60}, {"time_exponent": 60}]
)
def test_the_limits_themselves_are_valid(change):
    assert parsed(stored_document("one-ball") | change)


@pytest.mark.parametrize("most", [(100, 0, 1), (1, 100, 1), (1, 0, 401)], ids=["bodies", "springs", "terms"])
def test_as_much_as_is_allowed_is_valid(most):
    """And one more is not."""
    assert parsed(many_joints(*most)).nq
    more = (n + (n > 1) for n in most)
    with pytest.raises(MalformedCertificate, match=r"expected .*(100|401)"):
        parsed(many_joints(*more))


def test_a_compressed_file_is_read_as_its_text():
    raw = (FOLDER / "one-ball.json.gz").read_bytes()
    assert parse_certificate(raw).steps == parsed(stored_document("one-ball")).steps


def test_bytes_after_the_compressed_data_are_malformed():
    raw = (FOLDER / "one-ball.json.gz").read_bytes()
    for rest in (b"\0", b"x" * 1000, raw):
        with pytest.raises(MalformedCertificate, match="bytes follow the end of the compressed data"):
            parse_certificate(raw + rest)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a":' * 100_000,
        '{"bits": ' + "9" * 100_000 + "}",
        '{"bits": 1e999999999}',
        '{"bits": -' + "9" * 3000 + "}",
        "[1] [2]",
        '{"format": "\\ud800"}',
        "NaN",
    ],
    ids=["lists", "objects", "digits", "exponent", "negative", "twice", "surrogate", "NaN"],
)
def test_extreme_texts_are_malformed(text):
    with limited_time(1.0), pytest.raises(MalformedCertificate):
        parse_certificate(text.encode())


def test_extreme_numbers_are_malformed_or_rejected():
    document = stored_document("one-ball")
    changes = [{"mass": [f"0x1p{e}"]} for e in ("99999999999", "1023", "-1074")]
    changes += [{"times": ["0x1p1023"]}, {"omega": [["0x1p1000"] * 3]}, {"gravity": ["-0x1.fp1023"] * 3}]
    changes += [{"steps": [[10**n, *document["steps"][0][1:]]]} for n in (300, 4000)]
    changes += [{"steps": [[1, *[[10**4000]] * 7]]}, {"bits": 2000, "time_exponent": -60}]
    checker = pytest.importorskip("plumbline.truth.certificate_checker")
    for change in changes:
        with limited_time(), pytest.raises((MalformedCertificate, checker.Rejected)):
            checker.enclose_motion(parsed(document | change))


def test_damaged_files_are_malformed_or_read_whole():
    """The gzip checksum covers the content, not the header."""
    raw, draw = (FOLDER / "one-ball.json.gz").read_bytes(), random.Random(9)
    outcomes = Counter()
    for _ in range(100):
        with limited_time():
            try:
                found = parse_certificate(damaged_bytes(raw, draw))
            except MalformedCertificate:
                outcomes["malformed"] += 1
            else:
                assert found.steps == parse_certificate(raw).steps
    assert outcomes["malformed"] > 50
