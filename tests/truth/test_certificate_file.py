"""The reader of certificates: malformed, truncated and damaged files."""

import json
import random
from collections import Counter
from importlib.util import find_spec

import pytest

from plumbline.truth.certificate_file import MalformedCertificate, parse_certificate
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time
from tests.helpers.stored_certificates import FOLDER, many_joints, stored_document


def parsed(document):
    return parse_certificate(json.dumps(document).encode())


def test_a_truncated_file_is_malformed():
    raw = (FOLDER / "one-ball.json.gz").read_bytes()
    for length in (0, 1, 10, len(raw) // 2, len(raw) - 4):
        with pytest.raises(MalformedCertificate, match="not a complete gzip or JSON file"):
            parse_certificate(raw[:length])


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "x"}, "format: expected the text"),
        ({"version": 1}, "version: expected 2"),
        ({"mass": ["nan"]}, "mass: expected finite doubles"),
        ({"mass": [0.5]}, "mass: expected finite doubles"),
        ({"omega": [["0x1p0", 0.5, "0x1p0"]]}, "omega: expected finite doubles"),
        ({"mass": ["-0x1p0"]}, "mass: expected positive"),
        ({"mass": ["0x1p0", "0x1p0"]}, r"mass: expected finite doubles as '0x1.8p\+0', shape \(1,\)"),
        ({"inertia": None}, "inertia: expected finite doubles"),
        ({"inertia": [[["0x1p0"] * 3, ["0x0p0"] * 3, ["0x0p0"] * 3]]}, "inertia: expected symmetric"),
        ({"kind": []}, "kind: expected 1 to 100 of rod, free, ball, .*, not welds alone"),
        ({"kind": ["weld"]}, "kind: expected 1 to 100 of"),
        ({"kind": ["spring"]}, "kind: expected 1 to 100 of"),
        ({"kind": [["ball"]]}, "kind: expected 1 to 100 of"),
        ({"far": [0]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [-2]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [-1, 0]}, "far: expected of each joint -1 or a body before it"),
        ({"far": [True]}, "far: expected of each joint -1 or a body before it"),
        ({"springs": [[0, 1]]}, "springs: expected at most 100 pairs of bodies, -1 the world"),
        ({"springs": [[0]]}, "springs: expected at most 100 pairs of bodies, -1 the world"),
        ({"springs": [[0, -1]]}, "spring_point: expected finite doubles"),
        ({"kind": ["rod"], "stiffness": [["0x1p0", "0x0p0"]]}, "stiffness: expected zeros of rods and"),
        ({"stiffness": [["0x1p0", "0x0p0"]]}, r"steps\[0\]: expected a positive length, then 9 lists"),
        ({"springs": [[0, -1]] * 101}, "springs: expected at most 100 pairs of bodies, -1 the world"),
        ({"kind": ["rod"], "armature": [["0x1p0", "0x0p0"]]}, "armature: expected zeros of rods and"),
        ({"kind": ["free"], "damping": [["0x1p0", "0x0p0"]]}, "damping: expected zeros of rods and"),
        ({"kind": ["ball", "free"], "far": [-1, 0]}, "far: expected of each joint -1 or a body before it"),
        ({"springs": [[0, -2]]}, "springs: expected at most 100 pairs of bodies, -1 the world"),
        ({"mass": ["0x0p0"]}, "mass: expected positive"),
        ({"bits": 2001}, "bits: expected an integer from 16 to 2000"),
        ({"bits": 15}, "bits: expected an integer from 16 to 2000"),
        ({"time_exponent": 61}, "time_exponent: expected an integer from -60 to 60"),
        ({"steps": [[1, *[[1] * 402] * 7]]}, r"steps\[0\]: expected lists of at most 401"),
        ({"mass": ["0x1p-400"]}, "mass: expected finite doubles .* not below 1e-100"),
        ({"bits": 110.0}, "bits: expected an integer from 16 to"),
        ({"bits": True}, "bits: expected an integer"),
        ({"time_exponent": 100}, "time_exponent: expected an integer from -60 to 60"),
        ({"times": ["0x0p0", "0x0p0"]}, "times: expected ascending"),
        ({"times": []}, "times: expected ascending"),
        ({"scenario": 7}, "scenario: expected a digest"),
        ({"scenario": "a" * 300}, "scenario: expected a digest"),
        ({"steps": []}, "steps: expected a list of steps"),
        ({"steps": [[1]]}, r"steps\[0\]: expected a positive length, then 7 lists"),
        ({"steps": [[0, *[[1]] * 7]]}, r"steps\[0\]: expected a positive length"),
        ({"steps": [[1, *[[1.0]] * 7]]}, r"steps\[0\]: expected lists of at most"),
    ],
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
