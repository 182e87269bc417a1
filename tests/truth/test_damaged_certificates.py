"""Certificates with random damage: refused, or a proof of what they say, which contains the true motion."""

import gzip
import json
import random
from collections import Counter
from functools import cache

import pytest

from plumbline.truth.certificate_file import MalformedCertificate, parse_certificate
from plumbline.truth.certificate_proof import certificate_digest
from tests.helpers.mutations import damaged_bytes, damaged_document, limited_time
from tests.helpers.stored_certificates import FOLDER, NAMES, QUANTITIES, stored_document

checker = pytest.importorskip("plumbline.truth.certificate_checker", reason="needs python-flint")
PROOF_SECONDS = 60.0  # s of CPU time; the slowest of the originals takes 2


@cache
def original(name):
    """Digest of a stored certificate's numbers, and the balls of each sample by its time."""
    certificate = parse_certificate(json.dumps(stored_document(name)).encode())
    return certificate_digest(certificate), samples(checker.enclose_motion(certificate))


def samples(enclosure):
    balls = (getattr(enclosure, name).reshape(len(enclosure.times), -1) for name in QUANTITIES)
    rows = zip(*balls, strict=True)
    return {t: [ball for row in own for ball in row] for t, own in zip(enclosure.times, rows, strict=True)}


def adjusted(document, draw):
    """A document whose candidate motion or sample times are changed a little, as a proof may survive."""
    steps = document["steps"]
    for _ in range(draw.choice((1, 2, 5))):
        step = draw.choice(steps)
        row = draw.choice(step[1:])
        match draw.randrange(6):
            case 0 | 1 if row:
                row[draw.randrange(len(row))] += draw.choice((-1, 1)) << draw.randrange(document["bits"] - 8)
            case 2:
                row.append(draw.randrange(-3, 4))
            case 3 if row:
                row.pop()
            case 4 if len(document["times"]) > 1:
                document["times"].pop(draw.randrange(len(document["times"])))
            case 5:
                document["scenario"] = draw.choice(("", "x", "f" * 64))
    return document


def mutant(name, draw):
    """Bytes of a damaged file."""
    document = stored_document(name)
    match draw.randrange(5):
        case 0:
            return damaged_bytes((FOLDER / f"{name}.json.gz").read_bytes(), draw)
        case 1:
            return damaged_bytes(json.dumps(document).encode(), draw)
        case 2:
            return json.dumps(damaged_document(document, draw)).encode()
    return gzip.compress(json.dumps(adjusted(document, draw)).encode())


def try_mutants(count, names, seed):
    """Count what becomes of damaged certificates; those that prove the same motion have to agree on it."""
    draw, outcomes = random.Random(seed), Counter()
    for k in range(count):
        name = names[k % len(names)]
        raw = mutant(name, draw)
        with limited_time(PROOF_SECONDS):
            try:
                certificate = parse_certificate(raw)
                balls = samples(checker.enclose_motion(certificate))
            except (MalformedCertificate, checker.Rejected) as error:
                outcomes[type(error).__name__] += 1
                continue
        outcomes["proved"] += 1
        digest, own = original(name)
        if certificate_digest(certificate) != digest:
            continue
        outcomes["of the same motion"] += 1
        for t in own.keys() & balls.keys():
            outcomes["samples"] += 1
            pairs = zip(own[t], balls[t], strict=True)
            assert all(one.overlaps(other) for one, other in pairs), f"mutant {k} of {name}, t = {t}"
    return outcomes


def test_damaged_certificates_prove_nothing_wrong():
    outcomes = try_mutants(24, NAMES[:2], 31)
    assert outcomes["MalformedCertificate"] and outcomes["of the same motion"], outcomes


@pytest.mark.full
@pytest.mark.timeout(3600)
def test_eight_hundred_damaged_certificates_prove_nothing_wrong():
    outcomes = try_mutants(800, NAMES, 32)
    assert outcomes["of the same motion"] > 150, outcomes
    assert min(outcomes["MalformedCertificate"], outcomes["Rejected"]) > 100, outcomes
    print(dict(outcomes))
