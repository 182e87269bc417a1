"""Run the mutation tests: ``python -m tools.mutation reference_impl judging``."""

import sys

from tools.mutation.mutation import main

sys.exit(main())
