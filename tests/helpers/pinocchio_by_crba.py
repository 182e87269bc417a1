"""Pinocchio's steps without aba, whose loss of digits is a known issue."""

import sys
from contextlib import contextmanager
from unittest.mock import patch


@contextmanager
def steps_by_crba(adapter):
    """Let the adapter's chains find accelerations by crba and a dense solve."""
    module = sys.modules[type(adapter).__module__]
    chain = module.PinocchioChain
    with patch.object(module, "PinocchioChain", lambda model, _, *more: chain(model, "crba", *more)):
        yield
