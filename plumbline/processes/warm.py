"""What the warm process imports, from which workers are forked; imported by nothing else.

No engine is among the libraries: an engine that crashes when it is imported must crash in its worker.
Importing this module makes the process end with its parent, and so its workers.
"""

import os

import numpy  # noqa: F401
import pydantic  # noqa: F401
import scipy.integrate
import scipy.interpolate
import scipy.linalg
import scipy.optimize  # noqa: F401

from plumbline.processes.isolation import die_with_parent

die_with_parent(os.getppid())
