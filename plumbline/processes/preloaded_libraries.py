"""What the warm process imports, from which workers are forked; imported by nothing else.

No engine is among the libraries: an engine that crashes when it is imported must crash in its worker.
Importing this module makes the process adopt what engines leave running, and end with its parent. Then it
kills its workers and whatever else is below it.
"""

import os
import signal
import warnings

import numpy  # noqa: F401
import pydantic  # noqa: F401
import scipy.integrate
import scipy.interpolate
import scipy.linalg
import scipy.optimize  # noqa: F401

import plumbline.processes.worker_process  # noqa: F401
from plumbline.processes.isolation import adopt_orphans, die_with_parent

warnings.filterwarnings("ignore", message="forkserver: waitpid returned")  # an orphan has ended
adopt_orphans()
die_with_parent(os.getppid(), signal.SIGTERM)
